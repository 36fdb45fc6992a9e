"""A small elastic block: its quadrature, attachments and tension, a floor that it is pressed on."""

from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from rbfmuscle.geometry.frames import RestFrame
from rbfmuscle.scene.joints import rotation_about
from rbfmuscle.simulation.contact import HalfSpaces
from rbfmuscle.simulation.touching import TOLERANCE, meet, settle
from rbfmuscle.solid.lattice import Lattice
from rbfmuscle.solid.metric import stiffness_matrix
from rbfmuscle.solid.model import (
    MOST_CONTACT_PRESSURE,
    attached_owner,
    build_solid,
    greatest_forces,
    lattice_slopes,
)
from rbfmuscle.solid.solve import ERROR, SOFT, Settling
from rbfmuscle.solid.state import predict, rest_state, tension, transform

SIDES = np.array([40.0, 10.0, 8.0])
PLACE = rotation_about([1, 2, -1], 0.8, np.zeros(3))
PLACE[:3, 3] = [30.0, -7.0, 12.0]


class Solid:
    """The block somewhere in space, its ends held by two bones."""

    def __init__(self):
        mesh = trimesh.creation.box(SIDES).subdivide().subdivide()
        flat = np.array(mesh.vertices)
        self.faces = np.array(mesh.faces)
        points = flat @ PLACE[:3, :3].T + PLACE[:3, 3]
        self.flat = flat
        self.owner = np.select([flat[:, 0] < -19.9, flat[:, 0] > 19.9], [0, 1], -1)
        self.frame = RestFrame(points)
        self.lattice = Lattice(self.frame.local, self.faces, 60)
        self.area = float(mesh.area)
        self.points = points
        self.model = self.build(self.owner)

    def build(self, owner, iterations=100):
        held = np.flatnonzero(owner >= 0)
        each = self.area / len(self.points)
        return build_solid(
            self.lattice,
            self.frame,
            self.points,
            owner,
            held,
            surface=self.area,
            area=each,
            iterations=iterations,
        )


@pytest.fixture(scope="module")
def solid():
    return Solid()


class Floor:
    """A plane as an obstacle of all free contact points."""

    count = 1

    def __init__(self, free, normal, height):
        self.free = free
        self.normal = normal
        self.height = height

    def find_near(self, points, reach):
        return np.flatnonzero(self.free & (points @ self.normal - self.height < reach))

    def meet(self, which, here, reach):
        gap = here @ self.normal - self.height
        near = np.flatnonzero(gap < reach)
        zero = np.zeros(len(near), dtype=np.int64)
        normal = np.tile(self.normal, (len(near), 1))
        return HalfSpaces(near, gap[near], normal, zero)

    meet_exactly = meet


def test_quadrature_of_a_block_gives_its_volume_middle_and_moments(solid):
    cells = solid.model.cells
    volume = SIDES.prod()
    # A frame holds its vertices to seven digits.
    assert cells.weights.sum() == pytest.approx(volume, rel=1e-6)
    assert cells.volumes.sum() == pytest.approx(volume, rel=1e-6)
    middle = cells.weights @ cells.points / volume
    np.testing.assert_allclose(middle, PLACE[:3, 3], atol=1e-5)
    # Whole cells have Gauss's points.
    local = (cells.points - middle) @ PLACE[:3, :3]
    second = np.einsum("q,qa,qb->ab", cells.weights, local, local) / volume
    np.testing.assert_allclose(second, np.diag(SIDES**2 / 12.0), atol=2e-4)


def test_slopes_of_the_lattice_give_the_gradient_of_a_linear_map(solid):
    linear = np.random.default_rng(2).normal(size=(3, 3))
    points = solid.model.cells.points[::7]
    slopes = lattice_slopes(solid.lattice, solid.frame, points)
    local = (points - solid.frame.origin) @ solid.frame.axes.T / solid.frame.size
    nodes = (solid.model.rest @ linear.T)[solid.lattice.embed(local).indices]
    found = np.einsum("nka,nkb->nab", nodes, slopes)
    np.testing.assert_allclose(found, np.broadcast_to(linear, found.shape), atol=1e-9)


def test_a_lattice_turns_with_its_mesh_and_its_axes_point_where_that_is_long():
    ball = trimesh.creation.icosphere(2)
    x, y, z = ball.vertices.T
    lopsided = np.stack([3.0 * np.exp(0.3 * x), 2.0 * np.exp(0.3 * y), 0.5 * z + 0.2 * z**2], 1)
    first = Lattice(lopsided, np.asarray(ball.faces), 60)
    offset = lopsided - lopsided.mean(axis=0)
    half_turns = Rotation.from_rotvec(np.pi * np.eye(3)).as_matrix()
    for scale, turn in zip((1.0, 0.01, 0.01, 0.01), (PLACE[:3, :3], *half_turns), strict=True):
        turned = Lattice(scale * lopsided @ turn.T, np.asarray(ball.faces), 60)
        np.testing.assert_allclose(turned.axes @ turn, first.axes, atol=1e-6)
        np.testing.assert_allclose(turned.rest @ turn, scale * first.rest, atol=1e-6)
    assert np.linalg.det(first.axes) == pytest.approx(1.0)
    assert ((offset @ first.axes[:2].T) ** 3).sum(axis=0).min() > 0.0


def test_nodes_take_shares_of_the_bones_motions_that_sum_to_one(solid):
    weights = solid.model.motion_weights
    np.testing.assert_allclose(weights.sum(axis=1), 1.0, atol=1e-9)
    # By symmetry the bones change places with the ends.
    along = (solid.model.rest - PLACE[:3, 3]) @ PLACE[:3, 0]
    np.testing.assert_allclose(weights[along > 15.0, 1].min(), weights[along < -15.0, 0].min())
    assert weights[along > 19.0, 1].min() > 0.9 and weights[along < -19.0, 1].max() < 0.1
    np.testing.assert_allclose(weights[np.abs(along) < 0.1], 0.5, atol=1e-6)


def test_attached_points_of_every_bone_bear_the_greatest_pressure_and_mobile_free_ones(solid):
    most = greatest_forces(solid.model, 0.0) / (MOST_CONTACT_PRESSURE * solid.model.area)
    np.testing.assert_allclose(most[solid.owner >= 0], 1.0)
    free = most[solid.owner < 0]
    # What moves by more than the median bears all.
    assert free.max() == 1.0 and np.mean(free == 1.0) >= 0.5 and 0.0 < free.min() < 1.0
    along = np.abs(solid.flat[:, 0])[solid.owner < 0]
    assert free[along > 9.0].mean() < free[along < 1.0].mean()


def test_free_points_that_hardly_move_count_to_the_bone_of_the_nearest_held_one(solid, monkeypatch):
    assert (attached_owner(solid.model) == solid.owner).all()
    monkeypatch.setattr("rbfmuscle.solid.model.MOBILE", np.inf)
    found = attached_owner(solid.model)
    x = solid.flat[:, 0]
    assert (found[x < -0.1] == 0).all() and (found[x > 0.1] == 1).all()


def test_the_ends_are_those_of_the_bones_farthest_apart(solid):
    near = (np.abs(solid.flat[:, 0]) < 6.0) & (solid.flat[:, 2] > 3.9)
    for numbers in ([0, 1, 2], [2, 0, 1], [1, 2, 0]):
        owner = np.select([solid.owner == 0, solid.owner == 1, near], numbers, -1)
        model = solid.build(owner)
        assert model.end_distance == pytest.approx(SIDES[0])
        bone = model.held_bone
        assert set(model.end[bone == numbers[2]]) == {-1}
        first, second = (set(model.end[bone == number]) for number in numbers[:2])
        assert {*first, *second} == {0, 1} and len(first) == len(second) == 1


def test_tension_grows_with_the_square_of_the_approach_of_the_ends_and_not_without_two():
    ends = SimpleNamespace(end=np.array([0, 1, -1]), end_distance=10.0)
    anchors = np.array([[1.0, 0.0, 0.0], [1.0, 9.0, 0.0], [50.0, 0.0, 0.0]])
    assert tension(ends, anchors) == pytest.approx(10.0 * 0.1**2)
    assert tension(ends, 1.2 * anchors) == 0.0
    assert tension(ends, 0.1 * anchors) == 0.9
    ends.end = np.full(3, -1)
    assert tension(ends, anchors) == 0.0


def test_a_prediction_follows_one_rigid_motion_and_repeats_the_last_correction(solid):
    model = solid.model
    rng = np.random.default_rng(4)
    turn = rotation_about([3, 1, 2], 0.2, np.array([5.0, 1.0, 0.0]))
    still, once = np.array([np.eye(4)] * 2), np.array([turn] * 2)
    state = predict(model, rest_state(model), still, once)
    wanted = model.rest @ turn[:3, :3].T + turn[:3, 3]
    np.testing.assert_allclose(state.nodes, wanted, atol=1e-9)
    held = model.points[model.held] @ turn[:3, :3].T + turn[:3, 3]
    np.testing.assert_allclose(state.anchors, held, atol=1e-9)
    # A solve moves the nodes on; the same step again begins with the same correction, one against
    # it with the opposite one, a still one with none.
    moves = [trimesh.transformations.translation_matrix([x, 0.0, 0.0]) for x in (1.0, 2.0, 9.0)]
    first, second, long = (np.array([move] * 2) for move in moves)
    pushed = predict(model, rest_state(model), still, first)
    more, pressure = rng.normal(size=model.rest.shape), rng.normal(size=len(model.cells.volumes))
    solved = pushed._replace(nodes=pushed.nodes + more, pressures=pressure)
    # One eight times as long begins with no more than 1.5 of it.
    for after, share in ((second, 1.0), (still, -1.0), (first, 0.0), (long, 1.5)):
        again = predict(model, solved, first, after)
        moved = (after[0] - first[0])[:3, 3]
        np.testing.assert_allclose(again.nodes, solved.nodes + moved + share * more, atol=1e-9)
        np.testing.assert_allclose(again.pressures, (1.0 + share) * pressure, atol=1e-9)


def test_a_rigid_motion_turns_all_of_a_state(solid):
    model = solid.model
    state = predict(
        model,
        rest_state(model),
        np.array([np.eye(4)] * 2),
        np.array([np.eye(4), trimesh.transformations.translation_matrix([1.0, 2.0, 0.5])]),
    )
    motion = rotation_about([1, 1, 3], 1.1, np.array([2.0, 0.0, 4.0]))
    turn, shift = motion[:3, :3], motion[:3, 3]
    found = transform(state, motion)
    for name in ("nodes", "lifted_nodes", "points", "anchors", "start"):
        wanted = getattr(state, name) @ turn.T + shift
        np.testing.assert_allclose(getattr(found, name), wanted, atol=1e-9)
    np.testing.assert_allclose(found.step, state.step @ turn.T, atol=1e-9)
    np.testing.assert_allclose(found.turn, turn, atol=1e-12)
    quaternion = found.rotations[0][[1, 2, 3, 0]]
    np.testing.assert_allclose(Rotation.from_quat(quaternion).as_matrix(), turn, atol=1e-9)


def pressed(solid, depth, most=None, above=0.0):
    """The block settled on a floor that has come up by a depth; it begins from so far above."""
    up = PLACE[:3, 2]
    low = (solid.points @ up).min()
    floor = Floor(solid.owner < 0, up, low + depth)
    still = np.array([np.eye(4)] * 2)
    state = predict(solid.model, rest_state(solid.model), still, still)
    state = state._replace(nodes=state.nodes + above * up)
    most = greatest_forces(solid.model, 0.0) if most is None else most
    solving = Settling(solid.model, most, state, floor)
    settle([solving])
    return solving, floor


def test_a_block_on_a_floor_pushes_by_what_contacts_yield_and_is_lifted_by_that(solid, monkeypatch):
    yields = 1e-2  # a hundred times as much as contacts do, far above what is left of a lift
    monkeypatch.setattr("rbfmuscle.solid.solve.YIELDING", yields)
    solving, floor = pressed(solid, 3.0)
    state, report = solving.finish(), solving.report()
    assert report.caps == () and report.error < ERROR
    size, area = solid.model.size, solid.model.area
    gap = solid.model.embedding.of(state.nodes) @ floor.normal - floor.height
    force = state.forces[:, 0]
    assert (force > 0.0).sum() > 3
    np.testing.assert_allclose(
        gap[force > 0.0], -force[force > 0.0] * yields * size / area, atol=2 * ERROR * size
    )
    free = solid.owner < 0
    assert gap[free & (force == 0.0)].min() > -2 * ERROR * size
    assert gap[free].min() < -20.0 * TOLERANCE * size
    lifted = state.points @ floor.normal - floor.height
    assert lifted[free].min() > -1.01 * TOLERANCE * size


def test_a_lift_that_would_go_far_is_left_out_and_said(solid):
    solving, floor = pressed(solid, 3.0)
    floor.height += 0.3 * solid.model.size
    state = solving.finish()
    np.testing.assert_array_equal(state.lifted_nodes, state.nodes)
    assert solving.report().caps == ("lifts",)


def test_a_floor_is_met_however_far_from_it_a_solve_begins(solid):
    near, far = (pressed(solid, 1.0, above=above)[0] for above in (0.0, 4.0))
    assert near.report().caps == far.report().caps == () and near.forces.max() > 0.0
    ways = np.linalg.norm(solid.model.embedding.of(near.nodes - far.nodes), axis=1)
    assert ways.max() < 2.0 * ERROR * solid.model.size


def test_a_stated_error_counts_how_slowly_the_steps_go(solid, monkeypatch):
    """With a metric ten times as stiff a step is a tenth of the way."""
    still = np.array([np.eye(4)] * 2)
    bent = PLACE @ rotation_about([0, 1, 0], 0.6, np.array([20.0, 0.0, 0.0])) @ np.linalg.inv(PLACE)
    floor = Floor(np.zeros(len(solid.points), dtype=bool), PLACE[:3, 2], 0.0)
    most = greatest_forces(solid.model, 0.0)
    state = predict(solid.model, rest_state(solid.model), still, np.array([np.eye(4), bent]))
    exact = Settling(solid.model, most, state, floor, error=1e-3 * ERROR)
    settle([exact])
    monkeypatch.setattr(
        "rbfmuscle.solid.metric.stiffness_matrix", lambda *given: 10.0 * stiffness_matrix(*given)
    )
    slow = Settling(solid.model._replace(iterations=5), most, state, floor)
    settle([slow])
    report = slow.report()
    assert report.caps == ("iterations",)
    way = solid.model.embedding.of(slow.nodes - exact.nodes)
    way = np.linalg.norm(way, axis=1).max() / solid.model.size
    assert 10.0 * ERROR < way < report.error


def test_a_body_stays_asleep_where_its_metric_was_due_to_be_found_anew(solid, monkeypatch):
    count = pressed(solid, 2.0)[0].iterations
    monkeypatch.setattr("rbfmuscle.solid.solve.RENEWED", count)
    solving, _ = pressed(solid, 2.0)
    assert solving.iterations == count and solving.asleep
    solving.free_step()
    meet([solving], np.array([True]))
    assert np.linalg.norm(solving.step, axis=1).max() < ERROR * solid.model.size


def test_contacts_stand_for_areas(solid):
    most = np.linspace(1.0, 2.0, len(solid.points))
    solving, _ = pressed(solid, -100.0, most)
    some = np.array([3, 40])
    share = np.array([2.5, 0.5])
    found, yields = solving.contact_law(some, share * solid.model.area)
    np.testing.assert_allclose(found, share * most[some])
    np.testing.assert_allclose(yields, SOFT * solid.model.size / (share * solid.model.area))
