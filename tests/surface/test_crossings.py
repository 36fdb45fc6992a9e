"""Crossings of a surface: both sides move apart by the least that parts them."""

import numpy as np
import pytest
import trimesh
from shown_ball import EDGE, FACES, VOLUME, Drawn, X, bone

from rbfmuscle.geometry.crossing import crossing_faces
from rbfmuscle.surface.finish import part_crossings, rotation
from rbfmuscle.surface.sheet import Sheet, Shown


def parted(carried, shown=None):
    drawn = Drawn()
    shown = drawn.shown if shown is None else shown
    sheet = Sheet.at(carried)
    sheet.suspect[:] = True
    moved, crossing = part_crossings(shown, drawn.bones, sheet)
    return sheet.vertices, moved, crossing


def test_a_surface_without_crossings_stays_as_it_is():
    found, moved, crossing = parted(X)
    np.testing.assert_array_equal(found, X)
    assert not moved.any() and crossing == 0


def test_a_fold_is_found_where_nothing_is_suspect_and_parted_where_folds_are_asked_for():
    drawn, carried = Drawn(), X.copy()
    carried[X[:, 2] > 0.95, 2] -= 0.5  # through nothing, but with triangles that lie on others
    carried[X[:, 2].argmax(), :2] += 3.0 * EDGE
    count = crossing_faces(carried, FACES).sum()
    assert count > 0
    for folds in (False, True):
        sheet = Sheet.at(carried)
        moved, crossing = part_crossings(drawn.shown, drawn.bones, sheet, folds=folds)
        assert crossing == 0 and moved.any() == folds
        assert crossing_faces(sheet.vertices, FACES).sum() == (0 if folds else count)


def shown_as(vertices, faces, edge):
    """A triangle mesh as a shown surface, whose edges are about so long."""
    faces = np.asarray(faces, dtype=np.int64)
    nothing = np.zeros(len(vertices))
    given = {"weights": None, "offset": nothing, "slope": nothing}
    return Shown.of(vertices, faces, 1.0, **given)._replace(edge=float(edge))


@pytest.fixture(scope="module")
def plate():
    """A thin plate as a shown surface."""
    ball = trimesh.creation.icosphere(4)
    vertices = np.array(ball.vertices) * [1.0, 1.0, 0.1]
    return shown_as(vertices, np.array(ball.faces), ball.edges_unique_length.mean())


@pytest.fixture(scope="module")
def slabs():
    """Two slabs, one above the other and set off so that their vertices do not face each other."""
    box = trimesh.creation.box([4.0, 4.0, 1.0]).subdivide().subdivide()
    low, faces = np.array(box.vertices), np.array(box.faces, dtype=np.int64)
    vertices = np.concatenate([low, low + [0.8, 0.3, 1.3]])
    faces = np.concatenate([faces, faces + len(low)])
    return shown_as(vertices, faces, box.edges_unique_length.mean())


@pytest.mark.parametrize(
    ("depth", "size", "angle"), [(0.1, 1.0, 0.0), (0.2, 1.0, 2.0), (0.2, 30.0, 0.0)]
)
def test_sheets_that_ran_into_each_other_go_back_by_half_the_depth_each(slabs, depth, size, angle):
    carried = slabs.rest.copy()
    upper = np.arange(len(carried)) >= len(carried) // 2
    close = np.exp(-2.0 * ((carried[upper, :2] - [0.8, 0.3]) ** 2).sum(axis=1))
    carried[upper, 2] -= 0.3 + depth * close
    shown = slabs._replace(rest=size * slabs.rest, edge=size * slabs.edge)
    assert crossing_faces(carried, slabs.faces).sum() > 10
    # The muscle has turned since it was at rest, and the direction at rest with it.
    turn = trimesh.transformations.rotation_matrix(angle, [1.0, 2.0, 0.5])[:3, :3]
    found, moved, crossing = parted(size * carried @ turn.T, shown)
    assert crossing == 0 and not crossing_faces(found, slabs.faces).any()
    way = (found @ turn / size - carried) / depth
    # Half the depth, and somewhat more, as triangles beside them cross then.
    for side, sign in ((upper, 1.0), (~upper, -1.0)):
        assert 0.5 <= (sign * way[side, 2]).max() < 0.65 and (sign * way[side, 2]).min() > -1e-9
    assert np.linalg.norm(way, axis=1).max() < 0.7
    np.testing.assert_allclose(way[~moved], 0.0, atol=1e-9)


def turned_inside_out(plate, depth):
    """The plate with both sides pushed through each other by a depth about its middle."""
    carried = plate.rest.copy()
    close = np.exp(-4.0 * (carried[:, :2] ** 2).sum(axis=1))
    carried[:, 2] *= 1.0 - (1.0 + depth) * close
    return carried


@pytest.mark.parametrize("depth", [0.02, 0.1, 0.3])
def test_what_is_turned_inside_out_goes_back_by_about_its_depth(plate, depth):
    carried = turned_inside_out(plate, depth)
    assert crossing_faces(carried, plate.faces).sum() > 5
    found, moved, crossing = parted(carried, plate)
    assert crossing == 0 and not crossing_faces(found, plate.faces).any()
    way = np.linalg.norm(found - carried, axis=1)
    assert way.max() < 5.0 * 0.1 * depth + 0.1 * plate.edge
    np.testing.assert_array_equal(found[~moved], carried[~moved])
    assert moved.mean() < 0.5


def test_a_displacement_grows_from_zero_and_does_not_jump(plate):
    ways, last = [], None
    for depth in np.linspace(0.0, 0.2, 21):
        carried = turned_inside_out(plate, depth)
        found, _, crossing = parted(carried, plate)
        assert crossing == 0
        away = found - carried
        ways.append(np.linalg.norm(away, axis=1).max())
        if last is not None:
            # The sides move by 0.001 a step.
            assert np.linalg.norm(away - last, axis=1).max() < 0.25 * plate.edge
        last = away
    assert ways[0] == 0.0 and ways[-1] > 0.01


@pytest.mark.parametrize("seed", [1, 2, 5])
def test_a_tangle_is_smoothed_until_none_cross(seed):
    rng = np.random.default_rng(seed)
    carried = X + 0.06 * rng.normal(size=X.shape)
    assert crossing_faces(carried, FACES).sum() > 50
    assert Drawn()(carried)[1] == 0


def test_what_parts_beside_a_bone_stays_out_of_it():
    drawn = Drawn([bone(5.0, 5.6, 0.0, 0.0)], volume=0.9 * VOLUME)
    carried = X + 0.03 * np.random.default_rng(2).normal(size=X.shape)
    found, crossing, _, _ = drawn(carried)
    assert crossing == 0 and drawn.distance(found).min() > -1e-3


def test_a_dent_through_the_other_side_is_undone_and_a_turned_surface_is_parted_alike():
    carried = X.copy()
    top = X[:, 2] > 0.9
    carried[top, 2] -= 0.4
    dented = carried + 0.5 * EDGE * np.sin(9.0 * X[:, [1, 2, 0]])
    found, _, crossing = parted(dented)
    assert crossing == 0
    turn = trimesh.transformations.random_rotation_matrix(np.array([0.2, 0.5, 0.7]))[:3, :3]
    there = parted(dented @ turn.T)[0]
    np.testing.assert_allclose(there, found @ turn.T, atol=1e-6 * EDGE)


def test_the_best_rotation_is_the_one_that_was_made():
    turn = trimesh.transformations.random_rotation_matrix(np.array([0.3, 0.1, 0.9]))[:3, :3]
    np.testing.assert_allclose(rotation(X, X @ turn + [1.0, 2.0, 3.0]), turn, atol=1e-12)
    mirrored = rotation(X, X * [1.0, 1.0, -1.0])
    assert np.linalg.det(mirrored) == pytest.approx(1.0)
