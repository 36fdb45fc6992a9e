"""A scene as a TOML file, its meshes, lists of vertices and fibres in a folder beside it."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from rbfmuscle.geometry.arrays import Integers
from rbfmuscle.scene.bone import Bone
from rbfmuscle.scene.joints import Coupling, Joint, coupling_row, joint_row
from rbfmuscle.scene.objects import Muscle
from rbfmuscle.scene.options import Table
from rbfmuscle.validation import UsageError

if TYPE_CHECKING:
    import trimesh


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


TableRow: TypeAlias = tuple[str, Mapping[str, object]]  # the head of a table, and its keys


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

    def skeleton(
        self,
        bones: Sequence[Bone],
        meshless_bones: Sequence[str],
        joints: list[Joint],
        couplings: Sequence[Coupling],
    ) -> list[TableRow]:
        """``[[bone]]``, the meshes written, ``[[joint]]`` and ``[[coupling]]``."""
        meshes = {bone.name: self._mesh("bones", bone.name, bone.mesh) for bone in bones}
        return [
            *(("[[bone]]", {"name": name, "mesh": mesh}) for name, mesh in meshes.items()),
            *(("[[bone]]", {"name": name}) for name in meshless_bones),
            *(("[[joint]]", joint_row(joint)) for joint in joints),
            *(("[[coupling]]", coupling_row(coupling, joints)) for coupling in couplings),
        ]

    def muscle(self, muscle: Muscle) -> dict[str, object]:
        """``[[muscle]]``, its mesh, attached vertices and fibres written."""
        attach: list[dict[str, object]] = []
        row: dict[str, object] = {
            "name": muscle.name,
            "mesh": self._mesh("muscles", muscle.name, muscle.mesh),
            "model": {"name": muscle.model, **muscle.options},
            "attach": attach,
        }
        for number, held in enumerate(muscle.attachments, 1):
            name = attachment_file(f"{muscle.name}.{number}", held.bone)
            entry: dict[str, object] = {
                "bone": held.bone,
                "vertices": self._listed(name, held.vertices),
            }
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

    def settings(self, tables: Mapping[str, Table | None]) -> list[TableRow]:
        """Tables of settings that say something, by their names; the file of a motion is copied."""
        found: list[TableRow] = []
        for key, table in tables.items():
            if table is None:
                continue
            row = table.model_dump(by_alias=True, exclude_unset=True, exclude_none=True)
            if "file" in row:
                file = self._new(row["file"].name)
                shutil.copyfile(row["file"], file)
                row["file"] = self._relative(file)
            if row:
                found.append((f"[{key}]", row))
        return found

    def write(self, tables: Sequence[TableRow], comment: str) -> Path:
        """Write the file itself: a comment, then the heads and rows of its tables. Returns its
        path.
        """
        parts = [comment] if comment else []
        parts += [table_text(head, row) for head, row in tables]
        self.path.write_text("\n".join(parts), encoding="utf-8")
        return self.path

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

    def _mesh(self, folder: str, name: str, mesh: trimesh.Trimesh) -> str:
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
