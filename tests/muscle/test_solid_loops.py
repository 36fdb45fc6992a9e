"""Laws of the solid's loops on systems of a few nodes: contact, transposes, volumes,
acceleration."""

import numpy as np
import pytest

from rbfmuscle.muscle.carrier import Carrier
from rbfmuscle.muscle.solid_loops import (
    Fibres,
    _deepest,
    carry_loop,
    contact_loop,
    mobility_loop,
    press_loop,
    respond_loop,
    solve_contact_forces,
    stress_loop,
    swell_loop,
    target_loop,
)
from rbfmuscle.muscle.solid_step import Anderson
from rbfmuscle.simulation.contact import HalfSpaces

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
        self.spaces = HalfSpaces(index, rng.uniform(-0.4, 0.3, len(index)), normal, source)

    def gaps(self, motion):
        """Gaps after a motion of the centres on top of that of the points."""
        s = self.spaces
        way = (self.motion + self.weights @ motion)[s.index]
        return s.gap + np.einsum("ij,ij->i", s.normal, way)


@pytest.fixture
def system(rng):
    return System(rng)


def test_one_contact_takes_its_share_up_to_the_greatest_force():
    for need, expected in ((2.0, 1.0), (-3.0, 0.0), (3.0, 1.2)):
        force = np.zeros(1)
        solve_contact_forces(np.array([[2.0]]), np.array([need]), force, 60, 1e-12, np.array([1.2]))
        assert force[0] == expected


def test_contact_forces_and_gaps_are_complementary(rng):
    root = rng.normal(size=(6, 6))
    gram = root @ root.T + 3.0 * np.eye(6)
    need = rng.normal(size=6)
    force = np.zeros(6)
    solve_contact_forces(gram, need, force, 1000, 1e-12, np.full(6, np.inf))
    slack = gram @ force - need
    assert slack.min() > -1e-10 and force.min() >= 0.0 and abs(slack @ force) < 1e-10


def test_the_deepest_contacts_come_first_and_of_equals_the_first(rng):
    lacking, chosen = rng.integers(0, 6, 40) / 5.0, rng.random(40) < 0.3
    order = [c for c in np.argsort(-lacking, kind="stable") if lacking[c] > 0.2 and not chosen[c]]
    for most in (1, 8, 40):
        assert _deepest(lacking, chosen, 0.2, most).tolist() == order[:most]


@pytest.mark.parametrize("measured", [12, 9])
def test_acceleration_solves_a_linear_map_in_few_steps(rng, measured):
    """x -> M x + b with four different eigenvalues: four differences are enough (Walker & Ni
    2011)."""
    basis = np.linalg.qr(rng.normal(size=(12, 12)))[0]
    m = basis @ np.diag(np.repeat([0.9, 0.5, -0.4, 0.1], 3)) @ basis.T
    b = rng.normal(size=12)
    x, mixer = np.zeros(12), Anderson(4, 12, measured)
    for _ in range(7):
        x = mixer.mix(x, m @ x + b)
    # The normal equations carry 1e-8 of their diagonal.
    np.testing.assert_allclose(x, np.linalg.solve(np.eye(12) - m, b), atol=1e-4)


class Cells:
    """Two tetrahedra on five nodes, a point in each, two regions."""

    columns = np.array([[0, 1, 2, 3], [1, 2, 3, 4]])
    region = np.array([0, 1])
    weights = np.array([0.7, 0.4])

    def __init__(self, rng):
        self.rest = np.array([[0, 0, 0], [1.0, 0, 0], [0, 1.0, 0], [0, 0, 1.0], [0.9, 0.8, 1.1]])
        self.slopes = np.empty((2, 4, 3))
        for q, nodes in enumerate(self.columns):
            self.slopes[q] = np.linalg.inv(np.column_stack([self.rest[nodes], np.ones(4)]))[:3].T
        self.fibre = rng.normal(size=(2, 3))
        self.fibre /= np.linalg.norm(self.fibre, axis=1, keepdims=True)
        self.start = np.array([0, 4, 8])
        self.node = self.columns.ravel()
        self.slot = np.arange(8).reshape(2, 4)

    def turn(self, y):
        q = np.tile([1.0, 0, 0, 0], (2, 1))
        f = np.empty((2, 3, 3))
        target = np.empty((2, 3, 3))
        one = np.ones(2)
        for _ in range(20):
            target_loop(
                y, self.columns, self.slopes, self.fibre, one, 0.05, q, one.copy(), f, target
            )
        return q, f, target

    def stress(self, y):
        """Deformations, gradients of the volumes, and volumes."""
        _, f, target = self.turn(y)
        zero, one = np.zeros(2), np.ones(2)
        fibres = Fibres(self.fibre, zero, zero, one, one, one)
        out = np.empty((5, 3))
        gradient = np.empty((8, 3))
        volume = np.empty(2)
        given = self.weights, self.columns, self.slopes, self.region, self.slot
        stress_loop(f, target, fibres, *given, out, gradient, volume)
        return f, gradient, volume


@pytest.fixture
def cells(rng):
    return Cells(rng)


def test_volumes_are_determinants_and_their_gradients_differences(rng, cells):
    y = cells.rest + 0.1 * rng.normal(size=(5, 3))
    f, gradient, volume = cells.stress(y)
    np.testing.assert_allclose(volume, cells.weights * np.linalg.det(f), rtol=1e-12)
    step, direction = 6e-6, rng.normal(size=(5, 3))
    ahead, behind = (cells.stress(y + s * step * direction)[2] for s in (1, -1))
    swollen = np.empty(2)
    swell_loop(direction, cells.start, cells.node, gradient, swollen)
    np.testing.assert_allclose(swollen, (ahead - behind) / (2 * step), rtol=1e-8)


def test_responses_are_those_of_the_inverse_and_their_gram_is_symmetric(rng, cells):
    root = rng.normal(size=(5, 5))
    inverse, gradient = np.linalg.inv(root @ root.T + np.eye(5)), rng.normal(size=(8, 3))
    white = np.empty((2, 3, 5))
    factor = np.zeros((2, 2))
    yielding = np.array([0.3, 2.0])
    assert respond_loop((cells.start, cells.node, gradient), inverse, yielding, white, factor)
    response, gram = np.einsum("ro,oan->ran", factor, white), factor @ factor.T - np.diag(yielding)
    for r in range(2):
        force = np.zeros((5, 3))
        swollen = np.empty(2)
        motion = rng.normal(size=(5, 3))
        press_loop(np.eye(2)[r], cells.start, cells.node, gradient, force)
        np.testing.assert_allclose(response[r].T, inverse @ force, atol=1e-12)
        swell_loop(np.ascontiguousarray(response[r].T), cells.start, cells.node, gradient, swollen)
        np.testing.assert_allclose(gram[r], swollen, rtol=2e-9)
        # Pressing and swelling are transposes.
        swell_loop(motion, cells.start, cells.node, gradient, swollen)
        assert np.vdot(force, motion) == pytest.approx(swollen[r])
    twice = (
        np.array([0, 4, 8]),
        np.tile(cells.node[:4], 2),
        np.tile(gradient[:4], (2, 1)),
    )  # no factor
    assert not respond_loop(twice, inverse, np.array([0.0, -1e-3]), white, factor)


def test_embedded_points_and_their_mobility(rng, system):
    y, out = rng.normal(size=(CENTRES, 3)), np.empty((POINTS, 3))
    carry_loop(y, system.columns, system.shares, out)
    for places in (out, Carrier(system.columns, system.shares).carry(y)):
        np.testing.assert_allclose(places, system.weights @ y, atol=1e-14)
    mobility = np.empty(POINTS)
    mobility_loop(system.columns, system.shares, system.inverse, mobility)
    literal = np.diag(system.weights @ system.inverse @ system.weights.T)
    np.testing.assert_allclose(mobility, literal, rtol=1e-12)


@pytest.mark.parametrize("yielding", [0.0, 0.03])
@pytest.mark.parametrize("batch", [1, 10])
def test_contact_meets_the_laws_and_keeps_every_region(rng, system, batch, yielding):
    """Complementarity of gaps and forces, two regions, pressures whitened: responses have the
    identity as gram.
    """
    pulls = rng.normal(size=(2, CENTRES, 3))
    answers = np.einsum("ij,rja->ria", system.inverse, pulls)
    gram = np.einsum("ria,sia->rs", pulls, answers)
    whiten = np.linalg.inv(np.linalg.cholesky(gram))
    response = np.ascontiguousarray(np.einsum("rs,sia->rai", whiten, answers))
    s, table = system.spaces, np.zeros((POINTS, 2))
    soft = yielding * np.linspace(0.5, 2.0, len(s.index))
    push, taken = np.empty((CENTRES, 3)), np.empty(2)
    for _ in range(2):  # from nothing, and from the forces of the first time
        contact_loop(
            s.index,
            s.gap,
            s.normal,
            s.source,
            system.motion,
            system.inverse,
            system.columns,
            system.shares,
            response,
            table,
            (batch, 12, 400, 1e-10),
            (soft, np.full(len(s.index), np.inf)),
            push,
            taken,
        )
        force = table[s.index, s.source]
        # A contact gives way by its force; the matrix carries 1e-7 of its diagonal.
        gaps = system.gaps(push) + soft * force
        assert force.min() >= 0.0 and np.count_nonzero(force) >= 2
        assert gaps.min() > -1e-6 and np.abs(gaps[force > 0.0]).max() < 1e-6
        np.testing.assert_allclose(np.einsum("ria,ia->r", pulls, push), 0.0, atol=1e-11)
        load = system.weights[s.index].T @ (force[:, None] * s.normal)
        whitened = np.einsum("rai,ia->r", response, load)
        np.testing.assert_allclose(taken, whitened, atol=1e-11)
