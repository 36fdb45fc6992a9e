"""The benchmark of muscles that contract: closed forms, finite elements, and any surfaces measured against them.

    python benchmarks/contraction_measures.py models [rbf arap-volume ...]     the tables of docs/contraction.md
    python benchmarks/contraction_measures.py surface FILE [--activation 1]    a mesh made elsewhere, of the spindle

The spindle, its fibres and its loading stand in ``peers/contraction_scenes.py``; ``tests/data/contraction_spindle.npz``
holds the surfaces of finite elements (``vertices`` (t, n, 3) at ``activations`` (t,), ``faces`` (m, 3)), as made by
``benchmarks/contraction_reference.py``. A mesh made elsewhere is measured in the same millimetres and place: the
muscle along x, its middle at the origin, ends held at x = -160 and 160.
"""

import argparse
import time
from pathlib import Path

import numpy as np
from peers.contraction_scenes import (
    FREE_BAR,
    MUSCLE,
    PANEL,
    SPINDLE,
    bar_scene,
    panel_pennation,
    panel_scene,
    spindle_scene,
    with_frames,
)
from scipy.optimize import brentq

from rbfmuscle.models import build_model
from rbfmuscle.run import simulate
from rbfmuscle.study.measure.centreline import MuscleAtRest
from rbfmuscle.study.measure.contraction import ContractionStudy, belly_measures, pennation
from rbfmuscle.study.measure.mesh_distance import MeshDistance

DATA = Path(__file__).resolve().parents[1] / "tests" / "data" / "contraction_spindle.npz"
MODELS = ("rbf", "pbd", "xpbd", "arap-pbd", "arap-volume", "arap-interleaved")
ENDS = np.array([[-0.5, 0.0, 0.0], [0.5, 0.0, 0.0]]) * SPINDLE.length
TENDON = {"length": 0.5 * (SPINDLE.length - SPINDLE.belly_length), "strain": 0.08}


def settings(model):
    """Slender muscles want finer cells and more centres than the defaults of the RBF model."""
    return {"name": "rbf", "centres": 400, "resolution": 140} if model == "rbf" else model


def compare_spindle(vertices, faces, activation, kept):
    """Distances [mm] and relative errors of a spindle's surface against finite elements.

    Parameters
    ----------
    vertices, faces : (n, 3) and (m, 3) ndarray
        Closed, outward.
    activation : float
        One of ``kept["activations"]``.
    kept : mapping
        The arrays of the data file.

    Returns
    -------
    dict
        ``rms`` and ``worst`` [mm] of the reference's vertices between the held ends, ``csa`` (relative error of the
        greatest section) and ``place`` (its place, error as a share of the length).
    """
    row = int(np.argmin(np.abs(kept["activations"] - activation)))
    wanted = kept["vertices"][row].astype(float)
    between = np.abs(wanted[:, 0]) < 0.5 * SPINDLE.length - 5.0
    away = MeshDistance(vertices, faces).unsigned(wanted[between])
    mine = belly_measures(vertices, np.asarray(faces), *ENDS)
    theirs = belly_measures(wanted, kept["faces"], *ENDS)
    return {
        "rms": float(np.sqrt(np.mean(away**2))),
        "worst": float(away.max()),
        "csa": mine["csa_max"] / theirs["csa_max"] - 1.0,
        "place": mine["csa_place"] - theirs["csa_place"],
    }


def belly_length(rest, now):
    """Length between the sections that lay at the ends of the belly at rest, of points that move with the muscle."""
    half = 0.5 * SPINDLE.belly_length
    moved = now[:, 0] - rest[:, 0]
    ends = []
    for side in (-half, half):
        near = np.abs(rest[:, 0] - side) < 6.0
        # A line through the points about the section, as they do not lie evenly on both sides of it.
        ends.append(side + np.polyval(np.polyfit(rest[near, 0] - side, moved[near], 1), 0.0))
    return ends[1] - ends[0]


def spindle(model, kept):
    """A line for the spindle at full activation."""
    run = simulate(spindle_scene(model=settings(model), frames=4, tendon=TENDON))
    rest, now = (run.frames[k].carried[MUSCLE][0] for k in (0, -1))
    surface = run.frames[-1].surfaces[MUSCLE]
    found = compare_spindle(surface.vertices, surface.faces, 1.0, kept)
    theirs = belly_length(*(kept["vertices"][k].astype(float) for k in (0, -1)))
    mine = belly_length(rest, now)
    volume = np.abs(run.values(MUSCLE, "volume_error")).max()
    tendon = (SPINDLE.length - mine) / (SPINDLE.length - SPINDLE.belly_length) - 1.0
    print(
        f"  spindle          belly {mine:6.1f} mm ({100 * (mine / theirs - 1):+.1f} %), "
        f"greatest section {100 * found['csa']:+.1f} % at {100 * found['place']:+.1f} % of the length, "
        f"surface {found['rms']:.2f} mm RMS ({found['worst']:.1f}), "
        f"tendon {100 * tendon:+.1f} %, volume {volume:.0e}",
        flush=True,
    )


def tendon(model):
    """A line on tendon while the belly between shortens by a fifth, the insertion following it on its slider.

    ``shortening`` is what the belly is content with there, so that little but the shape's stiffness pulls the tendon.
    """
    scene = spindle_scene(
        model=settings(model),
        frames=5,
        tendon={"length": TENDON["length"]},
        shortening=0.8,
        activation=[0, 1],
    )
    pulls = 0.2 * SPINDLE.belly_length * np.linspace(0.0, 1.0, 6)
    run = simulate(with_frames(scene, pulls, SPINDLE.length))
    rest, now = (run.frames[k].carried[MUSCLE][0] for k in (0, -1))
    belly = belly_length(rest, now)
    change = (SPINDLE.length - pulls[-1] - belly) / (SPINDLE.length - SPINDLE.belly_length) - 1.0
    girth = [tendon_radius(run.frames[k].surfaces[MUSCLE].vertices, pulls[k]) for k in (0, -1)]
    print(
        f"  tendon           belly {100 * (belly / SPINDLE.belly_length - 1):+.1f} %, tendon's length "
        f"{100 * change:+.2f} %, its radius {100 * (girth[1] / girth[0] - 1):+.2f} %",
        flush=True,
    )


def tendon_radius(vertices, pull):
    """Mean radius of the two tendons, between a fifth and four fifths of their lengths."""
    half, end = 0.5 * SPINDLE.belly_length, 0.5 * SPINDLE.length
    low, high = half + 0.2 * (end - half), half + 0.8 * (end - half)
    left = (vertices[:, 0] < -low) & (vertices[:, 0] > -high)
    right = (vertices[:, 0] + pull > low) & (vertices[:, 0] + pull < high)
    return np.linalg.norm(vertices[left | right][:, 1:], axis=1).mean()


def free_bar(model):
    """Lines for the bar whose end slides to where its fibres are content on average."""
    for stretch in (0.9, 0.8, 0.7):
        scene = bar_scene(model=settings(model), spacing=4.0, activation=1.0, shortening=stretch)

        def excess(pull, scene=scene, stretch=stretch):
            run = simulate(with_frames(scene, [pull], FREE_BAR.length), settings={"output.surfaces": False})
            return run.values(MUSCLE, "fibre_stretch")[-1] - stretch

        pull = brentq(
            excess, 0.8 * (1 - stretch) * FREE_BAR.length, 1.2 * (1 - stretch) * FREE_BAR.length, xtol=0.5
        )
        run = simulate(with_frames(scene, [pull], FREE_BAR.length))
        points = run.frames[-1].surfaces[MUSCLE].vertices
        middle = 0.5 * (points[:, 0].min() + points[:, 0].max())
        radius = np.linalg.norm(points[np.abs(points[:, 0] - middle) < 60.0][:, 1:], axis=1).mean()
        length = 1.0 - pull / FREE_BAR.length
        error = 100 * (radius * np.sqrt(stretch) / 10 - 1)
        print(
            f"  free bar {stretch:.1f}     length {length:.4f}, radius {radius:.3f} mm against "
            f"{10 / np.sqrt(stretch):.3f} ({error:+.2f} %)",
            flush=True,
        )


def panel(model):
    """Lines for the pennate panel at fibre stretches 0.9 and 0.8."""
    for stretch in (0.9, 0.8):
        scene = panel_scene(stretch, model=model)
        run = simulate(scene)
        muscle = scene.muscles[0]
        study = ContractionStudy(MuscleAtRest(muscle, scene.joints, *_at_rest(scene, model)))
        angles = []
        for frame in (run.frames[0], run.frames[-1]):
            lines = study.lines(frame.carried[MUSCLE][0])
            angles.append(pennation(lines, study.belly[: len(lines)], np.eye(3)[0]))
        print(
            f"  panel {stretch:.1f}        pennation {angles[1]:.2f} degrees against {panel_pennation(stretch):.2f} "
            f"(at rest {angles[0]:.2f} against {PANEL.pennation:.2f})",
            flush=True,
        )


def _at_rest(scene, model):
    """Carried mesh of a model before the motion."""
    return build_model(scene.muscles[0], scene, model).carried_mesh()


def ramps(model):
    """A line on how much the shape depends on the way to an activation."""
    reached, back = [], []
    for count in (2, 10, 50):
        scene = spindle_scene(model=model, frames=2 * count, activation=[0, 1, 0], tendon=TENDON)
        run = simulate(scene, settings={"output.surfaces": False, "output.metrics": False})
        points = [frame.carried[MUSCLE][0] for frame in run.frames]
        reached.append(points[count])
        back.append(np.linalg.norm(points[-1] - points[0], axis=1).max())
    apart = max(np.linalg.norm(a - reached[-1], axis=1).max() for a in reached)
    print(
        f"  ramps            {apart:.3f} mm apart at the top, {max(back):.3f} mm from rest after it",
        flush=True,
    )


def cost(model):
    """A line on the time of a frame with constant activation against none, paired."""
    import rbfmuscle as rm

    plain = rm.phantom_scene(end=60.0, step=2.0)
    plain.muscles = [plain.muscle("extensor")]
    active = plain.with_options({"activation": [0, 0.3]})
    spent = []
    for scene in (plain, active, plain, active, plain, active, plain, active):
        start = time.process_time()
        run = simulate(scene, model, settings={"output.metrics": False})
        spent.append((time.process_time() - start) / len(run.frames))
    pairs = np.array(spent[2:]).reshape(-1, 2)
    print(f"  time             a frame {1e3 * pairs[:, 0].mean():.1f} ms of processor without activation, ratio "
          f"{np.median(pairs[:, 1] / pairs[:, 0]):.3f}", flush=True)  # fmt: skip


CASES = {
    "spindle": lambda model: spindle(model, np.load(DATA)),
    "tendon": tendon,
    "panel": panel,
    "ramps": ramps,
    "cost": cost,
    "free_bar": free_bar,
}


def main():
    """Run what the command line asks for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("action", choices=("models", "surface"))
    parser.add_argument("names", nargs="*", help="models, or the file of a surface")
    parser.add_argument("--activation", type=float, default=1.0)
    parser.add_argument("--cases", default=",".join(CASES), help="some of the cases, by commas")
    given = parser.parse_args()
    unknown = sorted(set(given.cases.split(",")) - set(CASES))
    if unknown:
        parser.error(f"no case {', '.join(unknown)}; known: {', '.join(CASES)}")
    if given.action == "surface":
        import trimesh

        kept = np.load(DATA)
        mesh = trimesh.load(given.names[0], process=False)
        print(compare_spindle(np.asarray(mesh.vertices), np.asarray(mesh.faces), given.activation, kept))
        return
    for model in given.names or MODELS:
        print(model, flush=True)
        for case in given.cases.split(","):
            CASES[case](model)


if __name__ == "__main__":
    main()
