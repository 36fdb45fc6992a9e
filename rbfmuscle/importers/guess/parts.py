"""The meshes of a folder, sorted into bones and muscles."""

from __future__ import annotations

import os
import re
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from rbfmuscle.importers.guess.anatomy import bone_class, muscle_facts, says_muscle, side_of
from rbfmuscle.scene.meshes.read import MESH_SUFFIXES, read_mesh
from rbfmuscle.validation import MeshError, UsageError

# Folders below the one that is given, as people sort their meshes.
BONE_FOLDERS = ("bones", "bone", "knochen", "os")
MUSCLE_FOLDERS = ("muscles", "muscle", "muskeln")


@dataclass
class Part:
    """One mesh and what is believed of it.

    Attributes
    ----------
    name : str
        In the scene.
    file : str
        Path as the scene file gives it.
    read : ReadMesh
    kind : str
        Class of bone, or the name of the muscle in the table; empty where the name tells nothing.
    side : str
        ``"l"``, ``"r"`` or empty.
    reason : str
        Why it is a bone or a muscle.
    sure : bool
    """

    name: str
    file: str
    read: Any
    kind: str = ""
    side: str = ""
    reason: str = "by its name"
    sure: bool = True
    facts: Any = field(default=None, repr=False)

    @property
    def mesh(self) -> Any:
        """The mended mesh, trimesh.Trimesh [scene unit]."""
        return self.read.mesh

    @property
    def points(self) -> np.ndarray:
        """Vertices (n, 3)."""
        return np.asarray(self.read.mesh.vertices, dtype=np.float64)

    @cached_property
    def tree(self) -> Any:
        """Tree over the middles of the faces."""
        return cKDTree(self.read.mesh.triangles_center)


def read_parts(folder: Path, base: Path) -> tuple[list[Part], list[Part]]:
    """Bones and muscles of a folder, and of its folders ``bones`` and ``muscles`` where it has them.

    Parameters
    ----------
    folder : Path
    base : Path
        Folder that paths are given relative to.

    Raises
    ------
    UsageError
        If the folder is missing or holds no bone or no muscle.
    MeshError
        If a mesh cannot be read, or a muscle is open.
    """
    paths = find_meshes(folder)
    names: set[str] = set()
    bones, muscles, unknown = [], [], []
    for path in paths:
        part = _read_part(path, base, names)
        parent = path.parent.name.lower()
        if path.parent != folder and parent in BONE_FOLDERS + MUSCLE_FOLDERS:
            part.reason = f"by its folder, {path.parent.name}"
            (bones if parent in BONE_FOLDERS else muscles).append(part)
        elif says_muscle(part.name):
            muscles.append(part)
        elif bone_class(part.name):
            bones.append(part)
        else:
            unknown.append(part)
    _sort_by_size(unknown, bones, muscles)
    if not bones or not muscles:
        kind, other = ("bone", "muscles") if not bones else ("muscle", "bones")
        listed = ", ".join(part.file for part in (bones if bones else muscles))
        raise UsageError(
            f"{folder} holds no {kind} (all are {other} by their names or sizes: {listed}); "
            "name the files after what they are, or sort them into folders bones and muscles"
        )
    for part in bones:
        part.kind = bone_class(part.name)
    for part in muscles:
        part.facts = muscle_facts(part.name)
        part.kind = part.facts.name if part.facts else ""
        if not part.mesh.is_watertight:
            raise MeshError(f"{part.file}: the surface is open; a muscle must be closed")
    return bones, muscles


def find_meshes(folder: Path) -> list[Path]:
    """Mesh files of a folder and of its folders for bones and muscles, in order.

    Raises
    ------
    UsageError
        If the folder is missing or holds fewer than two.
    """
    if not folder.is_dir():
        raise UsageError(f"{folder} is no folder; give the folder of the meshes")
    places = [
        folder,
        *(p for p in sorted(folder.iterdir()) if p.name.lower() in BONE_FOLDERS + MUSCLE_FOLDERS),
    ]
    paths = [
        path
        for place in places
        if place.is_dir()
        for path in sorted(place.iterdir())
        if path.suffix.lower() in MESH_SUFFIXES
    ]
    if len(paths) < 2:
        kinds = " ".join(MESH_SUFFIXES)
        raise UsageError(f"{folder} holds {len(paths)} meshes ({kinds}); a scene needs bones and muscles")
    return paths


def _read_part(path, base, names):
    name = re.sub(r"[^a-z0-9_-]+", "_", path.stem.lower()).strip("_") or "part"
    while name in names:
        name += "_2"
    names.add(name)
    file = os.path.relpath(path, base).replace(os.sep, "/")
    return Part(name, file, read_mesh(path, may_be_open=True), side=side_of(path.stem))


def _sort_by_size(unknown, bones, muscles):
    """What no name tells: the largest are bones until there are two, the others muscles."""
    unknown.sort(key=lambda part: -np.linalg.norm(part.mesh.extents))
    for part in unknown:
        is_bone = len(bones) < 2 or not part.mesh.is_watertight
        part.sure = False
        part.reason = f"{'a bone' if is_bone else 'a muscle'} by its size, as its name tells nothing"
        (bones if is_bone else muscles).append(part)
