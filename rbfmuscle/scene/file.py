"""The scene file: its tables, and the scene that they describe."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
from pydantic import AfterValidator, BeforeValidator, Field, model_validator

from rbfmuscle.scene.activation.keys import KEYS, ContractionTable
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
)
from rbfmuscle.scene.patches import AponeurosesTable, AttachTable
from rbfmuscle.scene.toml_file import read_tables
from rbfmuscle.scene.toml_text import FORMAT, MAIN
from rbfmuscle.validation import SceneError, did_you_mean


def _check_format(number):
    if number != FORMAT:
        raise ValueError(f"must be {FORMAT}; update the library for files of a later form")
    return number


class SceneTable(Table):
    """``[scene]``."""

    hints: ClassVar[Mapping[str, str]] = {"left_out": "did you mean 'missing_bones'?"}
    format: Annotated[int, AfterValidator(_check_format)]
    name: str | None = None
    units: Literal["m", "cm", "mm"]
    missing_bones: list[str] = Field(default=[])
    doubts: list[str] = Field(default=[])
    notes: list[str] = Field(default=[])
    superior: Axis | None = None
    anterior: Axis | None = None

    @model_validator(mode="before")
    @classmethod
    def _require_format(cls, data: object) -> object:
        if isinstance(data, dict) and "format" not in data:
            raise ValueError(f"key format is missing, write format = {FORMAT}")
        return data

    @model_validator(mode="after")
    def _check_directions(self) -> Self:
        up, front = self.superior, self.anterior
        if (up is None) != (front is None) or (
            up and front and np.abs(np.cross(up, front)).max() < PARALLEL
        ):
            raise ValueError("give superior and anterior, of different directions, or neither")
        return self


# Keys of ``[scene]`` that a `Scene` has by the same names.
PARALLEL = 1e-9  # greatest component of the cross product of directions that are one
ABOUT = ("units", "missing_bones", "doubts", "notes", "superior", "anterior")


class BoneTable(MeshTransform):
    """``[[bone]]``."""

    name: str
    mesh: FileName | None = None


def _check_model(model):
    if not isinstance(model, str | dict):
        raise ValueError("must be a name or a table with a name")
    return model


class MuscleKeys(ContractionTable, MeshTransform):
    """Keys of a muscle that say where its mesh lies, and how it contracts."""

    @property
    def contraction(self) -> dict[str, object]:
        """The keys of a muscle that contracts, those that are given."""
        return {key: getattr(self, key) for key in KEYS if key in self.model_fields_set}


class ClassTable(MuscleKeys):
    """``[classes.NAME]``: keys of a muscle, for those of the class that do not give them
    themselves.
    """

    model: Annotated[str | dict[str, object], BeforeValidator(_check_model)] = "rbf"
    attach: list[AttachTable] = Field(default_factory=list)
    fibres: FileName | None = None
    aponeuroses: AponeurosesTable | None = None


class MuscleTable(ClassTable):
    """``[[muscle]]``."""

    name: str
    mesh: FileName
    class_: str = Field(alias="class", default=MAIN)


class SceneFile(Table):
    """A whole scene file."""

    hints: ClassVar[Mapping[str, str]] = {
        **dict.fromkeys(SceneTable.model_fields, "it belongs into the table [scene]"),
        "defaults": f"[classes.{MAIN}] holds the keys of all muscles",
    }
    scene: SceneTable
    classes: dict[str, ClassTable] = Field(default_factory=dict)
    bone: list[BoneTable] = Field(default_factory=list)
    joint: list[JointTable] = Field(default_factory=list)
    coupling: list[CouplingTable] = Field(default_factory=list)
    motion: MotionOptions = MotionOptions()
    muscle: list[MuscleTable] = Field(default_factory=list)
    contact: ContactOptions = ContactOptions()
    sliding: SlidingOptions | None = None
    detect: DetectOptions = DetectOptions()
    output: OutputOptions = OutputOptions()


def read_scene_file(path: Path) -> SceneFile:
    """Return the checked SceneFile of a TOML file; relative names of files become relative to its
    folder.

    SceneError names the file, the table, the key, the value and what is right.
    """
    data = read_tables(path)
    context, folder = f"{path}: ", path.parent
    tables = SceneFile.build(
        data, context=context, folder=folder, name_row=lambda at: _place(at, data)
    )
    muscles = [_with_class(muscle, tables.classes, context) for muscle in tables.muscle]
    return tables.model_copy(update={"muscle": muscles})


def _with_class(muscle: MuscleTable, classes: dict[str, ClassTable], context: str) -> MuscleTable:
    """What the file gives of a muscle: its own keys, then those of its class, then those of the
    class ``main``, which all muscles belong to.
    """
    name = muscle.class_
    if name != MAIN and name not in classes:
        hint = did_you_mean(name, classes)
        raise SceneError(f"{context}muscle {muscle.name!r}: unknown class {name!r}, {hint}")
    named = [classes[key] for key in dict.fromkeys((MAIN, name)) if key in classes]
    given: dict[str, object] = {"model": "rbf"}
    for table in (*named, muscle):
        found = given_keys(table)
        model = found.get("model")
        if isinstance(model, dict) and "name" not in model:  # some settings of the model change
            before = given["model"]
            found["model"] = {**(before if isinstance(before, dict) else {"name": before}), **model}
        given |= found
    return muscle.model_copy(update=given)


def given_keys(row: BoneTable | ClassTable) -> dict[str, Any]:  # of each key its own type
    """The keys that a row gives, as `Scene.add_bone` and `Scene.add_muscle` take them."""
    return {key: getattr(row, key) for key in row.model_fields_set if key != "class_"}


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
        elif depth == 1 and location[0] == "classes":
            words = [f"[classes.{part}]"]
        else:
            words.append(part)
    return " ".join(words)
