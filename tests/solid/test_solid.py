"""The elastic solid of an RBF muscle: quadrature, energy, equilibrium, slack, squeezed material,
finite elements.
"""

from importlib import import_module
from typing import NamedTuple

import numpy as np
import pytest
import trimesh
from conftest import ROOT
from scipy.optimize import minimize_scalar
from scipy.spatial.transform import Rotation

from rbfmuscle.geometry.frames import RestFrame
from rbfmuscle.models import build_models
from rbfmuscle.muscle.muscle import RBFMuscle
from rbfmuscle.scene.joints import rotation_about
from rbfmuscle.scene.phantom import phantom_scene
from rbfmuscle.scene.scene import Scene
from rbfmuscle.simulation.frame_loop import simulate_frames
from rbfmuscle.simulation.touching import meet, settle
from rbfmuscle.solid import lattice as lattices
from rbfmuscle.solid.contact import Obstacles
from rbfmuscle.solid.kernels import (
    DETERMINANT,
    GRADIENT,
    POINTS,
    ROTATION,
    ROWS,
    STRETCH,
    WEIGHT,
    at_points,
    local_step,
    pull_apart,
)
from rbfmuscle.solid.lattice import LEAST_REGION, Lattice
from rbfmuscle.solid.metric import FLOOR, find_metric, lacking, point_stiffness, stiffness_matrix
from rbfmuscle.solid.model import TOGETHER, build_solid, greatest_forces
from rbfmuscle.solid.solve import (
    BULK,
    ERROR,
    LEAST,
    RENEWED,
    STIFFNESS,
    Settling,
    start_work,
)
from rbfmuscle.solid.state import predict, rest_state, tension

DATA = ROOT / "tests" / "data"


class Bar:
    """A block whose ends two bones hold, with its surface's vertices as contact points."""

    def __init__(self, iterations=100, tension=True, subdivisions=3):
        block = trimesh.creation.box(extents=(40.0, 10.0, 8.0))
        for _ in range(subdivisions):
            block = block.subdivide()
        frame = RestFrame(block.vertices)
        points = np.asarray(block.vertices)
        owner = np.select([points[:, 0] < -20.0 + 1e-9, points[:, 0] > 20.0 - 1e-9], [0, 1], -1)
        model = build_solid(
            Lattice(frame.local, np.asarray(block.faces), 150),
            frame,
            points,
            owner,
            np.flatnonzero(owner >= 0),
            surface=float(block.area),
            area=float(block.area) / len(points),
            iterations=iterations,
        )
        self.model = model if tension else model._replace(end=np.full_like(model.end, -1))
        self.state = rest_state(model)
        self.obstacles = Obstacles(
            [], [], np.zeros((0, 4, 4)), owner < 0, np.zeros((0, len(owner)))
        )
        self.poses = np.array([np.eye(4), np.eye(4)])

    def with_fibres(self, along, ratio=1.0, slack=1.0):
        """Give it fibres along a direction, stiffer by a ratio of Young's moduli, slack down to 1 /
        slack.
        """
        count = len(self.model.cells.weights)
        direction = np.tile(np.asarray(along, dtype=float), (count, 1))
        stiff, lower = np.full(count, 1.5 * (ratio - 1.0)), np.full(count, 1.0 / slack)
        fibres = self.model.fibres._replace(direction=direction, passive=stiff, lower=lower)
        self.model = self.model._replace(fibres=fibres)
        return self

    def settle(self, *poses, iterations=None):
        """The bones move to poses, the first one stays where only one is given."""
        after = np.array([np.eye(4), *poses][-2:])
        moved = predict(self.model, self.state, self.poses, after)
        model = self.model if iterations is None else self.model._replace(iterations=iterations)
        solid = Settling(model, greatest_forces(model, 0.0), moved, self.obstacles)
        settle([solid])
        self.poses, self.state, self.report = after, solid.finish(), solid.report()

    def settle_to(self, pose, error):
        """The same pose, iterated until the estimated error is below another bound."""
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("rbfmuscle.solid.solve.ERROR", error)
            self.settle(pose)

    def localise(self, y, tension, rounds=30):
        """The local step for nodes y: what it knows at the points, right side, volumes, energy of
        squeezed points; rotations and stretches are found over several.
        """
        cells = self.model.cells
        work, right = start_work(self.model, self.state), np.empty_like(y)
        gradient = np.empty((len(cells.volumes), 3, len(y)))
        volumes = np.empty(len(cells.volumes))
        shape = cells.nodes, cells.slopes, cells.region
        for _ in range(rounds):
            local_step(*shape, y, tension, work, right, gradient, volumes)
        det = np.linalg.det(at_points(work, GRADIENT, 3, 3))
        pulled = right.copy()
        points = np.flatnonzero(det < LEAST), cells.nodes, cells.slopes
        energy = pull_apart(*points, LEAST, STIFFNESS, work, pulled)
        return Local(work, right, gradient, volumes, energy, pulled - right)

    def energy(self, y=None, tension=0.0, rounds=30):
        """Elastic energy over 2 μ, springs at held points apart."""
        local = self.localise(self.state.nodes if y is None else y, tension, rounds)
        given, f = self.model.fibres, at_points(local.work, GRADIENT, 3, 3)
        turn = Rotation.from_quat(at_points(local.work, ROTATION, 4)[:, [1, 2, 3, 0]]).as_matrix()
        stretch, across = at_points(local.work, STRETCH), np.eye(3) - project(given.direction)
        wanted = stretch[:, None, None] * project(given.direction)
        wanted = wanted + across / np.sqrt(stretch)[:, None, None]
        gap = f - turn @ wanted
        along = np.linalg.norm(np.einsum("qab,qb->qa", f, given.direction), axis=1)
        beyond = along - np.clip(along, given.lower, given.upper)
        tone = 2.0 * tension * (1.0 - stretch)
        points = (gap**2).sum(axis=(1, 2)) + given.passive * beyond**2 - tone
        return 0.5 * float(self.model.cells.weights @ points) + local.squeezed


class Local(NamedTuple):
    """What a local step finds."""

    work: np.ndarray
    right: np.ndarray
    gradient: np.ndarray
    volumes: np.ndarray
    squeezed: float  # energy over 2 μ of squeezed points
    pull: np.ndarray  # what they add to the right side


def project(directions):
    """Matrices (n, 3, 3) of projections on unit vectors (n, 3)."""
    return directions[:, :, None] * directions[:, None, :]


def shift(x):
    motion = np.eye(4)
    motion[0, 3] = x
    return motion


def test_quadrature_gives_volume_middle_and_moments():
    ball = trimesh.creation.icosphere(subdivisions=4)
    mesh = trimesh.Trimesh(ball.vertices * [3.0, 1.0, 0.6], ball.faces)
    lattice = Lattice(mesh.vertices, np.asarray(mesh.faces), 300)
    w, p = lattice.weights, lattice.points
    # Cut cells are filled by 216 points each.
    assert w.sum() == pytest.approx(mesh.volume, rel=0.01)
    assert np.abs(w @ p / w.sum()).max() < 0.01
    wanted = np.array([3.0, 1.0, 0.6]) ** 2 / 5
    assert np.einsum("q,qa,qa->a", w, p, p) / w.sum() == pytest.approx(wanted, rel=0.03)


def test_thin_sheet_takes_no_more_points_than_a_thick_one(monkeypatch):
    """Its cells' least side is its thickness."""
    counts = []
    points_on = lattices._points_on

    def count(*given):
        found = points_on(*given)
        counts.append(len(found))
        return found

    monkeypatch.setattr(lattices, "_points_on", count)
    monkeypatch.setattr(lattices, "load_arrays", lambda key: {"count": np.array([20, 10, 1])})
    for thickness in (2.0, 0.02):
        sheet = trimesh.creation.box([100.0, 40.0, thickness]).subdivide_to_size(4.0)
        Lattice(np.asarray(sheet.vertices), np.asarray(sheet.faces), 150)
    assert counts[1] < 2 * counts[0]


def test_cells_that_were_kept_give_the_same_lattice(tmp_path, monkeypatch):
    monkeypatch.setenv("RBFMUSCLE_CACHE", str(tmp_path))
    mesh = trimesh.creation.icosphere(subdivisions=3).apply_scale([3.0, 1.0, 0.6])
    first, again = (Lattice(mesh.vertices, np.asarray(mesh.faces), 150) for _ in range(2))
    for name in ("count", "cells", "nodes", "rest", "points", "weights"):
        np.testing.assert_array_equal(getattr(first, name), getattr(again, name))
    (entry,) = tmp_path.iterdir()
    arrays = dict(np.load(entry)) | {"count": np.array([4, 2, 1])}
    with entry.open("wb") as file:
        np.savez(file, **arrays)
    assert Lattice(mesh.vertices, np.asarray(mesh.faces), 150).count.tolist() == [4, 2, 1]
    other = Lattice(mesh.vertices, np.asarray(mesh.faces), 300)
    assert len(other.rest) > 1.5 * len(first.rest)


@pytest.mark.parametrize("count", [1, 5, 18, 10_000])
def test_no_region_is_a_sliver(count):
    # Cells across are cut by the surface into parts of any size.
    mesh = trimesh.creation.icosphere(subdivisions=3).apply_scale([6.0, 1.3, 1.0])
    lattice = Lattice(mesh.vertices, np.asarray(mesh.faces), 150)
    region = lattice.regions(count)
    cells = np.bincount(lattice.cell, lattice.weights)
    volumes = np.bincount(region, cells)
    assert len(volumes) <= count
    assert volumes.min() >= min(LEAST_REGION * lattice.weights.sum() / count, cells.min())
    if count <= 18:
        assert len(volumes) == count and volumes.min() >= LEAST_REGION * volumes.mean()


def test_shape_functions_reproduce_linear_maps():
    mesh = trimesh.creation.icosphere(subdivisions=3)
    lattice = Lattice(mesh.vertices, np.asarray(mesh.faces), 200)
    rng = np.random.default_rng(0)
    inside = 0.9 * mesh.vertices[rng.choice(len(mesh.vertices), 50)]
    found = lattice.embed(inside)
    turn = rng.normal(size=(3, 3))
    there = lattice.rest @ turn.T
    assert np.allclose(
        np.einsum("nk,nka->na", found.weights, there[found.indices]), inside @ turn.T
    )
    slopes = np.einsum("nka,nkb->nab", there[found.indices], found.slopes)
    assert np.allclose(slopes, turn)
    # What carries empty cells resists no linear map.
    assert np.abs(lattice.second_differences() @ there).max() < 1e-9


def test_cells_that_large_triangles_cross_with_their_inside_alone_hold_material():
    corners = np.array([[0.0, 0, 0], [100, 0, 0], [10, 45, 0], [20, 10, 30]])
    faces = np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]])
    shares = np.random.default_rng(4).dirichlet(np.ones(3), (4, 3000))
    surface = np.einsum("fnk,fkc->fnc", shares, corners[faces]).reshape(-1, 3)
    lattice = Lattice(corners, faces, 300)
    at = (surface @ lattice.axes.T - lattice.low) / lattice.spacing
    crossed = np.unique(np.clip(at.astype(int), 0, lattice.count - 1), axis=0)
    used = {tuple(cell) for cell in lattice.cells}
    # Those cut by less than the points on the triangles lie apart may be missing.
    assert np.mean([tuple(cell) in used for cell in crossed]) > 0.97
    # Whole cells that only touch the surface weigh a thousandth each.
    assert lattice.weights.sum() == pytest.approx(100 * 45 * 30 / 6, rel=0.01)


@pytest.mark.parametrize("slack", [1.0, 1.6])
def test_right_side_is_the_derivative_of_the_energy(slack):
    solid = Bar().with_fibres([0.8, 0.6, 0.0], ratio=4.0, slack=slack)
    tension, rng = 0.3 * (slack - 1.0), np.random.default_rng(1)
    rest = solid.model.rest
    base = rest * [0.8, 1.1, 1.1] + rng.normal(0, 0.3, rest.shape)
    way = rng.normal(size=base.shape)
    h = 1e-4
    found = [solid.energy(base + step * way, tension) for step in (h, -h)]
    force = -solid.localise(base, tension).right
    # Differences of an energy some 1e5 times as great.
    assert (found[0] - found[1]) / (2 * h) == pytest.approx(np.vdot(force, way), rel=1e-4)


@pytest.mark.parametrize("pressed", [0.0, 0.7])
@pytest.mark.parametrize(("slack", "stretches"), [(1.0, [1.2, 1.1, 1.1]), (2.0, [0.8, 1.3, 1.3])])
def test_stiffness_is_the_derivative_of_the_forces(slack, stretches, pressed):
    solid = Bar().with_fibres(ALONG, ratio=4.0, slack=slack)
    cells = solid.model.cells
    rng = np.random.default_rng(1)
    pressure = pressed * rng.uniform(-1.0, 1.0, len(cells.volumes))
    rest = solid.model.rest
    base, way = rest * stretches + rng.normal(0, 0.02, rest.shape), rng.normal(size=rest.shape)
    h = 1e-5

    def force(nodes):
        local = solid.localise(nodes, 0.1)
        return local.right + np.einsum("m,man->na", pressure, local.gradient)

    ahead, behind = (force(base + step * way) for step in (h, -h))
    local = solid.localise(base, 0.1)
    stretch = at_points(local.work, STRETCH)
    assert (stretch == 1.0).all() if slack == 1.0 else ((stretch > 0.51) & (stretch < 0.99)).all()
    none = np.zeros(len(stretch), dtype=bool)
    by_point = np.repeat(pressure[cells.region], len(stretch) // len(cells.region))
    matrix = stiffness_matrix(solid.model, point_stiffness(local.work, by_point, none))
    found = (matrix @ way.ravel()).reshape(-1, 3) - solid.model.links @ way
    np.testing.assert_allclose(found, (behind - ahead) / (2 * h), atol=1e-4 * np.abs(found).max())


def test_stiffness_is_raised_to_its_floor_and_the_metric_is_positive_where_a_bar_buckles():
    solid = Bar().with_fibres(ALONG, ratio=4.0, slack=1.6)
    rest = solid.model.rest
    local = solid.localise(rest * 0.5 + np.random.default_rng(1).normal(0, 0.3, rest.shape), 0.0)
    none = np.zeros(len(at_points(local.work, STRETCH)), dtype=bool)
    points = point_stiffness(local.work, np.zeros(len(none)), none)
    before, half, whole = (
        np.linalg.eigvalsh(points + share * lacking(points)) for share in (0.0, 0.5, 1.0)
    )
    assert before.min() < 0.0
    assert whole.min() == pytest.approx(FLOOR, rel=1e-6)
    np.testing.assert_allclose(half, 0.5 * (before + whole), atol=1e-9 * np.abs(before).max())
    pressure = np.zeros(len(solid.model.cells.volumes))
    metric = find_metric(solid.model, local.gradient, local.work, none, pressure)
    assert np.linalg.eigvalsh(metric.inverse).min() > 0.0


@pytest.mark.parametrize(("push", "least", "most"), [(2.5, 0.0, 0.1), (4.0, 2.5, 4.0)])
def test_a_bar_stays_straight_up_to_its_critical_load_and_buckles_beyond(push, least, most):
    """The straight bar is in equilibrium at any load; beyond the critical one it is a saddle."""
    bar = Bar(tension=False, subdivisions=2)
    rest = bar.model.rest
    bent = rest.copy()
    bent[:, 2] += 1e-3 * np.cos(np.pi * rest[:, 0] / 40.0) ** 2
    bar.state = bar.state._replace(nodes=bent)
    bar.settle(trimesh.transformations.translation_matrix([-push, 0.0, 0.0]))
    assert bar.report.caps == ()
    before = bar.model.embedding.of(rest)
    moved = bar.model.embedding.of(bar.state.nodes) - before
    middle = np.abs(before[:, 0]) < 2.0
    assert least <= np.linalg.norm(moved[middle, 1:].mean(axis=0)) <= most


def test_steps_that_stay_too_long_make_the_metric_firmer_and_end_in_the_same_place(monkeypatch):
    """With a bound on steps so low that all are too long at first."""
    free, bound = Bar().with_fibres(ALONG, slack=1.6), Bar().with_fibres(ALONG, slack=1.6)
    free.settle(shift(-4.0))
    floors = []

    def note(*given, floor):
        floors.append(floor)
        return find_metric(*given, floor=floor)

    monkeypatch.setattr("rbfmuscle.solid.solve.find_metric", note)
    monkeypatch.setattr("rbfmuscle.solid.solve.LONGEST", 1e-3)
    bound.settle(shift(-4.0))
    assert max(floors) > FLOOR and bound.report.caps == ()
    apart = np.linalg.norm(bound.state.points - free.state.points, axis=1)
    assert apart.max() < 4e-5 * free.model.size  # twice the error of a solve


def test_motion_of_nodes_counts_by_what_hangs_on_them():
    model = Bar().model
    share = np.zeros(len(model.rest))
    np.maximum.at(share, model.embedding.columns, model.embedding.shares)
    assert (model.reach >= np.minimum(TOGETHER * share, 1.0)).all() and model.reach.max() == 1.0
    # A corner of the block takes an eighth of the motion of the node at the lattice's corner.
    assert model.reach.min() == pytest.approx(TOGETHER / 8.0, rel=1e-5)


@pytest.mark.parametrize("angle", np.linspace(0.05, 1.1, 10))
def test_a_solve_ends_within_its_stated_error_of_the_equilibrium(angle):
    solid = Bar()
    turn = rotation_about([0, 1, 0], angle, np.array([20.0, 0.0, 0.0]))
    solid.settle(turn)
    stated, before = solid.report, solid.state.points
    assert stated.error < ERROR and stated.caps == () and stated.iterations >= 3
    solid.model = solid.model._replace(iterations=10 * stated.iterations)
    solid.settle_to(turn, 1e-3 * ERROR)
    moved = np.linalg.norm(solid.state.points - before, axis=1).max() / solid.model.size
    assert 0.0 < moved < stated.error


def ways_after_the_end(scene, monkeypatch):
    """For each frame and muscle of a scene, how far ten times the iterations of its last solve take
    the material beyond where that ended, and the error that it stated, both over the muscle's size.
    """
    met, ended = {}, {}
    begin, take = RBFMuscle.begin, RBFMuscle.take

    def begin_noted(muscle, contacts):
        met[muscle.name] = contacts
        return begin(muscle, contacts)

    def taken(muscle, solid):
        ended[muscle.name] = solid.report()
        take(muscle, solid)

    monkeypatch.setattr(RBFMuscle, "begin", begin_noted)
    monkeypatch.setattr(RBFMuscle, "take", taken)
    found = []
    models = build_models(scene)
    for frame in simulate_frames(scene, models, surfaces=False):
        for muscle in models:
            stated = ended.pop(muscle.name, None)
            if stated is None:  # not solved in this frame
                continue
            solid = begin(muscle, met[muscle.name])
            solid.wanted = 1e-3 * ERROR
            solid.model = solid.model._replace(iterations=10 * stated.iterations)
            before = solid.model.embedding.of(solid.nodes)
            settle([solid])
            way = np.linalg.norm(solid.model.embedding.of(solid.nodes) - before, axis=1).max()
            found.append((frame.index, muscle.name, way / solid.model.size, stated))
    return found


def check_ways(found, muscles):
    beyond = [(*place, way, stated) for *place, way, stated in found if way >= stated.error]
    assert beyond == []
    assert max(stated.error for *_, stated in found) < ERROR
    for name in muscles:
        assert len({frame for frame, muscle, *_ in found if muscle == name}) >= 10


def test_a_solve_of_the_phantom_ends_within_its_stated_error_of_the_equilibrium(monkeypatch):
    scene = phantom_scene()
    scene.set_motion(waypoints=[{}, {"hip.flexion": 60.0}], step=6.0)
    scene.neighbours = None
    # The others do not move in each frame.
    check_ways(ways_after_the_end(scene, monkeypatch), ["extensor", "adductor_posterior"])


@pytest.mark.slow  # forty solves and each anew, to a thousandth of its error
def test_a_solve_of_the_hip_ends_within_its_stated_error_of_the_equilibrium(hip_data, monkeypatch):
    scene = Scene.load(hip_data / "flexion.toml")
    scene.set_motion(waypoints=[{}, {"hip.flexion": 90.0}], step=9.0)
    scene.neighbours = None
    names = [muscle.name for muscle in scene.muscles]
    check_ways(ways_after_the_end(scene, monkeypatch), names)


def test_rest_is_a_rest_and_a_turn_of_all_bones_turns_all():
    solid = Bar()
    for turn, error in ((np.eye(4), 1e-3), (rotation_about([1, 2, 3], 0.7, np.zeros(3)), 5e-3)):
        solid.settle(turn, turn)
        assert np.abs(solid.state.nodes - solid.model.rest @ turn[:3, :3].T).max() < error


def test_pulled_bar_keeps_the_volume_of_each_region_and_thins():
    solid = Bar()
    for pulled in (3.0, 6.0, 9.0):
        solid.settle(shift(pulled))
    cells, pressure = solid.model.cells, solid.state.pressures
    volumes = solid.localise(solid.state.nodes, 0.0).volumes / cells.volumes
    assert np.abs(volumes * (1 + pressure / BULK) - 1).max() < 1e-3
    assert solid.report.volume_error == pytest.approx(np.abs(volumes - 1).max(), abs=1e-6)
    rest = solid.model.points
    middle = np.abs(rest[:, 0]) < 3
    side = np.ptp(solid.state.points[middle], axis=0)[1:] / np.ptp(rest[middle], axis=0)[1:]
    # The middle of a short bar stretches more than the bar, by 22 %.
    assert np.all(side < 1 / np.sqrt(1.2)) and np.all(side > 1 / np.sqrt(1.35))


def test_iteration_ends_where_forces_balance():
    solid = Bar(iterations=300)
    for pulled in (3.0, 6.0):
        solid.settle(shift(pulled))
    assert solid.report.caps == ()
    y, local = solid.state.nodes, solid.localise(solid.state.nodes, 0.0)
    right = local.right + np.einsum("r,ran->na", solid.state.pressures, local.gradient)
    springs, anchors = solid.model.springs, solid.state.anchors
    residual = solid.model.links @ y - right - springs @ anchors
    held = springs @ (anchors - solid.state.points[solid.model.held])
    # Forces that an error of 2e-5 of the size leaves, against those that hold the ends.
    assert np.abs(residual).max() < 0.02 * np.abs(held).max()


def test_springs_of_an_attachment_do_not_depend_on_the_number_of_its_points():
    coarse, fine = (Bar(subdivisions=count).model for count in (3, 5))
    assert len(fine.held) > 10 * len(coarse.held)
    pulls = [model.springs.sum() for model in (coarse, fine)]
    # Points on the rim of an end stand for less than others, the more so the coarser they are.
    assert pulls[0] == pytest.approx(pulls[1], rel=0.25)


def test_solve_that_is_cut_short_says_so_and_its_residual_shrinks_with_iterations():
    found = []
    for iterations in (1, 3, 100):
        solid = Bar(iterations=iterations)
        solid.settle(shift(6.0))
        found.append(solid.report)
    assert [report.caps for report in found] == [("iterations",), ("iterations",), ()]
    assert found[0].iterations == 1 and found[1].iterations == 3
    first, second, last = (report.error for report in found)
    assert first > second > 2.0 * last and second > ERROR > last


@pytest.mark.parametrize("iterations", [RENEWED, RENEWED + 1, RENEWED + 2])
def test_a_solve_that_ends_when_its_metric_was_due_states_its_error(iterations):
    solid = Bar(iterations=iterations).with_fibres([1.0, 0.0, 0.0], ratio=4.0, slack=1.5)
    solid.settle(rotation_about([0, 1, 0], 0.3, np.array([20.0, 0.0, 0.0])) @ shift(-2.0))
    assert solid.report.caps == ("iterations",) and ERROR < solid.report.error < 1.0


def test_a_slow_solve_that_ends_at_its_cap_says_how_far_it_is_from_the_equilibrium():
    solid = Bar(iterations=12).with_fibres([1.0, 0.0, 0.0], ratio=4.0, slack=1.5)
    pose = rotation_about([0, 1, 0], 0.3, np.array([20.0, 0.0, 0.0])) @ shift(-2.0)
    solid.settle(pose)
    stated, before = solid.report, solid.state.points
    assert stated.caps == ("iterations",)
    solid.model = solid.model._replace(iterations=600)
    solid.settle_to(pose, 1e-3 * ERROR)
    assert solid.report.caps == ()
    left = np.linalg.norm(solid.state.points - before, axis=1).max() / solid.model.size
    assert left < 3.0 * stated.error


@pytest.mark.parametrize(
    ("file", "asked", "limits"),
    [
        # The requirement is 1.6 mm, of a muscle 60 mm thick bent by up to 60 degrees.
        ("fe_reference.npz", {}, (0.4, 1.6, 1.6)),
        # Measured 0.8 and 1.3 mm; an isotropic solid 3.4 and 4.0 (docs/fe_reference.md).
        ("fe_reference_fibres.npz", {"model.nodes": 300}, (0.4, 1.3, 1.8)),
    ],
)
def test_extensor_lies_near_finite_elements_of_the_same_passive_law(file, asked, limits):
    with np.load(DATA / file) as kept:
        kept = dict(kept)
    asked = {
        "model.slack_ratio": 1.0,
        "model.fibre_ratio": float(kept.get("fibre_ratio", 1.0)),
        **asked,
    }
    rows = import_module("fe_reference").distances("rbf", kept, settings=asked)
    assert [rms < limit for (_, rms, _, _), limit in zip(rows, limits, strict=True)] == [True] * 3
    # The surface is extracted at the rest volume.
    assert max(abs(volume) for *_, volume in rows) < 1e-6


def moved(x, along, ratio=1.0, slack=1.0, steps=3):
    """A bar with fibres that bear no tension while they are slack, one end moved by x in steps."""
    solid = Bar(tension=False).with_fibres(along, ratio, slack)
    for part in range(steps):
        solid.settle(shift(x * (part + 1) / steps))
    return solid


ALONG, ACROSS = [1.0, 0, 0], [0, 1.0, 0]


@pytest.mark.parametrize("stretch", [0.5, 0.7, 1.2])
def test_energy_is_that_of_the_formula_with_fibres_stiffer_than_across(stretch):
    """Springs along the fibres have no part in the choice of t."""
    slack, tension = 1.6, 0.1
    f = np.array([stretch, 1.1 / np.sqrt(stretch), 1.0 / (1.1 * np.sqrt(stretch))])

    def miss(t):
        across = ((f[1:] - t**-0.5) ** 2).sum()
        return (f[0] - t) ** 2 + across - 2.0 * tension * (1.0 - t)

    least = minimize_scalar(miss, bounds=(1.0 / slack, 1.0), options={"xatol": 1e-9}).fun
    beyond = f[0] - np.clip(f[0], 1.0 / slack, 1.0)
    wanted = 0.5 * (least + 1.5 * 3.0 * beyond**2)
    solid = Bar().with_fibres(ALONG, ratio=4.0, slack=slack)
    found = solid.energy(solid.model.rest * f, tension) / solid.model.cells.weights.sum()
    # The bounded search stays off its bounds by its tolerance.
    assert found == pytest.approx(wanted, rel=1e-6)


def test_fibres_make_the_bar_stiffer_along_them():
    plain = moved(0.8, ALONG, steps=2).energy()
    # A slender bar would give 5; this one is held at its ends.
    assert moved(0.8, ALONG, ratio=5.0, steps=2).energy() / plain == pytest.approx(5.0, rel=0.25)
    assert moved(0.8, ACROSS, ratio=5.0, steps=2).energy() / plain < 2.5


def test_slack_fibres_shorten_along_themselves_almost_without_resistance():
    stiff = moved(-6.0, ALONG)
    loose = moved(-6.0, ALONG, slack=1.6)
    aside = moved(-6.0, ACROSS, slack=1.6)
    # The bar's ends are held, so some of the shortening is sheared; the rest costs nothing.
    assert loose.energy() < 0.15 * stiff.energy()
    # Shortened across its fibres the bar is as stiff as without them.
    assert aside.energy() == pytest.approx(stiff.energy(), rel=0.1)
    stretch, cells = loose.state.stretches, loose.model.cells
    assert stretch.min() > 1 / 1.6 and np.average(stretch, weights=cells.weights) < 0.9
    volumes = loose.localise(loose.state.nodes, 0.0).volumes
    assert volumes.sum() == pytest.approx(cells.volumes.sum(), rel=0.01)
    # Beyond the band the energy grows with the square of what is left.
    near, far = (moved(x, ALONG, slack=1.1, steps=4).energy() for x in (-3.0, -10.0))
    assert far > 10.0 * near
    # Pulled, they are those of the plain solid.
    tight, slack = (moved(3.0, ALONG, slack=slack, steps=1).state.nodes for slack in (1.0, 1.6))
    assert np.abs(tight - slack).max() < 0.1  # mm; near the held ends some fibres shorten


def test_tension_of_slack_fibres_follows_the_ends():
    solid = Bar().with_fibres(ALONG, slack=1.6)
    found = []
    for x in (0.0, 2.0, -0.4, -4.0, -6.0, -12.0):
        solid.settle(shift(x))
        found.append(tension(solid.model, solid.state.anchors))
    # 10 times the square of the approach of ends that are 40 apart, and no more than 0.9; the ends
    # of moved vertices are as far apart to 1e-12.
    assert found == pytest.approx([0.0, 0.0, 0.001, 0.1, 0.225, 0.9], abs=1e-10)


@pytest.mark.parametrize("name", ["extensor", "adductor_posterior"])
def test_one_pose_has_one_shape(name):
    flexion, adduction = {"hip.flexion": 60.0}, {"hip.adduction": -25.0}
    end = {**flexion, **adduction}
    found = []
    paths = ([{}, flexion, end], 5.0), ([{}, adduction, end], 5.0), ([{}, end], 10.0)
    for waypoints, step in paths:
        scene = phantom_scene()
        scene.muscles = [scene.muscle(name)]
        scene.set_motion(waypoints=waypoints, step=step)
        last = len(scene.motion.frames) - 1
        (frame,) = simulate_frames(scene, build_models(scene), surfaces=False, written={last})
        found.append(frame.material_meshes[name][0])
    # mm; the requirement is 0.2.
    assert max(np.sqrt(((a - b) ** 2).sum(axis=1).mean()) for a in found for b in found) < 0.1


@pytest.mark.parametrize(
    "stretches", [(1.0, 1.0, 0.1), (1.2, 0.6, 0.05), (1.0, 0.9, -0.4), (1.3, 0.9, 0.8)]
)
def test_squeezed_points_are_pulled_to_the_nearest_deformation_with_the_least_volume(stretches):
    one, two = Rotation.random(2, random_state=3).as_matrix()
    f = one @ np.diag(stretches) @ two
    work, right = np.zeros((1, ROWS * POINTS)), np.zeros((3, 3))
    rows = work.reshape(ROWS, POINTS)
    rows[GRADIENT : GRADIENT + 9, 1] = f.ravel()
    rows[ROTATION : ROTATION + 4, 1] = Rotation.from_matrix(one @ two).as_quat()[[3, 0, 1, 2]]
    rows[DETERMINANT, 1], rows[WEIGHT, 1] = np.linalg.det(f), 1.0
    # Of three nodes each takes one axis, so that the right side is what the deformation lacks.
    slopes = np.zeros((1, 3, 3 * POINTS))
    slopes[0, :, 1::POINTS] = np.eye(3)
    energy = pull_apart(np.array([1]), np.array([[0, 1, 2]]), slopes, LEAST, 1.0, work, right)
    goal = f + right.T
    if np.prod(stretches) > LEAST:  # what keeps its volume is left as it is
        assert energy == 0.0 and np.allclose(goal, f, atol=1e-14)
        return
    square = ((f - goal) ** 2).sum()
    assert energy == pytest.approx(0.5 * square, rel=1e-9)
    assert np.linalg.det(goal) == pytest.approx(LEAST, rel=1e-3)  # ten steps of the search
    rng = np.random.default_rng(5)
    for size in (0.01, 0.1, 0.5):
        for other in goal + size * rng.normal(size=(200, 3, 3)):
            if np.linalg.det(other) >= LEAST:
                assert ((f - other) ** 2).sum() > square * (1 - 1e-2)


def test_force_of_squeezed_points_is_the_derivative_of_their_energy():
    solid = Bar().with_fibres([1.0, 0.0, 0.0], ratio=1.0, slack=1.0)
    rng = np.random.default_rng(1)
    rest = solid.model.rest
    base = rest * [0.5, 0.8, 0.8] + rng.normal(0, 0.05, rest.shape)
    way = rng.normal(size=base.shape)
    h = 1e-4
    found = [solid.localise(base + step * way, 0.0, rounds=1).squeezed for step in (h, -h)]
    local = solid.localise(base, 0.0, rounds=1)
    assert local.squeezed > 0.0
    assert (found[0] - found[1]) / (2 * h) == pytest.approx(-np.vdot(local.pull, way), rel=1e-3)


def test_bar_that_is_pushed_together_is_not_turned_inside_out():
    solid = Bar()
    length = np.ptp(solid.model.points[:, 0])
    for part in np.linspace(0.1, 0.7, 7):
        solid.settle(shift(-part * length))
        assert np.isfinite(solid.state.nodes).all()
    f = at_points(solid.localise(solid.state.nodes, 0.0).work, GRADIENT, 3, 3)
    assert np.linalg.det(f).min() > 0.0


def test_a_step_is_at_most_a_fiftieth_of_the_size_however_far_its_mixture_goes(monkeypatch):
    bar = Bar(subdivisions=2)
    moved = predict(bar.model, bar.state, bar.poses, np.array([np.eye(4), shift(2.0)]))
    solid = Settling(bar.model, greatest_forces(bar.model, 0.0), moved, bar.obstacles)
    # On a linear map mixtures go fifty times as far as the step that they are made from.
    monkeypatch.setattr(solid.mixer, "mix", lambda here, image: here + 1000.0 * (image - here))
    before = solid.nodes
    solid.free_step()
    meet([solid], np.ones(1, dtype=np.bool_))
    step = np.linalg.norm(bar.model.embedding.of(solid.step), axis=1).max()
    solid.advance()
    way = np.linalg.norm(bar.model.embedding.of(solid.nodes - before), axis=1).max()
    assert 1000.0 * step > bar.model.size
    assert 0.005 * bar.model.size < way <= 0.02 * (1.0 + 1e-9) * bar.model.size
