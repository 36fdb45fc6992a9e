"""Contacts as half-spaces, several bones at once, and overlap at rest."""

from itertools import product

import numpy as np
import pytest
from toy_scene import ToyMuscle, attach, box, ellipsoid, muscle, scene, sphere

from rbfmuscle.geometry.frames import moved_box
from rbfmuscle.scene.joints import rotation_about
from rbfmuscle.simulation.contact import BoneContacts, BonesInReach, Fences
from rbfmuscle.simulation.frame_loop import simulate_frames
from rbfmuscle.simulation.stepper import MuscleStepper, keep_initial_overlap


def _points(count=400, seed=0):
    return np.random.default_rng(seed).uniform(-6, 6, (count, 3))


def _pair(attached=None):
    bones = BonesInReach(["ball", "plate"], [sphere(2.0), box((3, 3, 0.5))])
    contacts = BoneContacts(bones, np.full(400, -1) if attached is None else attached)
    poses = {"ball": rotation_about([0, 1, 0], 0.3, np.array([5.0, 0, 0])), "plate": np.eye(4)}
    poses["plate"][:3, 3] = [0, 0, 4.0]
    contacts.move(poses)
    return contacts, poses


def _literal(contacts, poses, points, reach):
    """All pairs nearer than reach, one by one."""
    pairs = {}
    for b, (name, field) in enumerate(zip(contacts.bones.names, contacts.bones.fields)):
        distance, gradient = field.distance_and_gradient(points, poses[name])
        for i in np.flatnonzero(distance < reach):
            pairs[i, b] = distance[i], gradient[i]
    return pairs


@pytest.mark.parametrize("reach", [0.5, 3.0, 100.0])
def test_half_spaces_are_all_pairs_nearer_than_reach(reach):
    attached = np.where(np.arange(400) % 3 == 0, 0, -1)  # which take no contact
    contacts, poses = _pair(attached)
    points, rng = _points(), np.random.default_rng(1)
    for _ in range(10):  # later calls rely on distances known from the earlier ones
        every = _literal(contacts, poses, points, reach)
        expected = {(i, b): one for (i, b), one in every.items() if i % 3}
        found = contacts.half_spaces(points, reach)
        assert {(i, b) for i, b in zip(found.point, found.source)} == set(expected)
        for i, b, gap, normal in zip(found.point, found.source, found.gap, found.normal):
            assert gap == pytest.approx(expected[i, b][0], abs=1e-12)
            assert np.allclose(normal, expected[i, b][1])
        points = points + rng.normal(size=points.shape) * 0.4


def test_fences_come_behind_bones():
    contacts, _ = _pair()
    points, rng = _points(), np.random.default_rng(4)
    bones = len(contacts.half_spaces(points, 0.5).point)
    at, gap = rng.permutation(400)[:60], rng.normal(size=60)
    contacts.fences = Fences(at, gap, rng.normal(size=(60, 3)), points[at])
    wanted = [(i, 2, g) for i, g in zip(at, gap) if g < 0.5]
    found = contacts.half_spaces(points, 0.5)
    rows = list(zip(found.point[bones:], found.source[bones:], found.gap[bones:]))
    assert rows == wanted and (found.source[:bones] < 2).all()


def test_nearest_is_the_smallest_over_bones_and_infinite_without():
    contacts, poses = _pair()
    bones, points = contacts.bones, _points()
    expected = np.min(
        [f.distance(points, poses[n]) for f, n in zip(bones.fields, bones.names)], axis=0
    )
    assert np.isinf(BonesInReach([], []).nearest(points, {})[0]).all()
    distance, gradient = bones.nearest(points, poses)
    assert np.allclose(distance, expected)
    assert np.allclose(np.linalg.norm(gradient, axis=1), 1.0)
    limit = np.random.default_rng(2).uniform(0.0, distance.max(), len(points))
    found, slope = bones.nearest(points, poses, limit)
    below = distance < limit
    assert 0 < below.sum() < len(points)
    assert np.array_equal(found[below], distance[below])
    assert np.array_equal(slope[below], gradient[below])
    assert np.all(found[~below] >= limit[~below]) and np.all(found <= distance + 1e-9)


def test_moved_box_holds_what_is_in_the_box():
    rng = np.random.default_rng(3)
    for _ in range(50):
        bounds = np.sort(rng.uniform(-3, 3, (2, 3)), axis=0)
        pose = rotation_about(rng.normal(size=3), rng.uniform(0, 3), rng.uniform(-2, 2, 3))
        corners = np.array(list(product(*bounds.T))) @ pose[:3, :3].T + pose[:3, 3]
        assert np.allclose(moved_box(bounds, pose), [corners.min(axis=0), corners.max(axis=0)])


def test_kept_overlap_is_no_contact_and_deeper_is():
    fields = {"plate": box((6, 6, 2), (0, 0, -4.0)), "far": box((1, 1, 1), (60, 0, 0))}
    mesh = ellipsoid((30, 4, 4), subdivisions=3)
    ends = [
        attach(mesh, "plate", lambda v: v[:, 0] < -24),
        attach(mesh, "far", lambda v: v[:, 0] > 24),
    ]
    made = scene(fields, [], [muscle("belly", mesh, ends)], [{}], initial="keep")
    model = ToyMuscle(made.muscles[0], made)
    contacts = BoneContacts(BonesInReach(list(fields), list(fields.values())), model.attached_bone)
    stepper = MuscleStepper(model, contacts, made)
    points = model.contact_points().copy()
    assert contacts.depth(points) == pytest.approx(2.0, abs=1e-9)
    held = BoneContacts(contacts.bones, np.zeros(len(points)))
    assert held.depth(points) == 0.0  # free points alone count
    keep_initial_overlap(stepper)
    assert stepper.contacts.half_spaces(points, 0.5).gap.min() >= -1e-12
    assert stepper.contacts.half_spaces(points - [0, 0, 0.1], 0.5).gap.min() == pytest.approx(-0.1)
    shown = contacts.lifted(points)
    assert contacts.depth(shown) < 1e-9
    inside = fields["plate"].distance(points) < 0.0
    np.testing.assert_array_equal((shown != points).any(axis=1), inside & contacts.free)
    (frame,) = simulate_frames(made, [model], bone_sdfs=fields)
    assert [event.action for event in frame.events] == ["overlap_kept"]
    assert np.array_equal(model.contact_points(), model.rest)
