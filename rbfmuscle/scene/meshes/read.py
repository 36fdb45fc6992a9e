"""Reading surface meshes: STL, OBJ, PLY, VTK and VTP PolyData, mended where that is safe.

Vertex numbers in files stay usable: a read mesh knows which of its vertices each vertex of the file became.
"""

from __future__ import annotations

import io
import os
import re
import struct
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.scene.meshes.polydata import read_polydata
from rbfmuscle.scene.meshes.repair import repair
from rbfmuscle.validation import (
    MeshError,
    SceneError,
    check_mesh,
    check_positive,
    is_file,
    shown,
    shown_path,
)

# In any unit: beyond it, squares of squares of lengths leave the range in which volumes are exact.
LARGEST_COORDINATE = 1e12
MESH_SUFFIXES = (".stl", ".obj", ".ply", ".vtk", ".vtp")


@dataclass
class ReadMesh:
    """A mesh as read and mended.

    Attributes
    ----------
    mesh : trimesh.Trimesh
        Faces outward, in scene units.
    vertex_map : (n_file,) ndarray of int
        The vertex that each vertex of the file became, -1 where it was dropped.
    notes : list of str
        What was mended, for the user to read.
    closed : bool
    source : str
        The file.
    """

    mesh: object
    vertex_map: np.ndarray
    notes: list = field(default_factory=list)
    closed: bool = True
    source: str = ""


def read_mesh(
    path: str | Path, *, name: str | None = None, scale: float = 1.0, may_be_open: bool = False
) -> ReadMesh:
    """Read a surface mesh and mend what is safe to mend.

    Parameters
    ----------
    path : path
        ``.stl``, ``.obj``, ``.ply``, ``.vtk`` or ``.vtp``; polygons are split into triangles.
    name : str, optional
        What messages call the mesh, the file's stem by default.
    scale : float
        Factor from the file's unit to the scene's.
    may_be_open : bool
        Accept holes that cannot be closed safely (bones), with a note.

    Returns
    -------
    ReadMesh

    Raises
    ------
    MeshError
        If the file is missing, unreadable or empty, or the surface cannot be made closed and manifold.
    """
    path = Path(path)
    vertices, faces = read_arrays(path)
    with np.errstate(over="ignore", invalid="ignore"):
        vertices = vertices * scale
    read = prepare_mesh(vertices, faces, place=str(path), name=name or path.stem, may_be_open=may_be_open)
    read.source = str(path)
    return read


def prepare_mesh(
    vertices: Floats, faces: Integers, *, place: str, name: str, may_be_open: bool = False
) -> ReadMesh:
    """Return the ReadMesh of given arrays, mended like a file's; ``place`` begins each message."""
    import trimesh

    vertices, faces = np.asarray(vertices), np.asarray(faces)
    if not len(vertices) or not len(faces):
        raise MeshError(
            f"{place}: the mesh is empty ({len(vertices)} vertices, {len(faces)} triangles); "
            "points alone become a mesh by rbfmuscle surface FILE -o mesh.ply"
        )
    bad = np.flatnonzero(~np.isfinite(vertices).all(axis=1))
    used = np.zeros(len(vertices), dtype=bool)
    used[faces[(faces >= 0) & (faces < len(vertices))]] = True
    bad = bad[used[bad]]
    if len(bad):
        raise MeshError(
            f"{place}: {len(bad)} vertices are not finite, "
            f"the first is number {bad[0]} {vertices[bad[0]].tolist()}; export the mesh again"
        )
    far = used & (np.abs(np.where(used[:, None], vertices, 0.0)) > LARGEST_COORDINATE).any(axis=1)
    if far.any():
        first = int(np.flatnonzero(far)[0])
        raise MeshError(
            f"{place}: {int(far.sum())} vertices are further away than {LARGEST_COORDINATE:g}, the first is number "
            f"{first} {vertices[first].tolist()}; the file is damaged or its scale is wrong, export the mesh again"
        )
    vertices = np.where(used[:, None], vertices, 0.0)
    try:
        vertices, faces = check_mesh(vertices, faces, name=name)
    except MeshError as error:
        raise MeshError(f"{place}: {error}") from None
    result = repair(vertices, faces, place=place, may_be_open=may_be_open)
    mesh = trimesh.Trimesh(result.vertices, result.faces, process=False)
    return ReadMesh(mesh, result.vertex_map, result.notes, result.closed)


def as_mesh(mesh: Any, name: str, scale: float, *, may_be_open: bool) -> ReadMesh:
    """Return the ReadMesh of a path, a trimesh.Trimesh, (vertices, faces) or of what is read already."""
    if isinstance(mesh, ReadMesh):
        return mesh
    try:
        scale = check_positive(scale, name="scale")
    except (ValueError, TypeError) as error:
        raise SceneError(f"{name!r}: {error}") from None
    if isinstance(mesh, (str, Path)):
        return read_mesh(mesh, name=name, scale=scale, may_be_open=may_be_open)
    vertices, faces = mesh if isinstance(mesh, tuple) else (mesh.vertices, mesh.faces)
    vertices = np.asarray(vertices, dtype=np.float64) * scale
    place = f"mesh {name!r}"
    return prepare_mesh(vertices, np.asarray(faces), place=place, name=name, may_be_open=may_be_open)


def read_arrays(path: Path) -> Any:
    """Return vertices (n, 3) and triangles (m, 3) of a mesh file as they stand, or raise MeshError."""
    suffix = path.suffix.lower()
    if suffix not in MESH_SUFFIXES:
        raise MeshError(
            f"{shown_path(path)}: {shown(suffix) or 'no suffix'} is not a mesh format, use {', '.join(MESH_SUFFIXES)}"
            f"{'; rbfmuscle surface makes a mesh of points' if suffix in ('.xyz', '.npy') else ''}"
        )
    if not is_file(path):
        raise MeshError(f"{shown_path(path)}: no such mesh file{_neighbours(path)}")
    try:
        if path.stat().st_size == 0:
            raise MeshError(f"{path}: the file is empty")
        with path.open("rb"):
            pass
    except OSError as error:
        raise MeshError(f"{path}: cannot read the mesh: {error.strerror}") from None
    if suffix in (".vtk", ".vtp"):
        data = read_polydata(path)
        return data.points, data.triangles
    try:
        if suffix == ".stl":
            # It repeats each vertex for every triangle.
            vertices, corners = _unique_rows(_read_stl(path.read_bytes()))
            return vertices, corners.reshape(-1, 3)
        return _read_trimesh(path.read_bytes(), suffix[1:])
    except (ValueError, KeyError, IndexError, TypeError, AttributeError, EOFError, struct.error) as error:
        raise MeshError(f"{path}: not a readable {suffix[1:].upper()} file ({_short(error)})") from None


def _neighbours(path):
    from rbfmuscle.validation import did_you_mean

    if not os.path.isdir(path.parent):
        return f" (no folder {shown_path(path.parent)})"
    try:
        names = sorted(p.name for p in path.parent.iterdir() if p.suffix.lower() in MESH_SUFFIXES)
    except OSError:
        return ""
    return ", " + did_you_mean(path.name, names[:50]) if names else " (no meshes in that folder)"


def _read_stl(content):
    """Corners (3 m, 3). Trimesh logs tracebacks of damaged files, and leaves bytes out that are no text."""
    count = int.from_bytes(content[80:84], "little")
    if content.lstrip()[:5].lower() == b"solid" and b"facet" in content.lower()[:5000]:
        rows = [line.split() for line in content.lower().splitlines()]
        corners = np.array([row[1:] for row in rows if row[:1] == [b"vertex"]], dtype=np.float64).reshape(
            -1, 3
        )
        if len(corners) % 3 or not any(row[:1] == [b"endsolid"] for row in rows[-5:]):
            raise ValueError("it ends before 'endsolid', or has not three vertices for each triangle")
        return corners
    if len(content) < 84 + 50 * count or len(content) < 84:
        raise ValueError(f"neither text nor the {count} triangles that it promises")
    triangles = np.frombuffer(content, "(3,)<f4, (3,3)<f4, <u2", count, 84)
    return triangles["f1"].astype(np.float64).reshape(-1, 3)


def _read_trimesh(content, kind):
    """Vertices and triangles of an OBJ or PLY file, with the vertex numbers of the file."""
    import trimesh

    if kind == "obj":
        # Positions and corners alone: numbers of textures and normals would split vertices.
        lines = [line for line in content.splitlines() if line.split(None, 1)[:1] in ([b"v"], [b"f"])]
        content = b"\n".join(
            _counted_from_first(re.sub(rb"#[^\n]*|/\S*", b"", b"\n".join(lines)).splitlines())
        )
        content.decode("ascii")  # else trimesh leaves out what is not
    options = {"process": False, "force": "mesh", "skip_materials": True, "maintain_order": True}
    mesh = trimesh.load(io.BytesIO(content), file_type=kind, **options)
    vertices, faces = np.asarray(mesh.vertices, np.float64), np.asarray(getattr(mesh, "faces", ()), np.int64)
    if len(vertices) and vertices.shape[1] != 3:
        raise ValueError("a vertex has fewer than three coordinates")
    return vertices.reshape(-1, 3), faces.reshape(-1, 3)


def _counted_from_first(lines):
    """Lines of an OBJ file whose faces count vertices from the first, where some count back from the last so far."""
    count = 0
    for line in lines:
        words = line.split()
        count += words[:1] == [b"v"]
        if words[:1] == [b"f"] and b"-" in line:
            back = [int(word) for word in words if word.startswith(b"-")]
            if min(back, default=0) < -count:
                raise ValueError(f"a face counts back by {-min(back)}, {count} vertices stand before it")
            words = [b"%d" % (int(word) + count + 1) if word.startswith(b"-") else word for word in words]
        yield b" ".join(words)


def _unique_rows(vertices):
    """Vertices without repeats in order of first use, and the new number of each old one."""
    _, first, inverse = np.unique(vertices, axis=0, return_index=True, return_inverse=True)
    order = np.argsort(first, kind="stable")
    rank = np.empty(len(order), dtype=np.int64)
    rank[order] = np.arange(len(order))
    return vertices[first[order]], rank[inverse.ravel()]


def _short(error):
    return shown(" ".join(str(error).split())) or type(error).__name__
