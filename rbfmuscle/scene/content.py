"""What a scene and its parts hold, compared and hashed: every field but where files lie."""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
import trimesh
from pydantic import BaseModel

from rbfmuscle.geometry.surfaces import mesh_hash


class Compared:
    """Parts of a scene are equal where all their fields are, but those that are ``not_compared``:
    where a file lies, and what follows from the other fields.
    """

    not_compared: ClassVar[tuple[str, ...]] = ()

    def __eq__(self, other: object) -> bool:
        return content(self) == content(other) if type(other) is type(self) else NotImplemented


def content(value: object) -> object:
    """A value as plain data that JSON can hold; arrays and meshes by their hashes, and no names of
    files.
    """
    if isinstance(value, np.generic):
        value = value.item()
    if value is None or isinstance(value, str | int | float):
        return value
    if isinstance(value, Path):
        return "file"
    if isinstance(value, np.ndarray):
        numbers = np.ascontiguousarray(value, dtype=np.float64) + 0.0  # no -0
        return [list(value.shape), hashlib.sha256(numbers.tobytes()).hexdigest()]
    if isinstance(value, Mapping):
        return {key: content(item) for key, item in value.items()}
    if isinstance(value, Sequence):
        return [content(item) for item in value]
    if is_dataclass(value) or isinstance(value, BaseModel):
        names = (
            [each.name for each in fields(value)]
            if is_dataclass(value)
            else type(value).model_fields
        )
        left = value.not_compared if isinstance(value, Compared) else ()
        found = {name: content(getattr(value, name)) for name in names if name not in left}
        return {"": type(value).__name__, **found}
    if isinstance(value, trimesh.Trimesh):
        return mesh_hash(np.asarray(value.vertices), np.asarray(value.faces))
    raise TypeError(f"{type(value).__name__} is no part of a scene")


def content_hash(*values: object) -> str:
    """SHA-256 of the content of values."""
    text = json.dumps(content(values), sort_keys=True)
    return hashlib.sha256(text.encode()).hexdigest()
