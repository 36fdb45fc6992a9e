"""What it costs that a shape depends on its pose alone, and how smooth it is: `contact.from_rest` and frame by frame.

    python benchmarks/from_rest.py [--scene data/hip/flexion.toml] [--muscles NAME ...] [--set model.inside=300]

A leg of one coordinate at another one held aside (flexion at 25 degrees of abduction, by one degree): there each frame
has a way of its own from rest. Printed are, with and without, sub-steps and processor time, the ripple of the moment
arms -dl/dq about a cubic fitted to 21 degrees, and the greatest jump of it in a degree.
"""

import argparse
import time

import numpy as np
from scipy.signal import savgol_filter

from rbfmuscle.models import build_models
from rbfmuscle.sim.loop.simulate import simulate_frames
from rbfmuscle.sim.scene.phantom import phantom_scene
from rbfmuscle.sim.scene.scene import Scene
from rbfmuscle.sim.scene.settings import parse_setting
from rbfmuscle.study.measure.centreline import Centreline, MuscleAtRest

ASIDE, LEG = {"hip.adduction": -25.0}, {"hip.flexion": 60.0}
WINDOW = 21  # frames of one degree


def leg(scene):
    """Lengths (frames,) of the scene's only muscle along the leg, sub-steps, and processor time [s]."""
    scene.set_motion(waypoints=[{}, ASIDE, {**ASIDE, **LEG}], step=1.0)
    (muscle,), (model,) = scene.muscles, build_models(scene)
    line = Centreline(MuscleAtRest(muscle, scene.joints, *model.carried_mesh()))
    began, lengths, substeps = time.process_time(), [], 0
    for frame in simulate_frames(scene, [model], surfaces=False):
        lengths.append(line.length(frame.carried[muscle.name][0], frame.poses))
        substeps += frame.work[muscle.name].substeps
    first = round(abs(next(iter(ASIDE.values()))))
    return np.array(lengths[first:]), substeps, time.process_time() - began


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--scene")
    parser.add_argument("--muscles", nargs="*")
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE")
    given = parser.parse_args()
    whole = phantom_scene() if given.scene is None else Scene.load(given.scene)
    whole = whole.with_options(dict(parse_setting(text) for text in given.set))
    for name in given.muscles or [muscle.name for muscle in whole.muscles]:
        for from_rest in (False, True):
            scene = whole.with_options({"contact.from_rest": from_rest})
            scene.muscles = [scene.muscle(name)]
            length, substeps, seconds = leg(scene)
            arm = -np.diff(length) / np.radians(1.0)
            away = arm - savgol_filter(arm, WINDOW, 3)
            print(
                f"{name}, {'from rest' if from_rest else 'frame by frame'}: {substeps} sub-steps, {seconds:.1f} s, "
                f"arms {arm.min():.1f} to {arm.max():.1f}, ripple {np.sqrt((away**2).mean()):.2f} RMS "
                f"{np.abs(away).max():.1f} greatest, jump {np.abs(np.diff(away)).max():.1f}",
                flush=True,
            )


if __name__ == "__main__":
    main()
