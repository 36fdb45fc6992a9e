"""Activation of the muscles along a motion, and the sub-steps that it needs."""

import itertools
import math

import numpy as np

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.scene.motion import interpolate
from rbfmuscle.scene.objects import Motion, Muscle, SceneData

# No activation changes by more in one sub-step; smaller steps change the shapes that are reached by less than
# 0.1 mm (tests/contract/test_contraction.py).
STEP = 0.1
# Further solves after activation has changed while no bone moved.
SETTLING = 4


def activation_curve(muscle: Muscle, motion: Motion) -> Floats:
    """Activation (n,) of one muscle in each frame, 0 to 1."""
    values = np.atleast_1d(0.0 if muscle.contraction is None else muscle.contraction.activation)
    return np.interp(motion.progress, np.linspace(0.0, 1.0, len(values)), values)


class Activations:
    """Activations of the muscles that contract in the frame loop, and the sub-steps that they need.

    ``here`` is that of each muscle now, 0 before the first frame; ``target``, set by hand as a window does, overrides
    the scene's own curves.
    """

    def __init__(self, scene: SceneData) -> None:
        contracting = [muscle for muscle in scene.muscles if muscle.contraction is not None]
        self.curves = {muscle.name: activation_curve(muscle, scene.motion) for muscle in contracting}
        self.here = dict.fromkeys(self.curves, 0.0)
        self.target: dict[str, float] = {}

    def at(self, frame: int) -> dict[str, float]:
        """Activation of each muscle that contracts in a frame."""
        return {
            name: self.target.get(name, float(curve[min(frame, len(curve) - 1)]))
            for name, curve in self.curves.items()
        }

    def refine(
        self, frame: int, stops: list[dict[str, float]]
    ) -> tuple[list[dict[str, float]], list[dict[str, float]]]:
        """Sub-steps short enough in activation too.

        ``stops`` are coordinates: where the bones are, then the ends of the sub-steps that they need. Returned are
        these with further ones between them, and for each but the first the activation by muscle.
        """
        if not self.curves:
            return stops, []
        goal, start = self.at(frame), self.here
        most = max(abs(goal[name] - start[name]) for name in goal)
        wanted, steps = math.ceil(most / STEP - 1e-9), len(stops) - 1
        if steps == 0 and wanted == 0:
            return stops, []
        each = max(1, math.ceil(wanted / max(1, steps)))
        fine = [stops[0]]
        for before, after in list(itertools.pairwise(stops)) or [(stops[0], stops[0])]:
            fine += [interpolate(before, after, k / each) for k in range(1, each)] + [after]
        count = len(fine) - 1
        values = [interpolate(start, goal, k / count) for k in range(1, count + 1)]
        self.here = goal
        if steps == 0:
            # Bones that stand still leave the muscles nothing else to settle in.
            fine, values = fine + [stops[0]] * SETTLING, values + [goal] * SETTLING
        return fine, values
