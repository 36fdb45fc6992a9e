"""A mesh muscle that is kept sound: bones' vertices before its faces, ends out of bones, nothing through itself."""

from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from spindle_scene import build_scene

from pbd_baseline.muscle import PBDMuscle
from pbd_baseline.options import PBDOptions
from pbd_baseline.self_collision.contact import SoundContact
from pbd_baseline.self_collision.ridges import NOTHING, Ridges
from pbd_baseline.self_collision.untangling import Untangling
from rbfmuscle.geometry.crossing import crossing_faces
from rbfmuscle.metrics.penetration import BoneProbe, bone_depth, surface_depth
from rbfmuscle.scene.joints.joint import rotation_about
from rbfmuscle.simulation.contact import HalfSpaces
from rbfmuscle.simulation.frame_loop import simulate_frames


class Poses:
    """What `Ridges` asks of contacts."""

    def __init__(self, *poses):
        self.names = [f"bone {k}" for k in range(len(poses))]
        self.poses = dict(zip(self.names, poses))
        self.reached = list(range(len(poses)))


@pytest.mark.parametrize("seed", range(3))
def test_bone_vertices_behind_faces_are_those_of_a_search_through_all_pairs(seed):
    rng = np.random.default_rng(seed)
    muscle = trimesh.creation.icosphere(3, radius=10.0)
    bone = trimesh.creation.icosphere(4, radius=4.0)
    bone.apply_scale(rng.uniform(0.7, 1.5, 3))
    points = np.array(muscle.vertices) + 0.05 * rng.normal(size=muscle.vertices.shape)
    faces = np.array(muscle.faces, dtype=np.int64)
    pose = rotation_about(rng.normal(size=3), 1.0, np.zeros(3))
    pose[:3, 3] = [0.0, 0.0, 12.0]
    everywhere = {0: np.ones(len(points), dtype=bool)}
    columns, shares, normal, depth = Ridges(faces, [bone], cell=1.0, deepest=1.0).find(
        Poses(pose), points, everywhere
    )
    found = {(tuple(c), round(float(d), 9)) for c, d in zip(columns.tolist(), depth)}
    vertices = np.array(bone.vertices) @ pose[:3, :3].T + pose[:3, 3]
    outward = np.array(bone.vertex_normals) @ pose[:3, :3].T
    wanted = set()
    for f in faces:
        a, b, c = points[f]
        n = np.cross(b - a, c - a)
        n /= np.linalg.norm(n)
        behind = -(vertices - a) @ n
        near = np.flatnonzero((behind > 0) & (behind <= 1.0) & (outward @ n <= -0.2))
        if len(near):
            share = trimesh.triangles.points_to_barycentric(
                np.repeat(points[f][None], len(near), axis=0), vertices[near]
            )
            wanted |= {
                (tuple(f.tolist()), round(float(behind[p]), 9)) for p in near[(share > -0.15).all(axis=1)]
            }
    assert found == wanted and len(found) > 20
    # moving the face so far brings the vertex onto it, where its foot was not beside the face
    foot = np.einsum("ck,ckd->cd", shares, points[columns]) + depth[:, None] * normal
    within = (shares > 0.0).all(axis=1)
    assert np.linalg.norm(foot[within][:, None] - vertices[None], axis=2).min(axis=1).max() < 1e-9
    np.testing.assert_allclose(shares.sum(axis=1), 1.0)


def folded(points, rng):
    """The spindle with its belly pushed through its own back, and a dent pulled out on the other side."""
    points = points.copy()
    belly = np.exp(-((points[:, 0] - 6.0) ** 2 + points[:, 2] ** 2) / 30.0) * (points[:, 1] > 0)
    points[:, 1] -= 1.6 * belly * points[:, 1].max()
    return points + 0.02 * rng.normal(size=points.shape)


def test_what_crosses_itself_does_not_after_untangling():
    model = PBDMuscle((scene := build_scene()).muscles[0], scene, PBDOptions(sound=True))
    points = folded(model.rest.vertices, np.random.default_rng(1))
    faces = model.rest.topology.faces
    before = points.copy()
    crossing = crossing_faces(points, faces)
    assert crossing.sum() > 20

    def settle():
        model.shape.restore_volume(points, model.contact)

    assert Untangling(model.rest).untangle(points, settle) == 0
    assert not crossing_faces(points, faces).any()
    assert model.rest.volume.volume(points) == pytest.approx(model.rest.volume.rest, rel=1e-9)
    # far from the fold only the volume moves anything
    far = np.linalg.norm(before - before[faces[crossing].ravel()].mean(axis=0), axis=1) > 30.0
    assert np.linalg.norm(points - before, axis=1)[far].max() < 1.5


def test_what_smoothing_does_not_untangle_is_calmed():
    """The lower half inside out: no neighbourhood of the seam can be put right by itself."""
    model = PBDMuscle((scene := build_scene()).muscles[0], scene, PBDOptions(sound=True))
    points, rest = model.rest.vertices.copy(), model.rest.vertices
    points[points[:, 2] < 0.0] *= [-1.0, 1.0, 1.0]

    def settle():
        model.shape.restore_volume(points, model.contact)

    untangling = Untangling(model.rest)
    assert untangling.untangle(points, settle) == 0
    assert not crossing_faces(points, model.rest.topology.faces).any()
    turn = rotation_about([0.3, 1.0, -0.2], 0.7, np.array([5.0, 1.0, -9.0]))
    moved = rest @ turn[:3, :3].T + turn[:3, 3]
    np.testing.assert_allclose(untangling.smooth_displacement(moved, 40), moved, atol=1e-9)


def test_a_sound_surface_is_left_as_it_is():
    model = PBDMuscle((scene := build_scene()).muscles[0], scene, PBDOptions(sound=True))
    points = model.rest.vertices.copy()
    assert Untangling(model.rest).untangle(points, lambda: pytest.fail("nothing was to be settled")) == 0
    np.testing.assert_array_equal(points, model.rest.vertices)


def turning_scene():
    """The ball between two bones, and the lower one turned so far that the end it holds enters the ball."""
    scene = build_scene()
    scene.add_joint("hinge", "upper", "lower", centre=[0.0, -22.0, 0.0], axes={"turn": [1.0, 0.0, 0.0]})
    scene.set_motion(ramp={"hinge.turn": {"from": 0.0, "to": 20.0, "step": 5.0}})
    return scene


@pytest.mark.parametrize("method", ["pbd", "xpbd", "arap-volume"])
def test_an_end_that_is_driven_into_a_bone_gives_way(method):
    scene = turning_scene()
    depths = {}
    for sound in (False, True):
        options = PBDOptions(method=method, sound=sound)
        model = PBDMuscle(scene.muscles[0], scene, options)
        *_, frame = simulate_frames(scene, [model])
        surface = frame.surfaces["spindle"]
        probes = [BoneProbe(bone.name, bone.mesh) for bone in scene.bones]
        vertices, faces = surface.vertices, np.asarray(surface.faces)
        depths[sound] = (
            surface_depth(vertices, probes, frame.poses).max(),
            bone_depth(vertices, faces, probes, frame.poses),
        )
        if sound:
            assert not crossing_faces(vertices, faces).any()
            assert abs(model.volume() / model.rest.volume.rest - 1.0) < 1e-10
    assert depths[False][0] > 1.0
    assert depths[True][0] < 0.05 and depths[True][1] < 0.3


def test_without_the_key_nothing_of_it_is_built():
    model = PBDMuscle((scene := build_scene()).muscles[0], scene)
    assert model.sound is None and model.untangling is None


def test_a_skin_is_kept_from_bones_and_not_from_the_planes_of_neighbours():
    """A plane that keeps a point near looks like a bone behind it: pushed off, the point would go through it."""
    ball = trimesh.creation.icosphere(2, 1.0)
    vertices, faces = np.asarray(ball.vertices), np.asarray(ball.faces)
    count = len(vertices)
    found = HalfSpaces(np.array([4, 9]), np.array([0.3, 0.3]), vertices[[4, 9]], np.array([0, -1]))
    nothing = HalfSpaces(np.zeros(0, np.int64), np.zeros(0), np.zeros((0, 3)), np.zeros(0, np.int64))
    contacts = SimpleNamespace(
        half_spaces=lambda points, reach: found if len(points) == count else nothing, margin=0.0
    )
    contact = SoundContact(
        np.arange(count)[:, None].repeat(3, axis=1), np.tile([1.0, 0.0, 0.0], (count, 1)), reach=1.0, faces=faces,
        held=np.zeros(0, np.int64), attached_bone=np.zeros(0, np.int64), skin=0.1,
        ridges=SimpleNamespace(find=lambda *_: NOTHING),
    )  # fmt: skip
    contact._held_in = lambda *_: nothing
    contact._near = lambda _: np.zeros(0, np.int64)
    contact.find(contacts, vertices)
    assert contact.gap == pytest.approx([0.2, 0.3], abs=1e-6)
