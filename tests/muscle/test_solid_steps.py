"""Laws of the solid's loops on systems of a few nodes: contact, transposes, volumes,
acceleration."""

from typing import NamedTuple

import numpy as np
import pytest

from rbfmuscle.bones.obstacles import Known
from rbfmuscle.muscle.anderson import mix, no_memory
from rbfmuscle.muscle.contact_forces import (
    Law,
    contact_push,
    deepest,
    no_answers,
    solve_forces,
)
from rbfmuscle.muscle.global_step import BULK, Metric, find_metric, press, swell
from rbfmuscle.muscle.local_step import POINTS as IN_CELL
from rbfmuscle.muscle.local_step import local_step, start_local, volumes
from rbfmuscle.muscle.model import Cells, Embedding, Fibres, carry, mobility
from rbfmuscle.muscle.near_points import Near, Touch

CENTRES, POINTS = 7, 9


@pytest.fixture
def rng():
    return np.random.default_rng(5)


class System:
    """An elastic matrix of a few centres, points that hang on them, and half-spaces that some
    violate.
    """

    def __init__(self, rng):
        root = rng.normal(size=(CENTRES, CENTRES))
        self.inverse = np.linalg.inv(root @ root.T + CENTRES * np.eye(CENTRES))
        self.columns = np.array([rng.choice(CENTRES, 3, replace=False) for _ in range(POINTS)])
        self.shares = rng.dirichlet(np.ones(3), POINTS)
        self.weights = np.zeros((POINTS, CENTRES))
        np.put_along_axis(self.weights, self.columns, self.shares, axis=1)
        self.motion = 0.1 * rng.normal(size=(POINTS, 3))
        index = np.array([0, 1, 2, 3, 3, 5, 8])
        normal = rng.normal(size=(len(index), 3))
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        source = np.array([0, 0, 0, 0, 1, 1, 0])
        self.touch = Touch(index, rng.uniform(-0.4, 0.3, len(index)), normal, source)
        known = Known(np.zeros((0, POINTS, 3)), np.zeros((0, POINTS)))
        self.near = Near(
            np.arange(POINTS),
            self.columns,
            self.shares,
            np.ones(POINTS, dtype=bool),
            np.full(POINTS, np.inf),
            np.zeros((POINTS, 2)),
            np.zeros((0, POINTS)),
            known,
            known,
            np.zeros((CENTRES, 3)),
            np.zeros(POINTS),
            np.zeros(POINTS),
        )

    def gaps(self, motion):
        """Gaps after a motion of the centres on top of that of the points."""
        s = self.touch
        way = (self.motion + self.weights @ motion)[s.point]
        return s.gap + np.einsum("ij,ij->i", s.normal, way)


@pytest.fixture
def system(rng):
    return System(rng)


def test_one_contact_takes_its_share_up_to_the_greatest_force():
    for need, expected in ((2.0, 1.0), (-3.0, 0.0), (3.0, 1.2)):
        force = np.zeros(1)
        solve_forces(np.array([[2.0]]), np.array([need]), force, 60, 1e-12, np.array([1.2]))
        assert force[0] == expected


def test_contact_forces_and_gaps_are_complementary(rng):
    root = rng.normal(size=(6, 6))
    delassus = root @ root.T + 3.0 * np.eye(6)
    need = rng.normal(size=6)
    force = np.zeros(6)
    assert solve_forces(delassus, need, force, 1000, 1e-12, np.full(6, np.inf))
    assert not solve_forces(delassus, need, np.zeros(6), 1, 1e-12, np.full(6, np.inf))
    slack = delassus @ force - need
    assert slack.min() > -1e-10 and force.min() >= 0.0 and abs(slack @ force) < 1e-10


def test_the_deepest_contacts_come_first_and_of_equals_the_first(rng):
    lacking, chosen = rng.integers(0, 6, 40) / 5.0, rng.random(40) < 0.3
    order = [c for c in np.argsort(-lacking, kind="stable") if lacking[c] > 0.2 and not chosen[c]]
    for most in (1, 8, 40):
        assert deepest(lacking, chosen, 0.2, most).tolist() == order[:most]


@pytest.mark.parametrize("measured", [12, 9])
def test_acceleration_solves_a_linear_map_in_few_steps(rng, measured):
    """x -> M x + b with four different eigenvalues: four differences are enough (Walker & Ni
    2011)."""
    basis = np.linalg.qr(rng.normal(size=(12, 12)))[0]
    m = basis @ np.diag(np.repeat([0.9, 0.5, -0.4, 0.1], 3)) @ basis.T
    b = rng.normal(size=12)
    x, memory = np.zeros(12), no_memory(4, 12, measured)
    for _ in range(7):
        x = mix(memory, x, m @ x + b)
    # The normal equations carry 1e-8 of their diagonal.
    np.testing.assert_allclose(x, np.linalg.solve(np.eye(12) - m, b), atol=1e-4)


class Solid(NamedTuple):
    """What the local step reads of a model."""

    rest: np.ndarray
    cells: Cells
    fibres: Fibres


class State(NamedTuple):
    """What it starts from."""

    rotations: np.ndarray
    stretches: np.ndarray


class Tetrahedra:
    """Two tetrahedra on five nodes, each a cell and a region; of its points one has a weight."""

    def __init__(self, rng):
        self.rest = np.array([[0, 0, 0], [1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0], [0.9, 0.8, 1.1]])
        nodes, weights = np.array([[0, 1, 2, 3], [1, 2, 3, 4]]), np.zeros((2, IN_CELL))
        weights[:, 2] = [0.7, 0.4]
        corners = np.concatenate([self.rest[nodes], np.ones((2, 4, 1))], axis=2)
        slopes = np.linalg.inv(corners)[:, :3].swapaxes(1, 2)
        self.cells = Cells(
            nodes,
            np.repeat(slopes, IN_CELL, axis=2),
            weights.ravel(),
            np.zeros((2 * IN_CELL, 3)),
            np.array([0, 1]),
            np.arange(8).reshape(2, 4),
            np.array([0, 4, 8]),
            nodes.ravel(),
            weights.sum(axis=1),
        )
        fibre = rng.normal(size=(2 * IN_CELL, 3))
        fibre /= np.linalg.norm(fibre, axis=1, keepdims=True)
        zero, one = np.zeros(2 * IN_CELL), np.ones(2 * IN_CELL)
        self.fibres = Fibres(fibre, zero, zero, one, one, one)

    def stress(self, y):
        """Deformations, gradients of the volumes, and volumes."""
        solid = Solid(self.rest, self.cells, self.fibres)
        turns = np.tile([1.0, 0, 0, 0], (2 * IN_CELL, 1))
        local = start_local(solid, State(turns, np.ones(2 * IN_CELL)), 0.0)
        local_step(self.cells, y, 0.05, local)
        f = local.work.reshape(2, -1, IN_CELL)[:, :9, 2].reshape(2, 3, 3)
        return f, local.gradient, local.volumes


@pytest.fixture
def cells(rng):
    return Tetrahedra(rng)


def test_volumes_are_determinants_and_their_gradients_differences(rng, cells):
    y = cells.rest + 0.1 * rng.normal(size=(5, 3))
    f, gradient, volume = cells.stress(y)
    np.testing.assert_allclose(volume, cells.cells.volumes * np.linalg.det(f), rtol=1e-12)
    np.testing.assert_allclose(volumes(cells.cells, y), volume, rtol=1e-12)
    step, direction = 6e-6, rng.normal(size=(5, 3))
    ahead, behind = (cells.stress(y + s * step * direction)[2] for s in (1, -1))
    swollen = swell(direction, cells.cells, gradient)
    np.testing.assert_allclose(swollen, (ahead - behind) / (2 * step), rtol=1e-8)


def test_responses_are_those_of_the_inverse_and_their_gram_is_symmetric(rng, cells):
    root = rng.normal(size=(5, 5))
    inverse, gradient = np.linalg.inv(root @ root.T + np.eye(5)), rng.normal(size=(8, 3))
    given = cells.cells._replace(volumes=BULK * np.array([0.3, 2.0]))
    metric, sound = find_metric(given, gradient, inverse)
    assert sound
    factor = np.tril(metric.factor)
    response = np.einsum("ro,oan->ran", factor, metric.response)
    delassus = factor @ factor.T - np.diag([0.3, 2.0])
    for r in range(2):
        force, motion = np.zeros((5, 3)), rng.normal(size=(5, 3))
        press(np.eye(2)[r], given, gradient, force)
        np.testing.assert_allclose(response[r].T, inverse @ force, atol=1e-12)
        swollen = swell(np.ascontiguousarray(response[r].T), given, gradient)
        np.testing.assert_allclose(delassus[r], swollen, rtol=2e-9)
        # Pressing and swelling are transposes.
        assert np.vdot(force, motion) == pytest.approx(swell(motion, given, gradient)[r])
    # Twice the same region, that gives way the wrong way, has no factor.
    twice = given._replace(node=np.tile(given.node[:4], 2), volumes=BULK * np.array([0.0, -1e-3]))
    assert not find_metric(twice, np.tile(gradient[:4], (2, 1)), inverse)[1]


def test_embedded_points_and_their_mobility(rng, system):
    nodes, cell = np.unique(system.columns, axis=0, return_inverse=True)
    order = np.argsort(cell.ravel(), kind="stable")
    start = np.searchsorted(cell.ravel()[order], np.arange(len(nodes) + 1))
    by_cell = np.ascontiguousarray(system.shares[order].T)
    embedding = Embedding(system.columns, system.shares, nodes, start, order, by_cell)
    y = rng.normal(size=(CENTRES, 3))
    np.testing.assert_allclose(carry(embedding, y), system.weights @ y, atol=1e-14)
    literal = np.diag(system.weights @ system.inverse @ system.weights.T)
    found = mobility(system.columns, system.shares, system.inverse)
    np.testing.assert_allclose(found, literal, rtol=1e-12)


@pytest.mark.parametrize("yielding", [0.0, 0.03])
def test_contact_meets_the_laws_and_keeps_every_region(rng, system, yielding):
    """Complementarity of gaps and forces, two regions, pressures whitened: responses have the
    identity as delassus.
    """
    pulls = rng.normal(size=(2, CENTRES, 3))
    moved = np.einsum("ij,rja->ria", system.inverse, pulls)
    delassus = np.einsum("ria,sia->rs", pulls, moved)
    factor = np.linalg.cholesky(delassus)
    response = np.ascontiguousarray(np.einsum("rs,sia->rai", np.linalg.inv(factor), moved))
    metric = Metric(system.inverse, response, factor)
    s, near = system.touch, system.near
    soft = yielding * np.linspace(0.5, 2.0, len(s.point))
    law = Law(soft, np.full(len(s.point), np.inf))
    answers = no_answers(near, metric)
    for _ in range(2):  # from nothing, and from the forces of the first time
        found = contact_push(s, system.motion, near, metric, answers, law, near.forces, 1e-10)
        force = near.forces[s.point, s.source]
        # A contact gives way by its force; the matrix carries 1e-7 of its diagonal.
        gaps = system.gaps(found.nodes) + soft * force
        assert not found.capped
        assert force.min() >= 0.0 and np.count_nonzero(force) >= 2
        assert gaps.min() > -1e-6 and np.abs(gaps[force > 0.0]).max() < 1e-6
        np.testing.assert_allclose(np.einsum("ria,ia->r", pulls, found.nodes), 0.0, atol=1e-11)
        load = system.weights[s.point].T @ (force[:, None] * s.normal)
        whitened = np.einsum("rai,ia->r", response, load)
        np.testing.assert_allclose(found.taken, whitened, atol=1e-11)
