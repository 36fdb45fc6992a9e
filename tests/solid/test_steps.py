"""Laws of the solid's loops on systems of a few nodes: contact, volumes, acceleration."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from rbfmuscle.geometry.interpolation import Embedding, carry
from rbfmuscle.simulation.touching import Wanted, find_forces, solve_forces
from rbfmuscle.solid.contact import Obstacles, Reaction, fill_delassus
from rbfmuscle.solid.kernels import (
    ACTIVE,
    COFACTOR,
    CONTENT,
    DETERMINANT,
    FIBRE,
    GRADIENT,
    LOWER,
    PASSIVE,
    POINTS,
    ROTATION,
    ROWS,
    STRESS,
    STRETCH,
    UPPER,
    WEIGHT,
    add_rows,
    at_points,
    carry_steps,
    local_step,
    pull_apart,
    region_volumes,
    stress_points,
    turned_normals,
)
from rbfmuscle.solid.metric import LEAST, STIFFNESS, inverted, squeezed_stiffness
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
    rows = SimpleNamespace(delassus=delassus)
    force, found = find_forces({0: wanted}, {0: every}, None, every[:0], {0: rows}, tolerance)
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


def put(work, row, values):
    """Write values (P, ...) of the points of one cell to its ``work`` (1, ROWS * P)."""
    flat = values.reshape(POINTS, -1).T
    work.reshape(ROWS, POINTS)[row : row + len(flat)] = flat


def test_stresses_of_points_are_the_derivatives_of_the_least_energy(rng):
    """Minimised over all rotations and stretches by SciPy, with active fibres and springs."""
    tension, step = 0.1, 1e-4
    f = Rotation.random(POINTS, random_state=5).as_matrix() @ (
        np.eye(3) * [0.8, 1.2, 1.1] + 0.1 * rng.normal(size=(POINTS, 3, 3))
    )
    fibre = rng.normal(size=(POINTS, 3))
    fibre /= np.linalg.norm(fibre, axis=1)[:, None]
    lower, upper, content = 0.5, 0.9, 0.7
    passive, active, weight = rng.uniform(0.5, 2.0, (3, POINTS))
    work = np.zeros((1, ROWS * POINTS))
    polar = np.linalg.svd(f)
    turn = Rotation.from_matrix(polar.U @ polar.Vh)
    for row, values in (
        (GRADIENT, f),
        (ROTATION, turn.as_quat()[:, [3, 0, 1, 2]]),
        (STRETCH, np.ones(POINTS)),
        (FIBRE, fibre),
        (LOWER, np.full(POINTS, lower)),
        (UPPER, np.full(POINTS, upper)),
        (PASSIVE, passive),
        (ACTIVE, active),
        (CONTENT, np.full(POINTS, content)),
        (WEIGHT, weight),
    ):
        put(work, row, values)
    for _ in range(20):
        stress_points(work[0], tension)

    def energy(p, f):
        a, along = fibre[p], fibre[p][:, None] * fibre[p]

        def miss(x):
            wanted = x[3] * along + (np.eye(3) - along) / np.sqrt(x[3])
            gap = f - (turn[p] * Rotation.from_rotvec(x[:3])).as_matrix() @ wanted
            return 0.5 * (gap**2).sum() - tension * (1.0 - x[3])

        free = [(None, None)] * 3 + [(lower, 1.0)]
        least = minimize(miss, [0.0, 0.0, 0.0, 0.9], bounds=free, tol=1e-14).fun
        length = np.linalg.norm(f @ a)
        beyond = length - np.clip(length, lower, upper)
        springs = passive[p] * beyond**2 + active[p] * (length - content) ** 2
        return weight[p] * (least + 0.5 * springs)

    stress = at_points(work, STRESS, 3, 3)
    for p in range(POINTS):
        way = rng.normal(size=(3, 3))
        ahead, behind = (energy(p, f[p] + sign * step * way) for sign in (1, -1))
        # What SciPy leaves of the least energy over the step of the differences.
        assert -np.vdot(stress[p], way) == pytest.approx((ahead - behind) / (2 * step), abs=1e-5)
    det = np.linalg.det(f)
    np.testing.assert_allclose(at_points(work, DETERMINANT), det, rtol=1e-12)
    cofactor = (weight * det)[:, None, None] * np.linalg.inv(f).swapaxes(1, 2)
    np.testing.assert_allclose(at_points(work, COFACTOR, 3, 3), cofactor, atol=1e-12)


@pytest.mark.parametrize("point", [0, 5])
@pytest.mark.parametrize("half_turn", [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [0.6, 0, 0.8]])
def test_pull_on_a_squeezed_point_turns_with_it(half_turn, point):
    """Of stretches alone the nearest deformation with a volume is one of stretches."""
    least, stretches = 0.5, np.array([1.2, 0.6, 0.1])
    turn = Rotation.from_rotvec(np.pi * np.asarray(half_turn, dtype=float))
    work, right = np.zeros((1, ROWS * POINTS)), np.zeros((3, 3))
    rows = work.reshape(ROWS, POINTS)
    rows[GRADIENT : GRADIENT + 9, point] = (turn.as_matrix() * stretches).ravel()
    rows[ROTATION : ROTATION + 4, point] = turn.as_quat()[[3, 0, 1, 2]]
    rows[DETERMINANT, point], rows[WEIGHT, point] = stretches.prod(), 2.0
    # Of three nodes each takes one axis, so that the right side is what the deformation lacks.
    slopes = np.zeros((1, 3, 3 * POINTS))
    slopes[0, :, point::POINTS] = np.eye(3)
    energy = pull_apart(np.array([point]), np.array([[0, 1, 2]]), slopes, least, 3.0, work, right)
    pulled = turn.as_matrix().T @ right.T / 6.0
    # Diagonal, it grows by a multiple of the cofactors of what it becomes.
    goal = stretches + np.diag(pulled)
    np.testing.assert_allclose(pulled, np.diag(np.diag(pulled)), atol=1e-9)
    assert goal.prod() == pytest.approx(least, rel=1e-3)  # ten steps of the search
    share = np.diag(pulled) * goal / least
    np.testing.assert_allclose(share, share.mean(), rtol=1e-2)
    assert energy == pytest.approx(0.5 * 6.0 * (pulled**2).sum(), rel=1e-9)


@pytest.mark.parametrize(
    ("stretches", "left"),
    [((1.2, 0.6, 0.1), 0.2), ((0.9, 0.8, 0.69), 1e-4), ((1.5, 0.9, -0.05), 0.01)],
)
def test_stiffness_of_a_squeezed_point_is_the_derivative_of_its_pull(rng, stretches, left):
    """Against differences of the pull, whose ten rounds leave some of the search."""
    turn = Rotation.from_rotvec([0.3, -0.5, 0.2]).as_matrix()
    step = 1e-6
    slopes = np.zeros((1, 3, 3 * POINTS))
    slopes[0, :, ::POINTS] = np.eye(3)

    def squeezed(f):
        work = np.zeros((1, ROWS * POINTS))
        rows = work.reshape(ROWS, POINTS)
        rows[GRADIENT : GRADIENT + 9, 0] = f.ravel()
        rows[ROTATION : ROTATION + 4, 0] = Rotation.from_matrix(turn).as_quat()[[3, 0, 1, 2]]
        rows[DETERMINANT, 0], rows[WEIGHT, 0] = np.linalg.det(f), 1.0
        return work

    def pull(f):
        right = np.zeros((3, 3))
        pull_apart(
            np.array([0]), np.array([[0, 1, 2]]), slopes, LEAST, STIFFNESS, squeezed(f), right
        )
        return right.T

    f = turn * np.array(stretches)
    found = squeezed_stiffness(squeezed(f), np.array([0]))[0]
    np.testing.assert_allclose(found, found.T, atol=1e-9 * STIFFNESS)
    for _ in range(3):
        way = rng.normal(size=(3, 3))
        change = (pull(f - step * way) - pull(f + step * way)) / (2 * step)
        np.testing.assert_allclose(found @ way.ravel(), change.ravel(), atol=left)


def test_stiffness_of_a_point_without_any_extent_is_finite():
    work = np.zeros((1, ROWS * POINTS))
    work.reshape(ROWS, POINTS)[ROTATION] = 1.0
    found = squeezed_stiffness(work, np.arange(2))
    assert np.isfinite(found).all()
    assert np.linalg.eigvalsh(found).max() == pytest.approx(STIFFNESS)


def test_normals_of_a_deformed_surface_go_by_the_inverse_transpose(rng):
    """Of a linear map, whose gradient the slopes reproduce."""
    nodes, normals = rng.normal(size=(NODES, 3)), rng.normal(size=(HANGING, 3))
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    columns = np.array([rng.choice(NODES, 27, replace=False) for _ in range(HANGING)])
    slopes = rng.normal(size=(HANGING, 27, 3))
    f = np.einsum("ska,skb->sab", nodes[columns], slopes)
    wanted = np.linalg.det(f)[:, None] * np.einsum("sba,sb->sa", np.linalg.inv(f), normals)
    wanted /= np.linalg.norm(wanted, axis=1)[:, None]
    found = np.empty((HANGING, 3))
    turned_normals(nodes, columns, slopes, normals, found)
    np.testing.assert_allclose(found, wanted, atol=1e-9)


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
    single = system.inverse.astype(np.float32)
    rows = np.empty((HANGING, NODES), np.float32)
    add_rows(*shape, single, rows)
    np.testing.assert_allclose(rows, system.weights @ single, atol=1e-8)
    literal = np.diag(system.weights @ system.inverse @ system.weights.T)
    found = mobility(Embedding(*shape), system.inverse)
    np.testing.assert_allclose(found, literal, rtol=1e-12)


def test_reactions_do_not_depend_on_when_they_were_asked_for(rng, system):
    """Points that hang on some of NODES nodes with three coordinates each."""
    root = rng.normal(size=(3 * NODES, 3 * NODES))
    inverse = np.linalg.inv(root @ root.T + NODES * np.eye(3 * NODES)).astype(np.float32)
    embedding = Embedding(system.columns, system.shares)
    normal = rng.normal(size=(HANGING, 3))
    pushes = np.einsum("wn,wa->wna", system.weights, normal).reshape(HANGING, -1)
    known = Reaction(embedding, inverse)
    for asked in ([3], [5, 3, 0], [8, 1, 2, 3], range(HANGING)):
        rows = known.along(np.array(asked), normal[asked])
        np.testing.assert_allclose(rows, pushes[asked] @ inverse, atol=1e-8)
    np.testing.assert_allclose(known.at(embedding, normal), rows, atol=1e-8)
    delassus = np.empty((HANGING, HANGING))
    fill_delassus(*embedding, normal, rows, delassus)
    np.testing.assert_allclose(delassus, pushes @ inverse @ pushes.T, atol=1e-8)


def test_positive_definite_matrices_are_inverted(rng):
    root = rng.normal(size=(70, 70))
    matrix = root @ root.T + np.eye(70)
    np.testing.assert_allclose(inverted(matrix) @ matrix, np.eye(70), atol=1e-5)
    assert inverted(-matrix) is None


def test_fences_hold_the_points_that_they_name():
    obstacles = Obstacles([], [], np.zeros((0, 4, 4)), np.ones(5, dtype=bool), np.zeros((0, 5)))
    up = np.array([[0.0, 0.0, 1.0]])
    obstacles.fences = obstacles.fences._replace(
        point=np.array([3]), gap=np.array([0.5]), normal=up, anchor=2.0 * up
    )
    here = np.array([[1.0, 1.0, 1.0], [0.0, 0.0, 4.0]])
    touch = obstacles.meet(np.array([1, 3]), here, np.full(2, 1.0))
    assert touch.point.tolist() == [1] and touch.source.tolist() == [0]
    assert touch.gap == pytest.approx([0.5 + 2.0])
    assert len(obstacles.meet(np.array([1, 2]), here, np.full(2, 1.0)).gap) == 0


def test_bulk_modulus_is_that_of_the_stated_poisson_ratio():
    # Over 2 μ the bulk modulus is (1 + ν) / (3 (1 - 2 ν)).
    ratio = 0.4988
    assert (1.0 + ratio) / (3.0 * (1.0 - 2.0 * ratio)) == pytest.approx(BULK, rel=0.1)
