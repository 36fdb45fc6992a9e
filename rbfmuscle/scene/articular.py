"""Articular surfaces: where the bones of a joint face each other; a ball's head and its socket."""

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import cKDTree

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.scene.objects import Muscle, from_mm
from rbfmuscle.scene.scene import Scene

if TYPE_CHECKING:
    import trimesh

# Faces within this of the least gap face each other [mm], if the gap is no joint's beyond FARTHEST.
BAND, FARTHEST = 6.0, 15.0
# Least cosine between a face's normal and the direction to the other bone.
LOOK = 0.5
# Radii of a head [mm]; what belongs to it and to its socket, in radii from the centre.
HEAD = (12.0, 35.0)
SHELL = 1.08
SOCKET = 1.4
# The nearest points of a bone to the centre, of which the radius is the median.
NEAREST = 50
# What is attached lies on an articular surface where that is farther by no more than this than the
# bone itself [mm].
BESIDE = 1.5
TOUCHED = 8.0  # what is farther from the bone than this [mm] lies on none of its surfaces


def articular_points(
    joints: Iterable[tuple[str, str, Floats | None]],
    meshes: Mapping[str, "trimesh.Trimesh"],
    millimetre: float,
) -> dict[str, Floats]:
    """Points (n, 3) of the articular surfaces by bone.

    ``joints`` are (parent, child, centre of a ball or None) of the joints that move; bones without
    a mesh are left out.
    """
    found: dict[str, list[Floats]] = {name: [] for name in meshes}
    for parent, child, centre in joints:
        if parent not in meshes or child not in meshes:
            continue
        pair = meshes[parent], meshes[child]
        radius = 0.0 if centre is None else _head_radius(pair[1], centre) / millimetre
        if centre is not None and HEAD[0] <= radius <= HEAD[1]:
            found[parent].append(_about(pair[0], centre, SOCKET * radius * millimetre, -1.0))
            found[child].append(_about(pair[1], centre, SHELL * radius * millimetre, 1.0))
        else:
            found[parent].append(_facing(pair[0], pair[1], millimetre))
            found[child].append(_facing(pair[1], pair[0], millimetre))
    return {name: np.concatenate([np.empty((0, 3)), *parts]) for name, parts in found.items()}


def scene_surfaces(scene: Scene) -> dict[str, Floats]:
    """The same of a scene, by its joints that move."""
    meshes = {bone.name: bone.mesh for bone in scene.bones}
    joints = [
        (joint.parent, joint.child, joint.centre if len(joint.coordinates) > 1 else None)
        for joint in scene.joints
        if joint.coordinates
    ]
    return articular_points(joints, meshes, from_mm(1.0, scene.units))


def articular_share(
    muscle: Muscle, scene: Scene, surfaces: Mapping[str, Floats]
) -> tuple[float, str]:
    """Greatest share of an attachment that lies on an articular surface, and its bone.

    ``surfaces`` are as of `scene_surfaces`.
    """
    worst = (0.0, "")
    for held in (a for a in muscle.attachments if not a.via):
        surface = surfaces.get(held.bone, np.empty((0, 3)))
        if held.tendon is None and len(surface):
            points = np.asarray(muscle.mesh.vertices)[held.vertices]
            near, _ = cKDTree(surface).query(points)
            touched, beside = from_mm(TOUCHED, scene.units), from_mm(BESIDE, scene.units)
            some = near < touched + beside  # others cannot lie on it
            away = scene.bone(held.bone).exact.unsigned(points[some])
            lies = (near[some] <= away + beside) & (away < touched)
            share = float(lies.sum()) / len(points)
            worst = max(worst, (share, held.bone))
    return worst


def _head_radius(mesh, centre):
    away = np.sort(np.linalg.norm(np.asarray(mesh.triangles_center) - centre, axis=1))
    return float(np.median(away[:NEAREST]))


def _about(mesh, centre, reach, sign):
    """Middles of the triangles within reach of a centre that look away from it (1) or at it
    (-1).
    """
    points = np.asarray(mesh.triangles_center)
    away = points - centre
    distance = np.linalg.norm(away, axis=1)
    look = np.einsum("ij,ij->i", np.asarray(mesh.face_normals), away) * sign
    return points[(distance < reach) & (look > LOOK * distance)]


def _facing(mesh, other, millimetre):
    """Middles of the triangles that look at another bone within `BAND` of the least gap."""
    reach = (FARTHEST + BAND) * millimetre
    near = _within(mesh, other.bounds, reach)
    points = np.asarray(mesh.triangles_center)[near]
    theirs = np.asarray(other.triangles_center)[_within(other, mesh.bounds, reach)]
    if len(points) == 0 or len(theirs) == 0:
        return points[:0]
    distance, nearest = cKDTree(theirs).query(points)
    if distance.min() > FARTHEST * millimetre:
        return points[:0]
    away = (theirs[nearest] - points) / np.maximum(distance, 1e-12)[:, None]
    look = np.einsum("ij,ij->i", np.asarray(mesh.face_normals)[near], away)
    return points[(distance < distance.min() + BAND * millimetre) & (look > LOOK)]


def _within(mesh, bounds, reach):
    """Which triangles have their middles in a box (2, 3) or so near to it."""
    low, high = bounds
    points = np.asarray(mesh.triangles_center)
    return ((points > low - reach) & (points < high + reach)).all(axis=1)
