"""The scene file: its tables, and the scene that they describe."""

import os
import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
from pydantic import AfterValidator, BeforeValidator, Field, model_validator

from rbfmuscle.scene.joints import CouplingTable, JointTable
from rbfmuscle.scene.meshes.read import MeshTransform
from rbfmuscle.scene.options import (
    KEYS,
    Axis,
    ContactOptions,
    ContractionTable,
    DetectOptions,
    FileName,
    MotionOptions,
    NeighbourOptions,
    Neighbours,
    OutputOptions,
    Table,
    check_plain,
)
from rbfmuscle.scene.patches import AponeurosesTable, AttachTable
from rbfmuscle.scene.save import FORMAT, MAIN
from rbfmuscle.validation import SceneError, did_you_mean, shown, shown_path

Tables = dict[str, object]  # of a TOML file, unchecked

# A scene file is a page or two; long lists of vertices belong into files of their own.
LARGEST_FILE = 4_000_000
DEEPEST_INCLUDE = 8
LISTS = ("bone", "joint", "coupling", "muscle")
# Keys that name files, wherever they stand.
FILES = ("mesh", "fibres", "vertices", "points", "region", "file")
# How guesses were marked before they were keys.
_MARK = re.compile(r"#.*\bGUESS [01]\.\d")


def read_tables(path: Path, *, including: tuple[Path, ...] = ()) -> Tables:
    """The tables of a scene file, which the files ``including`` it led to; names of files are
    relative to its folder.
    """
    chain = (*including, path)
    text = _read_text(path)
    data = _parse(path, text)
    check_plain(data, context=f"{path}: ")
    about = data.get("scene")
    if isinstance(about, dict) and about.get("format") == 1:
        raise SceneError(
            f"{path}: files of format 1 are read no more; write the scene anew by "
            f"docs/scene_file.md, with format = {FORMAT}"
        )
    _refuse_marks(text, context=f"{path}: ")
    names = data.pop("include", [])
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        raise SceneError(f"{path}: include must be a list of names of files")
    for name in reversed(names):
        file = path.parent / name
        if file.resolve() in [one.resolve() for one in chain] or len(chain) > DEEPEST_INCLUDE:
            raise SceneError(f"{path}: include {name!r}: a file would include itself")
        inner = read_tables(file, including=chain)
        moved = {key: _moved(value, Path(name).parent) for key, value in inner.items()}
        data = _merged(moved, data, f"{path}: include {name!r}: ")
    return data


def _refuse_marks(text: str, *, context: str) -> None:
    """SceneError where a comment in a scene file marks a guess; lines that are comments as a whole
    may say anything.
    """
    for number, line in enumerate(text.splitlines(), start=1):
        if _MARK.search(line) and not line.lstrip().startswith("#"):
            raise SceneError(
                f"{context}line {number}: comments mark no guesses any more; give the joint or "
                'attachment guess = { confidence = 0.5, reason = "..." }, or remove the word GUESS'
            )


def _merged(inner: Tables, own: Tables, context: str) -> Tables:
    """Tables of an included file, then those of the file itself: lists follow each other, other
    tables take the place of included ones; classes do so one by one, and ``[scene]`` by keys.
    """
    found = inner | own
    for key in LISTS:
        given = [data[key] for data in (inner, own) if key in data]
        lists = [part for part in given if isinstance(part, list)]
        if lists and len(lists) == len(given):
            found[key] = [row for part in lists for row in part]
    for key in ("scene", "classes"):
        first, second = inner.get(key), own.get(key)
        if isinstance(first, dict) and isinstance(second, dict):
            found[key] = first | second
    first, second = (_units(data) for data in (inner, own))
    if None not in (first, second) and first != second:
        raise SceneError(f"{context}its lengths are in {shown(first)}, not in {shown(second)}")
    return found


def _units(data: Tables) -> object:
    about = data.get("scene")
    return about.get("units") if isinstance(about, dict) else None


def _moved(value: object, folder: Path, key: str = "") -> object:
    """Tables whose names of files are relative to the folder of the file that includes them."""
    if isinstance(value, dict):
        return {name: _moved(inner, folder, name) for name, inner in value.items()}
    if isinstance(value, list):
        return [_moved(inner, folder) for inner in value]
    return (folder / value).as_posix() if isinstance(value, str) and key in FILES else value


def _read_text(path: Path) -> str:
    if path.is_dir():
        raise SceneError(f"{path}: is a folder, give a scene file (.toml)")
    if not os.path.isfile(path):
        raise SceneError(f"{shown_path(path)}: no such scene file")
    size = os.path.getsize(path)
    if size > LARGEST_FILE:
        raise SceneError(
            f"{path}: has {size} bytes, a scene file at most {LARGEST_FILE}; put long lists of "
            "vertices into files of their own"
        )
    try:
        return path.read_text(encoding="utf-8")
    except OSError as error:
        raise SceneError(f"{path}: cannot read the scene file: {error.strerror}") from None
    except UnicodeDecodeError:
        raise SceneError(f"{path}: not a text file in UTF-8, give a scene file (.toml)") from None


def _parse(path: Path, text: str) -> Tables:
    try:
        return tomllib.loads(text)
    except RecursionError:
        raise SceneError(f"{path}: not valid TOML: tables or lists are nested too deep") from None
    except ValueError as error:  # TOML, and integers of thousands of digits
        quotes = "; text stands in quotes" if str(error).startswith("Invalid value") else ""
        raise SceneError(f"{path}: not valid TOML: {shown(str(error))}{quotes}") from None


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
        "sliding": "muscles touch by default: [neighbours] names pairs, neighbours = false none",
    }
    scene: SceneTable
    classes: dict[str, ClassTable] = Field(default_factory=dict)
    bone: list[BoneTable] = Field(default_factory=list)
    joint: list[JointTable] = Field(default_factory=list)
    coupling: list[CouplingTable] = Field(default_factory=list)
    motion: MotionOptions = MotionOptions()
    muscle: list[MuscleTable] = Field(default_factory=list)
    contact: ContactOptions = ContactOptions()
    neighbours: Neighbours = NeighbourOptions()
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
