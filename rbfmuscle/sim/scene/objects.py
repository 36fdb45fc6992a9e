"""What a scene is made of: bones, joints and muscles."""

from dataclasses import dataclass, field
from typing import Any

from rbfmuscle.sim.joints.joint import Joint

__all__ = ["Bone", "Joint", "Muscle"]


@dataclass
class Bone:
    """A rigid body: its mesh (trimesh.Trimesh, outward, rest pose), where it came from, what was mended."""

    name: str
    mesh: Any
    source: str = ""
    closed: bool = True
    notes: list = field(default_factory=list)


@dataclass
class Muscle:
    """A closed surface (trimesh.Trimesh, outward, rest pose) held by bones, and the model that moves it.

    ``contraction`` holds the keys of a muscle that contracts (ContractionTable), None for any other.
    """

    name: str
    mesh: Any
    model: str = "rbf"
    options: dict = field(default_factory=dict)
    attachments: list = field(default_factory=list)
    fibres: list | None = None
    source: str = ""
    notes: list = field(default_factory=list)
    contraction: object = None
