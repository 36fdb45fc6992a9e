"""Gaps to a solid whose map and surface are known: an affine map of a half-space."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rbfmuscle.bones.rounded import SIDE, WIDE, RoundedBone
from rbfmuscle.solid.material import Material, ask_material, cell_at, map_at

COUNT = np.array([4, 3, 2])
SPACING = np.array([1.0, 0.8, 1.5])
ORIGIN = np.array([3.0, -2.0, 5.0])
NORMAL = np.array([2.0, -1.0, 3.0]) / np.sqrt(14.0)
MIDDLE = 0.5 * COUNT  # a cell's side is the unit of places


def half_space(through, blocks):
    """Distance to the plane through a point, known in some blocks each way from there."""
    turn = Rotation.from_rotvec([0.3, 0.2, -0.5]).as_matrix()
    edge = 1.3
    table = np.arange((2 * blocks) ** 3, dtype=np.int32).reshape((2 * blocks,) * 3)
    first = SIDE * (np.indices(table.shape).reshape(3, -1).T - blocks)
    nodes = first[:, None, :] + np.indices((WIDE, WIDE, WIDE)).reshape(3, -1).T - 1
    # A spline through the values of a linear function is that function.
    return RoundedBone(edge, through, turn, np.full(3, -blocks), table, nodes @ (turn @ NORMAL))


class Block:
    """Cells of a turned lattice at rest, whose surface is a plane through their middle."""

    def __init__(self, blocks=2):
        axes = Rotation.from_rotvec([0.7, -0.4, 0.2]).as_matrix()
        turn = axes / SPACING[:, None]
        self.back = np.linalg.inv(turn)
        cells = np.ascontiguousarray(np.indices(tuple(COUNT)).reshape(3, -1).T)
        corners = cells[:, None, :] + np.indices((3, 3, 3)).reshape(3, -1).T
        nodes = np.ascontiguousarray(np.ravel_multi_index(np.moveaxis(corners, -1, 0), COUNT + 2))
        table = np.arange(len(cells)).reshape(tuple(COUNT))
        plane = half_space(ORIGIN + self.back @ MIDDLE, blocks)
        self.material = Material(ORIGIN, turn, self.back, table, cells, nodes, plane)
        places = np.indices(tuple(COUNT + 2)).reshape(3, -1).T - 0.5
        self.rest = ORIGIN + places @ self.back.T  # the nodes

    def ask(self, y, points, start):
        """Gaps, normals, where the search ends, feet and their shares."""
        count = len(points)
        gap, normal, place = np.empty(count), np.empty((count, 3)), start.copy()
        columns, shares = np.zeros((count, 27), dtype=np.int64), np.zeros((count, 27))
        ask_material(self.material, y, points, place, gap, normal, columns, shares)
        return gap, normal, place, np.einsum("nk,nka->na", shares, y[columns]), shares


STRETCHED = np.array([[1.4, 0.5, -0.2], [0.1, 0.7, 0.3], [-0.3, 0.2, 1.1]])
TURNED = Rotation.from_rotvec([1.0, 2.0, -0.5]).as_matrix() @ STRETCHED


def test_the_map_has_its_derivatives_and_beyond_the_box_is_that_of_the_nearest_cell():
    block, step = Block(), 6e-6
    material = block.material
    y = block.rest + np.random.default_rng(4).normal(0.0, 0.1, block.rest.shape)

    def at(place):
        cell = cell_at(material.table, tuple(place))
        return cell, *map_at(material.nodes[cell], tuple(material.cells[cell]), y, tuple(place))

    for place, cell in (
        ([1.3, 2.6, 0.2], [1, 2, 0]),
        ([3.9, 0.1, 1.7], [3, 0, 1]),
        ([-2.2, 5.4, 9.3], [0, 2, 1]),
    ):
        found, _, *slopes = at(np.array(place))
        assert material.cells[found].tolist() == cell
        ways = step * np.eye(3)
        ahead, behind = (np.stack([at(place + sign * way)[1] for way in ways]) for sign in (1, -1))
        np.testing.assert_allclose(slopes, (ahead - behind) / (2 * step), atol=1e-6)


@pytest.mark.parametrize("apart", [0.0, 3.0])
@pytest.mark.parametrize("linear", [np.eye(3), STRETCHED, TURNED])
def test_gaps_and_feet_are_those_of_the_plane_that_an_affine_map_makes(linear, apart):
    rng = np.random.default_rng(3)
    block, shift = Block(), np.array([7.0, 1.0, -4.0])
    inside = MIDDLE + rng.uniform(-0.3, 0.3, (6, 3)) * COUNT
    # The last ones lie beyond the box, where the cells' functions go on.
    inside[4] = MIDDLE + 1.3 * (block.material.turn @ NORMAL)
    inside[5] = MIDDLE - 1.3 * (block.material.turn @ NORMAL)
    rest = ORIGIN + inside @ block.back.T
    points = rest @ linear.T + shift
    start = inside + apart * rng.choice([-1.0, 1.0], inside.shape)
    gap, normal, place, feet, shares = block.ask(block.rest @ linear.T + shift, points, start)
    np.testing.assert_allclose(place, inside, atol=1e-9)
    # Normals of a plane go by the inverse transpose.
    outward = np.linalg.inv(linear).T @ NORMAL
    outward /= np.linalg.norm(outward)
    np.testing.assert_allclose(normal, np.tile(outward, (6, 1)), atol=1e-9)
    middle = ORIGIN + block.back @ MIDDLE
    np.testing.assert_allclose(gap, (points - middle @ linear.T - shift) @ outward, atol=1e-9)
    assert gap.min() < -0.5 and gap.max() > 0.5
    # The feet are those at rest, on the plane below the points.
    below = rest - ((rest - middle) @ NORMAL)[:, None] * NORMAL
    np.testing.assert_allclose(feet, below @ linear.T + shift, atol=1e-9)
    np.testing.assert_allclose(shares.sum(axis=1), 1.0, atol=1e-12)


def test_a_foot_beyond_the_material_pushes_with_no_share_below_zero():
    block = Block()
    beyond = MIDDLE + 1.5 * COUNT * np.array([1.0, -1.0, 0.2])
    points = ORIGIN + beyond[None] @ block.back.T
    gap, _, _, _, shares = block.ask(block.rest, points, np.tile(MIDDLE, (1, 1)))
    assert np.isfinite(gap).all() and shares.min() == 0.0
    assert shares.sum() == pytest.approx(1.0)


def test_there_is_no_gap_to_a_surface_out_of_reach_or_a_folded_map_or_one_not_found():
    block, start = Block(blocks=1), MIDDLE[None] + 0.1
    far = ORIGIN + block.back @ (MIDDLE + 40.0 * NORMAL)
    near = ORIGIN + block.back @ (MIDDLE + 0.1)
    flat = block.rest * [1.0, 1.0, 0.0]
    for y, point, first in (
        (block.rest, far, MIDDLE + 40.0 * NORMAL),
        (flat, near, MIDDLE),
        (block.rest, near, MIDDLE + 30.0),  # a cell a step, in eight
    ):
        gap, normal, *_ = block.ask(y, point[None], first[None].copy())
        assert gap[0] == np.inf and not normal.any()
    assert np.isfinite(block.ask(block.rest, near[None], start)[0]).all()
