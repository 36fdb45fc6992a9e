"""What a scene is made of: bones, joints and muscles, and how they are named."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.scene.joints.joint import Joint
from rbfmuscle.validation import SceneError, check_points, did_you_mean, shown

__all__ = [
    "Bone",
    "Joint",
    "Muscle",
    "as_vector",
    "check_new_name",
    "check_tree",
    "find_named",
    "split_model",
]

_NAME_CHARACTERS = set("abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789_-")


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


def split_model(model: dict[str, Any] | str, *, place: str) -> tuple[Any, ...]:
    """Return (name, options) of a model given as a name or as a table with ``name``."""
    if isinstance(model, str):
        return model, {}
    if isinstance(model, dict):
        options = dict(model)
        name = options.pop("name", "rbf")
        if isinstance(name, str):
            return name, options
    raise SceneError(f"{place}: model must be a name or a table with a name, got {shown(model)}")


def find_named(items: list[Any], name: str, what: str, *, place: str = "") -> Any:
    """Return the item of that name, or raise SceneError naming the nearest."""
    for item in items:
        if item.name == name:
            return item
    hint = did_you_mean(name, [item.name for item in items])
    raise SceneError(f"{place + ': ' if place else ''}unknown {what} {name!r}, {hint}")


def check_new_name(items: list[Any], name: str, what: str) -> None:
    """Raise SceneError if a name is no name for a file, or taken."""
    if not isinstance(name, str) or not name or not set(name) <= _NAME_CHARACTERS:
        raise SceneError(
            f"{what} name {shown(repr(name))} may hold letters, digits, '_' and '-' only (it becomes a file name)"
        )
    if any(item.name == name for item in items):
        raise SceneError(f"{what} {name!r} is given twice")


def check_tree(joints: list[Joint], new: Joint) -> None:
    """Raise SceneError if bones and joints would no longer form a tree with one joint more."""
    place, child = f"joint {new.name!r}", new.child
    if any(other.child == child for other in joints):
        raise SceneError(f"{place}: bone {child!r} is already the child of another joint")
    parents, ancestor = {other.child: other.parent for other in joints}, new.parent
    while ancestor is not None:
        if ancestor == child:
            raise SceneError(f"{place}: {child!r} would hang on itself, joints must form a tree")
        ancestor = parents.get(ancestor)


def as_vector(values: Any, name: str, *, unit: bool = False) -> Floats:
    """Three numbers as an array (3,), of length one where a unit vector is asked for, or raise SceneError."""
    try:
        vector = check_points([values], name=name)[0]
    except (ValueError, TypeError) as error:
        raise SceneError(f"{name} must be three numbers, got {shown(values)} ({error})") from None
    if not unit:
        return vector
    largest = np.abs(vector).max()
    if largest == 0:
        raise SceneError(f"{name} must not be the zero vector")
    vector = vector / largest  # the squares of very long or short ones leave the range of numbers
    return vector / np.linalg.norm(vector)
