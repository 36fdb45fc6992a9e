"""A ball that is drawn from frame to frame: fitted, carried without a field, and why."""

from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from rbfmuscle.bones.sdf import BoneSDF
from rbfmuscle.geometry.surfaces import mesh_volume
from rbfmuscle.implicit.field import FieldFit
from rbfmuscle.implicit.kernels import get_kernel
from rbfmuscle.simulation.contact import BoneContacts, BonesInReach
from rbfmuscle.surface.drawing import RestState, SurfaceBuilder

BALL = trimesh.creation.icosphere(2)
X = np.array(BALL.vertices)
EDGE = float(BALL.edges_unique_length.mean())
CENTRES = np.array(trimesh.creation.icosphere(1).vertices)
HELD = CENTRES[:, 2] < -0.9
TOP = -3.0  # of the bone at rest, a slab below the ball


class Drawn:
    """The ball, held at its lowest centres by a bone out of reach, above a slab that is another."""

    def __init__(self, shape="material", top=TOP, resolution=0):
        slab = trimesh.creation.box([20.0, 20.0, 4.0]).apply_translation([0.0, 0.0, top - 2.0])
        rest = RestState(
            centres=CENTRES,
            normals=CENTRES,
            samples=np.zeros((0, 3)),
            sample_faces=np.zeros((0, 3), dtype=int),
            fit=FieldFit(get_kernel("cubic"), 1.0),
            parts=np.arange(len(CENTRES))[None],
            bones=["holding"],
            attached_bone=np.where(HELD, 0, -1),
            volume=mesh_volume(X, np.asarray(BALL.faces)),
            axes=Rotation.from_rotvec([0.2, 0.5, -0.3]).as_matrix(),  # the ball itself has no axes
        )
        self.builder = SurfaceBuilder(
            SimpleNamespace(name="ball", source=None, mesh=BALL),
            SimpleNamespace(bones=[SimpleNamespace(name="slab", mesh=slab)]),
            rest,
            lambda vertices: lambda nodes: vertices @ nodes,
            shape=shape,
            resolution=resolution,
        )
        bones = BonesInReach(["slab"], [BoneSDF.from_mesh(slab)])
        self.contacts = BoneContacts(bones, rest.attached_bone)

    def __call__(self, linear, *, raised=0.0, fitted=True, turned=None):
        turned = np.eye(4) if turned is None else turned
        pose = turned.copy()
        pose[2, 3] += raised
        self.contacts.move({"slab": pose, "holding": turned})
        normals = CENTRES @ linear
        if not fitted:
            normals[0] = np.nan
        return self.builder.draw(CENTRES @ linear, linear, normals, self.contacts)


def causes(surface):
    return [(bone, action) for bone, _, action in surface.notes]


@pytest.mark.parametrize("shape", ["material", "embedded"])
def test_a_ball_that_turns_is_drawn_turned(shape):
    drawn = Drawn(shape)
    for turn in (np.eye(3), Rotation.from_rotvec([0.3, -1.0, 0.4]).as_matrix()):
        found = drawn(turn)
        # A level or a step along the normals is exact to a thousandth of an edge.
        np.testing.assert_allclose(found.vertices, X @ turn, atol=1e-3 * EDGE)
        assert causes(found) == [] and found.quantities["lifted_penetration_max"] == 0.0
        assert mesh_volume(found.vertices, found.faces) == pytest.approx(BALL.volume, rel=1e-9)
    if shape == "material":
        assert drawn.builder.level == pytest.approx(0.0, abs=1e-3 * EDGE)
        assert found.quantities["unfitted_fraction"] == 0.0


@pytest.mark.parametrize(
    ("stretch", "depth", "expected"),
    [
        (1.0, -1.0, ("", "carried_sheets")),
        (1.0, 0.3 * EDGE, ("", "carried_sheets")),
        (1.0, 2.0 * EDGE, ("slab", "carried_held_end")),
        (2.5, -1.0, ("", "carried_stretched")),
    ],
)
def test_a_surface_without_a_fit_is_carried_and_says_why(stretch, depth, expected):
    drawn = Drawn()
    level = drawn.builder.level
    linear = np.diag([stretch, 1.0, 1.0 / stretch])
    lowest = (CENTRES @ linear)[HELD, 2].min()
    found = drawn(linear, raised=lowest - TOP + depth, fitted=False)
    assert causes(found) == [expected]
    assert found.quantities["unfitted_fraction"] == 1.0 and drawn.builder.level == level
    assert mesh_volume(found.vertices, found.faces) == pytest.approx(BALL.volume, rel=1e-9)
    assert found.vertices[:, 2].min() > lowest + depth - 1e-3 * EDGE


def test_what_a_bone_covers_at_rest_is_out_of_it_in_all_frames():
    top = -0.95
    drawn = Drawn(top=top)
    turn = Rotation.from_rotvec([0.0, 0.0, 0.5]).as_matrix()
    for linear in (np.eye(3), turn):
        found = drawn(linear).vertices
        assert X[:, 2].min() < top - 0.04 and found[:, 2].min() > top - 1e-4 * EDGE
        # The volume of the cap below the slab, on all of the rest.
        away = np.linalg.norm(found - X @ linear, axis=1)
        assert away[X[:, 2] > -0.5].max() < 0.01 * EDGE
    same = X[:, 2] > top
    np.testing.assert_allclose(drawn.builder.shown.rest[same], X[same], atol=1e-7)


def test_the_shape_at_rest_is_the_one_that_the_first_frame_found():
    drawn = Drawn(top=-0.7)
    drawn(np.eye(3))
    first = drawn.builder.shown.rest
    assert 0.0 < (first[:, 2] < -0.7 - 0.1 * EDGE).sum() < (X[:, 2] < -0.7 - 0.1 * EDGE).sum()
    drawn.contacts.allowed[0] = 0.5
    assert drawn(np.eye(3)).vertices[:, 2].min() > -0.7 - 1e-4 * EDGE
    np.testing.assert_array_equal(drawn.builder.shown.rest, first)


def test_marching_cubes_give_the_ball_with_its_volume_and_turn_with_the_bones():
    drawn, turned = Drawn("marching", resolution=8), np.eye(4)
    first = drawn(np.eye(3))
    np.testing.assert_allclose(np.linalg.norm(first.vertices, axis=1), 1.0, atol=0.02)
    assert mesh_volume(first.vertices, first.faces) == pytest.approx(BALL.volume, rel=1e-6)
    turned[:3, :3] = Rotation.from_rotvec([0.3, -1.0, 0.4]).as_matrix()
    again = Drawn("marching", resolution=8)(turned[:3, :3].T, turned=turned)
    np.testing.assert_allclose(again.vertices, first.vertices @ turned[:3, :3].T, atol=1e-6)
    np.testing.assert_array_equal(again.faces, first.faces)
