"""Moment arms by nudging against those of a fine ramp through the same pose, where several coordinates have moved.

    python benchmarks/nudged_arms.py [--steps 0.5 1 2] [--muscles extensor,abductor]

The embedded hip, three poses of three coordinates. The ramp goes by 0.1 degrees through the pose; -dl/dq is taken over
the same span as the nudge. It is run twice: as any motion is (each frame a few iterations), and settled at every pose,
as a nudged muscle is. Prints the greatest difference for each muscle, step and kind of ramp.
"""

import argparse
from collections import defaultdict

import numpy as np

from rbfmuscle.models import build_models
from rbfmuscle.sim.loop.nudge import nudge, settle
from rbfmuscle.sim.loop.simulate import FrameLoop
from rbfmuscle.sim.plan.reach import build_fields, reached_bones
from rbfmuscle.sim.scene.motion import bone_poses
from rbfmuscle.sim.scene.phantom import phantom_scene
from rbfmuscle.study.measure.centreline import Centreline, MuscleAtRest

NAMES = ("hip.flexion", "hip.adduction", "hip.internal_rotation")
POSES = ((40.0, 10.0, 0.0), (20.0, 6.0, 5.0), (50.0, -8.0, -10.0))
FINE = 0.1  # degree


class Judge:
    """The phantom's muscles, built once, put back to rest for every way."""

    def __init__(self, muscles):
        self.scene = phantom_scene(end=60.0)
        if muscles:
            self.scene.muscles = [self.scene.muscle(name) for name in muscles]
        self.models = build_models(self.scene)
        self.rest = [model.snapshot() for model in self.models]
        self.lines = {
            m.name: Centreline(MuscleAtRest(self.scene.muscle(m.name), self.scene.joints, *m.carried_mesh()))
            for m in self.models
        }
        self.fields = build_fields(self.scene, reached_bones(self.scene))

    def loop(self):
        """A frame loop from rest."""
        for model, state in zip(self.models, self.rest):
            model.restore(state)
        return FrameLoop(self.scene, self.models, fields=self.fields, surfaces=False)

    def lengths(self, loop):
        """Length of every muscle where the loop is."""
        poses = bone_poses(self.scene, loop.here)
        return [self.lines[s.name].length(s.model.carried_mesh()[0], poses) for s in loop.steppers]

    def ramp(self, pose, coordinate, reach, settled):
        """Lengths (n, muscles) on the ramp from ``reach`` [degree] below a pose to as much above it."""
        found = []
        with self.loop() as loop:
            for change in np.radians(np.arange(-reach, reach + 0.5 * FINE, FINE)):
                loop.skip({**pose, coordinate: pose[coordinate] + change})
                if settled:
                    for stepper in loop.steppers:
                        settle(stepper, loop.here)
                found.append(self.lengths(loop))
        return np.array(found)

    def nudged(self, pose, step):
        """Arms by muscle and coordinate."""
        self.scene.output = self.scene.output.changed("moment_arms", {"step": step}, place="")
        found = {}
        with self.loop() as loop:
            loop.skip(pose)
            for stepper in loop.steppers:
                settle(stepper, loop.here)
                line = self.lines[stepper.name]
                for name, (span, below, above) in nudge(stepper, loop.here).items():
                    found[stepper.name, name] = -(line.length(*above) - line.length(*below)) / span
        return found


def main():
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=float, nargs="+", default=[0.5, 1.0, 2.0])
    parser.add_argument("--muscles")
    given = parser.parse_args()
    judge = Judge(given.muscles.split(",") if given.muscles else None)
    reach, worst = max(given.steps), defaultdict(float)
    for degrees in POSES:
        pose = dict(zip(NAMES, np.radians(degrees).tolist()))
        arms = {step: judge.nudged(pose, step) for step in given.steps}
        for coordinate in NAMES:
            for settled in (False, True):
                lengths = judge.ramp(pose, coordinate, reach, settled)
                for k, name in enumerate(judge.lines):
                    for step in given.steps:
                        middle, beside = len(lengths) // 2, round(step / FINE)
                        change = lengths[middle + beside, k] - lengths[middle - beside, k]
                        away = abs(arms[step][name, coordinate] + change / np.radians(2.0 * step))
                        worst[name, step, settled] = max(worst[name, step, settled], away)
        print(f"{degrees} done", flush=True)
    for (name, step, settled), value in sorted(worst.items()):
        print(
            f"{name:20} nudged by {step:g}: {value:.2f} mm off the {'settled' if settled else 'plain'} ramp"
        )


if __name__ == "__main__":
    main()
