"""What a scene is made of: bones, joints and muscles."""

from dataclasses import dataclass, field

import numpy as np


@dataclass
class Bone:
    """A rigid body: its mesh (trimesh.Trimesh, outward, rest pose), where it came from, what was mended."""

    name: str
    mesh: object
    source: str = ""
    closed: bool = True
    notes: list = field(default_factory=list)


@dataclass
class Joint:
    """Turns ``child`` (and all that hangs on it) against ``parent`` about ``centre`` (3,).

    ``axes`` maps a coordinate's name to its unit axis (3,), in the rest pose; several coordinates are
    a product of rotations in that order.
    """

    name: str
    parent: str
    child: str
    centre: np.ndarray
    axes: dict


@dataclass
class Muscle:
    """A closed surface (trimesh.Trimesh, outward, rest pose) held by bones, and the model that moves it."""

    name: str
    mesh: object
    model: str = "rbf"
    options: dict = field(default_factory=dict)
    attachments: list = field(default_factory=list)
    fibres: list | None = None
    source: str = ""
    notes: list = field(default_factory=list)
