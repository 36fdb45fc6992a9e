"""Meshes and joints whose size or place shows a wrong unit or another frame."""

import math
from typing import TypeAlias

import numpy as np

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.geometry.vectors import box_size
from rbfmuscle.scene.bone import Bone
from rbfmuscle.scene.meshes.repair import ReadMesh
from rbfmuscle.scene.objects import MM_PER_UNIT, Muscle
from rbfmuscle.validation import MeshError, SceneError

Item: TypeAlias = Bone | Muscle | ReadMesh

SMALLEST_MM = 2.0  # across: the bones of a mouse
LARGEST_MM = 3000.0  # across: a person with arms raised
# A muscle further from the bones than this many diagonals of their box is in another frame.
FAR_AWAY = 1.0
# The same for the centre of a joint: a nearly straight path has one far away.
FARTHEST_CENTRE = 1000.0


def check_size(kind: str, name: str, item: Item, units: str) -> None:
    """Raise MeshError for a mesh smaller than a mouse's or larger than a person's."""
    size = box_size(item.mesh.vertices)
    millimetres = size * MM_PER_UNIT[units]
    if not SMALLEST_MM <= millimetres <= LARGEST_MM:
        best = 10.0 ** round(math.log10(300.0 / max(millimetres, 1e-12)))
        raise MeshError(
            f"{kind} {name!r} ({item.source or 'built in code'}) is {size:.4g} {units} "
            "across, which "
            f"cannot be right; correct the scene's units, or set its scale ({best:g} times the "
            "present one would "
            f"make it {millimetres * best:.4g} mm)"
        )


def check_place(name: str, muscle: Item, bones: list[Bone], units: str) -> None:
    """Raise MeshError for a muscle of a wrong size, or one that lies far away from all bones."""
    check_size("muscle", name, muscle, units)
    away, size = _away_from_bones(bones, *muscle.mesh.bounds)
    if away > FAR_AWAY * size:
        raise MeshError(
            f"muscle {name!r} ({muscle.source or 'built in code'}) lies {away:.4g} {units} "
            "away from "
            "all bones; bring the meshes into one frame and unit (scale)"
        )


def check_centre(name: str, centre: Floats, bones: list[Bone], units: str) -> None:
    """Raise SceneError for a joint whose centre lies so far from all bones that poses lose their
    digits.
    """
    away, size = _away_from_bones(bones, centre, centre)
    if away > FARTHEST_CENTRE * size:
        raise SceneError(
            f"joint {name!r}: centre {np.asarray(centre).tolist()} lies {away:.4g} {units} "
            "away from all bones; "
            f"correct it, it is in the scene's unit ({units})"
        )


def _away_from_bones(bones, low, high):
    """Distance of a box from that of all bones, and the diagonal of that; no distance without
    bones.
    """
    if not bones:
        return 0.0, 0.0
    corners = np.concatenate([bone.mesh.bounds for bone in bones])
    least, most = corners.min(axis=0), corners.max(axis=0)
    away = np.maximum(least - high, low - most).clip(min=0)
    return float(np.linalg.norm(away)), float(np.linalg.norm(most - least))
