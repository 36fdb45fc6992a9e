"""Two finite-element solids in contact against known answers, and muscles that touch against the
reference that these gave.
"""

from importlib import import_module

import numpy as np
import pytest
from peers.finite_element import HexSolid, brick_grid
from peers.touching_solids import TouchingSolids

study = import_module("fe_touching")  # the script in benchmarks

HALF = 5.0  # of a block's side


def blocks(*cells):
    """Two cubes, one above the other, that touch at z = 0."""
    solids = []
    for side, count in zip((1.0, -1.0), cells):
        cube, bricks = brick_grid(count)
        solids.append(HexSolid(HALF * (cube + [0.0, 0.0, side]), bricks))
    none = [np.zeros(len(solid.facets), dtype=bool) for solid in solids]
    return TouchingSolids(solids, none, deepest=2.0)


def pressed(solid, depth):
    """Displacement when both ends of a solid about z = 0 are moved by ``depth`` each, and the force
    on the upper end.
    """
    z = solid.rest[:, 2]
    held = np.abs(z) > 2.0 * HALF - 1e-6
    u = np.zeros_like(solid.rest)
    for part in (0.5, 1.0):
        wanted = np.zeros_like(u)
        wanted[held, 2] = -np.sign(z[held]) * part * depth
        u = solid.solve(u, held, wanted, settled=1e-9).displacement
    force = solid._assemble(u)[0].reshape(-1, 3)
    return u, force[held & (z > 0.0)].sum(axis=0)


def test_contact_forces_and_their_derivative_are_those_of_the_energy():
    pair = blocks((3, 3, 2), (2, 2, 2))
    rng = np.random.default_rng(0)
    # Surfaces that are not plane, so that normals turn and points slide.
    u = 0.03 * rng.normal(size=pair.rest.shape)
    u[: pair.starts[1], 2] -= 0.3
    along = rng.normal(size=u.shape)
    along /= np.abs(along).max()
    step = 6e-6
    force, matrix = pair._assemble(u)
    ahead = u + step * along
    behind = u - step * along
    slope = (pair.energy(ahead) - pair.energy(behind)) / (2.0 * step)
    # Differences of an energy of 1e3 lose eight digits.
    assert force @ along.ravel() == pytest.approx(slope, rel=1e-6)
    change = (pair._assemble(ahead)[0] - pair._assemble(behind)[0]) / (2.0 * step)
    assert np.abs(matrix @ along.ravel() - change).max() < 1e-6 * np.abs(change).max()
    assert len(pair.forces(u)[1]) > 20


@pytest.mark.parametrize("other", [(4, 4, 4), (3, 3, 3)])
def test_two_equal_blocks_press_each_other_as_one_block_is_pressed(other):
    pair = blocks((4, 4, 4), other)
    u, force = pressed(pair, 1.5)
    cube, bricks = brick_grid((4, 4, 8))
    _, whole = pressed(HexSolid(HALF * cube * [1.0, 1.0, 2.0], bricks), 1.5)
    # The contact yields by 0.02 mm of 3, and a coarser half is some tenths of a percent stiffer.
    assert force[2] == pytest.approx(whole[2], rel=0.01)
    places, size, push = pair.forces(u)
    assert size.sum() == pytest.approx(-force[2], rel=1e-4)
    assert push.sum(axis=0) == pytest.approx(-force, abs=1e-3 * abs(force[2]))
    # The interface stays plane and midway, but for how far the contact yields.
    assert np.abs(places[:, 2]).max() < 0.03
    assert np.abs(size @ places / size.sum()).max() < 0.01
    assert max(-found.gap.min() for found in pair.overlaps(u)) < 0.05


def crowned(cells, radius, long=40.0):
    """Two quarters of blocks with round crowns, with finer bricks at the crowns; and what is
    held.
    """
    cube, bricks = brick_grid(cells)
    share = 0.5 * (cube + 1.0)
    x, y, z = (long * share**2.5).T
    z = z + np.minimum((x**2 + y**2) / (2.0 * radius), 2.0) * (1.0 - share[:, 2])
    solids = []
    inner = []
    held = []
    # The lower one is a mirror image twice over, so bricks keep their sign.
    for place in (np.stack([x, y, z], axis=1), np.stack([y, x, -z], axis=1)):
        solid = HexSolid(place, bricks)
        faces = solid.rest[solid.surface_faces()]
        inner.append((np.abs(faces[..., :2]) < 1e-9).all(axis=1).any(axis=1))
        planes = np.abs(solid.rest[:, :2]) < 1e-9
        held.append(np.column_stack([planes, share[:, 2] > 1.0 - 1e-9]))
        solids.append(solid)
    pair = TouchingSolids(solids, inner, penalty=300.0, deepest=1.0)
    return pair, np.concatenate(held)


@pytest.mark.slow  # two bodies of a thousand bricks
def test_two_round_bodies_press_each_other_as_hertz_says():
    radius = 30.0
    pair, held = crowned((10, 10, 8), radius)
    solid = pair.solids[0]
    poisson = 0.495
    young = 2.0 * solid.shear * (1.0 + poisson)
    u = np.zeros_like(pair.rest)
    for approach in (0.045, 0.09):
        wanted = np.zeros_like(u)
        wanted[:, 2] = -0.5 * approach * np.sign(pair.rest[:, 2]) * held[:, 2]
        u = pair.solve(u, held, wanted, settled=1e-8).displacement
        force = 4.0 * pair.forces(u)[2][:, 2].sum()
        modulus = 0.5 * young / (1.0 - poisson**2)
        exact = 4.0 / 3.0 * modulus * np.sqrt(0.5 * radius) * approach**1.5
        # Three bricks lie across the contact; with four the error is half as large.
        assert force == pytest.approx(exact, rel=0.08)


@pytest.mark.slow  # two whole muscles, solved anew
@pytest.mark.parametrize(
    ("file", "settings", "force"),
    [
        # The requirement is 0.1.
        (study.DATA, study.ISOTROPIC, 0.10),
        (study.FIBRES, study.REINFORCED, 0.10),
        (study.FIBRES, {}, 0.10),
        # Measured 0.29, above the requirement: the reference has no fibres, which resist stretch
        # here and add 25 % to the force.
        (study.DATA, {}, 0.33),
    ],
)
def test_muscles_that_touch_lie_near_finite_elements(file, settings, force):
    rows = study.differences(file, study.model_results("rbf", settings))
    assert len(rows) == len(study.DEPTHS)
    for row in rows:
        # The requirement is 1.5 mm; measured 0.4.
        assert max(row["upper"][0], row["lower"][0]) < 0.6
        assert abs(row["force"]) < force
        assert row["centre"] < 5.0  # the requirement; measured 1.2 mm
        assert row["caps"] == 0
