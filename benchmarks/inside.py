"""What an inside changes: RBF muscles with and without one, against the solid and the closed forms, and in time.

    python benchmarks/inside.py PART ... [--scene data/hip/flexion.toml]

Parts: ``solid`` (the phantom's extensor to the finite-element reference, over nodes and over centres), ``fibres`` (to
the one that is stiffer along its fibres), ``centres``
(neighbouring numbers of centres), ``stretched``, ``bent``, ``wrapped`` (closed forms), ``ripple`` (moment arms of a
scene's muscles by one degree) and ``time`` (processor time a frame, settings in turn). One pose over several ways is
measured by `one_pose.py`.
"""

import argparse
import itertools
import time

import numpy as np
from fe_reference import DATA, distances
from known_answers import EVEN, bent, stretched, wrapped
from peers.known_answers import observed_order

from rbfmuscle.models import build_model
from rbfmuscle.run import simulate
from rbfmuscle.sim.loop.simulate import simulate_frames
from rbfmuscle.sim.scene.phantom import phantom_scene
from rbfmuscle.sim.scene.scene import Scene
from rbfmuscle.study.measure.metrics import surface_distance

NODES, CENTRES = (150, 300, 600, 1200), (150, 300, 600, 1200)
INSIDE = 300
FIBRES = DATA.with_name("fe_reference_fibres.npz")
ROUNDS = 3
WINDOW = 21  # frames of one degree that the smooth curve of a moment arm is fitted to, a cubic


def solid():
    """Distance to the finite-element solid over the nodes of the inside, and over the centres."""
    rows = [("without", {})]
    rows += [(f"{n} nodes", {"model.inside": n}) for n in NODES]
    rows += [(f"{INSIDE} nodes, {k} centres", {"model.inside": INSIDE, "model.centres": k}) for k in CENTRES]
    for name, settings in rows:
        found = distances("rbf", DATA, settings=settings)
        print(f"{name:28}" + "".join(f"{rms:7.2f} ({worst:4.1f})" for _, rms, worst, _ in found), flush=True)


def fibres():
    """Distance to the solid that is stiffer along its fibres: no inside, an isotropic one, one like it."""
    with np.load(FIBRES) as kept:
        kept = dict(kept)
    ratio = float(kept["fibre_ratio"])
    rows = [("without", {}), (f"{INSIDE} nodes, isotropic", {"model.inside": INSIDE})]
    rows += [(f"{n} nodes, {ratio:g}", {"model.inside": n, "model.fibre_ratio": ratio}) for n in NODES[:3]]
    for name, settings in rows:
        found = distances("rbf", kept, settings=settings)
        print(f"{name:28}" + "".join(f"{rms:7.2f} ({worst:4.1f})" for _, rms, worst, _ in found), flush=True)


def centres(path):
    """Neighbouring numbers of centres: RMS distance of their surfaces at rest, 30 and 60 degrees of flexion.

    Of the phantom's extensor, or of each muscle of a scene.
    """
    cases = [(phantom_scene(end=60.0, step=30.0), "extensor")]
    if path is not None:
        cases = [(Scene.load(path), muscle.name) for muscle in Scene.load(path).muscles]
    for scene, name in cases:
        scene.muscles = [scene.muscle(name)]
        (coordinate,) = scene.motion.frames[-1]
        scene.set_motion(ramp={coordinate: {"to": 60.0, "step": 30.0}})
        for nodes in (0, INSIDE):
            runs = []
            for k in CENTRES:
                settings = {"model.resolution": 64}
                part = scene.with_options({**settings, "model.centres": k, "model.inside": nodes})
                runs.append(
                    [f.surfaces[name] for f in simulate_frames(part, [build_model(part.muscles[0], part)])]
                )
            for frame, angle in enumerate((0, 30, 60)):
                steps = [
                    surface_distance(a[frame].vertices, a[frame].faces, b[frame].vertices, b[frame].faces)[0]
                    for a, b in itertools.pairwise(runs)
                ]
                order = observed_order(np.array(CENTRES[:-1]) ** -0.5, steps)
                found = " / ".join(f"{step:.2f}" for step in steps)
                print(f"{name}, inside {nodes}, {angle} degrees: {found}, order {order:.1f}", flush=True)


def closed_forms(part):
    """Errors in per cent against closed forms."""
    for nodes in (0, 150, INSIDE, 600):
        model = {**EVEN, "centres": 300, "inside": nodes}
        if part == "wrapped":
            rows = {over: wrapped(over, model, 1.0) for over in ("cylinder", "sphere")}
        elif part == "bent":
            rows = {"bent": bent(model, 1.5)}
        else:
            rows = {f"{stretch:g}": stretched(stretch, model, 1.5) for stretch in (0.8, 1.2, 1.3)}
        for name, errors in rows.items():
            shown = ", ".join(f"{key} {100 * value:+.2f}" for key, value in errors.items())
            print(f"inside {nodes}, {part} {name}: {shown}", flush=True)


def ripple(path):
    """Moment arms by one degree, as differences and through the equilibrium, about a smooth curve [mm].

    RMS and greatest departure, greatest change of it in a degree, and the sum rule: how far the arms' integral strays
    from the change of length.
    """
    from scipy.signal import savgol_filter

    scene = phantom_scene(step=1.0) if path is None else Scene.load(path)
    (coordinate,) = scene.motion.frames[-1]
    end = np.degrees(scene.motion.frames[-1][coordinate])
    scene.set_motion(ramp={coordinate: {"to": float(end), "step": 1.0}})
    for nodes, asked in ((0, False), (INSIDE, False), (INSIDE, True)):
        settings = {"model.inside": nodes, "output.moment_arms": asked, "output.surfaces": False}
        run = simulate(scene, model="rbf", settings=settings)
        for muscle in scene.muscles:
            arm = np.array([
                row.value
                for row in run.metrics
                if (row.muscle, row.quantity, row.coordinate) == (muscle.name, "moment_arm", coordinate)
            ])  # fmt: skip
            away = arm - savgol_filter(arm, WINDOW, 3)
            length, step = run.values(muscle.name, "length"), np.radians(1.0)
            summed = length[0] - np.concatenate([[0.0], np.cumsum(0.5 * (arm[1:] + arm[:-1]) * step)])
            print(
                f"inside {nodes}, {'equilibrium' if asked else 'differences'}, {muscle.name}: "
                f"{len(arm)} arms {arm.min():.1f} to {arm.max():.1f}, "
                f"ripple {np.sqrt((away**2).mean()):.2f} RMS {np.abs(away).max():.1f} greatest, "
                f"jump {np.abs(np.diff(away)).max():.1f}, sum rule {np.abs(summed - length).max():.2f} "
                f"of {np.ptp(length):.1f}",
                flush=True,
            )


def times(path):
    """Processor time a frame [ms] without and with an inside, settings in turn, and the median ratio."""
    for muscle in (None,) if path is None else [m.name for m in Scene.load(path).muscles]:
        scene = phantom_scene() if path is None else Scene.load(path)
        scene.muscles = [scene.muscle(muscle or "extensor")]
        taken = {nodes: [] for nodes in (0, 150, INSIDE)}
        for _ in range(ROUNDS):
            for nodes, spent in taken.items():
                part = scene.with_options({"model.inside": nodes})
                model = build_model(part.muscles[0], part)
                start = time.process_time()
                for frame in simulate_frames(part, [model], ahead=False):
                    if frame.index == 0:
                        start = time.process_time()
                spent.append(1e3 * (time.process_time() - start) / (len(part.motion) - 1))
        plain = np.array(taken[0])
        for nodes, spent in taken.items():
            ratio = np.median(np.array(spent) / plain)
            print(
                f"{muscle or 'extensor'}, inside {nodes}: {np.median(spent):.1f} ms, {ratio:.2f}", flush=True
            )


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    names = ("solid", "fibres", "centres", "stretched", "bent", "wrapped", "ripple", "time")
    parser.add_argument("parts", nargs="+", choices=names)
    parser.add_argument("--scene")
    given = parser.parse_args()
    for part in given.parts:
        if part in ("stretched", "bent", "wrapped"):
            closed_forms(part)
        elif part in ("solid", "fibres"):
            {"solid": solid, "fibres": fibres}[part]()
        else:
            {"centres": centres, "ripple": ripple, "time": times}[part](given.scene)


if __name__ == "__main__":
    main()
