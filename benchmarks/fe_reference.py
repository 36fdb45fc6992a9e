"""The finite-element reference: the phantom's extensor, nearly incompressible, wrapped by flexion.

    python benchmarks/fe_reference.py solve [FILE] [--cells 40 12 8]     the reference, a small .npz
    file python benchmarks/fe_reference.py compare [FILE]                        distance of every
    model to it

``solve`` needs the extra ``fem`` (scikit-fem). The mesh is a regular grid of bricks in a cube,
mapped onto the tube; what is kept are the places of the phantom's surface vertices, which go along
with the bricks.
"""

import argparse
import time
from pathlib import Path

import numpy as np
from evidence import write_evidence
from peers.fibre_material import PassiveFibres
from peers.finite_element import HexSolid, brick_grid
from peers.load_steps import follow, nearest_bone
from scipy.spatial import cKDTree

from rbfmuscle.bones.sdf import BoneSDF
from rbfmuscle.geometry.surfaces import mesh_volume
from rbfmuscle.metrics.metrics import surface_distance
from rbfmuscle.muscle.muscle import RBFMuscle
from rbfmuscle.muscle.rest import RBFOptions
from rbfmuscle.recording import simulate
from rbfmuscle.scene.motion import bone_poses
from rbfmuscle.scene.phantom import ATTACHED_ENDS, ATTACHED_WITHIN, MUSCLES, phantom_scene

MUSCLE = "extensor"
COORDINATE = "hip.flexion"
ANGLES = (0.0, 30.0, 60.0)
STEP, SMALLEST_STEP = 1.0, 0.05  # degrees
SPACING = 3.0  # of the phantom's surface mesh [mm]
END = 0.5  # share of the largest section's area that the cube's end faces take
CELLS = (40, 12, 8)
FIBRE_NODES = 1200  # of the model's solid whose fibres a reinforced solid takes
DATA = Path(__file__).resolve().parents[1] / "tests" / "data" / "fe_reference.npz"
COMPARED = ("rbf", "pbd", "pbd-converged", "xpbd", "arap-pbd", "arap-volume")


def solid_points(tube, cube):
    """Points of the tube's solid, for points of the cube [-1, 1]^3 (along, across, thick).

    The square becomes a disc (elliptical grid mapping), disc and length the solid rho^2 +
    |z|^fullness <= 1.
    """
    t, x, y = cube.T
    p, q = x * np.sqrt(1 - y**2 / 2), y * np.sqrt(1 - x**2 / 2)
    power = tube.fullness
    z = t * (1 - END * (p**2 + q**2)) ** (1 / power)
    side = np.abs(t * (1 - END) ** (1 / power))
    rho = np.sqrt(1 - side**power)
    return _place(tube, z, p * rho, q * rho)


def _place(tube, z, p, q):
    """Places for fractions z of the half length, and p and q of the largest section's half-axes."""
    u = (z + 1) / 2
    centre, tangent, binormal = tube.axis(u)
    turn = (tube.twist[0] + u * (tube.twist[1] - tube.twist[0]))[:, None]
    wide = np.cos(turn) * binormal + np.sin(turn) * np.cross(binormal, tangent)
    g = tube.spread ** (1 - 2 * u)
    return (
        centre
        + (p * tube.width * g)[:, None] * wide
        + (q * tube.thickness / g)[:, None] * np.cross(tangent, wide)
    )


def cube_points(tube, vertices, u):
    """Inverse of `solid_points` for the vertices of the tube's surface mesh at fractions u of its
    axis.
    """
    power = tube.fullness
    z = 2 * u - 1
    centre, wide, thin = tube.sections(u)
    away = vertices - centre
    radius = np.sqrt(np.clip(1 - np.abs(z) ** power, 0, None))
    direction = np.stack([_share(away, wide), _share(away, thin)], axis=1)
    direction /= np.maximum(np.linalg.norm(direction, axis=1, keepdims=True), 1e-12)
    edge = (1 - END) ** (1 / power)
    cap = np.abs(z) > edge
    t = np.where(cap, np.sign(z), z / edge)
    p, q = (direction * np.where(cap, radius / np.sqrt(END), 1.0)[:, None]).T
    root = 2 * np.sqrt(2)

    def part(a, b):
        plus, minus = 2 + a**2 - b**2 + root * a, 2 + a**2 - b**2 - root * a
        return 0.5 * (np.sqrt(np.clip(plus, 0, None)) - np.sqrt(np.clip(minus, 0, None)))

    return np.clip(np.stack([t, part(p, q), part(q, p)], axis=1), -1, 1)


def _share(away, axis):
    return np.einsum("ij,ij->i", away, axis) / np.maximum(np.einsum("ij,ij->i", axis, axis), 1e-12)


class Course:
    """The solid on its way through the motion."""

    def __init__(self, cells, ratio=1.0):
        self.scene = phantom_scene(end=max(ANGLES), step=STEP, spacing=SPACING)
        tube = MUSCLES[MUSCLE]
        self.cells = cells
        self.cube, bricks = brick_grid(cells)
        rest = solid_points(tube, self.cube)
        fibres = None
        if ratio > 1.0:
            fibres = PassiveFibres.of_ratio(model_fibres(rest[bricks].mean(axis=1)), ratio)
        self.solid = HexSolid(rest, bricks, fibres=fibres)
        fields = {bone.name: BoneSDF.from_mesh(bone.mesh) for bone in self.scene.bones}
        self.fields = fields
        u = self._fraction()
        self.owner = self._attach(rest, u)
        first, last = ATTACHED_ENDS[MUSCLE]
        along = np.clip((u - first) / (last - first), 0, 1)
        along = along**2 * (3 - 2 * along)
        self.share = np.stack(
            [1 - along, along], axis=1
        )  # of the pelvis's and of the femur's motion
        self.solid.set_obstacles(self._distance, self.owner >= 0)
        self.poses = bone_poses(self.scene, {})

    def _fraction(self):
        """Fraction of the tube's axis at which each node lies."""
        t, x, y = self.cube.T
        disc = x**2 + y**2 - x**2 * y**2
        return (t * (1 - END * disc) ** (1 / MUSCLES[MUSCLE].fullness) + 1) / 2

    def _attach(self, rest, u):
        """Bone of each surface node by the phantom's own rule, -1 where free."""
        owner = np.full(len(rest), -1)
        skin = np.unique(self.solid.surface_faces())
        first, last = ATTACHED_ENDS[MUSCLE]
        for index, (bone, place) in enumerate(zip(self.scene.bones, (u <= first, u >= last))):
            near = bone.distances(rest[skin]) <= ATTACHED_WITHIN
            owner[skin[near & place[skin]]] = index
        return owner

    def _distance(self, points):
        return nearest_bone(self.fields, self.poses, points)

    def advance(self, displacement, before, angle):
        """Solve at an angle [degree]: nodes start where their share of the bone's motion takes
        them.
        """
        self.poses = bone_poses(self.scene, {COORDINATE: np.radians(angle)})
        old = bone_poses(self.scene, {COORDINATE: np.radians(before)})
        place = self.solid.rest + displacement
        start = place.copy()
        for index, bone in enumerate(self.scene.bones):
            pose, own = self.poses[bone.name], self.owner == index
            motion = pose @ np.linalg.inv(old[bone.name])
            start += self.share[:, [index]] * (place @ motion[:3, :3].T + motion[:3, 3] - place)
            start[own] = self.solid.rest[own] @ pose[:3, :3].T + pose[:3, 3]
        start -= self.solid.rest
        return self.solid.solve(start, self.owner >= 0, start)

    def run(self):
        """Yield (angle, displacement, greatest depth, volume error) at each of ``ANGLES``."""
        u = np.zeros_like(self.solid.rest)
        rest_volume = self.solid.volume(u)
        for goal, moved in follow(self.advance, u, ANGLES, (STEP, SMALLEST_STEP)):
            depth = max(0.0, -float(self.solid.gaps(moved)[0].min()))
            yield goal, moved, depth, self.solid.volume(moved) / rest_volume - 1.0


def model_fibres(points):
    """Unit directions (n, 3) of the model's own fibres at points of the muscle at rest."""
    scene = phantom_scene(end=0.0, spacing=SPACING)
    scene.muscles = [scene.muscle(MUSCLE)]
    options = RBFOptions(nodes=FIBRE_NODES, fibre_ratio=2.0)
    solid = RBFMuscle(scene.muscles[0], scene, options).model
    return solid.fibres.direction[cKDTree(solid.cells.points).query(points)[1]]


def carried(course, displacement):
    """Places of the phantom's surface vertices that go along with the bricks."""
    from scipy.interpolate import RegularGridInterpolator

    tube = MUSCLES[MUSCLE]
    vertices, _, u = tube.mesh(SPACING)
    axes = [np.linspace(-1, 1, n + 1) for n in course.cells]
    index = [np.rint((c + 1) / 2 * n).astype(int) for c, n in zip(course.cube.T, course.cells)]
    grid = np.zeros((*(n + 1 for n in course.cells), 3))
    grid[tuple(index)] = displacement
    return vertices + RegularGridInterpolator(axes, grid)(cube_points(tube, vertices, u))


def solve(path, cells, ratio=1.0):
    """Run the reference and keep it."""
    start = time.perf_counter()
    course = Course(cells, ratio)
    print(f"{len(course.solid.rest)} nodes, {(course.owner >= 0).sum()} of them attached")
    angles = []
    places = []
    depths = []
    volumes = []
    for angle, displacement, depth, volume in course.run():
        print(
            f"at {angle:g} degrees: {depth:.3f} mm deep, volume {100 * volume:+.3f} %", flush=True
        )
        angles.append(angle)
        places.append(np.round(carried(course, displacement), 3).astype(np.float32))
        depths.append(depth)
        volumes.append(volume)
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez_compressed(
        path,
        angles=angles,
        vertices=np.array(places),
        depth=depths,
        volume_error=volumes,
        cells=cells,
        fibre_ratio=ratio,
    )
    print(f"{path}: {path.stat().st_size} bytes, {time.perf_counter() - start:.0f} s")


def distances(model, kept, *, settings=None):
    """Distance of a model's surfaces to the reference, for the muscle alone on the same bones.

    Parameters
    ----------
    model : str
    kept : path or mapping
        The reference's file, or its arrays.
    settings : dict, optional
        Dotted keys as for `rbfmuscle.simulate`.

    Returns
    -------
    list of (angle, rms, worst, volume_error)
        [degree, mm, mm, 1], a row for each angle of the reference.
    """
    kept = np.load(kept) if isinstance(kept, (str, Path)) else kept
    scene = phantom_scene(end=float(max(kept["angles"])), spacing=SPACING)
    scene.muscles = [scene.muscle(MUSCLE)]
    faces = np.asarray(scene.muscles[0].mesh.faces)
    run = simulate(scene, model=model, settings=settings)
    volume = scene.muscles[0].mesh.volume
    rows = []
    for frame in run.frames:
        angle = np.degrees(frame.coordinates[COORDINATE])
        hit = np.flatnonzero(np.abs(kept["angles"] - angle) < 1e-6)
        if len(hit):
            skin = frame.surfaces[MUSCLE]
            rms, worst = surface_distance(
                skin.vertices, skin.faces, kept["vertices"][hit[0]].astype(float), faces
            )
            rows.append((angle, rms, worst, mesh_volume(skin.vertices, skin.faces) / volume - 1.0))
    return rows


def rows_of(path):
    """Distances of every model to the reference [mm], of the RBF model with more nodes too."""
    kept, rows = np.load(path), []
    for title, model, settings in (
        ("rbf", "rbf", {}),
        *((f"rbf, {n} nodes", "rbf", {"model.nodes": n}) for n in (150, 600)),
        *((name, name, {}) for name in COMPARED if name != "rbf"),
    ):
        found = distances(model, kept, settings=settings)
        rows.append([title, *(x for angle, rms, worst, _ in found if angle for x in (rms, worst))])
        print(*rows[-1], flush=True)
    heads = [f"{a:g}°, {what}" for a in kept["angles"] if a for what in ("RMS", "greatest")]
    return rows, ["model", *heads]


def compare(path):
    """Print the distance of every model to the reference."""
    kept = np.load(path)
    faces = MUSCLES[MUSCLE].mesh(SPACING)[1]
    volumes = [mesh_volume(places.astype(float), faces) for places in kept["vertices"]]
    columns = "".join(f"{angle:>6g} degrees {'':14}" for angle in kept["angles"])
    print(f"{'model':18}{columns}\n{'':18}" + "    rms   worst  volume  " * len(volumes))
    own = "".join(f"      -       - {100 * (v / volumes[0] - 1):+6.2f} %  " for v in volumes)
    print(f"{'finite elements':18}{own}")
    for model in COMPARED:
        cells = "".join(
            f"{r:7.2f} {w:7.2f} {100 * v:+6.2f} %  " for _, r, w, v in distances(model, kept)
        )
        print(f"{model:18}{cells}", flush=True)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("action", choices=("solve", "compare"))
    parser.add_argument("file", nargs="?", type=Path, default=DATA)
    parser.add_argument("--cells", nargs=3, type=int, default=CELLS)
    parser.add_argument(
        "--fibre-ratio", type=float, default=1.0, help="Young's modulus along fibres over across"
    )
    parser.add_argument("-o", "--output", type=Path, help="file of evidence for the pages")
    given = parser.parse_args()
    if given.output:
        write_evidence(
            given.output, ["benchmarks/fe_reference.py", "compare"], *rows_of(given.file)
        )
    elif given.action == "solve":
        solve(given.file, tuple(given.cells), given.fibre_ratio)
    else:
        compare(given.file)


if __name__ == "__main__":
    main()
