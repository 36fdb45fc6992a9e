"""Which way is up and forwards: from the bones themselves, or from a volume's header."""

from dataclasses import dataclass, field

import numpy as np

from rbfmuscle.geometry.vectors import across, unit
from rbfmuscle.importers.guess.landmarks import Frame, femur_frame, long_axis
from rbfmuscle.importers.guess.names import name_facts
from rbfmuscle.importers.guess.parts import Part
from rbfmuscle.scene.scene import Scene

AGREE = 45.0  # directions of bones and header that differ by more than this [degree] are named
# Scans are saved along the body: an axis of the coordinates within this [degree] of what a thigh
# shows is taken.
ALONG = 25.0
LEAST_TRIANGLES = 100  # of fewer triangles the shape of a bone says nothing
_ABOVE = {"femur": ("pelvis", "ilium", "sacrum"), "tibia": ("femur", "patella")}
_BELOW = {
    "femur": ("tibia", "patella", "fibula", "talus", "calcaneus", "foot"),
    "tibia": ("talus", "calcaneus", "foot"),
}


@dataclass
class Orientation(Frame):
    """Anatomical directions of a scene, what they were found from, and what speaks against them."""

    source: str = "the shapes of the bones"
    doubts: list[str] = field(default_factory=list)


# The axes of NIfTI: x to the right, y forwards, z up.
HEADER = Orientation(
    np.array([0.0, 0.0, 1.0]), np.array([0.0, 1.0, 0.0]), source="the volume's header"
)


def find_orientation(bones: list[Part], header: Orientation | None = None) -> Orientation | None:
    """Anatomical directions, None where no bone shows them; femora get their ``frame``, and a side
    if they have none.

    Directions of a ``header`` count; the bones are held against them.
    """
    femora = [bone for bone in bones if bone.kind == "femur"]
    doubts = []
    for bone in femora:
        bone.frame = femur_frame(
            bone, neighbours(bone, bones, _BELOW), neighbours(bone, bones, _ABOVE)
        )
        bone.side = bone.side or bone.frame.side
        if bone.side != bone.frame.side:
            words = {"l": "left", "r": "right"}
            said, shape = words[bone.side], words[bone.frame.side]
            doubts.append(
                f"{bone.name}: named {said}, its shape is that of the {shape} one; is it mirrored?"
            )
    shanks = (_shank_frame(bone, bones) for bone in bones) if not femora else ()
    frames = [bone.frame for bone in femora] + [frame for frame in shanks if frame is not None]
    if not frames:
        return header
    superior = unit(np.sum([frame.superior for frame in frames], axis=0))
    anterior = unit(across(np.sum([frame.anterior for frame in frames], axis=0), superior))
    if header is None:
        found = np.stack([superior, anterior])
        axes = np.sign(found) * (np.abs(found) == np.abs(found).max(axis=1, keepdims=True))
        near = ((found * axes).sum(axis=1) > np.cos(np.radians(ALONG))).all()
        up, front = axes if near else found
        return Orientation(up, front, doubts=doubts)
    for word, seen in {"superior": superior, "anterior": anterior}.items():
        angle = np.degrees(np.arccos(np.clip(seen @ getattr(header, word), -1.0, 1.0)))
        if angle > AGREE:
            doubts.append(
                f"{word} by the bones is {angle:.0f} degrees off {header.source}, which counts"
            )
    return Orientation(header.superior, header.anterior, source=header.source, doubts=doubts)


def orient_scene(scene: Scene) -> Scene:
    """Give a scene the directions that its bones show, by their names and shapes, where its file
    has none.
    """
    if scene.superior is None or scene.anterior is None:
        shapes = [bone for bone in scene.bones if len(bone.mesh.faces) >= LEAST_TRIANGLES]
        found = find_orientation([Part(b.name, "", b, name_facts(b.name).bone) for b in shapes])
        if found is not None:
            scene.superior, scene.anterior = found.superior.tolist(), found.anterior.tolist()
    return scene


def neighbours(bone: Part, bones: list[Part], table: dict[str, tuple[str, ...]]) -> list[Part]:
    """The bones of the classes that a table lists for a bone, on its side."""
    kinds = table.get(bone.kind, ())
    return [b for b in bones if b.kind in kinds and b.may_be_beside(bone)]


def shank_up(tibia: Part, bones: list[Part]) -> np.ndarray:
    """Direction (3,) up a tibia."""
    return long_axis(tibia, neighbours(tibia, bones, _BELOW), neighbours(tibia, bones, _ABOVE))


def _shank_frame(bone, bones):
    """Of a shank with a foot, which lies in front; else None."""
    feet = [b.points.mean(axis=0) for b in neighbours(bone, bones, _BELOW) if b.kind == "foot"]
    if bone.kind != "tibia" or not feet:
        return None
    up = shank_up(bone, bones)
    return Frame(up, unit(across(np.mean(feet, axis=0) - bone.points.mean(axis=0), up)))
