"""A spindle between two bones, beside a ball that they turn about."""

import numpy as np
import trimesh
from toy_scene import held

from rbfmuscle.scene.scene import Scene

CENTRE = np.array([0.0, -22.0, 0.0])


def build_scene():
    """A spindle of 90 mm before a ball of 10 mm that its two bones turn about."""
    muscle = trimesh.creation.icosphere(subdivisions=4)
    muscle.apply_transform(np.diag([12.0, 9.0, 45.0, 1.0]))
    ball = trimesh.creation.icosphere(subdivisions=3, radius=10.0)
    ball.apply_translation(CENTRE)
    ends = [trimesh.creation.icosphere(subdivisions=2, radius=8.0) for _ in range(2)]
    ends[0].apply_translation([0, 0, 50])
    ends[1].apply_translation([0, 0, -50])
    scene = Scene("spindle", units="mm")
    for name, mesh in zip(("upper", "lower", "ball"), (*ends, ball)):
        scene.add_bone(name, mesh)
    z = muscle.vertices[:, 2]
    scene.add_muscle("spindle", muscle, attach=held(upper=z > 38.0, lower=z < -38.0))
    return scene
