"""The elastic solid of an RBF muscle: quadrature, energy, equilibrium, slack, distance to finite elements."""

from pathlib import Path

import numpy as np
import pytest
import trimesh
from conftest import benchmark_script
from elastic_bar import NO_BONES, bar, settle, shift, with_fibres

from rbfmuscle.implicit.placement.lattice import LEAST_REGION, Lattice
from rbfmuscle.models import build_models
from rbfmuscle.muscle.solid import BULK, TONE
from rbfmuscle.scene.joints.joint import rotation_about
from rbfmuscle.scene.phantom import phantom_scene
from rbfmuscle.simulation.contact import BoneContacts
from rbfmuscle.simulation.frame_loop import simulate_frames

DATA = Path(__file__).resolve().parents[1] / "data"


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


@pytest.mark.parametrize("count", [1, 5, 18, 10_000])
def test_no_region_is_a_sliver_and_none_divides_a_cell(count):
    # Cells across are cut by the surface into parts of any size.
    mesh = trimesh.creation.icosphere(subdivisions=3).apply_scale([6.0, 1.3, 1.0])
    lattice = Lattice(mesh.vertices, np.asarray(mesh.faces), 150)
    region = lattice.regions(count)
    cells, volumes = (np.bincount(part, lattice.weights) for part in (lattice.cell, region))
    assert len(volumes) <= count
    assert volumes.min() >= min(LEAST_REGION * lattice.weights.sum() / count, cells.min())
    assert all(len(set(region[lattice.cell == cell])) == 1 for cell in np.unique(lattice.cell))
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
    assert np.allclose(np.einsum("nk,nka->na", found.weights, there[found.indices]), inside @ turn.T)
    slopes = np.einsum("nka,nkb->nab", there[found.indices], found.slopes)
    assert np.allclose(slopes, turn)
    # What carries empty cells resists no linear map.
    assert np.abs(lattice.second_differences() @ there).max() < 1e-9


def elastic(solid, y):
    """Matrix of the elastic energy times places y (N, 3), targets frozen."""
    f = np.einsum("qka,qkb->qab", y[solid.quad_columns], solid.slopes)
    fibre, stiff = solid.fibres.direction, solid.fibres.passive + solid.fibres.active
    along = np.einsum("qab,qb->qa", f, fibre)
    f = f + (stiff[:, None] * along)[:, :, None] * fibre[:, None, :]
    out = np.zeros_like(y)
    np.add.at(out, solid.quad_columns, np.einsum("q,qab,qkb->qka", solid.weights, f, solid.slopes))
    return out


@pytest.mark.parametrize("slack", [1.0, 1.6])
def test_right_side_is_the_derivative_of_the_energy(slack):
    solid = with_fibres(bar(), [0.8, 0.6, 0.0], ratio=4.0, slack=slack)
    rng = np.random.default_rng(1)
    base = solid.rest * [0.8, 1.1, 1.1] + rng.normal(0, 0.3, solid.rest.shape)
    way = rng.normal(size=base.shape)
    h = 1e-4
    found = []
    for sign in (1, -1):
        solid.y = base + sign * h * way
        for _ in range(30):  # rotations and stretches are found over the iterations
            solid.localise()
        found.append(solid.energy())
    solid.y = base
    for _ in range(30):
        solid.localise()
    force = elastic(solid, base) - solid.right
    # Differences of an energy some 1e5 times as great.
    assert (found[0] - found[1]) / (2 * h) == pytest.approx(np.vdot(force, way), rel=1e-4)


def test_rest_is_a_rest_and_a_turn_of_all_bones_turns_all():
    solid = bar()
    for turn, error in ((np.eye(4), 1e-3), (rotation_about([1, 2, 3], 0.7, np.zeros(3)), 5e-3)):
        solid.move(np.array([turn, turn]), {0: turn, 1: turn})
        solid.settle(BoneContacts(*NO_BONES, contact_bone=solid.owner))
        assert np.abs(solid.y - solid.rest @ turn[:3, :3].T).max() < error


def test_pulled_bar_keeps_the_volume_of_each_region_and_thins():
    solid = bar()
    for pulled in (3.0, 6.0, 9.0):
        settle(solid, shift(pulled))
    assert np.abs(solid.volumes / solid.rest_volumes * (1 + solid.pressure / BULK) - 1).max() < 1e-3
    middle = np.abs(solid.points[:, 0]) < 3
    side = np.ptp(solid.carry()[middle], axis=0)[1:] / np.ptp(solid.points[middle], axis=0)[1:]
    # The middle of a short bar stretches more than the bar, by 22 %.
    assert np.all(side < 1 / np.sqrt(1.2)) and np.all(side > 1 / np.sqrt(1.35))


def test_iteration_ends_where_forces_balance():
    solid = bar(iterations=300)
    for pulled in (3.0, 6.0):
        settle(solid, shift(pulled))
    solid.energy()
    right = solid.right.copy()
    for r, p in enumerate(solid.pressure):
        rows = slice(solid.start[r], solid.start[r + 1])
        right[solid.touched[rows]] += p * solid.gradient[rows]
    residual = np.linalg.solve(solid.inverse, solid.y) - right - solid.spring @ solid.anchor
    held = solid.spring @ (solid.anchor - solid.carry()[solid.held])
    # Forces that the stop at 2e-5 of the size leaves, against those that hold the ends.
    assert np.abs(residual).max() < 0.02 * np.abs(held).max()


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
    asked = {"model.slack": 1.0, "model.fibre_ratio": float(kept.get("fibre_ratio", 1.0)), **asked}
    rows = benchmark_script("fe_reference").distances("rbf", kept, settings=asked)
    assert [rms < limit for (_, rms, _, _), limit in zip(rows, limits, strict=True)] == [True] * 3
    # The surface is extracted at the rest volume.
    assert max(abs(volume) for *_, volume in rows) < 1e-6


def moved(x, along, ratio=1.0, slack=1.0, steps=3):
    """A bar with fibres, one end moved by x in steps."""
    solid = with_fibres(bar(), along, ratio, slack)
    for part in range(steps):
        settle(solid, shift(x * (part + 1) / steps))
    return solid


ALONG, ACROSS = [1.0, 0, 0], [0, 1.0, 0]


def test_fibres_make_the_bar_stiffer_along_them():
    plain = moved(0.8, ALONG, steps=2).energy()
    # A slender bar would give 5; this one is held at its ends.
    assert moved(0.8, ALONG, ratio=5.0, steps=2).energy() / plain == pytest.approx(5.0, rel=0.25)
    assert moved(0.8, ACROSS, ratio=5.0, steps=2).energy() / plain < 2.5


def test_slack_fibres_shorten_along_themselves_almost_without_resistance():
    stiff, loose, aside = moved(-6.0, ALONG), moved(-6.0, ALONG, slack=1.6), moved(-6.0, ACROSS, slack=1.6)
    # The bar's ends are held, so some of the shortening is sheared; the rest costs nothing.
    assert loose.energy() < 0.15 * stiff.energy()
    # Shortened across its fibres the bar is as stiff as without them.
    assert aside.energy() == pytest.approx(stiff.energy(), rel=0.1)
    assert loose.stretch.min() > 1 / 1.6 and np.average(loose.stretch, weights=loose.weights) < 0.9
    assert loose.volumes.sum() == pytest.approx(loose.rest_volumes.sum(), rel=0.01)


def test_slack_band_ends_where_it_should():
    """Beyond the band the solid resists: the energy grows with the square of what is left."""
    near, far = (moved(x, ALONG, slack=1.1, steps=4).energy() for x in (-3.0, -10.0))
    assert far > 10.0 * near
    # Pulled, slack fibres are those of the plain solid.
    tight, slack = (moved(3.0, ALONG, slack=slack, steps=1).y for slack in (1.0, 1.6))
    assert np.abs(tight - slack).max() < 0.1  # mm; near the held ends some fibres shorten


def test_target_is_the_nearest_admissible_deformation():
    """R D(t) is nearer to F than any other rotation with any other stretch in the band."""
    rng = np.random.default_rng(3)
    solid = with_fibres(bar(), [1.0, 0, 0], slack=1.6)
    solid.y = solid.rest * [0.8, 1.1, 1.2] + rng.normal(0, 0.4, solid.rest.shape)
    for _ in range(50):
        solid.localise()

    tension = TONE * (1.0 - np.average(solid.stretch, weights=solid.weights))

    def cost(f, rotation, t):
        d = np.diag([t, t**-0.5, t**-0.5])
        return ((f - rotation @ d) ** 2).sum() + 2.0 * tension * t

    whole = np.flatnonzero(solid.weights > 0.5 * solid.weights.max())
    for q in rng.choice(whole, 20, replace=False):
        f, t = solid.f[q], solid.stretch[q]
        best = ((f - solid.target[q]) ** 2).sum() + 2.0 * tension * t
        u, _, vt = np.linalg.svd(f @ np.diag([t, t**-0.5, t**-0.5]))
        for other in np.clip(t + rng.normal(0, 0.1, 20), 1 / 1.6, 1.0):
            turn = rotation_about(rng.normal(size=3), rng.normal(0, 0.1), np.zeros(3))[:3, :3]
            assert cost(f, turn @ u @ vt, other) > best - 1e-9


@pytest.mark.parametrize("name", ["extensor", "adductor_posterior"])
def test_one_pose_has_one_shape(name):
    """Flexion and adduction at once, one after the other, and in coarser steps end in the same place."""
    flexion, adduction = {"hip.flexion": 60.0}, {"hip.adduction": -25.0}
    end = {**flexion, **adduction}
    found = []
    for waypoints, step in (
        ([{}, end], 2.0),
        ([{}, flexion, end], 5.0),
        ([{}, adduction, end], 5.0),
        ([{}, end], 10.0),
    ):
        scene = phantom_scene()
        scene.muscles = [scene.muscle(name)]
        scene.set_motion(waypoints=waypoints, step=step)
        last = len(scene.motion.frames) - 1
        (frame,) = simulate_frames(scene, build_models(scene), surfaces=False, written={last})
        found.append(frame.carried[name][0])
    # mm; the requirement is 0.2, measured 0.04.
    assert max(np.sqrt(((a - b) ** 2).sum(axis=1).mean()) for a in found for b in found) < 0.1
