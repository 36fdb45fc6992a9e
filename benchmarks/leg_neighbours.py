"""Muscles that touch over a squat of the whole leg: overlap and gaps.

    python benchmarks/leg_neighbours.py [--frames 0:37:6] [--model rbf] [--muscles A,B] [--without]

Runs a scene of ``data/leg`` with tendons (``leg_tendons.py``) through its whole motion and measures
the shown surfaces of the chosen frames by exact distances, which the solver does not use: how deep
a vertex of one muscle lies in another, and for vertices nearer than the threshold at rest how much
farther they are now (RMS by pair). Both are listed by pair, the worst first, and as 95th
percentiles over pairs and frames. What two bones hold on both sides is counted apart: where a
vertex and what it meets of the other muscle both go along with bones, these decide how far they
come apart or into each other. Beside the gap stands the RMS over the vertices that the neighbour
still faces, without what slid past its rim (the way to the neighbour is more than 60 degrees off
the vertex's own normal). ``--without`` measures the same run without contact.
"""

import argparse
import itertools
import tempfile
import time
from pathlib import Path

import numpy as np
from evidence import data_folder, write_evidence
from leg_tendons import convert
from scipy.spatial import cKDTree

from rbfmuscle.geometry.exact_distance import ExactDistance
from rbfmuscle.geometry.mesh_distance import MeshDistance
from rbfmuscle.geometry.surfaces import vertex_normals
from rbfmuscle.models import build_models
from rbfmuscle.scene.muscles import attachment_frames
from rbfmuscle.scene.scene import Scene
from rbfmuscle.simulation.contact_pairs import build_fields, find_contact_pairs
from rbfmuscle.simulation.frame_loop import FrameLoop

THRESHOLD = 2.0  # mm: nearer at rest is touching
# cosine between a vertex's normal and the way to its neighbour, from which on it faces that
FACING = 0.5
TOLD = 12  # pairs listed of these


class Bench:
    """The scene with and without contact of neighbours; models and bones' fields are built once."""

    def __init__(self, arguments):
        with tempfile.TemporaryDirectory() as folder:
            scene = Scene.load(convert(data_folder("leg") / arguments.scene, Path(folder)))
        asked = {key: float(value) for key, value in (pair.split("=") for pair in arguments.set)}
        self.scenes = {
            True: scene.with_options(asked, model=arguments.model),
            False: scene.with_options({"neighbours": False}, model=arguments.model),
        }
        named = (
            arguments.muscles.split(",") if arguments.muscles else [m.name for m in scene.muscles]
        )
        for one in self.scenes.values():
            one.muscles = [muscle for muscle in one.muscles if muscle.name in named]
        self.models = build_models(self.scenes[True])
        self.rest = [model.snapshot() for model in self.models]
        self.fields = build_fields(self.scenes[True], find_contact_pairs(self.scenes[True]))

    def loop(self, *, touching=True):
        """A loop at rest."""
        for model, state in zip(self.models, self.rest):
            model.restore(state)
        return FrameLoop(self.scenes[touching], self.models, bone_sdfs=self.fields)

    @property
    def path(self):
        return self.scenes[True].motion.frames


def chosen(text, count):
    parts = [int(p) if p else None for p in text.split(":")]
    return list(range(count))[slice(*parts)] if len(parts) > 1 else list(range(parts[0]))


class Touching:
    """Vertices of the surfaces at rest that touch another muscle, by ordered pair of names.

    Parameters
    ----------
    surfaces : dict of str to (vertices, faces)
        At rest.
    attached_bone : dict of str to (n,) ndarray of str
        Bones that hold vertices, empty where none does.
    """

    def __init__(self, surfaces, attached_bone):
        self.held, self.found = {name: bones != "" for name, bones in attached_bone.items()}, {}
        for one, other in itertools.permutations(surfaces, 2):
            near = _near(surfaces[one], surfaces[other], THRESHOLD)
            if len(near):
                distance = MeshDistance(*surfaces[other]).signed(surfaces[one][0][near])
                touch = distance < THRESHOLD
                if touch.any():
                    both = self.both(one, other, surfaces, near[touch])
                    self.found[one, other] = near[touch], np.maximum(distance[touch], 0.0), both

    def both(self, one, other, surfaces, index):
        """Which vertices of one muscle are held, as is what lies nearest to them of the other."""
        nearest = cKDTree(surfaces[other][0]).query(surfaces[one][0][index])[1]
        return self.held[one][index] & self.held[other][nearest]

    def opened(self, surfaces):
        """RMS of how much farther these are, by pair of sorted names, and the same of those held on
        both sides; of the first those that the neighbour faces.
        """
        found = {}, {}, {}
        for (one, other), (index, rest, both) in self.found.items():
            now = MeshDistance(*surfaces[other]).signed(surfaces[one][0][index])
            gap = now - rest
            facing = _facing(surfaces[one], surfaces[other], index)
            kinds = ~both, both, ~both & facing
            for parts, which in zip(found, kinds):
                square = np.maximum(gap[which], 0.0) ** 2
                parts.setdefault(tuple(sorted((one, other))), []).append(square)
        return tuple(_rms_by_pair(squares) for squares in found)

    def overlaps(self, surfaces):
        """Deepest vertex of one in the other, by pair of sorted names, and the deepest held on both
        sides.
        """
        free, held = {}, {}
        for one, other in itertools.permutations(surfaces, 2):
            near = _near(surfaces[one], surfaces[other], 0.0)
            if len(near):
                depth = MeshDistance(*surfaces[other]).depth(surfaces[one][0][near])
                near, depth = near[depth > 0.0], depth[depth > 0.0]
                both = self.both(one, other, surfaces, near)
                pair = tuple(sorted((one, other)))
                for found, deep in ((free, depth[~both]), (held, depth[both])):
                    found[pair] = max(float(deep.max(initial=0.0)), found.get(pair, 0.0))
        return free, held


def _rms_by_pair(squares):
    joined = {pair: np.concatenate(parts) for pair, parts in squares.items()}
    return {
        pair: float(np.sqrt(part.mean())) if len(part) else 0.0 for pair, part in joined.items()
    }


def _facing(one, other, index):
    """Which vertices of one surface have the other before them, no farther off than 60 degrees, or
    touch it.
    """
    points = one[0][index]
    distance, closest, _, _ = ExactDistance(*other).nearest(points)
    normals = vertex_normals(
        np.ascontiguousarray(one[0]), np.ascontiguousarray(one[1], dtype=np.int64)
    )[index]
    along = np.einsum("ij,ij->i", normals, closest - points)
    return along >= FACING * np.abs(distance) * np.linalg.norm(normals, axis=1) - 0.5


def holders(scene, models, surfaces):
    """What the vertices (n,) of each surface at rest go along with, as the model's nearest contact
    point does.
    """
    found = {}
    for model in models:
        names = np.array([*attachment_frames(scene.bones, scene.muscle(model.name)), ""])
        nearest = cKDTree(model.contact_points()).query(surfaces[model.name][0])[1]
        found[model.name] = names[np.asarray(model.attached_bone)[nearest]]
    return found


def _near(one, other, reach):
    low, high = other[0].min(axis=0) - reach, other[0].max(axis=0) + reach
    return np.flatnonzero(np.all((one[0] > low) & (one[0] < high), axis=1))


def _surfaces(frame):
    return {
        name: (surface.vertices, np.asarray(surface.faces))
        for name, surface in frame.surfaces.items()
    }


COLUMNS = [
    "touching",
    "pairs that meet",
    "overlap, 95 %",
    "gap opened, 95 %",
    "overlap, worst",
    "gap opened, worst",
    "processor time [s]",
]


def pairs(bench, arguments):
    wanted = {0, *chosen(arguments.frames, len(bench.path))}
    worst = {}
    touching = None
    every = ([], [])
    spent = 0.0
    loop = bench.loop(touching=not arguments.without)
    for k, coordinates in enumerate(bench.path[: max(wanted) + 1]):
        begin = time.process_time()
        frame = loop.advance(coordinates) if k in wanted else loop.skip(coordinates)
        spent += time.process_time() - begin
        if frame is None:
            continue
        surfaces = _surfaces(frame)
        touching = touching or Touching(
            surfaces, holders(bench.scenes[True], bench.models, surfaces)
        )
        opened = touching.opened(surfaces)
        # Overlap, gap; the same of what is held on both sides; the gap of what is faced.
        found = [one for pair in zip(touching.overlaps(surfaces), opened) for one in pair]
        found += opened[2:]
        for place, values in enumerate(found):
            for pair, value in values.items():
                row = worst.setdefault(pair, [(0.0, 0)] * 5)
                row[place] = max(row[place], (value, k))
        met = {*found[0], *found[1]}
        for values, into in zip(found[:2], every):
            into += [values.get(pair, 0.0) for pair in met]
        _tell_frame(k, frame, found[:2])
    rows = list(worst.values())
    row = [
        "without" if arguments.without else "with",
        len(worst),
        *(float(np.percentile(values, 95)) for values in every),
        *(max(found[k][0] for found in rows) for k in range(2)),
        spent,
    ]
    print(f"processor time {spent:.1f} s, a frame {spent / (max(wanted) + 1):.2f} s")
    deep, wide = (np.percentile(values, 95) for values in every)
    print(f"95th percentile over pairs and frames: overlap {deep:.3f}, opened {wide:.3f}")
    print(f"{len(touching.found) // 2} pairs touch at rest, {len(worst)} pairs meet")
    for name, places in (
        ("muscle against muscle", (0, 1)),
        ("held by bones on both sides", (2, 3)),
    ):
        _tell_pairs(name, {pair: [row[k] for k in places] for pair, row in worst.items()})
    wide = np.array([row[4][0] for row in worst.values()])
    print(
        f"opened, faced by the neighbour: {(wide > 1.0).sum()} of {len(wide)} pairs beyond 1 "
        "mm RMS, "
        f"worst {wide.max():.3f}"
    )
    for pair, found in sorted(worst.items(), key=lambda item: -item[1][4][0])[:TOLD]:
        print(f"    {' and '.join(pair):60} {found[4][0]:7.3f} {found[4][1]:2d}", flush=True)
    return row


def _tell_pairs(name, worst):
    print(f"{name:60} overlap at  opened at")
    for pair, ((deep, at), (wide, there)) in sorted(
        worst.items(), key=lambda row: -max(row[1][0][0] / 0.3, row[1][1][0])
    ):
        if deep > 0.1 or wide > 0.3:
            print(f"{' and '.join(pair):60} {deep:7.3f} {at:2d} {wide:7.3f} {there:2d}")
    deep, wide = (np.array([row[k][0] for row in worst.values()]) for k in range(2))
    print(
        f"overlap: {(deep > 0.3).sum()} of {len(deep)} pairs beyond 0.3 mm, worst {deep.max():.3f}"
    )
    print(
        f"opened: {(wide > 1.0).sum()} of {len(wide)} pairs beyond 1 mm RMS, worst "
        f"{wide.max():.3f}",
        flush=True,
    )


def _tell_frame(k, frame, values):
    lost = sum(event.count for event in frame.events if event.action in ("unresolved", "reported"))
    print(f"frame {k:2d}: unresolved {lost}", end="")
    for found, name in zip(values, ("overlap", "opened")):
        listed = sorted(found, key=found.get)[:-4:-1]
        print(f"; {name} " + ", ".join(f"{found[p]:.2f} ({' + '.join(p)})" for p in listed), end="")
    told = sorted({(e.muscle, e.action) for e in frame.events if e.action != "angle_flag"})
    print(f"; events {', '.join(' '.join(one) for one in told)}" if told else "", flush=True)


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--scene", default="squat.toml")
    parser.add_argument("--model", default=None)
    parser.add_argument("--muscles", default="", help="some of them, by comma")
    parser.add_argument("--frames", default="0:1000:6", help="A:B:S")
    parser.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", help="of the scene"
    )
    parser.add_argument("--without", action="store_true", help="measure a run without contact")
    parser.add_argument("-o", "--output", help="file of evidence for the pages: with and without")
    arguments = parser.parse_args()
    if arguments.output:
        bench, rows = Bench(arguments), []
        for arguments.without in (True, False):
            rows.append(pairs(bench, arguments))
        command = ["benchmarks/leg_neighbours.py", "--frames", arguments.frames]
        write_evidence(arguments.output, command, rows, COLUMNS)
    else:
        pairs(Bench(arguments), arguments)


if __name__ == "__main__":
    main()
