"""The scene file: its tables, and the scene that they describe."""

import os
import tomllib
from pathlib import Path
from typing import Any, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from rbfmuscle.scene.activation.keys import ContractionTable
from rbfmuscle.scene.attachments import AttachTable
from rbfmuscle.scene.joints.tables import CouplingTable, JointTable
from rbfmuscle.scene.meshes.transform import MeshTransform
from rbfmuscle.scene.options import (
    Axis,
    ContactOptions,
    DetectOptions,
    FileName,
    MotionOptions,
    OutputOptions,
    SlidingOptions,
    Table,
    check_plain,
)
from rbfmuscle.validation import SceneError, shown, shown_path

# A scene file is a page or two; long lists of vertices belong into files of their own.
LARGEST_FILE = 4_000_000


class SceneTable(Table):
    """``[scene]``."""

    format: Literal[1]
    name: str | None = None
    units: Literal["m", "cm", "mm"]
    missing_bones: list[str] = Field(default=[])
    doubts: list[str] = Field(default=[])
    notes: list[str] = Field(default=[])
    superior: Axis | None = None
    anterior: Axis | None = None

    @model_validator(mode="after")
    def _check_directions(self) -> Self:
        up, front = self.superior, self.anterior
        if (up is None) != (front is None) or (
            up and front and np.abs(np.cross(up, front)).max() < 1e-9
        ):
            raise ValueError("give superior and anterior, of different directions, or neither")
        return self


class BoneTable(MeshTransform):
    """``[[bone]]``."""

    name: str
    mesh: FileName | None = None


class DefaultsTable(ContractionTable, MeshTransform):
    """``[defaults]``: any key of a muscle, for all that do not give it themselves."""

    model: Any = "rbf"
    attach: list[AttachTable] = Field(default_factory=list)
    fibres: FileName | None = None


class MuscleTable(DefaultsTable):
    """``[[muscle]]``."""

    name: str
    mesh: FileName


class SceneFile(Table):
    """A whole scene file."""

    scene: SceneTable
    defaults: DefaultsTable = DefaultsTable()
    bone: list[BoneTable] = Field(default_factory=list)
    joint: list[JointTable] = Field(default_factory=list)
    coupling: list[CouplingTable] = Field(default_factory=list)
    motion: MotionOptions = MotionOptions()
    muscle: list[MuscleTable] = Field(default_factory=list)
    contact: ContactOptions = ContactOptions()
    sliding: SlidingOptions | None = None
    detect: DetectOptions | None = None
    output: OutputOptions = OutputOptions()


def read_scene_file(path: Path) -> SceneFile:
    """Return the checked SceneFile of a TOML file; relative names of files become relative to its
    folder.

    SceneError names the file, the table, the key, the value and what is right.
    """
    data = _read_toml(path)
    check_plain(data, context=f"{path}: ")
    context, folder = f"{path}: ", path.parent
    return SceneFile.build(
        data, context=context, folder=folder, name_row=lambda at: _place(at, data)
    )


def _read_toml(path):
    if path.is_dir():
        raise SceneError(f"{path}: is a folder, give a scene file (.toml)")
    if not os.path.isfile(path):
        raise SceneError(f"{shown_path(path)}: no such scene file")
    size = os.path.getsize(path)
    if size > LARGEST_FILE:
        raise SceneError(
            f"{path}: has {size} bytes, a scene file at most {LARGEST_FILE}; put long lists of "
            "vertices into "
            "files of their own"
        )
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise SceneError(f"{path}: cannot read the scene file: {error.strerror}") from None
    except UnicodeDecodeError:
        raise SceneError(f"{path}: not a text file in UTF-8, give a scene file (.toml)") from None
    except RecursionError:
        raise SceneError(f"{path}: not valid TOML: tables or lists are nested too deep") from None
    except ValueError as error:  # TOML, and integers of thousands of digits
        quotes = "; text stands in quotes" if str(error).startswith("Invalid value") else ""
        raise SceneError(f"{path}: not valid TOML: {shown(str(error))}{quotes}") from None


def given_muscle(muscle: MuscleTable, defaults: DefaultsTable) -> dict[str, Any]:
    """What the file gives of a muscle, by key, with the defaults that it does not give itself."""
    given = {
        key: getattr(table, key) for table in (defaults, muscle) for key in table.model_fields_set
    }
    model = given.get("model", "rbf")
    if isinstance(model, dict) and "name" not in model:  # some options of the default's change
        default = defaults.model
        model = {**(default if isinstance(default, dict) else {"name": default}), **model}
    return given | {"model": model}


def _place(location, data):
    """Words for a pydantic location: ("muscle", 1, "attach", 0) -> [[muscle]] 'iliacus'
    attach 1.
    """
    words = []
    here = data
    for depth, part in enumerate(location):
        known = isinstance(here, list) or (isinstance(here, dict) and part in here)
        missing = depth == len(location) - 1 and isinstance(here, dict) and str(part).islower()
        if isinstance(part, str) and not known and not missing:
            continue  # the name of one of several types that pydantic tried
        here = (
            here[part]
            if known and not (isinstance(here, list) and not isinstance(part, int))
            else None
        )
        if isinstance(part, int):
            name = here.get("name") if isinstance(here, dict) else None
            words.append(repr(name) if name else str(part + 1))
        elif depth == 0:
            words.append(f"[[{part}]]" if isinstance(here, list) else f"[{part}]")
        else:
            words.append(part)
    return " ".join(words)
