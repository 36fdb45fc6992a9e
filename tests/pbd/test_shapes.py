"""Known answers of what gives a mesh muscle its shape, and of its fibres as they contract."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from constraint_values import constraint_values
from scipy.spatial.transform import Rotation
from toy_scene import held

from pbd_baseline.constraints import BendingConstraint, ContactConstraint
from pbd_baseline.contraction import MeshFibres
from pbd_baseline.muscle import PBDMuscle
from pbd_baseline.rest import PBDOptions, RestState, edge_stiffness
from pbd_baseline.shapes import ARAP, METHODS, ARAPShape, PBDShape, Shape
from pbd_baseline.topology import Topology
from rbfmuscle.scene.scene import Scene
from rbfmuscle.simulation.contact import BoneContacts, BonesInReach

ALONG = np.array([0.0, 0.0, 1.0])


def build_scene(**contraction):
    """A muscle along z, 60 mm long, of 42 vertices, held by a bone at each end."""
    scene = Scene("small", units="mm")
    for name, z in (("upper", 35.0), ("lower", -35.0)):
        ball = trimesh.creation.icosphere(subdivisions=1, radius=6.0)
        scene.add_bone(name, ball.apply_translation([0.0, 0.0, z]))
    mesh = trimesh.creation.icosphere(subdivisions=1)
    mesh.apply_transform(np.diag([10.0, 8.0, 30.0, 1.0]))
    z = mesh.vertices[:, 2]
    attach = held(upper=z > 25.0, lower=z < -25.0)
    scene.add_muscle("muscle", mesh, attach=attach, **contraction)
    return scene


def build_rest(scene):
    """What is known of its muscle at rest, with fibres along z."""
    rest = RestState.from_muscle(scene.muscles[0], scene, PBDOptions())
    return replace(rest, fibres=np.tile(ALONG, (len(rest.vertices), 1)))


@pytest.mark.parametrize("size", [1.0, 1e-3])
@pytest.mark.parametrize("axis", [*np.eye(3), np.array([0.6, -0.64, 0.48])])
def test_rotations_are_found_from_far_away_at_any_size(axis, size):
    """By 150 degrees, where a step to the maximum leads elsewhere."""
    mesh = trimesh.creation.icosphere(subdivisions=1)
    vertices = size * np.array(mesh.vertices) * [1.0, 0.9, 1.2]
    arap = ARAP(vertices, Topology.from_mesh(vertices, mesh.faces))
    turn = Rotation.from_rotvec(np.radians(150.0) * axis)
    arap.fit_rotations(turn.apply(vertices))
    found = Rotation.from_quat(arap.quaternions[:, [1, 2, 3, 0]])
    assert (found * turn.inv()).magnitude().max() < 1e-6


def test_shape_that_turns_with_its_bones_wants_its_turned_edges():
    """Before the first sweep, and after another turn."""
    rest = build_rest(build_scene())
    shape, motion = ARAPShape(rest, PBDOptions()), np.eye(4)
    for vector in ([0.4, -0.3, 0.9], [-1.0, 0.2, 0.5]):
        step = np.eye(4)
        step[:3, :3] = Rotation.from_rotvec(vector).as_matrix()
        shape.transform(step)
        motion = step @ motion
        turned = rest.vertices @ motion[:3, :3].T
        np.testing.assert_allclose(shape.arap.targets(), shape.arap.laplacian @ turned, atol=1e-9)


@pytest.mark.parametrize("size", [1e-5, 1.0, 1e5])
def test_folds_do_not_depend_on_the_unit_of_length(size):
    mesh = trimesh.creation.icosphere(subdivisions=1)
    vertices, topology = np.array(mesh.vertices), Topology.from_mesh(mesh.vertices, mesh.faces)
    points = vertices + 0.05 * np.random.default_rng(1).normal(size=vertices.shape)
    found = []
    for scale in (1.0, size):
        bending = BendingConstraint(
            scale * vertices, topology.edges, topology.wings, np.ones(len(vertices))
        )
        moved = scale * points
        bending.project(moved)
        found.append([constraint_values(bending, scale * points), moved / scale - points])
    for one, other in zip(*found, strict=True):
        assert np.abs(one).max() > 0.01
        np.testing.assert_allclose(other, one, rtol=1e-7, atol=1e-9)


def test_edges_are_soft_along_the_mean_of_the_fibres_at_their_ends():
    """Fibres 30 degrees to either side of the edge, in either sense, lie along it in the mean."""
    lean, vertices = np.radians(30.0), np.array([[0.0, 0.0, 0.0], [3.0, 0.0, 0.0], [0.0, 2.0, 0.0]])
    edges = np.array([[0, 1], [0, 2]])
    for sense in (1.0, -1.0):
        one, other = ([np.cos(lean), s * np.sin(lean), 0.0] for s in (1.0, -1.0))
        fibres = np.array([one, sense * np.array(other), sense * np.array(other)])
        found = edge_stiffness(vertices, edges, fibres, 0.5)
        np.testing.assert_allclose(found, [0.0, 1.0], atol=1e-7)


def test_long_edges_are_softer_in_inverse_proportion_until_the_fibres_are_active():
    scene = build_scene(activation=1.0)
    rest = build_rest(scene)
    shape = PBDShape(rest, PBDOptions(fibre_exponent=0.0))
    lengths, share = shape.edges.rest.copy(), shape.soft_length * rest.edge()
    assert lengths.min() > share
    np.testing.assert_allclose(shape.edges.stiffness * lengths, share, rtol=1e-12)
    fibres = MeshFibres(scene.muscles[0], rest, slack=1.6)
    fibres.activate(1.0)
    shape.contract(fibres, rest.vertices)
    np.testing.assert_allclose(shape.edges.stiffness, 1.0, rtol=1e-12)


def test_volume_comes_back_by_motions_in_proportion_to_the_room():
    rest = build_rest(build_scene())
    points = rest.vertices * [0.9, 0.95, 1.0]
    shrunk, contact = points.copy(), ContactConstraint(reach=1.0)
    Shape(rest, PBDOptions()).restore_volume(points, contact)
    assert rest.volume.volume(points) == pytest.approx(rest.volume.rest, rel=1e-12)
    free = rest.inverse_mass > 0.0
    ratio = np.linalg.norm(points - shrunk, axis=1)[free] / rest.room[free]
    np.testing.assert_allclose(ratio, ratio[0], rtol=1e-9)
    np.testing.assert_array_equal(points[~free], shrunk[~free])


@pytest.mark.parametrize("activation", [0.0, 0.3, 1.0])
@pytest.mark.parametrize("stretch", [0.45, 0.9, 1.3])
@pytest.mark.parametrize("scan", [None, 0.8, 1.25])
def test_evenly_scaled_fibres_want_the_length_and_girth_of_their_band(activation, stretch, scan):
    """A passive fibre is slack from 1 / 1.6, or between 1 and the slack length that the scene says;
    a fully active one wants half of its slack length. Across, the passive part keeps its volume.
    """
    scene = build_scene(activation=activation, fibre_stretch_at_rest=scan)
    rest = build_rest(scene)
    fibres = MeshFibres(scene.muscles[0], rest, slack=1.6)
    fibres.activate(activation)
    slack = sorted([1.0, 1.0 / scan]) if scan else [1.0 / 1.6, 1.0]
    low, high = ((1.0 - activation) * end + activation * 0.5 / (scan or 1.0) for end in slack)
    along = min(max(stretch, low), high)
    across = (activation * stretch + (1.0 - activation) * along) ** -0.5
    found = fibres.targets(stretch * rest.vertices)
    np.testing.assert_allclose(found, fibres.vectors * [across, across, along], rtol=1e-7)
    assert fibres.passive == (activation == 0.0 and scan is None)


def test_tendon_keeps_its_length_but_for_its_strain():
    scene = build_scene(activation=1.0, tendon_region={"length": 12.0, "strain": 0.05})
    rest = build_rest(scene)
    fibres = MeshFibres(scene.muscles[0], rest, slack=1.6)
    assert not fibres.passive and fibres.at_tendon.any() and not fibres.at_tendon.all()
    # An edge from tendon to belly is of the belly.
    i, j = rest.topology.edges.T
    np.testing.assert_array_equal(fibres.tendon, fibres.at_tendon[i] & fibres.at_tendon[j])
    assert 0 < fibres.tendon.sum() < len(i)
    for activation in (0.0, 0.5, 1.0):
        fibres.activate(activation)
        longest = 1.0 + 0.05 * activation
        for stretch, along in ((0.7, 1.0), (1.02, min(1.02, longest)), (1.4, longest)):
            found = fibres.targets(stretch * rest.vertices)[fibres.tendon]
            wanted = fibres.vectors[fibres.tendon] * [along**-0.5, along**-0.5, along]
            np.testing.assert_allclose(found, wanted, rtol=1e-7)


def test_residual_is_the_last_motion_in_sizes_of_the_muscle():
    """The size is twice the greatest distance from the middle: 60 mm."""
    scene = build_scene()
    model = PBDMuscle(scene.muscles[0], scene, PBDOptions(iterations=1), method=METHODS["arap-pbd"])
    contacts = BoneContacts(BonesInReach([], []), model.attached_bone)
    away = np.eye(4)
    away[2, 3] = -6.0
    model.predict({"upper": np.eye(4), "lower": np.eye(4)}, {"upper": np.eye(4), "lower": away})
    moving = model.begin(contacts)
    moving.free_step()
    longest = np.linalg.norm(moving.step, axis=1).max()
    moving.advance()
    model.take(moving)
    residual = model.surface(contacts).quantities["solver_residual"]
    assert longest > 0.01 and residual == pytest.approx(longest / 60.0, rel=1e-9)
