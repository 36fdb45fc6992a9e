"""Which way is up, forwards and right: from the bones themselves, or from a volume's header."""

from __future__ import annotations

from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

import numpy as np

from rbfmuscle.importers.guess.landmarks import Frame, femur_frame, femur_side, long_axis
from rbfmuscle.importers.guess.names import name_facts

# Directions of bones and header that differ by more than this [degree] are named.
AGREE = 45.0
_ABOVE = {
    "femur": ("pelvis", "ilium", "sacrum"),
    "tibia": ("femur", "patella"),
    "humerus": ("scapula", "clavicle"),
}
_BELOW = {
    "femur": ("tibia", "patella", "fibula", "talus", "calcaneus", "foot"),
    "tibia": ("talus", "calcaneus", "foot"),
    "humerus": ("ulna", "radius", "hand"),
}


@dataclass
class Orientation:
    """Anatomical directions of a scene, unit (3,).

    Attributes
    ----------
    superior, anterior, right : (3,) ndarray
    source : str
        What they were found from.
    sides : dict of int to str
        Side of the body, ``"l"`` or ``"r"``, of a femur by its ``id``, by its shape.
    frames : dict of int to Frame
        Directions of each femur, likewise.
    doubts : list of str
    """

    superior: np.ndarray
    anterior: np.ndarray
    right: np.ndarray
    source: str
    sides: dict[int, str] = field(default_factory=dict)
    frames: dict[int, Frame] = field(default_factory=dict)
    doubts: list[str] = field(default_factory=list)


# The axes of NIfTI: x to the right, y forwards, z up.
HEADER = Orientation(
    np.array([0.0, 0.0, 1.0]), np.array([0.0, 1.0, 0.0]), np.array([1.0, 0.0, 0.0]), "the volume's header"
)


def find_orientation(bones: list[Any], header: Orientation | None = None) -> Orientation | None:
    """Anatomical directions, None where no bone shows them.

    Parameters
    ----------
    bones : list of Part
        With their class in ``kind``.
    header : Orientation, optional
        Known directions, which count; the bones are held against them.
    """
    own, sides = {}, {}
    for bone in bones:
        if bone.kind == "femur":
            own[id(bone)] = femur_frame(
                bone, neighbours(bone, bones, _BELOW), neighbours(bone, bones, _ABOVE)
            )
            sides[id(bone)] = femur_side(bone, own[id(bone)])
    frames = list(own.values())
    if not frames:
        frames = [frame for frame in (_from_shank(bone, bones) for bone in bones) if frame is not None]
    if not frames:
        return header
    superior = _mean([frame.superior for frame in frames])
    anterior = _mean([frame.anterior for frame in frames])
    anterior = anterior - anterior @ superior * superior
    anterior = anterior / np.linalg.norm(anterior)
    found = Orientation(
        superior, anterior, np.cross(anterior, superior), "the shapes of the bones", sides, own
    )
    found.doubts = [
        f"{bone.name}: named {_word(bone.side)}, its shape is that of the {_word(sides[id(bone)])} one; is it mirrored?"
        for bone in bones
        if id(bone) in sides and bone.side and bone.side != sides[id(bone)]
    ]
    if header is None:
        return found
    for word in ("superior", "anterior"):
        angle = np.degrees(np.arccos(np.clip(getattr(found, word) @ getattr(header, word), -1.0, 1.0)))
        if angle > AGREE:
            found.doubts.append(
                f"{word} by the bones is {angle:.0f} degrees off the volume's header, which counts"
            )
    return Orientation(
        header.superior, header.anterior, header.right, header.source, sides, own, found.doubts
    )


def orient_scene(scene: Any) -> None:
    """Give a loaded scene the directions that its bones show, by their names and shapes, where its file has none."""
    if scene.superior is not None and scene.anterior is not None:
        return
    bones = []
    for bone in scene.bones:
        facts, points = name_facts(bone.name), np.asarray(bone.mesh.vertices)
        bones.append(SimpleNamespace(mesh=bone.mesh, points=points, kind=facts.bone, side="", name=bone.name))
    found = find_orientation(bones)
    if found is not None:
        scene.superior, scene.anterior = found.superior.tolist(), found.anterior.tolist()


def neighbours(bone: Any, bones: list[Any], table: dict[str, tuple[str, ...]]) -> list[Any]:
    """The bones of the classes that a table lists for a bone, on its side."""
    kinds = table.get(bone.kind, ())
    return [b for b in bones if b.kind in kinds and (not b.side or not bone.side or b.side == bone.side)]


def shank_up(tibia: Any, bones: list[Any]) -> np.ndarray:
    """Direction (3,) up a tibia."""
    return long_axis(tibia, neighbours(tibia, bones, _BELOW), neighbours(tibia, bones, _ABOVE))[1]


def _from_shank(bone, bones):
    """Of a shank with a foot: the foot's far end is in front."""
    if bone.kind != "tibia":
        return None
    feet = [b for b in neighbours(bone, bones, _BELOW) if b.kind == "foot"]
    if not feet:
        return None
    middle, up = bone.points.mean(axis=0), shank_up(bone, bones)
    front = np.vstack([foot.points for foot in feet]).mean(axis=0) - middle
    front = front - front @ up * up
    front = front / np.linalg.norm(front)
    return Frame(up, front, np.cross(front, up), middle)


def _mean(vectors):
    total = np.sum([v * np.sign(v @ vectors[0] or 1.0) for v in vectors], axis=0)
    return total / np.linalg.norm(total)


def _word(side):
    return {"l": "left", "r": "right"}[side]
