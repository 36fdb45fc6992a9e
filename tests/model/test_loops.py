"""Laws of the RBF muscle's loops on systems of a few centres: contact, transposes, volumes, acceleration."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rbfmuscle.geometry.rotations import quaternion_matrix
from rbfmuscle.model.contact import ROUNDS, SWEEPS, ContactConstraint, solve_contact_forces
from rbfmuscle.model.elasticity import Anderson, _carry_all_loop, _gather_loop, _move_loop
from rbfmuscle.model.inside.loops import (
    Fibres,
    carry_loop,
    mobility_loop,
    press_loop,
    respond_loop,
    stress_loop,
    swell_loop,
    touch_loop,
    turn_loop,
)
from rbfmuscle.sim.loop.contact import HalfSpaces

CENTRES, POINTS = 7, 9


@pytest.fixture
def rng():
    return np.random.default_rng(5)


class System:
    """An elastic matrix of a few centres, points that hang on them, and half-spaces that some violate."""

    def __init__(self, rng):
        root = rng.normal(size=(CENTRES, CENTRES))
        self.matrix = root @ root.T + CENTRES * np.eye(CENTRES)
        self.inverse = np.linalg.inv(self.matrix)
        self.columns = np.array([rng.choice(CENTRES, 3, replace=False) for _ in range(POINTS)])
        self.shares = rng.dirichlet(np.ones(3), POINTS)
        self.weights = np.zeros((POINTS, CENTRES))
        np.put_along_axis(self.weights, self.columns, self.shares, axis=1)
        self.pull = rng.normal(size=(CENTRES, 3))
        self.answer = self.inverse @ self.pull  # of the centres to a unit pressure
        self.stiffness = float(np.vdot(self.pull, self.answer))
        self.motion = 0.1 * rng.normal(size=(POINTS, 3))
        index = np.array([0, 1, 2, 3, 3, 5, 8])
        normal = rng.normal(size=(len(index), 3))
        normal /= np.linalg.norm(normal, axis=1, keepdims=True)
        source = np.array([0, 0, 0, 0, 1, 1, 0])
        self.spaces = HalfSpaces(index, rng.uniform(-0.4, 0.3, len(index)), normal, source)

    def constraint(self, batch=4):
        return ContactConstraint(
            self.columns, self.shares, inverse=self.inverse, free=np.arange(CENTRES), count=CENTRES,
            batch=batch, tolerance=1e-9,
        )  # fmt: skip

    def solve(self, constraint, spaces=None):
        """Motion of the centres by contact, what the volume takes back included, and the forces."""
        spaces = spaces or self.spaces
        moved = self.weights @ self.answer
        push, lost = constraint.correction(spaces, 2, self.motion, moved, self.stiffness)
        return push - self.answer * (lost / self.stiffness), constraint.forces

    def gaps(self, motion, spaces=None):
        """Gaps after a motion of the centres on top of that of the points."""
        s = spaces or self.spaces
        way = (self.motion + self.weights @ motion)[s.index]
        return s.gap + np.einsum("ij,ij->i", s.normal, way)


@pytest.fixture
def system(rng):
    return System(rng)


@pytest.mark.parametrize("batch", [1, 2, 10])
def test_contact_meets_the_laws_of_complementarity_and_keeps_the_volume(system, batch):
    motion, table = system.solve(system.constraint(batch))
    gaps = system.gaps(motion)
    force = table[system.spaces.index, system.spaces.source]
    assert system.gaps(np.zeros_like(motion)).min() < -0.2
    assert force.min() >= 0.0 and np.count_nonzero(force) >= 2
    # The matrix of the contacts carries 1e-9 of its diagonal for contacts that nothing can move.
    assert gaps.min() > -1e-6
    assert np.abs(gaps[force > 0.0]).max() < 1e-6
    assert np.vdot(system.pull, motion) == pytest.approx(0.0, abs=1e-12)
    assert set(np.flatnonzero(table.any(axis=1))) <= set(system.spaces.index)


def test_contact_forces_are_those_of_the_elastic_matrix(system):
    """A motion is what A, loaded with the contacts' forces and the pressure, gives."""
    motion, table = system.solve(system.constraint())
    force = table[system.spaces.index, system.spaces.source][:, None] * system.spaces.normal
    load = system.weights[system.spaces.index].T @ force
    pressure = np.vdot(system.answer, load) / system.stiffness
    np.testing.assert_allclose(system.matrix @ motion, load - pressure * system.pull, atol=1e-10)


def test_contact_does_not_depend_on_the_order_of_half_spaces_nor_on_the_batch(system):
    motion, _ = system.solve(system.constraint())
    order = np.random.default_rng(1).permutation(len(system.spaces))
    s = system.spaces
    turned = HalfSpaces(s.index[order], s.gap[order], s.normal[order], s.source[order])
    for batch in (1, 3, 7):
        other, _ = system.solve(system.constraint(batch), turned)
        np.testing.assert_allclose(other, motion, atol=1e-6)


def test_contact_from_the_last_forces_gives_the_same_again(system):
    constraint = system.constraint()
    motion, _ = system.solve(constraint)
    again, _ = system.solve(constraint)
    np.testing.assert_allclose(again, motion, atol=1e-6)


def test_contact_that_nothing_violates_moves_nothing(system):
    s = system.spaces
    motion, table = system.solve(
        system.constraint(), HalfSpaces(s.index, np.full(len(s), 5.0), s.normal, s.source)
    )
    assert not motion.any() and not table.any()


def test_a_contact_that_gives_way_moves_its_point_by_less(system):
    """By 1 / (1 + give) of its gap, as the force alone would move the point by the rest."""
    s = system.spaces
    for give in (0.0, 0.5, 3.0):
        one = HalfSpaces(s.index[:1], np.array([-0.4]), s.normal[:1], s.source[:1], np.array([give]))
        system.motion[:] = 0.0
        # A muscle without a volume to keep.
        push, _ = system.constraint().correction(one, 2, system.motion, np.zeros((POINTS, 3)), 1.0)
        assert system.gaps(push, one)[0] == pytest.approx(-0.4 * give / (1.0 + give), abs=1e-8)


def test_contacts_that_no_place_allows_push_no_harder_than_they_give_way(system):
    """One point between two half-spaces that overlap: rigid, their forces grow without end."""
    system.motion[:] = 0.0
    normal = np.array([[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]])
    point, gap, source = np.zeros(2, dtype=np.int64), np.full(2, -0.5), np.arange(2)
    reaction = (system.weights @ system.inverse @ system.weights.T)[0, 0]
    forces = []
    for give in (0.0, 0.1):
        between = HalfSpaces(point, gap, normal, source, np.full(2, give))
        constraint = system.constraint()
        push, _ = constraint.correction(between, 2, system.motion, np.zeros((POINTS, 3)), 1.0)
        forces.append(constraint.forces.max())
    assert np.abs(push).max() < 1e-6
    assert forces[1] == pytest.approx(0.5 / (0.1 * reaction), rel=1e-5)
    assert forces[0] > 5.0 * forces[1]


def test_the_deepest_of_many_join_first(system):
    """With one round's batch for all that is violated, and with one at a time, nothing is left over."""
    deep = HalfSpaces(
        system.spaces.index, system.spaces.gap - 0.2, system.spaces.normal, system.spaces.source
    )
    motion, _ = system.solve(system.constraint(batch=ROUNDS), deep)
    assert system.gaps(motion, deep).min() > -1e-6


def test_complementarity_of_one_contact_is_a_division():
    for need, expected in ((3.0, 1.5), (-3.0, 0.0)):
        force = np.zeros(1)
        solve_contact_forces(np.array([[2.0]]), np.array([need]), force, SWEEPS, 1e-12)
        assert force[0] == expected


def test_complementarity_stops_early_only_when_it_is_done(rng):
    root = rng.normal(size=(6, 6))
    gram, need = root @ root.T + 3.0 * np.eye(6), rng.normal(size=6)
    force = np.zeros(6)
    solve_contact_forces(gram, need, force, 1000, 1e-12)
    slack = gram @ force - need
    assert slack.min() > -1e-10 and force.min() >= 0.0 and abs(slack @ force) < 1e-10


def test_moving_and_gathering_are_transposes_of_each_other(rng, system):
    one, two = rng.normal(size=(2, CENTRES, 3))
    moved, also = np.empty((2, POINTS, 3))
    _move_loop(one, two, system.columns, system.shares, moved, also)
    np.testing.assert_allclose(moved, system.weights @ one, atol=1e-14)
    np.testing.assert_allclose(also, system.weights @ two, atol=1e-14)
    gradient, out = rng.normal(size=(POINTS, 3)), np.full((CENTRES, 3), 9.0)
    _gather_loop(gradient, system.columns, system.shares, out)
    assert np.vdot(out, one) == pytest.approx(np.vdot(gradient, moved))


def test_carried_points_turn_with_centres_that_turn(rng, system):
    rest, points = rng.normal(size=(CENTRES, 3)), rng.normal(size=(POINTS, 3))
    turn = Rotation.from_rotvec([0.3, -0.8, 0.5]).as_matrix()
    target, out = np.repeat(turn[None], CENTRES, axis=0), np.empty_like(points)
    _carry_all_loop(rest @ turn.T + 2.0, target, rest, points, system.columns, system.shares, out)
    np.testing.assert_allclose(out, points @ turn.T + 2.0, atol=1e-13)


@pytest.mark.parametrize("mixer", [Anderson(4), Anderson(4, 9)], ids=["surface", "inside"])
def test_acceleration_solves_a_linear_map_in_few_steps(rng, mixer):
    """x -> M x + b with four different eigenvalues: four differences are enough (Walker & Ni 2011)."""
    basis = np.linalg.qr(rng.normal(size=(12, 12)))[0]
    m = basis @ np.diag(np.repeat([0.9, 0.5, -0.4, 0.1], 3)) @ basis.T
    b = rng.normal(size=12)
    x = np.zeros(12)
    for _ in range(7):
        x = mixer.mix(x, m @ x + b)
    # The normal equations carry 1e-8 of their diagonal.
    np.testing.assert_allclose(x, np.linalg.solve(np.eye(12) - m, b), atol=1e-4)


@pytest.mark.parametrize("mixer", [Anderson(0), Anderson(0, 12)], ids=["surface", "inside"])
def test_without_memory_steps_are_plain(mixer):
    image = np.arange(12.0)
    np.testing.assert_array_equal(mixer.mix(np.ones(12), image), image)


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
        q, f, target = np.tile([1.0, 0, 0, 0], (2, 1)), np.empty((2, 3, 3)), np.empty((2, 3, 3))
        for _ in range(20):
            turn_loop(y, self.columns, self.slopes, q, f, target)
        return q, f, target

    def stress(self, y, passive=0.0, active=0.0, content=1.0, slack=(1.0, 1.0)):
        _, f, target = self.turn(y)
        one = np.ones(2)
        fibres = Fibres(
            self.fibre, passive * one, active * one, slack[0] * one, slack[1] * one, content * one
        )
        out, gradient, volume = np.empty((5, 3)), np.empty((8, 3)), np.empty(2)
        stress_loop(
            f, target, fibres, self.weights, self.columns, self.slopes, self.region, self.slot, out,
            gradient, volume,
        )  # fmt: skip
        return out, gradient, volume


@pytest.fixture
def cells(rng):
    return Cells(rng)


def test_deformation_of_an_affine_map_is_its_matrix_and_the_target_its_rotation(rng, cells):
    turn = Rotation.from_rotvec([0.4, 0.2, -0.5]).as_matrix()
    stretch = np.diag([1.2, 0.9, 0.95])
    q, f, target = cells.turn(cells.rest @ (turn @ stretch).T + 3.0)
    for i in range(2):
        np.testing.assert_allclose(f[i], turn @ stretch, atol=1e-12)
        np.testing.assert_allclose(target[i], turn, atol=1e-9)
        np.testing.assert_allclose(np.array(quaternion_matrix(q[i])), turn, atol=1e-9)


def test_a_slack_fibre_asks_for_the_length_it_has_and_a_taut_one_for_the_nearest_end(cells):
    # Both cells at rest: the fibres' length is 1.
    def asked(slack):
        return cells.stress(cells.rest, passive=2.0, slack=slack)[0] - cells.stress(cells.rest)[0]

    taut = asked((1.0, 1.0))
    np.testing.assert_allclose(asked((0.9, 1.2)), taut, atol=1e-12)
    np.testing.assert_allclose(asked((0.7, 0.8)), 0.8 * taut, atol=1e-12)
    np.testing.assert_allclose(asked((1.1, 1.2)), 1.1 * taut, atol=1e-12)


def test_volumes_are_determinants_and_their_gradients_differences(rng, cells):
    y = cells.rest + 0.1 * rng.normal(size=(5, 3))
    _, gradient, volume = cells.stress(y)
    _, f, _ = cells.turn(y)
    np.testing.assert_allclose(volume, cells.weights * np.linalg.det(f), rtol=1e-12)
    step, direction = 6e-6, rng.normal(size=(5, 3))
    ahead, behind = (cells.stress(y + s * step * direction)[2] for s in (1, -1))
    swollen = np.empty(2)
    swell_loop(direction, cells.start, cells.node, gradient, swollen)
    np.testing.assert_allclose(swollen, (ahead - behind) / (2 * step), rtol=1e-8)


def test_pressing_and_swelling_are_transposes(rng, cells):
    gradient, motion, pressure = rng.normal(size=(8, 3)), rng.normal(size=(5, 3)), rng.normal(size=2)
    force, swollen = np.zeros((5, 3)), np.empty(2)
    press_loop(pressure, cells.start, cells.node, gradient, force)
    swell_loop(motion, cells.start, cells.node, gradient, swollen)
    assert np.vdot(force, motion) == pytest.approx(swollen @ pressure)


def test_right_side_balances_the_laplacian_at_rest_and_carries_the_fibres(rng, cells):
    """With F = T at rest, Σ w T ∇N is Σ w F ∇N: no force is left; a fibre adds its own stress along itself."""
    out, _, _ = cells.stress(cells.rest)
    laplacian = np.zeros((5, 5))
    for q, nodes in enumerate(cells.columns):
        laplacian[np.ix_(nodes, nodes)] += cells.weights[q] * cells.slopes[q] @ cells.slopes[q].T
    np.testing.assert_allclose(out, laplacian @ cells.rest, atol=1e-12)
    y = cells.rest + 0.1 * rng.normal(size=(5, 3))
    given = {"passive": 2.5, "active": 1.5, "content": 0.6}
    fibres = cells.stress(y, **given)[0] - cells.stress(y)[0]
    _, f, _ = cells.turn(y)
    expected = np.zeros((5, 3))
    for q, nodes in enumerate(cells.columns):
        along = f[q] @ cells.fibre[q]
        pull = cells.weights[q] * (2.5 + 1.5 * 0.6) * along / np.linalg.norm(along)
        expected[nodes] += np.outer(cells.slopes[q] @ cells.fibre[q], pull)
    np.testing.assert_allclose(fibres, expected, atol=1e-11)


def test_responses_are_those_of_the_inverse_and_their_gram_is_symmetric(rng, cells):
    root = rng.normal(size=(5, 5))
    inverse, gradient = np.linalg.inv(root @ root.T + np.eye(5)), rng.normal(size=(8, 3))
    response, gram = np.empty((2, 3, 5)), np.empty((2, 2))
    respond_loop(cells.start, cells.node, gradient, inverse, response, gram)
    for r in range(2):
        force, swollen = np.zeros((5, 3)), np.empty(2)
        press_loop(np.eye(2)[r], cells.start, cells.node, gradient, force)
        np.testing.assert_allclose(response[r].T, inverse @ force, atol=1e-12)
        swell_loop(np.ascontiguousarray(response[r].T), cells.start, cells.node, gradient, swollen)
        np.testing.assert_allclose(gram[r], swollen, atol=1e-12)
    np.testing.assert_allclose(gram, gram.T, atol=1e-12)


def test_embedded_points_and_their_mobility(rng, system):
    y, out = rng.normal(size=(CENTRES, 3)), np.empty((POINTS, 3))
    carry_loop(y, system.columns, system.shares, out)
    np.testing.assert_allclose(out, system.weights @ y, atol=1e-14)
    mobility = np.empty(POINTS)
    mobility_loop(system.columns, system.shares, system.inverse, mobility)
    np.testing.assert_allclose(
        mobility, np.diag(system.weights @ system.inverse @ system.weights.T), rtol=1e-12
    )


@pytest.mark.parametrize("yielding", [0.0, 0.03])
@pytest.mark.parametrize("batch", [1, 10])
def test_contact_inside_meets_the_laws_and_keeps_every_region(rng, system, batch, yielding):
    """As for the surface alone, with two regions whose pressures are whitened: response r has gram = identity."""
    pulls = rng.normal(size=(2, CENTRES, 3))
    answers = np.einsum("ij,rja->ria", system.inverse, pulls)
    gram = np.einsum("ria,sia->rs", pulls, answers)
    whiten = np.linalg.inv(np.linalg.cholesky(gram))
    response = np.ascontiguousarray(np.einsum("rs,sia->rai", whiten, answers))
    s, table = system.spaces, np.zeros((POINTS, 2))
    push, taken = np.empty((CENTRES, 3)), np.empty(2)
    for _ in range(2):  # from nothing, and from the forces of the first time
        touch_loop(
            s.index, s.gap, s.normal, s.source, system.motion, system.inverse, system.columns, system.shares,
            response, table, batch, 12, 400, 1e-10, yielding, push, taken,
        )  # fmt: skip
        force = table[s.index, s.source]
        # A contact gives way by its force; the matrix carries 1e-7 of its diagonal.
        gaps = system.gaps(push) + yielding * force
        assert force.min() >= 0.0 and np.count_nonzero(force) >= 2
        assert gaps.min() > -1e-6 and np.abs(gaps[force > 0.0]).max() < 1e-6
        np.testing.assert_allclose(np.einsum("ria,ia->r", pulls, push), 0.0, atol=1e-11)
        load = system.weights[s.index].T @ (force[:, None] * s.normal)
        whitened = np.einsum("rai,ia->r", response, load)
        np.testing.assert_allclose(taken, whitened, atol=1e-11)
