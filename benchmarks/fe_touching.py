"""Two muscles that a bone presses together, beside finite elements with contact.

    python benchmarks/fe_touching.py solve [FILE] [--cells 16 8 8] [--penalty 100]
    python benchmarks/fe_touching.py compare [FILE] [-o FILE.json]

Two ellipsoids lie on each other, held at their ends; a ball is moved down onto the upper one, and
presses it into the lower one. ``solve`` needs the extra ``fem`` (scikit-fem); kept are the places
of the vertices of both surfaces, the contact force between the muscles over 2 μ, and its centre.
The models have the reference's material: without slack and without stiffer fibres.
"""

import argparse
import time
from pathlib import Path

import numpy as np
import trimesh
from evidence import write_evidence
from peers.finite_element import HexSolid, PressedSolids, brick_grid
from peers.load_steps import follow

from rbfmuscle.bones.sdf import BoneSDF
from rbfmuscle.metrics.metrics import surface_distance
from rbfmuscle.models import build_models
from rbfmuscle.scene.objects import Motion
from rbfmuscle.scene.scene import Scene
from rbfmuscle.simulation.frame_loop import FrameLoop

HALF = np.array([40.0, 10.0, 10.0])  # half axes [mm]
GAP = 0.2
# Along the first axis, from the middle on, a surface is held: from where the ends of the cube lie,
# so that meshes of any size are held alike.
HELD = HALF[0] / np.sqrt(2.0) - 0.01
RADIUS, ABOVE = 15.0, 0.2  # of the ball, and how far it lies above the upper muscle
WAY, FRAMES = 8.0, 16  # of the ball
STEP, SMALLEST_STEP = 0.5, 0.01
CELLS, FINE = (16, 8, 8), (36, 14, 14)  # of each solid, and of the surface that is compared
NAMES = "lower", "upper"
HEIGHTS = -(HALF[2] + GAP / 2), HALF[2] + GAP / 2
DATA = Path(__file__).resolve().parents[1] / "tests" / "data" / "fe_touching.npz"
COMPARED = ("rbf", "pbd", "pbd-converged", "arap-volume")
MATERIAL = {"fibre_ratio": 1.0, "slack_ratio": 1.0}


def ellipsoid_points(cube):
    """Points of the ellipsoid about the origin for points of the cube [-1, 1]^3: square sections
    become discs.
    """
    t, x, y = cube.T
    p, q = x * np.sqrt(1 - y**2 / 2), y * np.sqrt(1 - x**2 / 2)
    rho = np.sqrt(1 - t**2 / 2)
    return np.column_stack([t * np.sqrt(1 - (p**2 + q**2) / 2), p * rho, q * rho]) * HALF


def surface():
    """Places in the cube (n, 3) of the vertices of the surface, and its faces."""
    from skfem import MeshHex

    cube, bricks = brick_grid(FINE)
    mesh = MeshHex(cube.T, bricks.T)
    quads = mesh.facets[:, mesh.boundary_facets()].T
    used, quads = np.unique(quads, return_inverse=True)
    quads = quads.reshape(-1, 4)
    faces = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    a, b, c = np.moveaxis(ellipsoid_points(cube[used])[faces], 1, 0)
    inward = np.einsum("ni,ni->n", np.cross(b - a, c - a), a) < 0.0
    return cube[used], np.where(inward[:, None], faces[:, ::-1], faces)


def ball():
    """The bone that presses, at rest."""
    made = trimesh.creation.icosphere(5, RADIUS)
    made.apply_translation([0, 0, HEIGHTS[1] + HALF[2] + ABOVE + RADIUS])
    return made


def solve(path, cells, penalty):
    """Run the reference and keep it."""
    from scipy.interpolate import RegularGridInterpolator

    start = time.perf_counter()
    cube, bricks = brick_grid(cells)
    body = ellipsoid_points(cube)
    # Flat sides cut off what is round: with its volume a coarse mesh is as thick and as stiff.
    body *= np.cbrt(4 / 3 * np.pi * HALF.prod() / HexSolid(body, bricks).weights.sum())
    rest = [body + [0, 0, height] for height in HEIGHTS]
    solids = PressedSolids(*((points, bricks) for points in rest), penalty=penalty)
    held = np.zeros(len(solids.rest), dtype=bool)
    skin = np.unique(solids.surface_faces())
    held[skin] = np.abs(solids.rest[skin, 0]) > HELD
    bone = BoneSDF.from_mesh(ball())
    pose = np.eye(4)
    solids.set_obstacles(lambda points: bone.distance_and_gradient(points, pose), held)
    print(f"{len(solids.rest)} nodes")

    def advance(displacement, _, down):
        pose[2, 3] = -down
        return solids.solve(displacement, held, np.zeros_like(displacement))

    ((_, u),) = follow(advance, np.zeros_like(solids.rest), [WAY], (STEP, SMALLEST_STEP))
    force, centre = solids.pair_force(u)
    places, axes = [], [np.linspace(-1, 1, n + 1) for n in cells]
    index = [np.rint((c + 1) / 2 * n).astype(int) for c, n in zip(cube.T, cells)]
    at, _ = surface()
    for height, moved in zip(HEIGHTS, np.split(u, 2)):
        grid = np.zeros((*(n + 1 for n in cells), 3))
        grid[tuple(index)] = moved
        places.append(
            ellipsoid_points(at) + [0, 0, height] + RegularGridInterpolator(axes, grid)(at)
        )
    depth = solids.pair_contacts(u)[2].max()
    # The models' forces are over 2 μ, with the shear modulus μ = 1 of the reference.
    print(f"force over 2 μ {force / 2} at {centre}; {depth:.3f} mm into each other")
    np.savez_compressed(
        path,
        vertices=np.round(places, 3).astype(np.float32),
        force=force / 2.0,
        centre=centre,
        cells=cells,
        penalty=penalty,
    )
    print(f"{path}: {path.stat().st_size} bytes, {time.perf_counter() - start:.0f} s")


def press_scene(model="rbf", options=None):
    """The same as a scene, for a model."""
    scene = Scene("press", units="mm")
    for name, x in (("left", -60.0), ("right", 60.0)):
        scene.add_bone(name, trimesh.creation.box([8, 8, 8]).apply_translation([x, 0, 0]))
    scene.add_bone("ball", ball())
    scene.add_joint("down", "left", "ball", (0, 0, 0), {"by": (0, 0, -1)}, type="slide")
    scene.add_joint("fixed", "left", "right", (0, 0, 0), type="weld")
    at, faces = surface()
    for name, height in zip(NAMES, HEIGHTS):
        points = ellipsoid_points(at) + [0, 0, height]
        ends = [
            {"bone": bone, "vertices": np.flatnonzero(side * points[:, 0] > HELD).tolist()}
            for bone, side in (("left", -1.0), ("right", 1.0))
        ]
        mesh = trimesh.Trimesh(points, faces, process=False)
        scene.add_muscle(name, mesh, attach=ends, model={"name": model, **(options or {})})
    scene.motion = Motion([{"down.by": way} for way in np.linspace(0.0, WAY, FRAMES + 1)])
    return scene


def pair_force(loop):
    """Contact force (3,) of the lower muscle on the upper one, over 2 μ, and its centre (3,)."""
    (group,) = loop.groups
    bodies = [stepper.model.begin(stepper.contacts) for stepper in group.steppers]
    meeting = group.neighbours.find(bodies)
    meeting.ask(bodies)
    upper = [stepper.name for stepper in group.steppers].index(NAMES[1])
    sign = np.where(meeting.one == upper, 1.0, -1.0)
    force = (sign * meeting.force)[:, None] * meeting.normal
    points = np.empty((len(force), 3))
    for m, body in enumerate(bodies):
        points[meeting.mine[m]] = meeting.own[m].of(body.nodes)
    size = np.abs(meeting.force)
    return force.sum(axis=0), size @ points / size.sum()


def distances(model, kept, options=None):
    """Distance of a model to the reference: RMS and greatest of each surface [mm]; for RBF muscles
    the contact force over the reference's and how far apart their centres are [mm].
    """
    scene = press_scene(model, options)
    loop = FrameLoop(scene, build_models(scene))
    for frame in scene.motion.frames:
        shown = loop.advance(frame).surfaces
    row = []
    for name, there in zip(NAMES, kept["vertices"]):
        own = shown[name]
        faces = np.asarray(scene.muscle(name).mesh.faces)
        row += surface_distance(own.vertices, own.faces, there.astype(float), faces)
    if model != "rbf":
        return [*row, None, None]
    force, centre = pair_force(loop)
    share = np.linalg.norm(force) / np.linalg.norm(kept["force"])
    return [*row, float(share), float(np.linalg.norm(centre - kept["centre"]))]


COLUMNS = [
    "model",
    "lower, RMS",
    "lower, greatest",
    "upper, RMS",
    "upper, greatest",
    "force over the reference's",
    "centres of the forces apart",
]


def compare(path, output):
    """Print the distance of every model to the reference."""
    kept, rows = np.load(path), []
    cases = [("rbf", "rbf", MATERIAL), ("rbf, 600 nodes", "rbf", {**MATERIAL, "nodes": 600})]
    for title, model, options in [*cases, *((name, name, {}) for name in COMPARED[1:])]:
        rows.append([title, *distances(model, kept, options)])
        print(*rows[-1], flush=True)
    if output:
        write_evidence(output, ["benchmarks/fe_touching.py", "compare"], rows, COLUMNS)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("action", choices=("solve", "compare"))
    parser.add_argument("file", nargs="?", type=Path, default=DATA)
    parser.add_argument("--cells", nargs=3, type=int, default=CELLS)
    parser.add_argument("--penalty", type=float, default=100.0)
    parser.add_argument("-o", "--output", type=Path, help="file of evidence for the pages")
    given = parser.parse_args()
    if given.action == "solve":
        solve(given.file, tuple(given.cells), given.penalty)
    else:
        compare(given.file, given.output)


if __name__ == "__main__":
    main()
