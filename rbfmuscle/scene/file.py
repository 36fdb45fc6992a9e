"""The scene file: its tables, and the scene that they describe."""

import hashlib
import os
import tomllib
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np
from pydantic import Field

from rbfmuscle.scene.activation.keys import ContractionTable
from rbfmuscle.scene.attachments import AttachTable
from rbfmuscle.scene.bone import Bone
from rbfmuscle.scene.build import add_bone, add_muscle, place_coupling, place_joint, validate
from rbfmuscle.scene.check import check_centre, check_place, check_size
from rbfmuscle.scene.guesses import find_guesses
from rbfmuscle.scene.joints.joint import all_coordinates
from rbfmuscle.scene.joints.tables import (
    CouplingTable,
    JointTable,
    coupling_row,
    joint_row,
    make_coupling,
)
from rbfmuscle.scene.meshes.read import read_mesh
from rbfmuscle.scene.motion import make_motion, unit_sign
from rbfmuscle.scene.objects import Muscle, SceneData
from rbfmuscle.scene.options import (
    Axis,
    ContactOptions,
    DetectOptions,
    FileName,
    MotionOptions,
    OutputOptions,
    Positive,
    SlidingOptions,
    Table,
    check_plain,
)
from rbfmuscle.validation import MeshError, SceneError, shown, shown_path

S = TypeVar("S", bound=SceneData)
# A scene file is a page or two; long lists of vertices belong into files of their own.
LARGEST_FILE = 4_000_000


class SceneTable(Table):
    """``[scene]``."""

    format: Literal[1]
    name: str | None = None
    units: Literal["m", "cm", "mm"]
    left_out: list[str] = Field(default=[])
    doubts: list[str] = Field(default=[])
    notes: list[str] = Field(default=[])
    superior: Axis | None = None
    anterior: Axis | None = None


class BoneTable(Table):
    """``[[bone]]``."""

    name: str
    mesh: FileName | None = None
    scale: Positive = 1.0


class DefaultsTable(ContractionTable):
    """``[defaults]``: any key of a muscle, for all that do not give it themselves."""

    model: Any = "rbf"
    scale: Positive = 1.0
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
    check_plain(data, place=f"{path}: ")
    place, folder = f"{path}: ", path.parent
    return SceneFile.build(data, place=place, folder=folder, name_row=lambda at: _place(at, data))


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


def load_scene(cls: type[S], path: str | Path, *, skeleton: bool = False) -> S:
    """Return the scene (of class ``cls``) of a TOML file; its paths are relative to the file.

    Parameters
    ----------
    path : path
    skeleton : bool
        Accept a scene without muscles; it can be looked at, not run.

    Raises
    ------
    SceneError
        If the file, or a name or value in it, is wrong; the message names it and the remedy.
    MeshError
        If a mesh cannot be used.
    """
    path = Path(path)
    tables = read_scene_file(path)
    scene = cls(tables.scene.name or path.stem, units=tables.scene.units, path=path)
    scene.guesses = find_guesses(path.read_text(encoding="utf-8"))
    try:
        _fill(scene, tables)
        return scene if skeleton and not scene.muscles else validate(scene)
    except (SceneError, MeshError) as error:
        raise type(error)(f"{path}: {error}") from None


def _fill(scene: SceneData, tables: SceneFile) -> None:
    about = tables.scene
    up, front = about.superior, about.anterior
    if (up is None) != (front is None) or (
        up and front and np.abs(np.cross(up, front)).max() < 1e-9
    ):
        raise SceneError("[scene]: give superior and anterior, of different directions, or neither")
    scene.left_out = about.left_out
    scene.doubts = about.doubts
    scene.notes = about.notes
    scene.superior = about.superior
    scene.anterior = about.anterior
    for bone in tables.bone:
        add_bone(scene, bone.name, bone.mesh, scale=bone.scale)
        if bone.mesh is not None:
            check_size(scene, "bone", bone.name, scene.bones[-1])
    for joint in tables.joint:
        place_joint(scene, joint.joint())
        check_centre(scene, joint.name, scene.joints[-1].centre)
    for coupling in tables.coupling:
        place_coupling(scene, make_coupling(coupling, scene.joints))
    for muscle in tables.muscle:
        _add_muscle(scene, muscle, tables.defaults)
    scene.motion = make_motion(scene, tables.motion)
    scene.contact, scene.sliding = tables.contact, tables.sliding
    scene.detect, scene.output = tables.detect, tables.output


def _add_muscle(scene, muscle, defaults):
    given = {
        key: getattr(table, key) for table in (defaults, muscle) for key in table.model_fields_set
    }
    scale = given.get("scale", 1.0)
    read = read_mesh(muscle.mesh, name=muscle.name, scale=scale)
    check_size(scene, "muscle", muscle.name, read)
    check_place(scene, muscle.name, read)
    model, default = given.get("model", "rbf"), defaults.model
    if (
        isinstance(model, dict) and "name" not in model
    ):  # some options of the default model are changed
        model = {**(default if isinstance(default, dict) else {"name": default}), **model}
    add_muscle(scene, **given | {"mesh": read, "model": model})


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


def describe_scene(scene: SceneData) -> dict[str, Any]:
    """Return the scene as plain data for ``run.json``: names, counts, options, sources and
    hashes.
    """
    units = {name: unit_sign(scene, name) for name in all_coordinates(scene.joints)}
    motion = scene.motion.options.model_dump(mode="json", by_alias=True, exclude_none=True)
    times = {} if scene.motion.times is None else {"times": scene.motion.times}
    return {
        "name": scene.name,
        "units": scene.units,
        "file": str(scene.path) if scene.path else None,
        "superior": scene.superior,
        "anterior": scene.anterior,
        "bones": [{"name": bone.name, **_describe_mesh(bone)} for bone in scene.bones],
        "links": list(scene.links),
        "left_out": list(scene.left_out),
        "doubts": list(scene.doubts),
        "guesses": [guess._asdict() for guess in scene.guesses],
        "notes": list(scene.notes),
        "joints": [joint_row(joint) for joint in scene.joints],
        "couplings": [coupling_row(coupling, scene.joints) for coupling in scene.couplings],
        "coordinate_units": {name: unit for name, unit in units.items() if unit != "°"},
        "motion": {**motion, "frames": len(scene.motion), **times},
        "muscles": [_describe_muscle(muscle) for muscle in scene.muscles],
        "contact": scene.contact.model_dump(),
        "sliding": scene.sliding.model_dump() if scene.sliding else None,
        "detect": scene.detect.model_dump() if scene.detect else None,
        "output": scene.output.model_dump(),
    }


def _describe_muscle(muscle: Muscle) -> dict[str, Any]:
    keys = muscle.contraction
    return {
        "name": muscle.name,
        "model": {"name": muscle.model, **muscle.options},
        "attach": [
            {"bone": held.bone, "vertices": len(held.vertices)}
            | ({} if held.tendon is None else {"tendon": held.tendon.model_dump()})
            for held in muscle.attachments
        ],
        "fibres": len(muscle.fibres) if muscle.fibres else 0,
        **({} if keys is None else keys.model_dump(exclude_none=True)),
        **_describe_mesh(muscle),
    }


def _describe_mesh(item: Bone | Muscle) -> dict[str, Any]:
    vertices = np.ascontiguousarray(item.mesh.vertices, dtype=np.float64)
    faces = np.ascontiguousarray(item.mesh.faces, dtype=np.int64)
    return {
        "mesh": item.source,
        "vertices": len(vertices),
        "triangles": len(faces),
        "volume": float(item.mesh.volume),
        "sha256": hashlib.sha256(vertices.tobytes() + faces.tobytes()).hexdigest(),
        "mended": list(item.notes),
    }
