"""The surface of a muscle in one frame: level sets of known shapes, bones, crossings, volume."""

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from rbfmuscle.bones.obstacles import stack_bones
from rbfmuscle.bones.sdf import BoneSDF
from rbfmuscle.geometry.crossing import FaceTree, crossing_faces
from rbfmuscle.geometry.surfaces import mesh_volume
from rbfmuscle.implicit.blend import material_blend, refit_loop
from rbfmuscle.implicit.extraction.obstacles import (
    BESIDE,
    MARGIN,
    PointGrid,
    _near_loop,
    _sort_loop,
    stack_grids,
)
from rbfmuscle.implicit.field import SMALL, RBFField, overlapping_parts
from rbfmuscle.muscle.bone_distances import ask_bones
from rbfmuscle.muscle.display_mesh import neighbour_lists
from rbfmuscle.muscle.level_set import FITTED, NO_FIT, UNSURE
from rbfmuscle.muscle.model import Embedding
from rbfmuscle.muscle.surface import _begin, clear_rest, finish_surface, start_surface
from rbfmuscle.muscle.surface_limits import (
    Obstacles,
    SurfaceModel,
    SurfaceState,
    lift,
    untangle,
)

BALL = trimesh.creation.icosphere(3)
X = np.array(BALL.vertices)
FACES = np.array(BALL.faces, dtype=np.int64)
VOLUME = mesh_volume(X, FACES)
EDGE = float(BALL.edges_unique_length.mean())
CENTRES = np.array(trimesh.creation.icosphere(2).vertices)


def field_of(centres=CENTRES):
    """The field through centres of the unit ball."""
    return RBFField.fit_hermite(centres, CENTRES, parts=overlapping_parts(CENTRES, *SMALL))


def loose(n):
    """An embedding of n points, each with a node of its own."""
    numbers, one = np.arange(n), np.ones((n, 1))
    return Embedding(
        numbers[:, None], one, numbers[:, None], np.arange(n + 1), numbers, one.T.copy()
    )


class Drawn:
    """The unit ball, at rest with the offsets of its vertices, drawn where its vertices are."""

    def __init__(self, bones=(), points=None, volume=VOLUME):
        fields = [BoneSDF.from_mesh(bone) for bone in bones]
        grids = [PointGrid.of(np.asarray(bone.vertices, dtype=float)) for bone in bones]
        if points is not None:
            grids = [PointGrid.of(points) for _ in bones]
        still = np.tile(np.eye(4), (len(fields), 1, 1))
        self.obstacles = Obstacles(stack_bones(fields), still, stack_grids(grids))
        self.fields, terms = fields, field_of().terms
        self.fit, blend = (terms, None), material_blend(X, terms)
        value, gradient = blend.field(X, terms, None)
        self.model = SurfaceModel(
            FACES,
            *neighbour_lists(FACES, len(X)),
            FaceTree(X, FACES).arrays,
            loose(len(X)),
            blend,
            value,
            np.linalg.norm(gradient, axis=1),
            volume,
            EDGE,
        )
        self.forget()

    def forget(self):
        n, r = len(X), len(self.fields)
        known = np.zeros((r, n, 3)), np.full((r, n), -np.inf), np.zeros((r, n, 3))
        self.state = SurfaceState(np.zeros(1), np.zeros(n), *known)

    def __call__(self, carried, *, fitted=True, excess=None):
        """Vertices, triangles that cross, the outcome and what was left."""
        given = self.model, self.state, self.obstacles
        work, outcome = start_surface(*given, np.ascontiguousarray(carried), self.fit, fitted)
        excess = np.zeros(0) if excess is None else excess
        crossing, outcome = finish_surface(*given, work, outcome, excess)
        assert mesh_volume(work.vertices, FACES) == pytest.approx(self.model.volume, rel=1e-12)
        assert crossing == crossing_faces(work.vertices, FACES).sum()
        return work.vertices, crossing, outcome, work.left

    def distance(self, points):
        return np.min([field.distance(points) for field in self.fields], axis=0)

    def height(self, points):
        """F(x) - r - s at the vertices."""
        value = self.model.blend.field(points, *self.fit)[0]
        return value - self.model.offset - self.state.level[0]


def bone(radius, *centre):
    return trimesh.creation.icosphere(3, radius).apply_translation(centre)


def test_at_rest_the_surface_is_the_mesh_itself():
    found, crossing, outcome, left = Drawn()(X)
    np.testing.assert_allclose(found, X, atol=1e-12)
    assert (crossing, outcome, left.any()) == (0, FITTED, False)


def test_vertices_come_to_lie_on_the_level_that_gives_the_volume():
    noise = np.random.default_rng(1).normal(size=(len(X), 1))
    drawn = Drawn(volume=1.2 * VOLUME)
    carried = X * (1.0 + 0.02 * noise)
    found, crossing, outcome, _ = drawn(carried)
    assert (crossing, outcome) == (0, FITTED)
    # The last step of the level is of first order.
    assert np.abs(drawn.height(found)).max() < 1e-4
    assert drawn.state.level[0] == pytest.approx(1.2 ** (1 / 3) - 1.0, abs=0.01)
    again = drawn(carried)[0]
    assert np.abs(drawn.height(again)).max() < 1e-5, "it starts where it ended"


def test_what_a_bone_takes_away_lies_on_it():
    drawn = Drawn([bone(5.0, 5.5, 0.0, 0.0)], volume=0.8 * VOLUME)
    found, crossing, outcome, _ = drawn(X)
    distance = drawn.distance(found)
    assert (crossing, outcome) == (0, FITTED)
    # Bone vertices are kept out of the triangles, by a hundredth of an edge.
    assert distance.min() > -1e-4 * EDGE
    on_bone = np.abs(distance) < 1e-4
    assert on_bone.sum() > 50
    assert np.abs(drawn.height(found)[distance > 0.1 * EDGE]).max() < 1e-3


def test_bone_vertices_end_up_outside():
    middle = BALL.triangles_center[0] * 0.97 ** (1 / 3)
    spike = (middle - 0.1 * EDGE * BALL.face_normals[0])[None]
    drawn = Drawn([bone(1e-3, *spike[0])], points=spike, volume=0.97 * VOLUME)
    found = drawn(X)[0]
    depth = trimesh.proximity.signed_distance(trimesh.Trimesh(found, FACES), spike)
    # A hundredth of an edge is the tolerance; 0.12 without being pushed.
    assert depth[0] <= 0.015 * EDGE


def test_where_the_field_has_faded_vertices_stay_where_the_material_is():
    drawn = Drawn()
    faded = X[:, 0] > 0.3
    slope = np.where(faded, 4.0, 1.0) * drawn.model.slope
    drawn.model = drawn.model._replace(slope=slope)
    carried = X * (1.0 + 0.02 * np.sin(5.0 * X[:, 1:2]))
    found, crossing, outcome, left = drawn(carried)
    assert (crossing, outcome) == (0, FITTED)
    # A twentieth of an edge is never refused.
    way = np.linalg.norm(found - carried, axis=1) / EDGE
    assert way[faded].max() == pytest.approx(0.05, abs=1e-12)
    np.testing.assert_array_equal(left[faded], way[faded] > 0.05 - 1e-9)
    assert left[faded].sum() > 50 and not left[~faded].any()


def test_how_far_a_vertex_may_go_does_not_depend_on_the_last_frame():
    drawn = Drawn()
    rng = np.random.default_rng(2)
    # Half of the vertices trust the field half, and less than their way to it.
    slope = np.where(X[:, 2] > 0.0, 2.0, 1.0) * drawn.model.slope
    drawn.model = drawn.model._replace(slope=slope)
    carried = X * (1.0 + 0.4 * EDGE * np.sin(7.0 * X[:, 1:2]))
    first, crossing, outcome, left = drawn(carried)
    assert (crossing, outcome) == (0, FITTED) and left.sum() > 50
    # The slope is that of the field where carried, 1 to within a tenth.
    most = ((0.5 - UNSURE) / (1.0 - UNSURE)) ** 2 * EDGE
    bounded = np.linalg.norm(first[left] - carried[left], axis=1)
    assert np.median(bounded) == pytest.approx(most, rel=0.1)
    for _ in range(3):
        drawn.state.height[:] = EDGE * rng.uniform(-0.5, 0.5, len(X))
        found, crossing, _, again = drawn(carried)
        both = left & again
        assert crossing == 0 and both.sum() > 50
        ways = [np.linalg.norm(x[both] - carried[both], axis=1) for x in (first, found)]
        np.testing.assert_allclose(*ways, rtol=1e-9)


@pytest.mark.parametrize(("radius", "seed"), [(0.0, 5), (0.75, 2), (0.9, 1), (0.9, 3)])
def test_tangled_triangles_are_smoothed_until_none_cross(radius, seed):
    rng = np.random.default_rng(seed)
    share = 0.8 if radius else 1.0
    bones = [bone(radius, 0.9, 0.1 * seed, 0.0)] if radius else []
    drawn = Drawn(bones, volume=share * VOLUME)
    carried = X + 0.06 * rng.normal(size=X.shape)
    assert crossing_faces(carried, FACES).sum() > 50
    found, crossing, _, _ = drawn(carried)
    assert crossing == 0
    assert not radius or drawn.distance(found).min() > -1e-3


def test_what_crosses_goes_back_to_the_material_beside_the_bone():
    rng = np.random.default_rng(4)
    drawn = Drawn([bone(0.9, 0.9, 0.0, 0.0)])
    given = drawn.model, drawn.state, drawn.obstacles
    work = _begin(*given, X)
    lift(drawn.obstacles, drawn.state, work, np.flatnonzero(work.near))
    target = work.vertices.copy()
    assert not crossing_faces(target, FACES).any()
    among = np.linalg.norm(X - [0.5, 0.0, 0.86], axis=1) < 0.5
    work.vertices[among] += 0.1 * rng.normal(size=(among.sum(), 3))
    work.odd[:] = True
    tangled = work.vertices.copy()
    assert crossing_faces(tangled, FACES).sum() > 30
    moved = untangle(*given, work, False, np.zeros((0, 3)), np.ones(len(FACES), np.bool_), True)
    assert moved.any()
    assert not crossing_faces(work.vertices, FACES).any()
    assert drawn.distance(work.vertices[moved]).min() > -1e-3
    ways = [np.linalg.norm(x - target, axis=1) for x in (work.vertices, tangled)]
    assert (ways[0][moved & among] < ways[1][moved & among]).mean() > 0.99, "back, not smoothed"
    np.testing.assert_array_equal(work.vertices[~moved], tangled[~moved])


def test_what_crosses_goes_back_to_a_sound_surface_there_alone():
    rng = np.random.default_rng(6)
    drawn = Drawn()
    given = drawn.model, drawn.state, drawn.obstacles
    work = _begin(*given, X + 0.06 * rng.normal(size=X.shape))
    assert crossing_faces(work.carried, FACES).sum() > 50, "the material is no help"
    work.vertices[:] = X
    among = X[:, 2] > 0.8
    work.vertices[among] += 0.1 * rng.normal(size=(among.sum(), 3))
    work.odd[:] = True
    tangled = work.vertices.copy()
    assert crossing_faces(tangled, FACES).sum() > 20
    moved = untangle(*given, work, False, X, np.ones(len(FACES), np.bool_), True)
    assert moved.any()
    assert not crossing_faces(work.vertices, FACES).any()
    assert moved.sum() < 0.5 * len(X)
    np.testing.assert_array_equal(work.left, moved)
    np.testing.assert_array_equal(work.vertices[~moved], tangled[~moved])
    away = np.linalg.norm(work.vertices - X, axis=1)
    assert (away <= np.linalg.norm(tangled - X, axis=1) + 1e-12).all()


@pytest.mark.parametrize("bones", [[], [bone(0.5, 1.3, 0.0, 0.0)], [bone(0.9, 0.0, 0.0, 0.9)]])
@pytest.mark.parametrize("noise", [0.0, 0.05])
def test_a_surface_without_a_field_keeps_volume_and_leaves_the_bone(bones, noise):
    drawn = Drawn(bones)
    carried = X + noise * np.random.default_rng(5).normal(size=X.shape)
    found, crossing, outcome, left = drawn(carried, fitted=False)
    assert (crossing, outcome, left.all()) == (0, NO_FIT, True)
    assert not bones or drawn.distance(found).min() > -1e-3


def test_vertices_make_room_for_a_neighbour():
    drawn = Drawn()
    excess = np.where(X[:, 0] > 0.5, 0.05, 0.0)
    found = drawn(X, excess=excess)[0]
    inwards = 1.0 - np.linalg.norm(found, axis=1)
    np.testing.assert_allclose(inwards[X[:, 0] > 0.5], 0.05, atol=2e-3)
    assert (inwards[X[:, 0] < 0.4] < 0.0).all(), "the volume goes elsewhere"


@pytest.mark.parametrize("shift", [0.0, 0.1, -0.2])
def test_what_is_known_of_the_bones_changes_nothing(shift):
    drawn, start = Drawn([bone(5.0, 5.6, 0.0, 0.0)], volume=0.9 * VOLUME), [0.0, 0.0, 0.0]
    drawn(X + [0.05, 0.0, 0.0])
    known = drawn.state
    assert np.isfinite(known.bounds).any()
    drawn.forget()
    drawn.state = drawn.state._replace(level=known.level.copy(), height=known.height.copy())
    start = X + [shift, 0.0, 0.0]
    fresh = drawn(start)[0]
    drawn.state = known
    np.testing.assert_allclose(drawn(start)[0], fresh, rtol=0, atol=1e-12)


def test_a_question_about_the_same_place_takes_the_answer_that_is_known():
    drawn = Drawn([bone(0.9, 0.0, 0.0, 1.9)])
    rows = np.arange(len(X))
    limit = np.full(len(X), 0.3)
    asked = np.empty(len(X))
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_rotvec([0.4, 0.2, 0.1]).as_matrix(), [0.1, 0.0, 0.2]
    ask_bones(drawn.obstacles, drawn.state, X, rows, limit, 0.0, asked, np.empty_like(X))
    there = drawn.obstacles._replace(poses=pose[None])
    points = (X + 1e-4) @ pose[:3, :3].T + pose[:3, 3]
    known = np.empty(len(X))
    way = X.copy()
    ask_bones(there, drawn.state, points, rows, limit, 1e-3, known, way)
    exact = drawn.fields[0].distance(X + 1e-4)
    near = asked < limit
    assert 10 < near.sum() < len(X)
    assert (known <= exact + 1e-9).all(), "a lower bound"
    np.testing.assert_allclose(known[near], exact[near], atol=4e-4)
    outward = (X[near] - [0.0, 0.0, 1.9]) @ pose[:3, :3].T
    outward /= np.linalg.norm(outward, axis=1)[:, None]
    assert (np.einsum("ij,ij->i", way[near], outward) > 0.98).all(), "turned with the bone"


def test_what_a_bone_holds_is_brought_out_of_it_at_rest():
    drawn = Drawn([bone(0.5, 1.2, 0.0, 0.0)])
    held = X[:, 1] > -10.0
    found = clear_rest(drawn.model, drawn.state, drawn.obstacles, X.copy(), held)
    assert drawn.distance(X).min() < -0.2 and drawn.distance(found).min() > -1e-3
    assert not crossing_faces(found, FACES).any()
    far = drawn.distance(X) > 0.1
    np.testing.assert_array_equal(found[far], X[far])
    drawn.forget()
    same = clear_rest(drawn.model, drawn.state, drawn.obstacles, X.copy(), ~held)
    np.testing.assert_array_equal(same, X)


@pytest.mark.parametrize("kernel", ["cubic", "gaussian", "matern_52"])
def test_a_fit_made_anew_is_that_of_moved_centres(kernel):
    how = {"kernel": kernel, "epsilon": 1.7, "parts": overlapping_parts(CENTRES)}
    first = RBFField.fit_hermite(CENTRES, CENTRES, **how)
    bent = CENTRES * [1.2, 0.9, 1.0] + 0.1 * CENTRES[:, [1, 2, 0]] ** 2
    normals = CENTRES / [1.2, 0.9, 1.0]
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    wanted = RBFField.fit_hermite(bent, normals, **how)
    form = None if first.kernel.plain_cube else first.kernel.form
    epsilon = 1.7 if first.kernel.has_epsilon else 0.0
    condition = refit_loop(bent, normals, how["parts"], first.terms, form, epsilon)
    assert 1.0 < condition < np.inf
    points = bent[::3] * 1.05
    tolerance = 1e-14 * max(condition, 1e4)
    np.testing.assert_allclose(first(points), wanted(points), rtol=0, atol=tolerance)
    np.testing.assert_allclose(first.terms.radius, wanted.terms.radius, rtol=1e-12)


def test_a_blend_in_the_material_is_the_field_at_rest_and_its_gradient_is_its_derivative():
    field, points = field_of(), 1.02 * X[::5]
    blend = material_blend(points, field.terms)
    value, gradient = blend.field(points, field.terms, None)
    assert np.abs(value - field(points)).max() < 1e-3
    for axis, step in enumerate(6e-6 * np.eye(3)):
        ahead, behind = (
            blend.field(points + sign * step, field.terms, None)[0] for sign in (1, -1)
        )
        np.testing.assert_allclose(gradient[:, axis], (ahead - behind) / 1.2e-5, atol=1e-7)


def test_points_near_triangles_are_those_found_one_by_one():
    rng = np.random.default_rng(0)
    ball = trimesh.creation.icosphere(2, radius=5.0)
    vertices, faces = (
        np.asarray(ball.vertices),
        np.asarray(ball.faces)[ball.triangles_center[:, 0] > 0.0],
    )
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_rotvec([-0.5, 0.4, 0.1]).as_matrix(), [0.3, 0.2, -0.1]
    points = rng.uniform(-8.0, 8.0, (700, 3))
    local = (vertices - pose[:3, 3]) @ pose[:3, :3]
    grid, pairs = PointGrid.of(points), np.empty((2, 20_000), dtype=np.int64)
    assert _near_loop(local, faces, PointGrid.of(points[:0]), pairs) == 0
    met = _near_loop(local, faces, grid, pairs)
    point, first, near = _sort_loop(pairs[:, :met], grid.number, len(faces))
    corners = local[faces]
    inside = np.zeros((len(points), len(faces)), dtype=bool)
    for f, (a, b, c) in enumerate(corners):
        normal = np.cross(b - a, c - a)
        frame = np.column_stack([b - a, c - a, normal / np.linalg.norm(normal)])
        along = np.linalg.solve(frame, (points - a).T)
        beside = np.minimum(np.minimum(along[0], along[1]), 1.0 - along[0] - along[1])
        sides = np.linalg.norm([a - b, b - c, c - a], axis=1)
        margin = MARGIN * sides.max()
        low, high = corners[f].min(axis=0) - margin, corners[f].max(axis=0) + margin
        boxed = ((points >= low) & (points <= high)).all(axis=1)
        inside[:, f] = boxed & (np.abs(along[2]) <= margin) & (beside >= -BESIDE)
    rows = np.flatnonzero(inside.any(axis=1))
    assert 30 < len(rows) < 400
    np.testing.assert_array_equal(grid.points[point], points[rows])
    for p, row in enumerate(rows):
        found = near[first[p] : first[p + 1]]
        np.testing.assert_array_equal(found, np.flatnonzero(inside[row]))
