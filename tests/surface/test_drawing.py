"""The surface of a muscle in one frame: level sets of known shapes, bones, crossings, volume."""

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation
from shown_ball import BALL, CENTRES, EDGE, FACES, VOLUME, Drawn, X, bone

from rbfmuscle.geometry.crossing import crossing_faces
from rbfmuscle.surface.finish import clear_rest
from rbfmuscle.surface.projection import FARTHEST, UNSURE


def test_at_rest_the_surface_is_the_mesh_itself():
    found, crossing, fitted, left = Drawn()(X)
    np.testing.assert_allclose(found, X, atol=1e-12)
    assert (crossing, fitted, left.any()) == (0, True, False)


def test_vertices_come_to_lie_on_the_level_that_gives_the_volume():
    noise = np.random.default_rng(1).normal(size=(len(X), 1))
    drawn = Drawn(volume=1.06 * VOLUME)
    carried = X * (1.0 + 0.01 * noise)
    found, crossing, fitted, _ = drawn(carried)
    assert (crossing, fitted) == (0, True)
    # The last step of the level is of first order.
    assert np.abs(drawn.height(found)).max() < 1e-4
    assert drawn.level == pytest.approx(1.06 ** (1 / 3) - 1.0, abs=0.004)
    again = drawn(carried)[0]
    assert np.abs(drawn.height(again)).max() < 1e-5, "it starts where it ended"


def test_what_a_bone_takes_away_lies_on_it():
    drawn = Drawn([bone(5.0, 5.5, 0.0, 0.0)], volume=0.8 * VOLUME)
    found, crossing, fitted, _ = drawn(X)
    distance = drawn.distance(found)
    assert (crossing, fitted) == (0, True)
    # Bone vertices are kept out of the triangles, by a hundredth of an edge.
    assert distance.min() > -1e-4 * EDGE
    on_bone = np.abs(distance) < 1e-4
    assert on_bone.sum() > 50
    assert np.abs(drawn.height(found)[distance > 0.1 * EDGE]).max() < 1e-3


def test_bone_vertices_end_up_outside():
    middle = BALL.triangles_center[0] * 0.97 ** (1 / 3)
    spike = (middle - 0.1 * EDGE * BALL.face_normals[0])[None]
    drawn = Drawn([bone(1e-3, *spike[0])], points=spike, volume=0.97 * VOLUME)
    found = drawn(X)[0]
    depth = trimesh.proximity.signed_distance(trimesh.Trimesh(found, FACES), spike)
    # A hundredth of an edge is the tolerance; 0.12 without being pushed.
    assert depth[0] <= 0.015 * EDGE


def test_where_the_field_has_faded_vertices_stay_where_the_material_is():
    drawn = Drawn()
    faded = X[:, 0] > 0.3
    slope = np.where(faded, 4.0, 1.0) * drawn.shown.slope
    drawn.shown = drawn.shown._replace(slope=slope)
    carried = X * (1.0 + 0.02 * np.sin(5.0 * X[:, 1:2]))
    found, crossing, fitted, left = drawn(carried)
    assert (crossing, fitted) == (0, True)
    # A twentieth of an edge is never refused.
    way = np.linalg.norm(found - carried, axis=1) / EDGE
    assert way[faded].max() == pytest.approx(0.05, abs=1e-12)
    np.testing.assert_array_equal(left[faded], way[faded] > 0.05 - 1e-9)
    assert left[faded].sum() > 50 and not left[~faded].any()


def test_how_far_a_vertex_may_go_does_not_depend_on_the_last_frame():
    drawn = Drawn()
    # Half of the vertices trust the field by two thirds, and less than their way to it.
    slope = np.where(X[:, 2] > 0.0, 1.5, 1.0) * drawn.shown.slope
    drawn.shown = drawn.shown._replace(slope=slope)
    carried = X * (1.0 + 0.4 * EDGE * np.sin(7.0 * X[:, 1:2]))
    first, crossing, fitted, left = drawn(carried)
    assert (crossing, fitted) == (0, True) and left.sum() > 50
    # The slope is that of the field where carried, 1 to within a tenth.
    most = FARTHEST * ((1.0 / 1.5 - UNSURE) / (1.0 - UNSURE)) ** 2 * EDGE
    bounded = np.linalg.norm(first[left] - carried[left], axis=1)
    assert np.median(bounded) == pytest.approx(most, rel=0.1)
    for level in EDGE * np.array([-0.2, 0.1, 0.3]):
        drawn.level = level
        found, crossing, _, again = drawn(carried)
        both = left & again
        assert crossing == 0 and both.sum() > 50
        ways = [np.linalg.norm(x[both] - carried[both], axis=1) for x in (first, found)]
        np.testing.assert_allclose(*ways, rtol=1e-9)


@pytest.mark.parametrize(
    ("bones", "noise"),
    [
        ([], 0.05),
        ([bone(0.5, 1.3, 0.0, 0.0)], 0.0),
        ([bone(0.5, 1.3, 0.0, 0.0)], 0.05),
        ([bone(0.9, 0.0, 0.0, 0.9)], 0.0),
    ],
)
def test_a_surface_without_a_field_keeps_volume_and_leaves_the_bone(bones, noise):
    drawn = Drawn(bones)
    carried = X + noise * np.random.default_rng(5).normal(size=X.shape)
    found, crossing, fitted, left = drawn(carried, fitted=False)
    assert (crossing, fitted, left.all()) == (0, False, True)
    assert not bones or drawn.distance(found).min() > -1e-3


def test_displaced_vertices_stay_and_the_volume_goes_elsewhere():
    drawn = Drawn()
    excess = np.where(X[:, 0] > 0.5, 0.05, 0.0)
    found = drawn(X, displacement=-excess[:, None] * X)[0]
    inwards = 1.0 - np.linalg.norm(found, axis=1)
    np.testing.assert_allclose(inwards[X[:, 0] > 0.5], 0.05, atol=2e-3)
    assert (inwards[X[:, 0] < 0.4] < 0.0).all()


def test_a_surface_that_turns_and_is_mirrored_turns_and_is_mirrored():
    carried = X * (1.0 + 0.02 * np.sin(5.0 * X[:, 1:2]))
    centre = np.array([5.5, 0.0, 0.3])
    first = Drawn([bone(5.0, *centre)], volume=0.9 * VOLUME)(carried)[0]
    turn = Rotation.from_rotvec([0.4, -1.2, 0.3]).as_matrix()
    drawn = Drawn([bone(5.0, *centre)], volume=0.9 * VOLUME)
    pose = np.eye(4)
    pose[:3, :3] = turn
    drawn.contacts.move({"bone 0": pose})
    drawn.field.move(CENTRES @ turn.T, CENTRES @ turn.T)
    np.testing.assert_allclose(drawn(carried @ turn.T)[0], first @ turn.T, atol=1e-9)


def test_what_a_bone_holds_is_brought_out_of_it_at_rest():
    drawn = Drawn([bone(0.5, 1.2, 0.0, 0.0)])
    held = X[:, 1] > -10.0
    found = clear_rest(drawn.shown, drawn.bones, held)
    assert drawn.distance(X).min() < -0.2 and drawn.distance(found).min() > -1e-3
    assert not crossing_faces(found, FACES).any()
    far = drawn.distance(X) > 0.3
    np.testing.assert_allclose(found[far], X[far], rtol=0, atol=1e-15)
    same = clear_rest(drawn.shown, drawn.bones, ~held)
    np.testing.assert_array_equal(same, X)
    depth = np.maximum(-drawn.distance(X), 0.0).max()
    assert np.linalg.norm(found - X, axis=1).max() < 1.1 * depth


@pytest.mark.parametrize("shift", [0.0, 0.1, -0.2])
def test_what_is_known_of_the_bones_changes_nothing(shift):
    drawn = Drawn([bone(5.0, 5.6, 0.0, 0.0)], volume=0.9 * VOLUME)
    drawn(X + [0.05, 0.0, 0.0])
    level = drawn.level
    known = drawn(X + [shift, 0.0, 0.0])[0]
    drawn.forget()
    drawn.level = level
    np.testing.assert_allclose(drawn(X + [shift, 0.0, 0.0])[0], known, rtol=0, atol=1e-12)
