"""Finite elements on real muscles: a gluteus maximus and a quadriceps as nearly incompressible
solids, and the models.

    python benchmarks/real_solids.py solve NAME [--edges 18 14] [--coarser FILE] [-o FILE]   the
    reference, a small .npz python benchmarks/real_solids.py compare NAME ... [--models
    rbf,pbd,arap-volume] [-o FILE.json]

Names are those of ``CASES``. ``solve`` needs scikit-fem (the extra ``fem``) and pytetwild
(fTetWild, MPL-2.0), which makes the tetrahedra; the real data are looked for beside the project or
in RBFMUSCLE_DATA. Kept are the displacements of the input mesh's vertices, which go along with the
tetrahedra, in hundredths of a unit; the data are not.
"""

import argparse
import contextlib
import hashlib
import itertools
import os
import tempfile
from pathlib import Path

import numpy as np
from evidence import write_evidence
from peers.finite_element import TetSolid
from peers.load_steps import follow, nearest_bone
from scipy.spatial import cKDTree

from rbfmuscle.metrics.metrics import surface_distance
from rbfmuscle.recording import simulate
from rbfmuscle.scene.frames import interpolate
from rbfmuscle.scene.motion import bone_poses
from rbfmuscle.scene.scene import Scene
from rbfmuscle.simulation.contact_pairs import build_fields, find_contact_pairs
from rbfmuscle.validation import MissingDependencyError, SolveError

ROOT = Path(__file__).resolve().parents[1]
# Scene, muscle and edges of the tetrahedra [mm], each level; frames 15 and 30 are 30 and 60
# degrees.
CASES = {
    "gluteus_maximus": ("hip/flexion.toml", "gluteus_maximus", (18.0, 14.0)),
    "vastus_lateralis": ("leg/quadriceps.toml", "vastus_lateralis", (12.0, 8.5)),
    "rectus_femoris": ("leg/quadriceps.toml", "rectus_femoris", (11.0, 8.5)),
}
FRAMES = (15, 30)
ANGLES = (30, 60)  # of these frames [degree]
ENVELOPE = 0.7  # how far the tetrahedra's surface may leave the mesh [mm]
STEP, SMALLEST_STEP = 1.0, 0.02  # frames of 2 degrees
SETTLED, ON_THE_WAY = 2e-6, 1e-3  # share of the energy that a step must save
UNIT = 0.01  # of the kept displacements [mm]
MODELS = ("rbf", "pbd", "arap-volume")


def data_folder():
    """Where the real data are."""
    places = [os.environ.get("RBFMUSCLE_DATA"), ROOT.parent / "shared" / "data"]
    return next((Path(p) for p in places if p and Path(p).is_dir()), None)


def reference_file(name):
    """File of a reference."""
    return ROOT / "tests" / "data" / f"solid_{name}.npz"


def case_scene(name):
    """The muscle alone with its bones, up to the last frame that is compared."""
    scene = Scene.load(data_folder() / CASES[name][0])
    scene.muscles = [scene.muscle(CASES[name][1])]
    scene.motion.frames = scene.motion.frames[: FRAMES[-1] + 1]
    return scene


def tetrahedra(mesh, edge):
    """Points (n, 3) and tetrahedra (m, 4), positive, of the inside of a mesh."""
    try:
        import pytetwild
    except ImportError as error:
        raise MissingDependencyError(
            "pytetwild is not installed, which makes tetrahedra: pip install -e '.[fem]' in "
            "rbfmuscle's folder"
        ) from error
    size = float(np.linalg.norm(mesh.extents))
    # The mesher leaves a file of its own where it runs.
    with tempfile.TemporaryDirectory() as folder, contextlib.chdir(folder):
        points, cells = pytetwild.tetrahedralize(
            np.asarray(mesh.vertices),
            np.asarray(mesh.faces),
            edge_length_fac=edge / size,
            epsilon=ENVELOPE / size,
            coarsen=True,
            num_threads=1,
            quiet=True,
        )
    cells = np.asarray(cells, dtype=int)
    sides = points[cells[:, 1:]] - points[cells[:, :1]]
    flipped = np.linalg.det(sides) < 0.0
    cells[flipped] = cells[flipped][:, [0, 1, 3, 2]]
    return points, cells


class Course:
    """A real muscle as a solid of tetrahedra, on its way through a scene's motion."""

    def __init__(self, scene, edge):
        self.scene, self.muscle = scene, scene.muscles[0]
        self.solid = TetSolid(*tetrahedra(self.muscle.mesh, edge))
        self.fields = build_fields(scene, find_contact_pairs(scene))
        self.names = [attachment.bone for attachment in self.muscle.attachments]
        self.owner = self._attach()
        self.poses = bone_poses(scene, scene.motion.frames[0])
        self.solid.set_obstacles(self._distance, self.owner >= 0)

    def _attach(self):
        """Place of the holding bone in ``names``, -1 where free: that of the nearest vertex of the
        mesh.
        """
        held = np.full(len(self.muscle.mesh.vertices), -1)
        for index, attachment in enumerate(self.muscle.attachments):
            held[attachment.vertices] = index
        skin, owner = self.solid.skin(), np.full(len(self.solid.rest), -1)
        owner[skin] = held[cKDTree(self.muscle.mesh.vertices).query(self.solid.rest[skin])[1]]
        return owner

    def _distance(self, points):
        return nearest_bone(self.fields, self.poses, points)

    def coordinates(self, place):
        """Coordinates at a place among the frames, which need not be whole."""
        frames = self.scene.motion.frames
        first = min(int(place), len(frames) - 2)
        return interpolate(frames[first], frames[first + 1], place - first)

    def advance(self, displacement, place, settled):
        """Solve at a place, from a displacement at another one, until no step saves a larger share
        of the energy.
        """
        self.poses = bone_poses(self.scene, self.coordinates(place))
        rest, wanted = self.solid.rest, displacement.copy()
        for index, name in enumerate(self.names):
            pose, own = self.poses[name], self.owner == index
            wanted[own] = rest[own] @ pose[:3, :3].T + pose[:3, 3] - rest[own]
        return self.solid.solve(displacement, self.owner >= 0, wanted, settled=settled)

    def run(self):
        """Yield (frame, displacement, greatest depth, volume error) at each of ``FRAMES``."""
        u = self.advance(np.zeros_like(self.solid.rest), 0.0, SETTLED).displacement
        volume = self.solid.volume(np.zeros_like(u))

        def advance(displacement, _, target):
            return self.advance(displacement, target, SETTLED if target in FRAMES else ON_THE_WAY)

        for goal, moved in follow(advance, u, FRAMES, (STEP, SMALLEST_STEP)):
            depth = max(0.0, -float(self.solid.gaps(moved)[0].min()))
            yield goal, moved, depth, self.solid.volume(moved) / volume - 1.0


def kept_level(path):
    """A level that is kept in a file, as `keep` takes it."""
    with np.load(path) as kept:
        found = [(UNIT * moved, 0.0, 0.0) for moved in kept["moved"]]
        return float(kept["edges"][-1]), int(kept["cells"][-1]), found


def solve(name, edges, path, coarser=None):
    """Run the reference on each level, coarse to fine, and keep the finest so far."""
    scene, levels = case_scene(name), [] if coarser is None else [kept_level(coarser)]
    mesh = scene.muscles[0].mesh
    for edge in edges:
        course = Course(scene, edge)
        cells, nodes = len(course.solid.nodes), len(course.solid.rest)
        print(
            f"{name}, edges of {edge:g}: {cells} cells, {nodes} nodes, "
            f"{(course.owner >= 0).sum()} held",
            flush=True,
        )
        columns, shares = course.solid.at(np.asarray(mesh.vertices))
        found = []
        for frame, u, depth, volume in course.run():
            print(f"  at frame {frame}: {depth:.3f} deep, volume {100 * volume:+.3f} %", flush=True)
            found.append((np.einsum("nk,nki->ni", shares, u[columns]), depth, volume))
        levels.append((edge, cells, found))
        keep(path, mesh, levels)


def keep(path, mesh, levels):
    """Write the finest of the levels, coarse to fine: (edge, cells, [(displacements, depth, volume
    error)]).
    """
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    apart = [
        [
            surface_distance(vertices + one[0], faces, vertices + other[0], faces)
            for one, other in zip(coarse[2], fine[2])
        ]
        for coarse, fine in itertools.pairwise(levels)
    ]
    for (coarse, *_), row in zip(levels, apart):
        print(
            f"edges of {coarse:g} to the next: " + ", ".join(f"{r:.2f} ({w:.1f})" for r, w in row)
        )
    finest = levels[-1][2]
    kept = np.round(np.array([u for u, _, _ in finest]) / UNIT)
    np.savez_compressed(
        path,
        frames=FRAMES,
        moved=kept.astype(np.int16),
        depth=[d for _, d, _ in finest],
        volume_error=[v for _, _, v in finest],
        edges=[e for e, *_ in levels],
        cells=[n for _, n, _ in levels],
        apart=np.array(apart),
        mesh=digest(vertices),
    )
    print(f"{path}: {path.stat().st_size} bytes", flush=True)


def digest(vertices):
    """What tells whether a mesh is the one that a reference is of."""
    return hashlib.sha256(np.round(vertices, 3).astype(np.float32).tobytes()).hexdigest()


def reference(name, scene):
    """Places (frames, n, 3) of the mesh's vertices in the solid, by what is kept."""
    vertices = np.asarray(scene.muscles[0].mesh.vertices)
    with np.load(reference_file(name)) as kept:
        if str(kept["mesh"]) != digest(vertices):
            raise SolveError(
                f"{reference_file(name)} is of another mesh than {scene.muscles[0].name}'s"
            )
        return vertices + UNIT * kept["moved"]


def distances(name, model, settings=None):
    """Distance of a model's surfaces to the solid, ``[(rms, worst)]`` for each of ``FRAMES``
    [mm]."""
    scene = case_scene(name)
    places, faces = reference(name, scene), np.asarray(scene.muscles[0].mesh.faces)
    run = simulate(scene, model=model, settings=settings or {})
    found = []
    for frame, place in zip(FRAMES, places):
        skin = run.frames[frame].surfaces[scene.muscles[0].name]
        found.append(surface_distance(skin.vertices, skin.faces, place, faces))
    return found


def rows_of(models):
    """Named (model, settings) to compare."""
    rows = []
    for model in models:
        rows.append((model, model, {}))
        if model == "rbf":
            rows += [(f"rbf, {n} nodes", model, {"model.nodes": n}) for n in (150, 600)]
    return rows


def compare(names, models):
    """Print and return the distance of every model to every reference: by row and muscle, RMS and
    greatest a frame.
    """
    found = {}
    for name in names:
        for title, model, settings in rows_of(models):
            rows = distances(name, model, settings)
            found.setdefault(title, {})[name] = rows
            print(
                f"{name}, {title}: " + ", ".join(f"{r:.2f} ({w:.1f})" for r, w in rows), flush=True
            )
    return found


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("action", choices=("solve", "compare"))
    parser.add_argument("names", nargs="+", choices=sorted(CASES), metavar="NAME")
    parser.add_argument("--edges", nargs="+", type=float)
    parser.add_argument(
        "--coarser", type=Path, help="file of a coarser level that was solved before"
    )
    parser.add_argument("--models", default=",".join(MODELS))
    parser.add_argument("-o", "--output", type=Path)
    given = parser.parse_args()
    if given.action == "solve":
        for name in given.names:
            solve(
                name,
                given.edges or CASES[name][2],
                given.output or reference_file(name),
                given.coarser,
            )
        return
    found = compare(given.names, given.models.split(","))
    if given.output:
        heads = [f"{name.replace('_', ' ')}, {angle}°" for name in given.names for angle in ANGLES]
        rows = [
            [
                title,
                *(f"{rms:.2f} ({worst:.1f})" for name in given.names for rms, worst in own[name]),
            ]
            for title, own in found.items()
        ]
        command = ["benchmarks/real_solids.py", "compare", *given.names]
        write_evidence(given.output, command, rows, ["model", *heads])


if __name__ == "__main__":
    main()
