"""Errors of the models against answers in closed form, and runs refined until they no longer move.

    python benchmarks/known_answers.py [PART ...]
    python benchmarks/known_answers.py -o docs/evidence/known_answers.json    the RBF model alone

Parts are ``stretched``, ``bent``, ``wrapped`` (against closed forms), ``solid`` (what held ends do;
needs the extra ``fem``), ``centres``, ``meshes``, ``iterations``, ``substeps`` (converged runs on
the phantom). Without any, all tables are printed: some ten minutes on one thread. Errors are in per
cent; the order is the slope of the error's logarithm over that of the spacing (1 / sqrt(centres),
or the mesh's edge).
"""

import argparse
import math
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from evidence import write_evidence
from peers.known_answers import (
    bent_bar_errors,
    centreline,
    observed_order,
    path_length,
    richardson,
    stretched_bar_errors,
    wrapped_strip_errors,
)
from peers.known_scenes import (
    BENT_BAR,
    DRUM_RADIUS,
    ROUND_BAR,
    STRIPS,
    bent_bar,
    stretched_bar,
    wrapped_path,
    wrapped_strip,
)

from rbfmuscle.metrics.metrics import surface_distance
from rbfmuscle.models import build_model
from rbfmuscle.scene.phantom import phantom_scene
from rbfmuscle.simulation.frame_loop import simulate_frames

CENTRES = (150, 300, 600, 1200)
RBF = {"name": "rbf"}
STRETCHES = (0.8, 1.2, 1.3)
BEND, TURNS = 60.0, {"cylinder": 90.0, "sphere": 40.0}  # degrees


@dataclass
class Played:
    """The last frame of a scene, and the model's material surface at rest."""

    scene: object
    rest: tuple
    frame: object

    @property
    def muscle(self):
        return self.scene.muscles[0]

    @property
    def carried(self):
        return self.frame.material_meshes[self.muscle.name]

    def lines(self):
        """Centreline at rest and now."""
        still = dict.fromkeys(self.frame.poses, np.eye(4))
        return [
            centreline(self.muscle, self.scene, self.rest, mesh, poses)
            for mesh, poses in ((self.rest, still), (self.carried, self.frame.poses))
        ]


def play(scene, *, surfaces=True):
    """Run a scene with one muscle to its last frame."""
    model = build_model(scene.muscles[0], scene)
    rest = model.material_mesh()
    last = len(scene.motion) - 1
    (frame,) = simulate_frames(scene, [model], surfaces=surfaces, written=[last])
    return Played(scene, rest, frame)


def stretched(stretch, model, spacing):
    """Errors of a pulled bar."""
    played = play(stretched_bar(stretch, spacing=spacing, model=model))
    return stretched_bar_errors(stretch, ROUND_BAR, played.rest, played.frame)


def bent(model, spacing):
    """Errors of a bent bar."""
    played = play(bent_bar(BEND, spacing=spacing, model=model))
    return bent_bar_errors(math.radians(BEND), BENT_BAR, *played.lines(), played.frame)


def wrapped(over, model, spacing):
    """Errors of a strip over a cylinder or a sphere."""
    played = play(
        wrapped_strip(TURNS[over], over=over, spacing=spacing, model=model), surfaces=False
    )
    angle = math.radians(TURNS[over])
    added, lifted = wrapped_path(angle, bar=STRIPS[over])
    places = played.carried[0]
    return wrapped_strip_errors(angle, over, added, lifted, DRUM_RADIUS, *played.lines(), places)


def rbf_levels(spacing, **options):
    """Refinements of the RBF muscle on one input mesh: (label, size, model, spacing)."""
    return [(f"{k} centres", k**-0.5, {**RBF, "centres": k, **options}, spacing) for k in CENTRES]


def mesh_levels(name, spacings, options=None):
    """Refinements of a mesh muscle; ``options`` may depend on the spacing."""
    chosen = options or (lambda spacing: {})
    return [(f"{h:g} mm", h, {"name": name, **chosen(h)}, h) for h in spacings]


def settled(sweeps, spacing):
    """Options of PBD with stiff fibres and as many sweeps as let the shape settle, more on finer
    meshes.
    """
    return lambda h: {
        "fibre_exponent": 0.0,
        "slack_ratio": 1.0,
        "iterations": round(sweeps * (spacing / h) ** 2),
    }


def table(title, levels, measure, keys):
    """Print the errors of each level and their order."""
    print(f"\n### {title}\n\n| level | {' | '.join(keys)} | s |\n|---|{'---|' * (len(keys) + 1)}")
    rows = []
    for label, _, model, spacing in levels:
        start = time.perf_counter()
        found = measure(model, spacing)
        rows.append([found[key] for key in keys])
        cells = " | ".join(f"{100 * found[key]:+.2f}" for key in keys)
        print(f"| {label} | {cells} | {time.perf_counter() - start:.1f} |", flush=True)
    sizes = [level[1] for level in levels]
    orders = [observed_order(sizes, column) for column in np.array(rows).T]
    print(f"| order | {' | '.join(f'{order:.1f}' for order in orders)} | |", flush=True)


def stretched_tables():
    """Every model, pulled and compressed."""
    meshes = (4.0, 3.0, 2.0, 1.5)
    for stretch in STRETCHES:
        for name, levels in (
            ("rbf", rbf_levels(1.5)),
            ("pbd", mesh_levels("pbd", meshes)),
            ("xpbd", mesh_levels("xpbd", meshes)),
            ("arap-volume", mesh_levels("arap-volume", meshes)),
        ):
            table(
                f"stretch {stretch:g}, {name}",
                levels,
                lambda model, spacing: stretched(stretch, model, spacing),  # noqa: B023
                ("radius", "radius_ends", "waviness", "path", "volume"),
            )


def solid_table():
    """What the held ends do to a solid: an incompressible bar of bricks, pulled with its end faces
    held.
    """
    from peers.finite_element import HexSolid, brick_grid

    print("\n### solid of bricks, stretch 1.3\n\n| bricks | radius_ends | volume |\n|---|---|---|")
    goal = STRETCHES[-1]
    steps = 10
    half = 0.5 * ROUND_BAR.length
    for cells in ((40, 4, 4), (60, 6, 6)):
        cube, bricks = brick_grid(cells)
        disc = cube[:, 1:] * np.sqrt(1.0 - cube[:, :0:-1] ** 2 / 2)  # of the square
        solid = HexSolid(
            np.column_stack([half * cube[:, 0], ROUND_BAR.thickness * disc]), bricks, poisson=0.4975
        )
        held, u = np.abs(cube[:, 0]) > 1 - 1e-9, np.zeros_like(cube)
        for _ in range(steps):
            start = u.copy()
            start[:, 0] += (goal - 1.0) / steps * solid.rest[:, 0]
            u = solid.solve(start, held, start).displacement
        rim = (np.abs(cube[:, 1:]).max(axis=1) > 1 - 1e-9) & (np.abs(cube[:, 0]) <= 0.5)
        radius = np.linalg.norm((solid.rest + u)[rim, 1:], axis=1).mean()
        error = radius * math.sqrt(goal) / ROUND_BAR.thickness - 1.0
        volume = solid.volume(u) / solid.volume(np.zeros_like(u)) - 1.0
        print(
            f"| {' × '.join(map(str, cells))} | {100 * error:+.2f} | {100 * volume:+.2f} |",
            flush=True,
        )


def bent_tables():
    """Every model, bent, by default and settled."""
    keys = ("path", "arc", "radius", "volume")
    meshes = (4.0, 3.0, 2.0)
    table("bent by 60 degrees, rbf", rbf_levels(1.5), bent, keys)
    table("bent, pbd by default", mesh_levels("pbd", meshes), bent, keys)
    table("bent, pbd settled", mesh_levels("pbd", meshes, settled(2000, 4.0)), bent, keys)
    table("bent, xpbd by default", mesh_levels("xpbd", meshes), bent, keys)
    table("bent, arap-volume by default", mesh_levels("arap-volume", meshes), bent, keys)
    stiff = {"slack_ratio": 1.0, "iterations": 100}
    table(
        "bent, arap-volume settled",
        mesh_levels("arap-volume", (*meshes, 1.5), lambda h: stiff),
        bent,
        keys,
    )


def wrapped_tables():
    """Every model, wrapped, by default and settled."""
    keys = ("path", "radius", "contact")
    meshes = (3.0, 2.0, 1.5)
    stiff = {"edge_compliance": 0.002, "bending_compliance": 0.002, "iterations": 300}
    for over, turn in TURNS.items():

        def measure(model, spacing, over=over):
            return wrapped(over, model, spacing)

        title = f"over a {over} by {turn:g} degrees"
        table(f"{title}, rbf", rbf_levels(1.0), measure, keys)
        table(f"{title}, pbd by default", mesh_levels("pbd", meshes), measure, keys)
        table(f"{title}, pbd settled", mesh_levels("pbd", meshes, settled(300, 2.0)), measure, keys)
        table(f"{title}, xpbd settled", mesh_levels("xpbd", meshes, lambda h: stiff), measure, keys)
        table(f"{title}, arap-volume by default", mesh_levels("arap-volume", meshes), measure, keys)


# --- converged runs on the phantom
# ----------------------------------------------------------------------------

MUSCLE = "extensor"
FLEXIONS = (30.0, 60.0)
SIDE = math.sqrt(2.0)


def flexed(model, *, spacing=3.0, substep=2.0):
    """The phantom's extensor alone at each of ``FLEXIONS``: list of (surface, carried vertices,
    elongation).
    """
    scene = phantom_scene(end=max(FLEXIONS), step=30.0, spacing=spacing, model=model)
    scene.muscles = [scene.muscle(MUSCLE)]
    scene = scene.with_options({"contact.substep_angle": substep})
    built = build_model(scene.muscles[0], scene)
    rest = built.material_mesh()
    found = []
    lengths = []
    for frame in simulate_frames(scene, [built]):
        mesh = frame.material_meshes[MUSCLE]
        lengths.append(path_length(centreline(scene.muscles[0], scene, rest, mesh, frame.poses)))
        found.append((frame.surfaces[MUSCLE], mesh[0], lengths[-1] - lengths[0]))
    return found[1:]


def apart(one, other, *, same_mesh):
    """RMS and greatest distance of two results: of the material's points, or of the surfaces."""
    (skin, mesh, _), (second, goal, _) = one, other
    if same_mesh:
        away = np.linalg.norm(mesh - goal, axis=1)
        return math.sqrt(np.mean(away**2)), away.max()
    return surface_distance(skin.vertices, skin.faces, second.vertices, second.faces)


def converged(title, runs, *, same_mesh):
    """Print distances to the finest and to the next run, and the orders that follow.

    ``runs`` holds (label, size, result of `flexed`) from coarse to fine. Where the results converge
    with an order p, the differences of neighbours do so too.
    """
    head = " | ".join(
        f"{angle:g}°: to the finest, worst | to the next | elongation" for angle in FLEXIONS
    )
    print(f"\n### {title}\n\n| level | {head} |\n|---|{'---|---|---|' * len(FLEXIONS)}")
    steps = np.full((len(runs), len(FLEXIONS)), np.nan)
    for k, (label, _, result) in enumerate(runs):
        cells = []
        for j, here in enumerate(result):
            rms, worst = apart(here, runs[-1][2][j], same_mesh=same_mesh)
            if k + 1 < len(runs):
                steps[k, j] = apart(here, runs[k + 1][2][j], same_mesh=same_mesh)[0]
            cells.append(f"{rms:.3f}, {worst:.2f} | {steps[k, j]:.3f} | {here[2]:.3f}")
        print(f"| {label} | {' | '.join(cells)} |", flush=True)
    sizes = [size for _, size, _ in runs]
    for j, angle in enumerate(FLEXIONS):
        order = observed_order(
            sizes[-4:-1], steps[-4:-1, j]
        )  # the coarsest are often beyond all order
        exponent, limit = richardson(sizes, [result[j][2] for _, _, result in runs])
        print(
            f"{angle:g}°: surface of order {order:.1f}; elongation of order {exponent:.1f}, limit "
            f"{limit:.3f} mm"
        )


def centre_tables():
    """RBF muscles over the number of centres."""
    levels = (150, 300, 600, 1200)
    fine = [{**RBF, "nodes": n, "centres": 600, "samples": 6000, "resolution": 64} for n in levels]
    converged(
        "rbf over nodes",
        [(f"{m['nodes']} nodes", m["nodes"] ** (-1 / 3), flexed(m)) for m in fine],
        same_mesh=False,
    )


def mesh_tables():
    """Mesh muscles over the edge of their mesh [mm]."""
    for name in ("pbd", "arap-volume"):
        sides = [6.0 / SIDE**k for k in range(6)]
        runs = [(f"{h:.2f} mm", h, flexed({"name": name}, spacing=h)) for h in sides]
        converged(f"{name} over the mesh", runs, same_mesh=False)


def iteration_tables():
    """All models over the iterations of a solve."""
    for name, counts, side in (
        ("rbf", (1, 2, 4, 8, 16), 3.0),
        ("pbd", (3, 12, 48, 192, 768, 3072, 9216), 6.0),
        ("arap-volume", (6, 24, 96, 384, 1536), 6.0),
    ):
        runs = [
            (f"{n} iterations", 1.0 / n, flexed({"name": name, "iterations": n}, spacing=side))
            for n in counts
        ]
        converged(f"{name} over iterations", runs, same_mesh=True)


def substep_tables():
    """All models over the angle of a sub-step."""
    for name in ("rbf", "pbd", "arap-volume"):
        runs = [(f"{a:g}°", a, flexed({"name": name}, substep=a)) for a in (2.0, 1.0, 0.5, 0.25)]
        converged(f"{name} over the sub-step", runs, same_mesh=True)


NODES = (150, 300, 600)
COLUMNS = [
    "nodes of the solid",
    "bar stretched by 1.2, radius",
    "bar bent by 60°, length",
    "strip over a cylinder, length",
    "strip over a sphere, length",
    "strip over a cylinder, radius",
]


def rbf_errors(nodes):
    """Errors of the RBF model with 600 centres [per cent], one for each of `COLUMNS`."""
    model = {**RBF, "centres": 600, "nodes": nodes}
    over = {name: wrapped(name, model, 1.5) for name in TURNS}
    found = [
        stretched(1.2, model, 1.5)["radius"],
        bent({**model, "slack_ratio": 1.0}, 2.0)["path"],
        over["cylinder"]["path"],
        over["sphere"]["path"],
        over["cylinder"]["radius"],
    ]
    return [nodes, *(100.0 * float(error) for error in found)]


PARTS = {
    "stretched": stretched_tables,
    "solid": solid_table,
    "bent": bent_tables,
    "wrapped": wrapped_tables,
    "centres": centre_tables,
    "meshes": mesh_tables,
    "iterations": iteration_tables,
    "substeps": substep_tables,
}


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "parts", nargs="*", metavar="PART", choices=[*PARTS, []], help=", ".join(PARTS)
    )
    parser.add_argument("-o", "--output", type=Path)
    given = parser.parse_args()
    if given.output:
        rows = [rbf_errors(nodes) for nodes in NODES]
        write_evidence(given.output, ["benchmarks/known_answers.py"], rows, COLUMNS)
        return
    for part in given.parts or PARTS:
        PARTS[part]()


if __name__ == "__main__":
    main()
