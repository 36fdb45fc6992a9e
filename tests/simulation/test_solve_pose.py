"""A pose solved straight from rest is a function of the pose alone."""

import numpy as np
import pytest

import rbfmuscle as rm
from rbfmuscle.models import build_models
from rbfmuscle.scene.objects import Motion
from rbfmuscle.simulation.frame_loop import simulate_frames, solve_pose

POSE = {"hip.flexion": np.radians(24.0), "hip.adduction": np.radians(-10.0)}
OTHER = {"hip.flexion": np.radians(30.0)}


@pytest.mark.parametrize("model", ["pbd", {"name": "rbf", "centres": 80, "samples": 300, "resolution": 16}])
def test_a_pose_is_the_same_whatever_was_solved_before(model):
    scene = rm.phantom_scene(model=model, spacing=6.0)
    scene.muscles = [scene.muscle("extensor")]
    scene.motion = Motion([POSE, OTHER])
    models = build_models(scene)
    first = solve_pose(scene, models, POSE)
    solve_pose(scene, models, OTHER)
    again = solve_pose(scene, models, POSE)
    (alone, _) = simulate_frames(scene, build_models(scene))
    for frame in (again, alone):
        np.testing.assert_array_equal(frame.carried["extensor"][0], first.carried["extensor"][0])
    assert (
        np.abs(first.surfaces["extensor"].vertices - scene.muscles[0].mesh.vertices.mean(axis=0)).max() > 1.0
    )
