"""Mesh muscles leave bones with their held ends too, and do not go through themselves where that is asked for."""

import numpy as np
import pytest
from spindle_scene import build_scene

from pbd_baseline.muscle import PBDMuscle
from pbd_baseline.options import PBDOptions
from pbd_baseline.self_collision import SelfCollision
from rbfmuscle.geometry.crossing import crossing_faces
from rbfmuscle.metrics.penetration import BoneProbe, surface_depth
from rbfmuscle.scene.joints.joint import rotation_about
from rbfmuscle.simulation.frame_loop import simulate_frames


@pytest.fixture
def model():
    scene = build_scene()
    return PBDMuscle(scene.muscles[0], scene)


def folded(points, rng):
    """The spindle with its belly pushed through its own back, and a dent pulled out on the other side."""
    points = points.copy()
    belly = np.exp(-((points[:, 0] - 6.0) ** 2 + points[:, 2] ** 2) / 30.0) * (points[:, 1] > 0)
    points[:, 1] -= 1.6 * belly * points[:, 1].max()
    return points + 0.02 * rng.normal(size=points.shape)


def untangle(model, points):
    """Triangles that still cross others after points were smoothed in place; the volume is restored in each round."""
    return SelfCollision(model.rest).untangle(
        points, lambda: model.shape.restore_volume(points, model.contact)
    )


def test_what_crosses_itself_does_not_after_untangling(model):
    points = folded(model.rest.vertices, np.random.default_rng(1))
    faces = model.rest.topology.faces
    before = points.copy()
    crossing = crossing_faces(points, faces)
    assert crossing.sum() > 20
    assert untangle(model, points) == 0
    assert not crossing_faces(points, faces).any()
    assert model.rest.volume.volume(points) == pytest.approx(model.rest.volume.rest, rel=1e-9)
    # far from the fold only the volume moves anything
    far = np.linalg.norm(before - before[faces[crossing].ravel()].mean(axis=0), axis=1) > 30.0
    assert np.linalg.norm(points - before, axis=1)[far].max() < 1.5


def test_what_smoothing_does_not_untangle_is_calmed(model):
    """The lower half inside out: no neighbourhood of the seam can be put right by itself."""
    points, rest = model.rest.vertices.copy(), model.rest.vertices
    points[points[:, 2] < 0.0] *= [-1.0, 1.0, 1.0]
    assert untangle(model, points) == 0
    assert not crossing_faces(points, model.rest.topology.faces).any()
    turn = rotation_about([0.3, 1.0, -0.2], 0.7, np.array([5.0, 1.0, -9.0]))
    moved = rest @ turn[:3, :3].T + turn[:3, 3]
    smoothed = SelfCollision(model.rest).smooth_displacement(moved, 40)
    np.testing.assert_allclose(smoothed, moved, atol=1e-9)


def test_a_surface_without_crossings_is_left_as_it_is(model):
    points = model.rest.vertices.copy()
    assert SelfCollision(model.rest).untangle(points, lambda: pytest.fail("nothing was to be settled")) == 0
    np.testing.assert_array_equal(points, model.rest.vertices)


@pytest.mark.parametrize(
    ("method", "leaves"), [("pbd", True), ("xpbd", True), ("arap-volume", True), ("pbd-paper", False)]
)
def test_an_end_that_is_driven_into_a_bone_comes_out_of_it(method, leaves):
    """The lower bone is turned so far that the end it holds enters the ball; as the paper has it, it stays there."""
    scene = build_scene()
    scene.add_joint("hinge", "upper", "lower", centre=[0.0, -22.0, 0.0], axes={"turn": [1.0, 0.0, 0.0]})
    scene.set_motion(ramp={"hinge.turn": {"from": 0.0, "to": 20.0, "step": 5.0}})
    model = PBDMuscle(scene.muscles[0], scene, PBDOptions(method=method, self_collision=leaves))
    *_, frame = simulate_frames(scene, [model])
    surface = frame.surfaces["spindle"]
    probes = [BoneProbe(bone.name, bone.mesh) for bone in scene.bones]
    depth = surface_depth(surface.vertices, probes, frame.poses).max()
    assert depth < 0.05 if leaves else depth > 1.0
    if leaves:
        assert not crossing_faces(surface.vertices, np.asarray(surface.faces)).any()
    assert abs(model.volume() / model.rest.volume.rest - 1.0) < 1e-10
