"""Writing a scene to a folder: a TOML file that a person can read, and the meshes that it names."""

import os
from pathlib import Path
from typing import Any

import numpy as np

from rbfmuscle.importers.opensim.scene import Imported
from rbfmuscle.scene.joints.tables import coupling_row, joint_row
from rbfmuscle.scene.options import MotionOptions
from rbfmuscle.scene.scene import Scene
from rbfmuscle.validation import UsageError

BONES, MUSCLES, ATTACHMENTS = "bones", "muscles", "attachments"


def write_scene(found: Imported, directory: Path, *, motion: Path | None = None) -> Path:
    """Write ``scene.toml`` and the bones' meshes to a folder, and return the scene file.

    Parameters
    ----------
    found : Imported
    directory : path
        Made where it is missing.
    motion : path, optional
        A motion file that the scene shall follow; checked against its coordinates.

    Raises
    ------
    SceneError
        If the motion file does not fit.
    UsageError
        If the folder cannot be written to.
    """
    directory = Path(directory)
    target, options = directory / "scene.toml", None
    try:
        directory.mkdir(parents=True, exist_ok=True)
        if motion is not None:
            options = MotionOptions(file=os.path.relpath(Path(motion).resolve(), directory.resolve()))
            found.scene.motion = found.scene.motion_from(options, folder=directory)
            found.notes += found.scene.motion.notes
        parts = [skeleton_text(found.scene, head_text(found), write_meshes(found.scene, directory))]
        parts += _muscle_texts(found.scene, directory)
        if options is not None:
            parts.append(table_text("[motion]", {"file": options.file}))
        target.write_text("\n".join(parts), encoding="utf-8")
    except OSError as error:
        raise UsageError(f"cannot write to {directory}: {error.strerror}; choose another --output") from None
    return target


def _muscle_texts(scene, directory):
    """The tables of the muscles, their meshes and attachments written."""
    parts = []
    for folder in (MUSCLES, ATTACHMENTS) if scene.muscles else ():
        (directory / folder).mkdir(exist_ok=True)
    for muscle in scene.muscles:
        write_ply(directory / MUSCLES / f"{muscle.name}.ply", muscle.mesh.vertices, muscle.mesh.faces)
        rows = []
        for held in muscle.attachments:
            file = f"{ATTACHMENTS}/{muscle.name}_{held.bone}.txt"
            np.savetxt(directory / file, held.vertices, fmt="%d")
            rows.append({"bone": held.bone, "vertices": file})
        head = (
            "[[muscle]]   # a tube along the model's path, of its fibres' volume; put a mesh of your own here"
        )
        mesh = f"{MUSCLES}/{muscle.name}.ply"
        parts.append(table_text(head, {"name": muscle.name, "mesh": mesh, "attach": rows}))
    return parts


def head_text(found: Imported) -> str:
    """Return the comment that begins the file: where it is from, and what was not taken."""
    model = found.model
    lines = [
        f"Scene from the OpenSim model {model.path.name} (version {model.version}).",
        "Its meshes, authors and licence are the model's: see its <credits>.",
        "Meshes stand in the model's default pose; angles are degrees. All keys: docs/scene_file.md.",
        *(f"note: {note}" for note in found.notes),
    ]
    return "\n".join("# " + " ".join(line.split()) for line in lines) + "\n"


def number(value: float) -> str:
    """Return a number as text, to 13 digits: more than any judge of a pose can tell."""
    text = f"{value:.13g}"
    return "0" if text == "-0" else text


def value_text(value: Any) -> str:
    """Return a value as TOML on one line."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, (int, float)):
        return number(float(value)) if isinstance(value, float) else str(value)
    if isinstance(value, str):
        escaped = value.replace("\\", "\\\\").replace('"', '\\"')
        return '"' + "".join(c if c.isprintable() else " " for c in escaped) + '"'
    if isinstance(value, dict):
        return "{ " + ", ".join(f"{_key(k)} = {value_text(v)}" for k, v in value.items()) + " }"
    return "[" + ", ".join(value_text(item) for item in value) + "]"


def _key(key):
    bare = key.replace("_", "").replace("-", "")
    return key if bare.isascii() and bare.isalnum() else value_text(key)


def joint_text(row: dict) -> str:
    """Return a joint's table as TOML."""
    lines = ["[[joint]]"]
    for key, value in row.items():
        if key in ("rotations", "translations"):
            lines.append(f"{key} = [")
            lines += [f"  {value_text(axis)}," for axis in value]
            lines.append("]")
        elif key != "coordinates":
            lines.append(f"{key} = {value_text(value)}")
    for name, facts in row.get("coordinates", {}).items():
        lines.append(f"coordinates.{_key(name)} = {value_text(facts)}")
    return "\n".join(lines) + "\n"


def table_text(head: str, row: dict) -> str:
    """Return a plain table as TOML."""
    return "\n".join([head, *(f"{key} = {value_text(value)}" for key, value in row.items())]) + "\n"


def skeleton_text(scene: Scene, head: str, meshes: dict[str, str]) -> str:
    """Return the scene file of a skeleton: bones, joints and couplings.

    Parameters
    ----------
    head : str
        Comment lines that begin the file.
    meshes : dict of str to str
        File of every bone's mesh, relative to the scene file.
    """
    parts = [
        head,
        table_text("[scene]", {"format": 1, "name": scene.name, "units": scene.units, **_directions(scene)}),
    ]
    for bone in scene.bones:
        parts.append(table_text("[[bone]]", {"name": bone.name, "mesh": meshes[bone.name]}))
    for link in scene.links:
        parts.append(f'[[bone]]   # no mesh: it carries joints only\nname = "{link}"\n')
    parts += [joint_text(joint_row(joint)) for joint in scene.joints]
    parts += [table_text("[[coupling]]", coupling_row(c, scene.joints)) for c in scene.couplings]
    return "\n".join(parts)


def _directions(scene):
    return {} if scene.superior is None else {"superior": scene.superior, "anterior": scene.anterior}


def write_meshes(scene: Scene, directory: Path) -> dict[str, str]:
    """Write every bone's mesh as PLY (float64) and return the files, relative to the folder."""
    (directory / BONES).mkdir(parents=True, exist_ok=True)
    files = {bone.name: f"{BONES}/{bone.name}.ply" for bone in scene.bones}
    for bone in scene.bones:
        write_ply(directory / files[bone.name], bone.mesh.vertices, bone.mesh.faces)
    return files


def write_ply(path: Path, vertices: np.ndarray, faces: np.ndarray) -> None:
    """Write a triangle mesh as binary PLY with positions in float64, so that nothing is rounded."""
    vertices = np.ascontiguousarray(vertices, dtype="<f8")
    table = np.empty(len(faces), dtype=[("count", "u1"), ("corners", "<i4", 3)])
    table["count"], table["corners"] = 3, faces
    head = (
        f"ply\nformat binary_little_endian 1.0\nelement vertex {len(vertices)}\n"
        "property double x\nproperty double y\nproperty double z\n"
        f"element face {len(faces)}\nproperty list uchar int vertex_indices\nend_header\n"
    )
    path.write_bytes(head.encode() + vertices.tobytes() + table.tobytes())
