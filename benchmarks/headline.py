"""The table at the head of the README: how exact the RBF muscles of a scene are.

    python benchmarks/headline.py SCENE.toml [-o docs/evidence/headline.json]

The scene's ramp by 2 degrees with all metrics in every frame; its end reached by steps of 2, 5, 10 and 30 degrees; the
way there and back to rest. Lengths in the scene's unit.
"""

import argparse
from pathlib import Path

import numpy as np
from evidence import write_evidence

import rbfmuscle as rm

ROOT = Path(__file__).resolve().parent.parent
STEPS = (2.0, 5.0, 10.0, 30.0)
WORST = ("volume_error", "penetration_max", "bone_penetration_max", "solver_penetration_max")
REST = ("rest_error_rms", "rest_error_max")


def worst(run, muscle, quantity):
    """Greatest magnitude of a quantity over all frames that have it."""
    rows = [row.value for row in run.metrics if row.muscle == muscle and row.quantity == quantity]
    return float(np.nanmax(np.abs(rows)))


def apart(one, two):
    """Root mean square distance of two sets of carried vertices."""
    return float(np.sqrt(((one - two) ** 2).sum(axis=1).mean()))


def last(run):
    return {name: np.asarray(vertices) for name, (vertices, _) in run.frames[-1].carried.items()}


def there_and_back(scene, ramp, first, end):
    """Carried vertices at rest and after the motion and its reverse."""
    scene.set_motion(waypoints=[{ramp: first}, {ramp: end}, {ramp: first}], step=STEPS[0])
    run = rm.simulate(scene, model="rbf")
    return {name: np.asarray(vertices) for name, (vertices, _) in run.frames[0].carried.items()}, last(run)


def measure(path):
    """Rows by muscle: the worst of each quantity, how far steps and ways lead apart."""
    scene = rm.Scene.load(path)
    ((name, ramp),) = scene.resolved()["motion"]["ramp"].items()
    runs = {}
    for step in STEPS:
        quiet = {} if step == STEPS[0] else {"output.metrics": False}
        runs[step] = rm.simulate(
            rm.Scene.load(path).with_options({"motion.step": step, **quiet}), model="rbf"
        )
    poses = {step: last(run) for step, run in runs.items()}
    rest, back = there_and_back(rm.Scene.load(path), name, ramp.get("from", 0.0), ramp["to"])
    rows = {}
    for muscle in (m.name for m in scene.muscles):
        rows[muscle] = {q: worst(runs[STEPS[0]], muscle, q) for q in (*WORST, *REST)}
        pairs = [(a, b) for a in STEPS for b in STEPS if a < b]
        rows[muscle]["steps_apart"] = max(apart(poses[a][muscle], poses[b][muscle]) for a, b in pairs)
        rows[muscle]["there_and_back"] = apart(rest[muscle], back[muscle])
    return rows


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", type=Path, metavar="SCENE.toml")
    parser.add_argument("-o", "--output", type=Path, default=ROOT / "docs" / "evidence" / "headline.json")
    given = parser.parse_args()
    write_evidence(given.output, ["benchmarks/headline.py", str(given.scene)], measure(given.scene))


if __name__ == "__main__":
    main()
