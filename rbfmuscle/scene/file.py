"""The scene file: its tables, and the scene that they describe; a scene written as a TOML file, its
meshes, lists of vertices and fibres in a folder beside it.
"""

import json
import os
import re
import shutil
import tomllib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
import trimesh
from pydantic import AfterValidator, BeforeValidator, Field, model_validator

from rbfmuscle.geometry.arrays import Integers
from rbfmuscle.scene.joints import CouplingTable, JointTable
from rbfmuscle.scene.meshes.read import MeshTransform
from rbfmuscle.scene.objects import Muscle
from rbfmuscle.scene.options import (
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
from rbfmuscle.validation import SceneError, UsageError, did_you_mean, shown, shown_path

FORMAT = 2  # of scene files
MAIN = "main"  # the class of all muscles


def value_text(value: object) -> str:
    """A value as TOML on one line; numbers to 13 digits."""
    if isinstance(value, float):
        return f"{value + 0.0:.13g}"  # no -0
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{_key(k)} = {value_text(v)}" for k, v in value.items()) + " }"
    if isinstance(value, (list, tuple)):
        return "[" + ", ".join(map(value_text, value)) + "]"
    if isinstance(value, str):
        value = "".join(c if c.isprintable() else " " for c in value)
    return json.dumps(value, ensure_ascii=False)  # of text, whole numbers and truth TOML is JSON


def _key(key):
    bare = key.replace("_", "").replace("-", "")
    return key if bare.isascii() and bare.isalnum() else value_text(key)


def table_text(
    head: str, row: Mapping[str, object], comments: Mapping[str, str | list[str]] | None = None
) -> str:
    """A table as TOML, lists of tables with one a line, after its first line ``head``, as
    ``[[bone]]``, which the keys before all tables have not.

    ``comments`` stand after the line of a key, or after each table of its list.
    """
    lines = [head] if head else []
    for key, value in row.items():
        said = (comments or {}).get(key, "")
        if isinstance(value, list) and value and isinstance(value[0], dict):
            words = said if isinstance(said, list) else [""] * len(value)
            rows = [_commented(f"  {value_text(item)},", text) for item, text in zip(value, words)]
            lines += [f"{_key(key)} = [", *rows, "]"]
        else:
            lines.append(_commented(f"{_key(key)} = {value_text(value)}", str(said)))
    return "\n".join(lines) + "\n"


def _commented(line, text):
    return f"{line}   # {text}" if text else line


def attachment_file(muscle: str, bone: str) -> str:
    """File of the vertices of a muscle that a bone holds, relative to the scene's.

    No name holds a full stop, so that no two pairs share a file.
    """
    return f"attachments/{muscle}.{bone}.txt"


class SceneFiles:
    """The files of one scene, each written when its table is made into a folder that is there, or a
    new one beside the scene's own file; paths are relative to that file.

    UsageError if the file or the new folder is there already.
    """

    def __init__(self, path: Path, folder: Path | None = None) -> None:
        self.path = path
        self.folder = folder or path.with_name(f"{path.stem}_files")
        if path.suffix != ".toml":
            raise UsageError(f"{path}: the name of a scene file ends in .toml")
        for taken in (path, self.folder)[: 1 if folder else 2]:
            if taken.exists():
                raise UsageError(f"{taken} is there already; choose another name")
        self._own = folder is None
        self.folder.mkdir(parents=True, exist_ok=True)

    @contextmanager
    def kept_whole(self) -> Iterator[None]:
        """Context after whose error neither the file nor the new folder is left."""
        try:
            yield
        except BaseException:
            self.path.unlink(missing_ok=True)
            if self._own:
                shutil.rmtree(self.folder, ignore_errors=True)
            raise

    def mesh(self, folder: str, name: str, mesh: trimesh.Trimesh) -> str:
        """Write a PLY file in double precision, which trimesh does not, and return its name."""
        file = self._new(f"{folder}/{name}.ply")
        faces = np.zeros(len(mesh.faces), dtype=[("count", "u1"), ("corners", "<i4", 3)])
        faces["count"] = 3
        faces["corners"] = mesh.faces
        head = [
            "ply",
            "format binary_little_endian 1.0",
            f"element vertex {len(mesh.vertices)}",
            *(f"property double {axis}" for axis in "xyz"),
            f"element face {len(faces)}",
            "property list uchar int vertex_indices",
            "end_header\n",
        ]
        vertices = np.asarray(mesh.vertices, dtype="<f8")
        file.write_bytes("\n".join(head).encode() + vertices.tobytes() + faces.tobytes())
        return self._relative(file)

    def muscle(self, muscle: Muscle) -> dict[str, object]:
        """``[[muscle]]``, its mesh, attached vertices and fibres written."""
        attach: list[dict[str, object]] = []
        row: dict[str, object] = {
            "name": muscle.name,
            "mesh": self.mesh("muscles", muscle.name, muscle.mesh),
            "model": {"name": muscle.model, **muscle.options},
            "attach": attach,
        }
        for number, held in enumerate(muscle.attachments, 1):
            listed = self._listed(
                attachment_file(f"{muscle.name}.{number}", held.bone), held.vertices
            )
            entry: dict[str, object] = {"bone": held.bone, "vertices": listed}
            if held.tendon is not None:
                entry["tendon"] = held.tendon.model_dump(exclude_unset=True)
            if held.via:
                entry["via"] = True
            if held.guess is not None:
                entry["guess"] = held.guess.model_dump(exclude_unset=True)
            attach.append(entry)
        if muscle.fibres:
            file = self._new(f"fibres/{muscle.name}.json")
            lines = [np.asarray(line).tolist() for line in muscle.fibres]
            file.write_text(json.dumps({"polylines": lines}), encoding="utf-8")
            row["fibres"] = self._relative(file)
        if muscle.aponeuroses:
            row["aponeuroses"] = {
                end: {"vertices": self._listed(f"aponeuroses/{muscle.name}.{end}.txt", patch)}
                for end, patch in zip(("origin", "insertion"), muscle.aponeuroses)
            }
        if muscle.contraction is not None:
            row |= muscle.contraction.model_dump(exclude_unset=True)
        return row

    def settings(self, table: Table) -> dict[str, object]:
        """What a table of settings says; the file of a motion is copied."""
        row = table.model_dump(by_alias=True, exclude_unset=True, exclude_none=True)
        if "file" in row:
            file = self._new(row["file"].name)
            shutil.copyfile(row["file"], file)
            row["file"] = self._relative(file)
        return row

    def _new(self, name: str) -> Path:
        file = self.folder / name
        file.parent.mkdir(exist_ok=True)
        return file

    def _listed(self, name: str, vertices: Integers) -> str:
        """Write a list of vertices and return its name."""
        file = self._new(name)
        np.savetxt(file, vertices, fmt="%d")
        return self._relative(file)

    def _relative(self, file: Path) -> str:
        return file.relative_to(self.path.parent).as_posix()


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
    try:
        data = tomllib.loads(text)
    except RecursionError:
        raise SceneError(f"{path}: not valid TOML: tables or lists are nested too deep") from None
    except ValueError as error:  # TOML, and integers of thousands of digits
        quotes = "; text stands in quotes" if str(error).startswith("Invalid value") else ""
        raise SceneError(f"{path}: not valid TOML: {shown(str(error))}{quotes}") from None
    check_plain(data, context=f"{path}: ")
    about = data.get("scene")
    if isinstance(about, dict) and about.get("format") == 1:
        raise SceneError(
            f"{path}: files of format 1 are read no more; write the scene anew by "
            f"docs/scene_file.md, with format = {FORMAT}"
        )
    for number, line in enumerate(text.splitlines(), start=1):
        # Lines that are comments as a whole may say anything.
        if _MARK.search(line) and not line.lstrip().startswith("#"):
            raise SceneError(
                f"{path}: line {number}: comments mark no guesses any more; give the joint or "
                'attachment guess = { confidence = 0.5, reason = "..." }, or remove the word GUESS'
            )
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


def _merged(inner: Tables, own: Tables, context: str) -> Tables:
    """Tables of an included file, then those of the file itself: lists follow each other, other
    tables take the place of included ones; classes do so one by one, and ``[scene]`` by keys.
    """
    found = inner | own
    for key in inner.keys() & own.keys():
        first = inner[key]
        second = own[key]
        if key in LISTS and isinstance(first, list) and isinstance(second, list):
            found[key] = [*first, *second]
        elif key in ("scene", "classes") and isinstance(first, dict) and isinstance(second, dict):
            found[key] = first | second
            units = first.get("units"), second.get("units")
            if key == "scene" and None not in units and units[0] != units[1]:
                raise SceneError(
                    f"{context}its lengths are in {shown(units[0])}, not in {shown(units[1])}"
                )
    return found


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


class ClassTable(ContractionTable, MeshTransform):
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
        raise SceneError(
            f"{context}muscle {muscle.name!r}: unknown class {name!r}, "
            f"{did_you_mean(name, classes)}"
        )
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
