"""A scene as a TOML file, its meshes, lists of vertices and fibres in a folder beside it."""

from __future__ import annotations

import json
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from rbfmuscle.geometry.arrays import Integers
from rbfmuscle.scene.bone import Bone
from rbfmuscle.scene.build import made_motion
from rbfmuscle.scene.contents import SceneContents
from rbfmuscle.scene.guesses import Guess
from rbfmuscle.scene.joints.tables import coupling_row, joint_row
from rbfmuscle.scene.meshes.input_mesh import InputMesh
from rbfmuscle.scene.meshes.obj import obj_text
from rbfmuscle.scene.objects import Muscle
from rbfmuscle.scene.options import Table
from rbfmuscle.scene.settings import TABLES
from rbfmuscle.scene.toml_text import attachment_file, table_text
from rbfmuscle.scene.upgrade import FORMAT
from rbfmuscle.validation import SceneError, UsageError

if TYPE_CHECKING:
    import trimesh

OPTIONAL = ("sliding", "detect")  # tables that change a scene even where they are empty


class SceneFiles:
    """The files of one scene, in a folder, each written when its table is made; paths are relative
    to the scene's own file.
    """

    def __init__(self, path: Path, folder: Path) -> None:
        self.path = path
        self.folder = folder

    def bone(self, bone: Bone) -> dict[str, object]:
        """``[[bone]]``, its mesh written."""
        return {"name": bone.name, "mesh": self._mesh("bones", bone.name, bone.mesh)}

    def muscle(self, muscle: Muscle) -> dict[str, object]:
        """``[[muscle]]``, its mesh, attached vertices and fibres written."""
        attach: list[dict[str, object]] = []
        row: dict[str, object] = {
            "name": muscle.name,
            "mesh": self._muscle_mesh(muscle),
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

    def table(self, table: Table) -> dict[str, object]:
        """A table of settings; the file of a motion is copied."""
        row = table.model_dump(by_alias=True, exclude_unset=True, exclude_none=True)
        if "file" in row:
            file = self._new(row["file"].name)
            shutil.copyfile(row["file"], file)
            row["file"] = self._relative(file)
        return row

    def write(
        self,
        tables: Sequence[tuple[str, Mapping[str, object]]],
        guesses: Sequence[Guess],
        comment: str,
    ) -> None:
        """Write the file itself: a comment, then the heads and rows of its tables; lines that are
        guesses are marked.
        """
        parts = [comment] if comment else []
        for head, row in tables:
            name = row.get("name")
            about = [g for g in guesses if g.table == head.strip("[]") and g.name in ("", name)]
            said = [f"GUESS {guess.confidence}: {guess.text}" for guess in about]
            keys = [key for key, value in row.items() if not isinstance(value, list)]
            parts.append(table_text(head, row, dict(zip(keys, said))))
        self.path.write_text("\n".join(parts), encoding="utf-8")

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

    def _muscle_mesh(self, muscle: Muscle) -> str:
        """Write the mesh of a muscle and return its name: an OBJ file where it has texture
        coordinates or normals.
        """
        given = muscle.given
        if given is None or not (len(given.corners.texture) or len(given.corners.normals)):
            return self._mesh("muscles", muscle.name, muscle.mesh)
        vertices = np.asarray(muscle.mesh.vertices)
        own = InputMesh(vertices, given.source[given.faces], given.source, given.corners)
        file = self._new(f"muscles/{muscle.name}.obj")
        file.write_text(obj_text(own), encoding="ascii")
        return self._relative(file)

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


def save_scene(scene: SceneContents, path: Path) -> Path:
    """Write a scene, and the files that it names into a new folder beside it; the path of its
    file.
    """
    folder = path.with_name(f"{path.stem}_files")
    if path.suffix != ".toml":
        raise UsageError(f"{path}: the name of a scene file ends in .toml")
    for taken in (path, folder):
        if taken.exists():
            raise UsageError(f"{taken} is there already; choose another name")
    if list(made_motion(scene, scene.motion.options).frames) != list(scene.motion.frames):
        raise SceneError(
            "the frames of the motion are not those of its table [motion]; give it by "
            "set_motion before the scene is saved"
        )
    folder.mkdir(parents=True)
    write_scene(scene, path, folder)
    return path


def write_scene(scene: SceneContents, path: Path, folder: Path, *, comment: str = "") -> None:
    """Write a scene's file, which begins with a comment, and the files that it names into a folder
    that is there.
    """
    files = SceneFiles(path, folder)
    about: dict[str, object] = {"format": FORMAT, "name": scene.name, "units": scene.units}
    for key in ("missing_bones", "doubts", "notes", "superior", "anterior"):
        about |= {key: getattr(scene, key)} if getattr(scene, key) else {}
    tables = [("[scene]", about)]
    tables += [("[[bone]]", files.bone(bone)) for bone in scene.bones]
    tables += [("[[bone]]", {"name": name}) for name in scene.meshless_bones]
    tables += [("[[joint]]", joint_row(joint)) for joint in scene.joints]
    tables += [("[[coupling]]", coupling_row(one, scene.joints)) for one in scene.couplings]
    tables += [("[[muscle]]", files.muscle(muscle)) for muscle in scene.muscles]
    for key in TABLES:
        table = getattr(scene, key) if key != "motion" else scene.motion.options
        row = {} if table is None else files.table(table)
        # What a scene may lack is switched on by its mere table.
        if row or (table is not None and key in OPTIONAL):
            tables.append((f"[{key}]", row))
    files.write(tables, scene.guesses, comment)
