"""Distance fields of bones whose meshes are open, crossed, split or degenerate."""

import logging

import numpy as np
import pytest
import trimesh
from conftest import samples

from rbfmuscle.bones.sdf import BoneSDF, prepare_bone
from rbfmuscle.validation import MeshError


@pytest.fixture(scope="module")
def ball():
    return trimesh.creation.icosphere(4, 20.0)


def _random(count=20000, width=26.0):
    return np.random.default_rng(0).uniform(-width, width, (samples(count), 3))


def _sides_right(field, points, radius=20.0, faceting=0.1):
    depth = np.linalg.norm(points, axis=1) - radius
    clear = np.abs(depth + 0.5 * faceting) > faceting
    return np.mean(field.distance(points[clear]) * depth[clear] > 0.0)


def test_open_bone_keeps_its_signs_away_from_the_hole(ball, caplog):
    centres = ball.triangles_center
    order = np.argsort(np.linalg.norm(centres - centres[7], axis=1))
    removed = order[: len(order) // 100]
    faces = np.delete(ball.faces, removed, axis=0)
    with caplog.at_level(logging.WARNING):
        field = BoneSDF.from_mesh((ball.vertices, faces), name="hip")
    assert not field.closed
    assert "hip: not closed" in caplog.text
    assert "winding numbers" in caplog.text
    radius = np.linalg.norm(centres[removed] - centres[7], axis=1).max()
    points = _random()
    away = np.linalg.norm(points - centres[7], axis=1) > 2.0 * radius
    assert _sides_right(field, points[away]) >= 0.999


def test_soup_and_faces_of_mixed_orientation_are_mended(ball):
    soup = ball.vertices[ball.faces].reshape(-1, 3)
    mixed = ball.faces.copy()
    mixed[::7] = mixed[::7, ::-1]
    for mesh in ((soup, np.arange(len(soup)).reshape(-1, 3)), (ball.vertices, mixed)):
        field = BoneSDF.from_mesh(mesh)
        assert field.closed and _sides_right(field, _random()) == 1.0


def test_a_closed_mesh_is_taken_as_it_is():
    """Two boxes, of which one's corner is where the other's is."""
    one = trimesh.creation.box((2.0, 2.0, 2.0))
    both = trimesh.util.concatenate([one, one.copy().apply_translation([2.0, 2.0, 2.0])])
    taken, closed, notes = prepare_bone(both.vertices, both.faces)
    np.testing.assert_array_equal(taken, both.faces)
    assert closed and notes == []
    turned, _, notes = prepare_bone(both.vertices, both.faces[:, ::-1])
    np.testing.assert_array_equal(turned, both.faces)
    assert notes == ["faces pointed inward and were turned"]


def _crossed(ball, away):
    """Two balls that overlap, made one shell by a tube between their facing sides."""
    other = ball.copy().apply_translation([away, 0.0, 0.0])
    one = int(np.argmax(ball.triangles_center[:, 0]))
    corners = ball.faces[one]
    mirrored = ball.vertices[corners] * [-1, 1, 1]
    across = [int(np.linalg.norm(ball.vertices - at, axis=1).argmin()) for at in mirrored]
    two = int(np.flatnonzero(np.isin(ball.faces, across).all(axis=1))[0])
    far = np.array(across) + len(ball.vertices)
    tube = [
        side
        for k in range(3)
        for side in (
            (corners[k], corners[k - 2], far[k - 2]),
            (corners[k], far[k - 2], far[k]),
        )
    ]
    faces = [np.delete(ball.faces, one, axis=0), np.delete(other.faces, two, axis=0)]
    faces = np.vstack([faces[0], faces[1] + len(ball.vertices), tube])
    return np.vstack([ball.vertices, other.vertices]), faces


def test_bone_that_intersects_itself_is_signed_by_winding_numbers(ball):
    vertices, faces = _crossed(ball, 15.0)
    field = BoneSDF.from_mesh((vertices, faces))
    assert not field.closed
    points = _random() + [7.5, 0.0, 0.0]
    depth = (
        np.min([np.linalg.norm(points - [x, 0.0, 0.0], axis=1) for x in (0.0, 15.0)], axis=0) - 20.0
    )
    clear = np.abs(depth + 0.05) > 0.1
    # Cells that both surfaces cross take their sign from their corners.
    assert (field.distance(points) * depth < 0.0)[clear].mean() < 1e-3


def test_duplicate_and_degenerate_faces_are_left_out(ball):
    faces = np.vstack([ball.faces, ball.faces[:5], [[0, 0, 1], [3, 3, 3]]])
    field = BoneSDF.from_mesh((ball.vertices, faces))
    clean = BoneSDF.from_mesh(ball)
    assert field.closed
    assert "5 duplicate faces left out" in field.notes
    assert "2 faces without area left out" in field.notes
    np.testing.assert_array_equal(field.distance(_random(2000)), clean.distance(_random(2000)))


@pytest.mark.parametrize(
    ("vertices", "faces", "message"),
    [
        ([[0, 0, np.nan], [1, 0, 0], [0, 1, 0]], [[0, 1, 2]], "vertices of shin must be finite"),
        ([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]], [[0, 0, 1]], "shin has no face with an area"),
    ],
)
def test_unusable_meshes_are_refused(vertices, faces, message):
    with pytest.raises(MeshError, match=message):
        BoneSDF.from_mesh((vertices, faces), name="shin")
