"""How far the bones of a joint part in a motion."""

from collections.abc import Iterable, Mapping

import numpy as np
from scipy.spatial import cKDTree

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.scene.motion import bone_poses
from rbfmuscle.scene.scene import Scene

# Bones of a joint that are nearer than this at rest [mm] meet there; others, as a tendon's end, are held apart.
MEETING = 10.0
# Vertices of a bone whose distance to the other is taken, at most.
_VERTICES = 2000


def joint_gaps(scene: Scene, frames: Iterable[int]) -> list[tuple[int, str, str, float]]:
    """How much wider than at rest the gap between the two bones of each joint is, by their vertices.

    For some frames of the motion, of joints whose bones meet at rest: (frame, parent, child, opening [scene unit]).
    """
    vertices = {bone.name: np.asarray(bone.mesh.vertices, dtype=float) for bone in scene.bones}
    pairs = [(j.parent, j.child) for j in scene.joints if j.parent in vertices and j.child in vertices]
    trees = {parent: cKDTree(vertices[parent]) for parent, _ in pairs}
    points = {child: vertices[child][:: -(-len(vertices[child]) // _VERTICES)] for _, child in pairs}
    rest = {(p, c): float(trees[p].query(points[c])[0].min()) for p, c in pairs}
    meeting = [pair for pair in pairs if rest[pair] < scene.length(MEETING)]
    found = []
    for frame in frames:
        poses: Mapping[str, Floats] = bone_poses(scene, scene.motion.frames[frame])
        for parent, child in meeting:
            relative = np.linalg.solve(poses[parent], poses[child])
            moved = points[child] @ relative[:3, :3].T + relative[:3, 3]
            gap = float(trees[parent].query(moved)[0].min())
            found.append((frame, parent, child, gap - rest[parent, child]))
    return found
