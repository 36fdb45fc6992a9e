"""The table at the head of the README: how accurate and how fast the models are on one scene.

    python benchmarks/headline.py SCENE.toml [-o docs/evidence/headline.json]

The scene's ramp by 2 degrees with all metrics in every frame; its end reached in steps of 2, 5, 10
and 30 degrees; the motion and its reverse. Values are the worst of all muscles and frames. Times
are processor times of one thread for all muscles, with surfaces and without metrics.
"""

import argparse
import os
import time
from pathlib import Path

os.environ.setdefault("NUMBA_NUM_THREADS", "1")

import numpy as np
from evidence import write_evidence

import rbfmuscle as rm
from rbfmuscle.models import build_models
from rbfmuscle.simulation.frame_loop import simulate_frames
from rbfmuscle.studies.sweep import WORST

ROOT = Path(__file__).resolve().parent.parent
# pbd-converged takes half an hour; embedded is the RBF muscle's solid shown without its field.
MODELS = ("rbf", "embedded", "pbd")
SETTINGS = {"embedded": ("rbf", {"model.surface": "embedded"})}
STEPS = (2.0, 5.0, 10.0, 30.0)


def worst(run, quantity):
    """Greatest magnitude of a quantity over all muscles and frames; None where no frame has it."""
    values = [abs(row.value) for row in run.metrics if row.quantity == quantity]
    return float(np.nanmax(values)) if values else None


def apart(one, two):
    """Greatest RMS distance of a muscle's material vertices between two sets."""
    return max(float(np.sqrt(((one[name] - two[name]) ** 2).sum(axis=1).mean())) for name in one)


def vertices(frame):
    """Material vertices by muscle."""
    return {name: np.asarray(found) for name, (found, _) in frame.material_meshes.items()}


def load(path, model):
    """The scene with a model of `MODELS` or of the library."""
    name, settings = SETTINGS.get(model, (model, {}))
    return rm.Scene.load(path).with_options(settings, model=name)


def timed(path, model):
    """Processor time per frame [s], without the first frame."""
    scene = load(path, model)
    stamps = [time.process_time() for _ in simulate_frames(scene, build_models(scene))]
    return (stamps[-1] - stamps[0]) / (len(stamps) - 1)


def measure(path, model):
    """One row: the worst of each quantity, distances between paths, and the time."""
    scene = load(path, model)
    ((name, ramp),) = scene.motion.options.model_dump(by_alias=True)["ramp"].items()
    runs = {step: rm.simulate(scene.with_options({"motion.step": step})) for step in STEPS}
    ends = [vertices(run.frames[-1]) for run in runs.values()]
    first = ramp.get("from", 0.0)
    scene.set_motion(waypoints=[{name: first}, {name: ramp["to"]}, {name: first}], step=STEPS[0])
    back = rm.simulate(scene).frames
    return {
        **{quantity: worst(runs[STEPS[0]], quantity) for quantity in WORST},
        "steps_apart": max(apart(one, two) for one in ends for two in ends),
        "there_and_back": apart(vertices(back[0]), vertices(back[-1])),
        "time_frame": timed(path, model),
    }


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("scene", type=Path, metavar="SCENE.toml")
    parser.add_argument("--models", default=",".join(MODELS))
    parser.add_argument(
        "-o", "--output", type=Path, default=ROOT / "docs" / "evidence" / "headline.json"
    )
    given = parser.parse_args()
    rows = {model: measure(given.scene, model) for model in given.models.split(",")}
    write_evidence(given.output, ["benchmarks/headline.py", str(given.scene)], rows)


if __name__ == "__main__":
    main()
