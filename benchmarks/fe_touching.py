"""Finite elements on two muscles that touch: a moving bone presses one belly into the other.

    python benchmarks/fe_touching.py solve [FILE] [--levels 48,4,8 48,6,12] [--fibre-ratio 1.5]
    the reference, a small .npz file
    python benchmarks/fe_touching.py compare [-o FILE.json]     distance of the models from both
    references that are kept, and the contact force of RBF muscles against theirs

``solve`` needs the extra ``fem`` (scikit-fem). Both bellies are symmetric about the plane y = 0,
and one half of them is solved. What is kept are the displacements of the vertices of both meshes,
which go along with the bricks, and the contact force of the pair. Forces are over 2 mu, in square
millimetres.
"""

import argparse
import itertools
import time
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import trimesh
from evidence import write_evidence
from peers.fibre_material import PassiveFibres
from peers.finite_element import HexSolid, brick_grid
from peers.load_steps import follow, nearest_bone
from peers.touching_solids import TouchingSolids
from scipy.interpolate import RegularGridInterpolator
from scipy.spatial import cKDTree

from rbfmuscle.bones.sdf import BoneSDF
from rbfmuscle.metrics.metrics import surface_distance
from rbfmuscle.models import build_models, configure_scene
from rbfmuscle.muscle.muscle import RBFMuscle
from rbfmuscle.muscle.rest import RBFOptions
from rbfmuscle.scene.motion import bone_poses
from rbfmuscle.scene.scene import Scene
from rbfmuscle.simulation.frame_loop import FrameLoop

DEPTHS = (8.0, 16.0)  # of the moving bone at which results are kept [mm]
FRAME = 2.0  # between frames of the scene [mm]
STEP, SMALLEST_STEP = 4.0, 0.05  # of the finite elements [mm]
SETTLED, ON_THE_WAY = 1e-8, 1e-4  # share of the energy that a step must save
COORDINATE = "slide.press"
END = 0.3  # share of the largest section's area that the held faces take
GAP = 0.2  # between the bellies, and to the moving bone [mm]
SKIN = (40, 12, 12)  # quads of the muscles' meshes along, across and through the thickness
# Bricks along, across one half and through the thickness: those along change the force most.
LEVELS = ((24, 4, 8), (48, 4, 8), (96, 4, 8))
FIBRE_NODES = 600  # of the model's solid whose fibres a reinforced solid takes
PENALTY = 30.0  # of all contacts [shear modulus / mm]
UNIT = 0.01  # of the kept displacements [mm]
DATA = Path(__file__).resolve().parents[1] / "tests" / "data" / "fe_touching.npz"
FIBRES = DATA.with_name("fe_touching_fibres.npz")  # with fibres, by --fibre-ratio 1.5
# The laws of both references.
ISOTROPIC = {"model.slack_ratio": 1.0, "model.fibre_ratio": 1.0}
REINFORCED = {"model.slack_ratio": 1.0, "model.fibre_ratio": 1.5}
COMPARED = (
    ("rbf", "rbf", {}, DATA),
    ("rbf, isotropic", "rbf", ISOTROPIC, DATA),
    ("rbf, isotropic, 150 nodes", "rbf", {**ISOTROPIC, "model.nodes": 150}, DATA),
    ("rbf, isotropic, 600 nodes", "rbf", {**ISOTROPIC, "model.nodes": 600}, DATA),
    ("pbd", "pbd", {}, DATA),
    ("pbd-converged", "pbd-converged", {}, DATA),
    ("rbf (reference with fibres)", "rbf", {}, FIBRES),
    ("rbf, no slack (reference with fibres)", "rbf", REINFORCED, FIBRES),
)


@dataclass(frozen=True)
class Belly:
    """A solid |x / length|^3 + (y / width)^2 + (z / thickness)^2 <= 1 about its centre [mm]."""

    length: float
    width: float
    thickness: float
    centre: tuple

    def points(self, cube):
        """Points of the solid for points (n, 3) of the cube [-1, 1]^3.

        The square becomes a disc (elliptical grid mapping); the faces at both ends of the cube
        become the held ends.
        """
        t, x, y = cube.T
        p, q = x * np.sqrt(1 - y**2 / 2), y * np.sqrt(1 - x**2 / 2)
        z = t * np.cbrt(1 - END * (p**2 + q**2))
        rho = np.sqrt(1 - np.abs(t * np.cbrt(1 - END)) ** 3)
        place = np.stack([self.length * z, self.width * p * rho, self.thickness * q * rho], axis=1)
        return place + self.centre

    def skin(self):
        """Points (n, 3) of the cube's surface that are the vertices of the mesh, and outward
        triangles.
        """
        axes = [np.linspace(-1, 1, n + 1) for n in SKIN]
        quads = []
        corners = []
        for axis in range(3):
            first, second = (k for k in range(3) if k != axis)
            a, b = np.meshgrid(axes[first], axes[second], indexing="ij")
            for side in (-1.0, 1.0):
                face = np.empty((*a.shape, 3))
                face[..., axis] = side
                face[..., first] = a
                face[..., second] = b
                start = sum(map(len, corners))
                number = start + np.arange(a.size).reshape(a.shape)
                around = [number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]]
                found = np.stack([part.ravel() for part in around], axis=1)
                flip = (side > 0) == (axis == 1)
                quads.append(found[:, ::-1] if flip else found)
                corners.append(face.reshape(-1, 3))
        cube, back = np.unique(np.round(np.concatenate(corners), 9), axis=0, return_inverse=True)
        quads = back.ravel()[np.concatenate(quads)]
        return cube, np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])


BELLIES = {
    "upper": Belly(50.0, 13.0, 11.0, (5.0, 0.0, 11.0 + GAP / 2)),
    "lower": Belly(58.0, 15.0, 10.0, (0.0, 0.0, -10.0 - GAP / 2)),
}
# Bones beyond the ends, which touch nothing: name, sides and middle [mm].
BLOCKS = (
    ("origin", (8.0, 30.0, 20.0), (-64.0, 0.0, -10.0)),
    ("upper_origin", (6.0, 20.0, 14.0), (-49.0, 0.0, 12.0)),
    ("insertion", (8.0, 30.0, 44.0), (64.0, 0.0, 0.0)),
)
ORIGINS = {"upper": "upper_origin", "lower": "origin"}
PRESSER_RADIUS = 12.0
PRESSER_AT = 12.0  # along x: beside the middle of both


def touching_scene():
    """Two bellies one above the other, held at both ends, and a bar across them that moves
    down.
    """
    scene = Scene("touching", units="mm")
    for name, extents, place in BLOCKS:
        block = trimesh.creation.box(extents=extents)
        block.apply_translation(place)
        scene.add_bone(name, block)
    bar = trimesh.creation.cylinder(radius=PRESSER_RADIUS, height=80.0, sections=180)
    bar.apply_transform(trimesh.transformations.rotation_matrix(0.5 * np.pi, (1, 0, 0)))
    top = BELLIES["upper"].centre[2] + BELLIES["upper"].thickness
    bar.apply_translation((PRESSER_AT, 0.0, top + GAP + PRESSER_RADIUS))
    scene.add_bone("bar", bar)
    scene.add_joint("slide", "origin", "bar", (0, 0, 0), {"press": (0, 0, -1)}, type="slide")
    for name, belly in BELLIES.items():
        cube, faces = belly.skin()
        attach = [
            {"bone": bone, "vertices": np.flatnonzero(cube[:, 0] == side).tolist()}
            for bone, side in ((ORIGINS[name], -1.0), ("insertion", 1.0))
        ]
        scene.add_muscle(name, (belly.points(cube), faces), attach=attach)
    return scene.set_motion(ramp={COORDINATE: {"to": max(DEPTHS), "step": FRAME}})


class Result(NamedTuple):
    """What is kept of the solids at a depth of the bone."""

    moved: np.ndarray  # (2, n, 3) displacements of the vertices of both meshes
    force: float  # of the contact between the muscles, sum of sizes [2 mu mm^2]
    push: np.ndarray  # (3,) on the upper muscle [2 mu mm^2]
    centre: np.ndarray  # (3,) of the contact force
    overlap: float  # greatest depth of a point of one muscle in the other
    bone_overlap: float  # and in the bone
    volume_error: float  # greatest relative change of a muscle's volume


class Course:
    """Both solids on the way of the moving bone."""

    def __init__(self, cells, ratio=1.0):
        self.scene = touching_scene()
        self.cells = cells
        self.cube, bricks = brick_grid(cells)
        self.cube[:, 1] = 0.5 * (self.cube[:, 1] + 1.0)
        self.bar = BoneSDF.from_mesh(self.scene.bone("bar").mesh)
        self.pose = bone_poses(self.scene, {})
        end = np.abs(self.cube[:, 0]) == 1.0
        plane = self.cube[:, 1] == 0.0
        solids = []
        inner = []
        for name, belly in BELLIES.items():
            rest = belly.points(self.cube)
            fibres = None
            if ratio > 1.0:
                direction = model_fibres(self.scene, name, rest[bricks].mean(axis=1))
                fibres = PassiveFibres.of_ratio(direction, ratio)
            solid = HexSolid(rest, bricks, penalty=PENALTY, fibres=fibres)
            hidden = plane[solid.surface_faces()].all(axis=1)
            solid.set_obstacles(self._distance, end, inner=hidden)
            solids.append(solid)
            inner.append(hidden)
        self.solids = TouchingSolids(solids, inner, penalty=PENALTY)
        held = np.stack([end, end | plane, end], axis=1)
        self.held = np.concatenate([held, held])

    def _distance(self, points):
        return nearest_bone({"bar": self.bar}, self.pose, points)

    def advance(self, displacement, before, depth):
        """Solve with the bar at a depth [mm]."""
        self.pose = bone_poses(self.scene, {COORDINATE: depth})
        settled = SETTLED if depth in DEPTHS else ON_THE_WAY
        return self.solids.solve(displacement, self.held, displacement, settled=settled)

    def run(self):
        """Yield (depth, displacement) at each of ``DEPTHS``."""
        u = np.zeros_like(self.solids.rest)
        yield from follow(self.advance, u, DEPTHS, (STEP, SMALLEST_STEP))

    def carried(self, displacement):
        """Displacements (2, n, 3) of the vertices of both meshes, which go along with the
        bricks.
        """
        axes = [np.linspace(low, 1, n + 1) for low, n in zip((-1, 0, -1), self.cells)]
        index = [np.argmin(np.abs(c[:, None] - a), axis=1) for c, a in zip(self.cube.T, axes)]
        found = []
        for belly, part in zip(BELLIES.values(), self.solids.split(displacement)):
            grid = np.zeros((*(n + 1 for n in self.cells), 3))
            grid[tuple(index)] = part
            cube = belly.skin()[0]
            mirrored = cube[:, 1] < 0.0
            cube[:, 1] = np.abs(cube[:, 1])
            moved = RegularGridInterpolator(axes, grid)(cube)
            moved[mirrored, 1] *= -1.0
            found.append(moved)
        return np.stack(found)

    def volumes(self, displacement):
        """Volumes (2,) of both solids."""
        parts = zip(self.solids.solids, self.solids.split(displacement))
        return np.array([solid.volume(part) for solid, part in parts])

    def contact(self, displacement):
        """Contact force of the whole pair [2 mu mm^2], the force (3,) on the upper muscle, and the
        centre (3,) of the contact force.
        """
        places, size, push = self.solids.forces(displacement)
        mirrored = np.array([1.0, 0.0, 1.0])
        scale = 2.0 / (2.0 * self.solids.shear)  # two halves, over 2 mu
        centre = size @ places / size.sum()
        return scale * size.sum(), scale * push.sum(axis=0) * mirrored, centre * mirrored

    def deepest(self, displacement):
        """Greatest depth of a point of one muscle in the other, and in the bone [mm]."""
        between = [-part.gap.min(initial=0.0) for part in self.solids.overlaps(displacement)]
        parts = zip(self.solids.solids, self.solids.split(displacement))
        bone = [-min(0.0, solid.gaps(part)[0].min()) for solid, part in parts]
        return float(max(between)), float(max(bone))


def model_fibres(scene, name, points):
    """Unit directions (n, 3) of the RBF model's own fibres at points of a muscle at rest."""
    options = RBFOptions(nodes=FIBRE_NODES, fibre_ratio=2.0)
    solid = RBFMuscle(scene.muscle(name), scene, options).model
    return solid.fibres.direction[cKDTree(solid.cells.points).query(points)[1]]


def solve(path, levels, ratio=1.0):
    """Run the reference on each level, coarse to fine, and keep the finest so far."""
    found = []
    for cells in levels:
        start = time.perf_counter()
        course = Course(cells, ratio)
        print(f"{cells}: {len(course.solids.rest)} nodes", flush=True)
        volumes = course.volumes(np.zeros_like(course.solids.rest))
        rows = []
        for depth, u in course.run():
            change = float(np.abs(course.volumes(u) / volumes - 1.0).max())
            row = Result(course.carried(u), *course.contact(u), *course.deepest(u), change)
            rows.append(row)
            print(
                f"  at {depth:g} mm: force {row.force:.3f}, on the upper {np.round(row.push, 3)}, "
                f"centre {np.round(row.centre, 3)}; {row.overlap:.4f} mm deep, "
                f"{row.bone_overlap:.4f} in the bone, volume {100 * change:.3f} %, "
                f"{time.perf_counter() - start:.0f} s",
                flush=True,
            )
        found.append(rows)
        keep(path, levels[: len(found)], found)


def keep(path, levels, found):
    """Write the finest of the levels, and how far each is from the next finer one."""
    vertices = [belly.points(belly.skin()[0]) for belly in BELLIES.values()]
    faces = [belly.skin()[1] for belly in BELLIES.values()]
    apart = np.array(
        [
            [
                [
                    surface_distance(v + a, f, v + b, f)
                    for v, f, a, b in zip(vertices, faces, one.moved, two.moved)
                ]
                for one, two in zip(coarse, fine)
            ]
            for coarse, fine in itertools.pairwise(found)
        ]
    )
    print("levels apart, RMS and greatest:", apart.round(3).tolist())
    results = {name: np.array(parts) for name, parts in zip(Result._fields, zip(*found[-1]))}
    results["moved"] = np.round(results["moved"] / UNIT).astype(np.int16)
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(
        path,
        depths=DEPTHS,
        **results,
        cells=levels,
        level_forces=[[row.force for row in rows] for rows in found],
        level_centres=[[row.centre for row in rows] for rows in found],
        apart=apart,
    )
    print(f"{path}: {path.stat().st_size} bytes", flush=True)


def reference(path):
    """What is kept: its arrays, and the places (depths, 2, n, 3) of the vertices."""
    with np.load(path) as file:
        kept = dict(file)
    rest = np.stack([belly.points(belly.skin()[0]) for belly in BELLIES.values()])
    return kept, rest + UNIT * kept["moved"]


def pair_force(loop):
    """Contact force of an RBF model's pair [2 mu mm^2], and its centre (3,)."""
    neighbours = loop.groups[0].neighbours
    state = neighbours.state
    places = []
    sizes = []
    for (one, _), force in state.forces.items():
        solid = state.bodies[one]
        places.append(solid.feet_of(neighbours.bodies[one].points).of(solid.nodes))
        sizes.append(force)
    size = np.concatenate(sizes)
    return size.sum(), size @ np.concatenate(places) / size.sum()


def model_results(model, settings=None):
    """Surfaces (vertices and faces by muscle) of a model at each of ``DEPTHS``, the contact force
    of the pair and its centre, None where it is no RBF model, and how many solves were capped.
    """
    scene = configure_scene(touching_scene(), settings, model=model)
    loop = FrameLoop(scene, build_models(scene))
    found = []
    for coordinates in scene.motion.frames:
        frame = loop.advance(coordinates)
        if np.isclose(DEPTHS, coordinates.get(COORDINATE, 0.0)).any():
            shown = {name: (skin.vertices, skin.faces) for name, skin in frame.surfaces.items()}
            caps = sum(event.action == "iteration_cap" for event in frame.events)
            found.append((shown, pair_force(loop) if model == "rbf" else None, caps))
    return found


def differences(path, results):
    """What the results of a model differ by from the reference, a dict for each of ``DEPTHS``.

    ``upper`` and ``lower`` are the distances of the surfaces, RMS and greatest [mm]. Of an RBF
    model ``force`` is the relative error of the pair's contact force, and ``centre`` how far its
    centre is from that of the reference [mm].
    """
    kept, places = reference(path)
    found = []
    for k, (shown, contact, caps) in enumerate(results):
        row = {"caps": caps}
        for (name, belly), place in zip(BELLIES.items(), places[k]):
            row[name] = surface_distance(*shown[name], place, belly.skin()[1])
        if contact is not None:
            force, centre = contact
            row["force"] = force / kept["force"][k] - 1.0
            row["centre"] = float(np.linalg.norm(centre - kept["centre"][k]))
        found.append(row)
    return found


def rows_of():
    """Rows of the table, and the heads of its columns."""
    rows = []
    for title, model, settings, path in COMPARED:
        row = [title]
        for one in differences(path, model_results(model, settings)):
            row += [f"{rms:.2f} ({worst:.1f})" for rms, worst in (one["upper"], one["lower"])]
            row.append(f"{100 * one['force']:+.1f} %" if "force" in one else None)
            row.append(f"{one['centre']:.1f}" if "centre" in one else None)
        rows.append(row)
        print(*row, one["caps"], sep="  ", flush=True)
    heads = [
        f"{what}, {depth:g} mm"
        for depth in DEPTHS
        for what in ("upper", "lower", "force", "centre of force")
    ]
    return rows, ["model", *heads]


def level(text):
    """Numbers of bricks, from a text as "24,4,8"."""
    return tuple(int(part) for part in text.split(","))


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("action", choices=("solve", "compare"))
    parser.add_argument("file", nargs="?", type=Path, default=DATA, help="what solve writes")
    parser.add_argument("--levels", nargs="+", type=level, default=LEVELS)
    parser.add_argument(
        "--fibre-ratio", type=float, default=1.0, help="Young's modulus along fibres over across"
    )
    parser.add_argument("-o", "--output", type=Path, help="file of evidence for the pages")
    given = parser.parse_args()
    if given.action == "solve":
        solve(given.file, given.levels, given.fibre_ratio)
        return
    rows, columns = rows_of()
    if given.output:
        write_evidence(given.output, ["benchmarks/fe_touching.py", "compare"], rows, columns)


if __name__ == "__main__":
    main()
