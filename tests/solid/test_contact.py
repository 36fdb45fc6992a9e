"""What contact points of a solid meet at the edges of bones."""

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from rbfmuscle.bones.rounded import round_bone
from rbfmuscle.bones.sdf import BoneSDF
from rbfmuscle.geometry.frames import RestFrame
from rbfmuscle.solid.contact import Obstacles

DEPTH = 0.8
HALF = 10.0  # half a side of the bone


def obstacles_about(pose, count):
    """A cube that is met by ``count`` points."""
    bone = BoneSDF.from_mesh(trimesh.creation.box((2.0 * HALF,) * 3))
    frame = RestFrame(np.random.default_rng(0).normal(size=(50, 3)) * [30.0, 20.0, 10.0])
    region = np.array([[-20.0] * 3, [20.0] * 3])
    rounded = round_bone(bone, frame, 1.5, region, cache=False, reach=3.0)
    free, allowed = np.ones(count, dtype=bool), np.zeros((1, count))
    return Obstacles([bone.arrays], [rounded], pose[None], free, allowed)


def test_normals_turn_gradually_where_points_in_a_bone_pass_an_edge():
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_euler("xyz", [20.0, 30.0, 40.0], degrees=True).as_matrix()
    pose[:3, 3] = [5.0, -3.0, 2.0]
    # Beneath the edge of two faces of a cube, from beneath the one to beneath the other.
    along = np.linspace(-4.0, 0.0, 60)
    path = np.column_stack([np.minimum(along, -DEPTH), np.minimum(along[::-1], -DEPTH)]) + HALF
    points = np.column_stack([path, np.zeros(len(path))])
    here = points @ pose[:3, :3].T + pose[:3, 3]
    which = np.arange(len(here))
    obstacles = obstacles_about(pose, len(here))
    _, exact = obstacles.ask(0, which, here, np.full(len(here), 1.0))
    assert np.einsum("pa,pa->p", exact[1:], exact[:-1]).min() < 0.1  # at a right angle
    touch = obstacles.meet_exactly(which, here, 1.0)
    assert (touch.point == which).all()
    np.testing.assert_allclose(np.linalg.norm(touch.normal, axis=1), 1.0, atol=1e-12)
    turns = np.einsum("pa,pa->p", touch.normal[1:], touch.normal[:-1])
    # In steps of 0.07, beside cells of 2.55 over which the bone is rounded.
    assert turns.min() > np.cos(np.radians(10.0))
    # The way along them ends on the bone, or beyond it where another face is nearer.
    moved = here - touch.gap[:, None] * touch.normal
    left, _ = obstacles.ask(0, which, moved, np.full(len(here), 1.0))
    assert left.min() > -0.05 * DEPTH
    far = np.abs(along + 2.0) > 1.9  # beneath the middle of a face
    np.testing.assert_allclose(left[far], 0.0, atol=0.02)
