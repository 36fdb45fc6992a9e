"""Reading surface meshes: STL, OBJ, PLY, VTK and VTP PolyData, mended where that is safe; fibres
from JSON.

Vertex numbers in files stay usable: a read mesh knows which of its vertices each vertex of the file
became.
"""

import io
import itertools
import json
import os
import warnings
from pathlib import Path
from typing import Any

import numpy as np

from rbfmuscle.geometry.arrays import Floats, Integers, MeshLike
from rbfmuscle.scene.meshes.polydata import read_polydata
from rbfmuscle.scene.meshes.repair import ReadMesh, repair
from rbfmuscle.validation import (
    MeshError,
    SceneError,
    check_mesh,
    check_points,
    check_positive,
    did_you_mean,
    read_text,
    shown,
    shown_path,
)

# In any unit: beyond it, squares of squares of lengths leave the range in which volumes are exact.
LARGEST_COORDINATE = 1e12
MESH_SUFFIXES = (".stl", ".obj", ".ply", ".vtk", ".vtp")


def read_mesh(
    path: str | Path, *, name: str | None = None, scale: float = 1.0, may_be_open: bool = False
) -> ReadMesh:
    """Read a surface mesh (``.stl``, ``.obj``, ``.ply``, ``.vtk``, ``.vtp``) and mend what is safe
    to mend.

    ``name`` is what messages call it, the file's stem by default; ``scale`` takes the file's unit
    to the scene's. Holes that cannot be closed safely are kept, with a note, where it
    ``may_be_open`` (bones). MeshError if the file is missing, unreadable or empty, or the surface
    cannot be made closed and manifold.
    """
    path = Path(path)
    vertices, faces = read_arrays(path)
    with np.errstate(over="ignore", invalid="ignore"):
        vertices = vertices * scale
    read = prepare_mesh(
        vertices, faces, place=str(path), name=name or path.stem, may_be_open=may_be_open
    )
    read.source = str(path)
    return read


def as_mesh(
    mesh: str | Path | ReadMesh | MeshLike, name: str, scale: float, *, may_be_open: bool
) -> ReadMesh:
    """Return the ReadMesh of a path, a trimesh.Trimesh, (vertices, faces) or of what is read
    already.
    """
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
    return prepare_mesh(
        vertices, np.asarray(faces), place=place, name=name, may_be_open=may_be_open
    )


def prepare_mesh(
    vertices: Floats, faces: Integers, *, place: str, name: str, may_be_open: bool = False
) -> ReadMesh:
    """Return the ReadMesh of given arrays, mended like a file's; ``place`` begins each message."""
    vertices, faces = np.asarray(vertices), np.asarray(faces)
    if not len(vertices) or not len(faces):
        raise MeshError(
            f"{place}: the mesh is empty ({len(vertices)} vertices, {len(faces)} triangles)"
        )
    used = np.zeros(len(vertices), dtype=bool)
    used[faces[(faces >= 0) & (faces < len(vertices))]] = True
    vertices = np.where(used[:, None], vertices, 0.0)
    for wrong, words in (
        (~np.isfinite(vertices), "not finite"),
        (np.abs(vertices) > LARGEST_COORDINATE, f"further away than {LARGEST_COORDINATE:g}"),
    ):
        bad = np.flatnonzero(wrong.any(axis=1))
        if len(bad):
            raise MeshError(
                f"{place}: {len(bad)} vertices are {words}, the first is number {bad[0]} "
                f"{vertices[bad[0]].tolist()}; correct the scale, or export the mesh again"
            )
    try:
        vertices, faces = check_mesh(vertices, faces, name=name)
    except MeshError as error:
        raise MeshError(f"{place}: {error}") from None
    return repair(vertices, faces, place=place, may_be_open=may_be_open)


def read_arrays(path: Path) -> tuple[Floats, Integers]:
    """Return vertices (n, 3) and triangles (m, 3) of a mesh file as they stand, or raise
    MeshError.
    """
    suffix = path.suffix.lower()
    if suffix not in MESH_SUFFIXES:
        words = (
            f"{shown(suffix) or 'no suffix'} is not a mesh format, use {', '.join(MESH_SUFFIXES)}"
        )
        raise MeshError(f"{shown_path(path)}: {words}")
    if not os.path.isfile(path):
        raise MeshError(f"{shown_path(path)}: no such mesh file{_neighbours(path)}")
    try:
        content = path.read_bytes()
    except OSError as error:
        raise MeshError(f"{path}: cannot read the mesh: {error.strerror}") from None
    if not content:
        raise MeshError(f"{path}: the file is empty")
    if suffix in (".vtk", ".vtp"):
        return read_polydata(path)
    try:
        return _read_obj(content) if suffix == ".obj" else _read_trimesh(content, suffix[1:])
    except Exception as error:  # noqa: BLE001 - any error of a library becomes one line
        why = shown(" ".join(str(error).split())) or type(error).__name__
        raise MeshError(f"{path}: not a readable {suffix[1:].upper()} file ({why})") from None


def _neighbours(path):
    """Words for the nearest mesh file in the folder of a missing one."""
    if not os.path.isdir(path.parent):
        return f" (no folder {shown_path(path.parent)})"
    try:
        names = sorted(p.name for p in path.parent.iterdir() if p.suffix.lower() in MESH_SUFFIXES)
    except OSError:
        return ""
    return ", " + did_you_mean(path.name, names[:50]) if names else " (no meshes in that folder)"


def _read_trimesh(content, kind):
    """Vertices and triangles of an STL or PLY file, with the vertex numbers of the file."""
    import trimesh

    with warnings.catch_warnings():
        # Older NumPy warns of text that is no number and goes on.
        warnings.filterwarnings("error", "string or file could not be read", DeprecationWarning)
        # Vertices are not split where textures meet.
        options = {"fix_texture": False, "skip_materials": True} if kind == "ply" else {}
        mesh = trimesh.load(
            io.BytesIO(content), file_type=kind, process=False, force="mesh", **options
        )
    vertices, faces = (
        np.asarray(mesh.vertices, np.float64),
        np.asarray(getattr(mesh, "faces", ()), np.int64),
    )
    if kind == "stl":  # each triangle has its own vertices: merged in order of first use
        # Bytes sort faster than rows; 0.0 is -0.0.
        rows = np.ascontiguousarray(vertices + 0.0).view("V24").ravel()
        _, first, inverse = np.unique(rows, return_index=True, return_inverse=True)
        order = np.argsort(first)
        vertices, faces = vertices[first[order]], np.argsort(order)[inverse][faces]
    return vertices, faces.reshape(-1, 3)


def _read_obj(content):
    """Vertices and triangles of an OBJ file; numbers of textures and normals do not split
    vertices.
    """
    vertices, faces = [], []
    for line in content.replace(b"\\\r\n", b" ").replace(b"\\\n", b" ").splitlines():
        key, *words = line.partition(b"#")[0].split() or [b""]
        if key == b"v":
            x, y, z = map(float, words[:3])
            vertices.append((x, y, z))
        elif key == b"f":
            numbers = [int(word.partition(b"/")[0]) for word in words]
            corners = [number - 1 if number > 0 else len(vertices) + number for number in numbers]
            faces += [(corners[0], *side) for side in itertools.pairwise(corners[1:])]
    return np.array(vertices).reshape(-1, 3), np.array(faces, dtype=np.int64).reshape(-1, 3)


def read_fibres(fibres: Any, *, scale: float = 1.0, muscle: str = "") -> list[Floats]:
    """Return fibres as a list of (k, 3) arrays in scene units, ``scale`` from the unit of a file or
    of given arrays.

    A JSON file holds ``{"polylines": [[[x, y, z], ...], ...]}`` or that list alone.
    """
    place = f"muscle {muscle!r} fibres"
    if isinstance(fibres, (str, Path)):
        place, fibres = f"{place}: {fibres}", _read_lines(Path(fibres), f"{place}: ")
    lines = []
    for number, line in enumerate(fibres):
        try:
            points = check_points(line, name=f"polyline {number}")
        except (ValueError, TypeError) as error:
            raise SceneError(f"{place}: {error}") from None
        kept = np.append(True, np.diff(points, axis=0).any(axis=1))[: len(points)]
        points = points[kept]  # none twice in a row
        if len(points) < 2:
            words = f"polyline {number} has {len(points)} points, a fibre needs two or more"
            raise SceneError(f"{place}: {words}")
        lines.append(points * scale)
    if not lines:
        raise SceneError(f"{place}: no polylines")
    return lines


def _read_lines(path, place):
    text = read_text(path, place=place)
    try:
        found = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise SceneError(f"{place}{path}: not JSON ({shown(str(error))})") from None
    lines = found.get("polylines") if isinstance(found, dict) else found
    if not isinstance(lines, list):
        raise SceneError(f"{place}{path}: needs a list 'polylines'")
    return lines
