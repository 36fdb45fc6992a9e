"""Checks a motion before the run: attachments that it moves into another bone, too far apart or too close together."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.geometry.rest_frame import moved_box
from rbfmuscle.scene.attachments import ExactMeshes
from rbfmuscle.scene.check import Finding
from rbfmuscle.scene.motion import bone_poses

if TYPE_CHECKING:
    from rbfmuscle.scene.objects import Muscle
    from rbfmuscle.scene.scene import Scene

# Greatest numbers of frames and of vertices of an attachment that are checked.
MOST_FRAMES, MOST_VERTICES = 25, 60
# Depth beyond that at rest from which an attachment counts as inside a bone [mm].
DEEPER = 1.0
# Bounds of the distance between attachments, relative to rest.
LONGEST, SHORTEST = 1.5, 0.5
# Attachments closer than this fraction of the muscle's extent lie side by side, not at its ends.
APART = 0.3


class Driven(NamedTuple):
    """An attachment that the motion moves into another bone: depth beyond rest, and the first frame."""

    muscle: str
    bone: str
    into: str
    depth: float
    frame: int
    first: int


class Stretched(NamedTuple):
    """Two attachments whose distance grows or shrinks too far: the extreme, and the first frame."""

    muscle: str
    bones: tuple[str, str]
    rest: float
    distance: float
    frame: int
    first: int


def check_motion(scene: Scene, exact: ExactMeshes | None = None) -> tuple[list[Driven], list[Stretched]]:
    """Follow the attachments of every muscle along the motion.

    Parameters
    ----------
    scene : Scene
    exact : ExactMeshes, optional
        Distances to the bones' meshes that are known already.

    Returns
    -------
    driven : list of Driven
    stretched : list of Stretched
    """
    exact = ExactMeshes() if exact is None else exact
    count = len(scene.motion)
    frames = sorted({round(k) for k in np.linspace(0, count - 1, min(count, MOST_FRAMES))})
    poses = [bone_poses(scene, {}), *(bone_poses(scene, scene.motion.frames[k]) for k in frames)]
    driven, stretched = [], []
    for muscle in scene.muscles:
        patches = _patches(muscle)
        for bone, points in patches.items():
            driven += _driven(scene, muscle.name, bone, points, (frames, poses), exact)
        extent = float(np.linalg.norm(np.ptp(np.asarray(muscle.mesh.vertices), axis=0)))
        for pair in itertools.combinations(patches, 2):
            stretched += _stretched(muscle.name, pair, patches, extent, (frames, poses))
    return driven, stretched


def _patches(muscle: Muscle) -> dict[str, Floats]:
    """Attached vertices by bone, thinned."""
    found: dict[str, list[Any]] = {}
    for attachment in muscle.attachments:
        found.setdefault(attachment.holder, []).append(attachment.vertices)
    thinned = {}
    for bone, parts in found.items():
        index = np.unique(np.concatenate(parts))
        step = max(1, math.ceil(len(index) / MOST_VERTICES))
        thinned[bone] = np.asarray(muscle.mesh.vertices, dtype=float)[index[::step]]
    return thinned


def _driven(
    scene: Scene, name: str, bone: str, points: Floats, along: tuple[list[int], list[Any]], exact: ExactMeshes
) -> list[Driven]:
    """Depth of one attachment in the bones that do not hold it, beyond its depth at rest."""
    frames, poses = along
    bounds = np.array([points.min(axis=0), points.max(axis=0)])
    found = []
    for other in scene.bones:
        if other.name == bone:
            continue
        places = [np.linalg.inv(pose[other.name]) @ pose[bone] for pose in poses]
        if all(np.allclose(place, places[0], atol=1e-9) for place in places[1:]):
            continue
        depths = np.array([_depth(points, bounds, place, other.mesh, exact) for place in places])
        deeper = depths[1:] - depths[0]
        over = np.flatnonzero(deeper > scene.length(DEEPER))
        if len(over):
            worst = int(deeper.argmax())
            found.append(
                Driven(name, bone, other.name, float(deeper[worst]), frames[worst], frames[int(over[0])])
            )
    return found


def _depth(points: Floats, bounds: Floats, place: Floats, mesh: Any, exact: ExactMeshes) -> float:
    """Depth of the deepest point inside a mesh, of points moved into its coordinates."""
    low, high = moved_box(bounds, place)
    if np.any(low > mesh.bounds[1]) or np.any(high < mesh.bounds[0]):
        return 0.0
    return max(0.0, -float(exact.distances(points @ place[:3, :3].T + place[:3, 3], mesh).min()))


def _stretched(
    name: str,
    pair: tuple[str, str],
    patches: dict[str, Floats],
    extent: float,
    along: tuple[list[int], list[Any]],
) -> list[Stretched]:
    """Whether the centroids of two attachments move too far apart or too close together."""
    frames, poses = along
    middles = [np.append(patches[bone].mean(axis=0), 1.0) for bone in pair]
    distances = np.array(
        [np.linalg.norm((pose[pair[0]] @ middles[0] - pose[pair[1]] @ middles[1])[:3]) for pose in poses]
    )
    rest, ratio = float(distances[0]), distances[1:] / max(float(distances[0]), 1e-12)
    if rest < APART * extent:
        return []
    found = []
    for over, worst in ((ratio > LONGEST, ratio.argmax()), (ratio < SHORTEST, ratio.argmin())):
        if over.any():
            first = frames[int(np.flatnonzero(over)[0])]
            found.append(Stretched(name, pair, rest, float(distances[1 + worst]), frames[int(worst)], first))
    return found


def motion_findings(scene: Scene, exact: ExactMeshes | None = None) -> list[Finding]:
    """The same as warnings with remedies."""
    return describe(check_motion(scene, exact), scene.units)


def describe(found: tuple[Sequence[Driven], Sequence[Stretched]], units: str) -> list[Finding]:
    """Warnings, the worst first."""
    driven, stretched = found
    said = [
        Finding(
            "warning",
            one.muscle,
            f"the motion drives the end held by {one.bone!r} into bone {one.into!r}, from about frame {one.first}, "
            f"by up to {one.depth:.3g} {units} at frame {one.frame}; give it a tendon, or its tendon via "
            "points, or end the motion sooner",
        )
        for one in sorted(driven, key=lambda one: -one.depth)
    ]
    # Attachments that meet come first.
    for one in sorted(stretched, key=lambda one: -abs(math.log(max(one.distance / one.rest, 1e-12)))):
        how = "take apart" if one.distance > one.rest else "bring together"
        said.append(
            Finding(
                "warning",
                one.muscle,
                f"{one.bones[0]!r} and {one.bones[1]!r} {how} its ends to {one.distance / one.rest:.2f} times their "
                f"distance at rest ({one.rest:.4g} to {one.distance:.4g} {units} at frame {one.frame}, too far from "
                f"about frame {one.first}); a tendon may be missing between mesh and bone: give one to the "
                "attachment, or correct the attachments",
            )
        )
    return said
