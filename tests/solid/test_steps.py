"""Laws of the solid's loops on systems of a few nodes: contact, volumes, acceleration."""

from types import SimpleNamespace

import numpy as np
import pytest

from rbfmuscle.geometry.interpolation import Embedding, carry
from rbfmuscle.simulation.touching import Contacts, Wanted, find_forces, solve_forces
from rbfmuscle.solid.contact import Obstacles, Reaction, fill_delassus
from rbfmuscle.solid.kernels import (
    GRADIENT,
    POINTS,
    ROTATION,
    ROWS,
    STRETCH,
    WEIGHT,
    add_rows,
    carry_steps,
    local_step,
    region_volumes,
)
from rbfmuscle.solid.metric import inverted
from rbfmuscle.solid.model import mobility
from rbfmuscle.solid.solve import BULK, Mixer

NODES, HANGING = 40, 9


@pytest.fixture
def rng():
    return np.random.default_rng(5)


class System:
    """An elastic matrix of some nodes, and points that hang on 27 of them each."""

    def __init__(self, rng):
        root = rng.normal(size=(NODES, NODES))
        self.inverse = np.linalg.inv(root @ root.T + NODES * np.eye(NODES))
        self.columns = np.array([rng.choice(NODES, 27, replace=False) for _ in range(HANGING)])
        self.shares = rng.dirichlet(np.ones(27), HANGING)
        self.weights = np.zeros((HANGING, NODES))
        np.put_along_axis(self.weights, self.columns, self.shares, axis=1)


@pytest.fixture
def system(rng):
    return System(rng)


def forces_of(delassus, wants, most=np.inf, yields=0.0, tolerance=1e-13):
    """Forces of one solid's contacts, from nothing."""
    count = len(wants)
    every = np.arange(count)
    wanted = Wanted(
        every,
        every,
        np.zeros((count, 3)),
        np.asarray(wants, dtype=float),
        np.full(count, yields),
        np.full(count, most),
        np.zeros(count),
    )
    contacts = Contacts(wanted, Embedding(np.zeros((count, 1), dtype=int), np.ones((count, 1))))
    rows = SimpleNamespace(delassus=delassus)
    force, found = find_forces({0: contacts}, {0: every}, None, every[:0], {0: rows}, tolerance)
    return force[0], found


def test_one_contact_takes_its_share_up_to_the_greatest_force():
    for need, expected in ((2.0, 1.0), (-3.0, 0.0), (3.0, 1.2)):
        force, found = forces_of(np.array([[2.0]]), [need], most=1.2)
        assert found and force[0] == pytest.approx(expected, rel=1e-6)
    # A contact that yields by as much as it moves takes half.
    assert forces_of(np.array([[2.0]]), [2.0], yields=2.0)[0][0] == pytest.approx(0.5, rel=1e-6)


def test_contact_forces_and_gaps_are_complementary(rng):
    root = rng.normal(size=(6, 6))
    delassus = root @ root.T + 3.0 * np.eye(6)
    need = rng.normal(size=6)
    force, found = forces_of(delassus, need)
    slack = delassus @ force - need
    # The matrix carries 1e-7 of its diagonal.
    assert found and slack.min() > -1e-6 and force.min() >= 0.0 and abs(slack @ force) < 1e-6
    assert np.count_nonzero(force) >= 2


def test_forces_between_two_solids_are_those_of_one_with_both_matrices(rng):
    """Contacts of a first solid alone, of a second alone, and one between them."""
    roots = rng.normal(size=(2, 2, 2))
    first, second = (root @ root.T + 2.0 * np.eye(2) for root in roots)
    # Motions of the contacts (own of the first, between, own of the second) by the four rows.
    rows = np.array([[1.0, 0, 0, 0], [0, 1.0, 1.0, 0], [0, 0, 0, 1.0]])
    both = np.zeros((4, 4))
    both[:2, :2], both[2:, 2:] = first, second
    wants, force = np.array([1.0, 2.0, 1.5]), np.zeros(3)
    found = solve_forces(
        np.concatenate([first.ravel(), second.ravel()]),
        np.array([0, 4]),
        np.array([2, 2]),
        np.array([0, 0, 1]),
        np.array([0, 1, 1]),
        np.array([-1, 1, -1]),
        np.array([-1, 0, -1]),
        wants,
        np.zeros(3),
        np.zeros(3),
        np.full(3, np.inf),
        force,
        np.empty(4),
        1e-13,
    )
    alone, _ = forces_of(rows @ both @ rows.T, wants)
    assert found and force == pytest.approx(alone, rel=1e-6) and force.min() >= 0.0


@pytest.mark.parametrize("measured", [12, 9])
def test_acceleration_solves_a_linear_map_in_few_steps(rng, measured):
    """x -> M x + b with four different eigenvalues: four differences are enough (Walker & Ni
    2011)."""
    basis = np.linalg.qr(rng.normal(size=(12, 12)))[0]
    m = basis @ np.diag(np.repeat([0.9, 0.5, -0.4, 0.1], 3)) @ basis.T
    b = rng.normal(size=12)
    x, mixer = np.zeros(12), Mixer(measured, 12)
    for _ in range(7):
        x = mixer.mix(x, m @ x + b)
    # The normal equations carry 1e-8 of their diagonal.
    np.testing.assert_allclose(x, np.linalg.solve(np.eye(12) - m, b), atol=1e-4)


class Tetrahedra:
    """Two tetrahedra on five nodes, each a cell and a region; of its points one has a weight."""

    def __init__(self):
        self.rest = np.array([[0, 0, 0], [1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0], [0.9, 0.8, 1.1]])
        self.nodes = np.array([[0, 1, 2, 3], [1, 2, 3, 4]])
        self.weights = np.zeros((2, POINTS))
        self.weights[:, 2] = [0.7, 0.4]
        corners = np.concatenate([self.rest[self.nodes], np.ones((2, 4, 1))], axis=2)
        slopes = np.linalg.inv(corners)[:, :3].swapaxes(1, 2)
        self.slopes = np.ascontiguousarray(np.repeat(slopes, POINTS, axis=2))
        self.region = np.array([0, 1])

    def step(self, y):
        """Deformations, gradients of the volumes, and volumes."""
        rows = np.ones((2, ROWS, POINTS))
        rows[:, ROTATION + 1 : ROTATION + 4] = 0.0
        rows[:, STRETCH + 1 : STRETCH + 4] = [[1.0], [0.0], [0.0]]
        rows[:, WEIGHT] = self.weights
        work = rows.reshape(2, -1)
        right, gradient, volumes = np.empty((5, 3)), np.empty((2, 3, 5)), np.empty(2)
        local_step(self.nodes, self.slopes, self.region, y, 0.05, work, right, gradient, volumes)
        f = work.reshape(2, ROWS, POINTS)[:, GRADIENT : GRADIENT + 9, 2].reshape(2, 3, 3)
        return f, gradient, volumes


def test_volumes_are_determinants_and_their_gradients_differences(rng):
    cells = Tetrahedra()
    y = cells.rest + 0.1 * rng.normal(size=(5, 3))
    f, gradient, volume = cells.step(y)
    np.testing.assert_allclose(volume, [0.7, 0.4] * np.linalg.det(f), rtol=1e-12)
    again = np.empty(2)
    shape = cells.nodes, cells.slopes, cells.weights.ravel(), cells.region
    region_volumes(*shape, y, again)
    np.testing.assert_allclose(again, volume, rtol=1e-12)
    step, direction = 6e-6, rng.normal(size=(5, 3))
    ahead, behind = (cells.step(y + s * step * direction)[2] for s in (1, -1))
    swollen = np.einsum("ran,na->r", gradient, direction)
    np.testing.assert_allclose(swollen, (ahead - behind) / (2 * step), rtol=1e-8)


def test_embedded_points_and_their_mobility(rng, system):
    y, step, push = rng.normal(size=(3, NODES, 3))
    out = np.empty((HANGING, 3))
    carry(system.columns, system.shares, y, out)
    np.testing.assert_allclose(out, system.weights @ y, atol=1e-14)
    which = np.array([1, 4, 8])
    here, motion, reach = np.empty((3, 3)), np.empty((3, 3)), np.empty(3)
    shape = system.columns, system.shares
    carry_steps(which, *shape, y, step, push, 0.2, here, motion, reach)
    np.testing.assert_allclose(here, out[which], atol=1e-14)
    np.testing.assert_allclose(motion, (system.weights @ step)[which], atol=1e-14)
    far = np.linalg.norm((system.weights @ (step + push))[which], axis=1)
    np.testing.assert_allclose(reach, 1.5 * far + 0.2, rtol=1e-12)
    rows = np.empty((HANGING, NODES))
    add_rows(*shape, system.inverse, rows)
    np.testing.assert_allclose(rows, system.weights @ system.inverse, atol=1e-14)
    literal = np.diag(rows @ system.weights.T)
    found = mobility(Embedding(*shape), system.inverse)
    np.testing.assert_allclose(found, literal, rtol=1e-12)


def test_reactions_do_not_depend_on_when_they_were_asked_for(rng, system):
    """Points that hang on some of NODES nodes with three coordinates each."""
    root = rng.normal(size=(3 * NODES, 3 * NODES))
    inverse = np.linalg.inv(root @ root.T + NODES * np.eye(3 * NODES))
    embedding = Embedding(system.columns, system.shares)
    normal = rng.normal(size=(HANGING, 3))
    pushes = np.einsum("wn,wa->wna", system.weights, normal).reshape(HANGING, -1)
    known = Reaction(embedding, inverse)
    for asked in ([3], [5, 3, 0], [8, 1, 2, 3], range(HANGING)):
        rows = known.along(np.array(asked), normal[asked])
        np.testing.assert_allclose(rows, pushes[asked] @ inverse, atol=1e-14)
    np.testing.assert_allclose(known.at(embedding, normal), rows, atol=1e-14)
    delassus = np.empty((HANGING, HANGING))
    fill_delassus(*embedding, normal, rows, delassus)
    np.testing.assert_allclose(delassus, pushes @ inverse @ pushes.T, atol=1e-14)


def test_positive_definite_matrices_are_inverted(rng):
    root = rng.normal(size=(70, 70))
    matrix = root @ root.T + np.eye(70)
    np.testing.assert_allclose(inverted(matrix.copy()) @ matrix, np.eye(70), atol=1e-11)
    with pytest.raises(np.linalg.LinAlgError, match="not positive definite"):
        inverted(-matrix)


def test_fences_hold_the_points_that_they_name():
    nothing = np.zeros((0, 2, 3)), [], np.zeros((0, 4, 4)), np.ones(5, dtype=bool), np.zeros((0, 5))
    obstacles = Obstacles([], *nothing)
    up = np.array([[0.0, 0.0, 1.0]])
    obstacles.fences = obstacles.fences._replace(
        point=np.array([3]), gap=np.array([0.5]), normal=up, anchor=2.0 * up
    )
    here = np.array([[1.0, 1.0, 1.0], [0.0, 0.0, 4.0]])
    touch = obstacles.meet(np.array([1, 3]), here, np.full(2, 1.0))
    assert touch.near.tolist() == [1] and touch.source.tolist() == [0]
    assert touch.gap == pytest.approx([0.5 + 2.0])
    assert len(obstacles.meet(np.array([1, 2]), here, np.full(2, 1.0)).gap) == 0


def test_bulk_modulus_is_that_of_the_stated_poisson_ratio():
    # Over 2 μ the bulk modulus is (1 + ν) / (3 (1 - 2 ν)).
    ratio = 0.4988
    assert (1.0 + ratio) / (3.0 * (1.0 - 2.0 * ratio)) == pytest.approx(BULK, rel=0.1)
