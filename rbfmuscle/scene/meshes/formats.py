"""Mesh files as they stand: the parts of an STL, OBJ, PLY, VTK or VTP file, by their names."""

import io
import os
import re
import warnings
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.geometry.surfaces import joined_meshes
from rbfmuscle.scene.meshes.input_mesh import NO_CORNERS, Corners, vertex_corners
from rbfmuscle.scene.meshes.obj import read_obj
from rbfmuscle.scene.meshes.polydata import read_polydata
from rbfmuscle.scene.meshes.polygons import cut_polygons
from rbfmuscle.validation import BROKEN_FILE, MeshError, did_you_mean, shown, shown_path

MESH_SUFFIXES = (".stl", ".obj", ".ply", ".vtk", ".vtp")
# Part of a file's path that names one of its meshes, and what names all of them.
_PART = re.compile(r"(.+\.(?:stl|obj|ply|vtk|vtp))#(.+)", re.IGNORECASE)
ALL = "*"
# A binary STL file: header, number of triangles, and normal, corners and two bytes of each.
_HEAD = 84
_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("more", "<u2")])
_VERTEX = re.compile(rb"vertex\s+(\S+)\s+(\S+)\s+(\S+)", re.IGNORECASE)
_SOLID = re.compile(rb"^[ \t]*(end)?solid\b([^\r\n]*)", re.IGNORECASE | re.MULTILINE)
# First bytes of what is saved under a wrong name, and what to do about it.
_NO_MESH = (
    (rb"version https://git-lfs", "a pointer of Git LFS: fetch the file itself (git lfs pull)"),
    (rb"\s*<(!doctype\s+html|html)", "a web page: download the file itself"),
    (rb"\x1f\x8b", "compressed: unpack it (gzip -d)"),
    (rb"PK\x03\x04", "a zip archive: unpack it"),
    (rb"\xff\xfe|\xfe\xff", "text in UTF-16: save it as UTF-8"),
)
# Mesh formats by their first bytes. A binary STL may begin with any of these, but not be so long.
_MESHES = (
    (rb"ply\s", ".ply"),
    (rb"# vtk DataFile", ".vtk"),
    (rb"(<\?xml[^>]*>\s*)?<VTKFile", ".vtp"),
    (rb"solid\b[^\r\n]*\s+facet\s", ".stl"),
    (rb"(#[^\n]*\n|\s)*(mtllib|o|g|v|vn|vt)[ \t]+\S", ".obj"),
)


class FilePart(NamedTuple):
    """One mesh of a file: vertices (n, 3), triangles (m, 3), what was left out or assumed, and
    texture coordinates and normals.
    """

    name: str  # empty where the file gives none
    vertices: Floats
    faces: Integers
    notes: list[str]
    corners: Corners = NO_CORNERS


def split_path(path: Path) -> tuple[Path, str]:
    """The file and the name of one of its meshes, of ``FILE#NAME``; no name where none is given."""
    match = _PART.fullmatch(path.name)
    return (path.with_name(match[1]), match[2]) if match else (path, "")


def read_part(path: Path) -> FilePart:
    """Return the mesh of a file, or of ``FILE#NAME``, or all of ``FILE#*`` as one; or raise
    MeshError.

    A file of several meshes is refused where none is named.
    """
    file, name = split_path(path)
    parts = read_file(file)
    if name == ALL:
        return _together(parts)
    if not name and len(parts) == 1:
        return parts[0]
    names = [part.name for part in parts]
    if name in names:
        return parts[names.index(name)]
    if name:
        raise MeshError(f"{path}: no mesh of this name in the file, {did_you_mean(name, names)}")
    example = f"{file.name}#{names[0]}"
    raise MeshError(
        f"{path}: {len(parts)} meshes in one file ({', '.join(names[:8])}); name one of them, as "
        f"{example}, or take all as one rigid mesh by {file.name}#{ALL}"
    )


def _together(parts):
    """All meshes of a file as one."""
    notes = [note for part in parts for note in part.notes]
    if len(parts) > 1:
        notes.append(f"{len(parts)} meshes of the file taken as one")
    whole = joined_meshes([part.vertices for part in parts], [part.faces for part in parts])
    return FilePart("", *whole, notes)


def read_file(path: Path) -> list[FilePart]:
    """Return the meshes of a file as they stand, at least one; several have names, each another."""
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
    if foreign := _foreign_content(content, suffix):
        raise MeshError(f"{path}: not a {suffix[1:].upper()} file but {foreign}")
    try:
        if suffix == ".stl":
            return _named(_read_stl(content))
        if suffix == ".obj":
            return _named([FilePart(*part) for part in read_obj(content)])
        return [_read_ply(path, content) if suffix == ".ply" else _read_polydata(path)]
    except MeshError:
        raise
    except BROKEN_FILE as error:
        why = shown(" ".join(str(error).split())) or type(error).__name__
        raise MeshError(f"{path}: not a readable {suffix[1:].upper()} file ({why})") from None


def _foreign_content(content: bytes, suffix: str) -> str:
    """What content is and what to do, where it is not of its file's ``suffix``; empty where it may
    be.
    """
    if _has_stl_length(content):
        return "" if suffix == ".stl" else "a .stl file: rename it"
    start = content[:1000].removeprefix(b"\xef\xbb\xbf")
    for pattern, said in _NO_MESH:
        if re.match(pattern, start, re.IGNORECASE):
            return said
    for pattern, kind in _MESHES:
        if re.match(pattern, start) and (kind != ".obj" or b"\0" not in start):
            return "" if kind == suffix else f"a {kind} file: rename it"
    return ""


def _neighbours(path):
    """Words for the nearest mesh file in the folder of a missing one."""
    if not os.path.isdir(path.parent):
        return f" (no folder {shown_path(path.parent)})"
    try:
        names = sorted(p.name for p in path.parent.iterdir() if p.suffix.lower() in MESH_SUFFIXES)
    except OSError:
        return ""
    return ", " + did_you_mean(path.name, names[:50]) if names else " (no meshes in that folder)"


def _named(parts):
    """The parts that have triangles, with names that differ; those without are noted."""
    full = [part for part in parts if len(part.faces)]
    empty = [part.name or "without a name" for part in parts if not len(part.faces)]
    full = full or parts[:1]
    if empty and len(parts) > len(full):
        full[0].notes.append(f"{len(empty)} empty meshes in the file ({', '.join(empty[:8])})")
    if len(full) == 1:
        return full
    names: list[str] = []
    for number, part in enumerate(full, start=1):
        # A name may become that of a file, and begins no folder.
        name = stem = re.sub(r"[^\w.+-]+", "_", part.name).strip("_.") or f"part_{number}"
        count = 1
        while name in names:
            count += 1
            name = f"{stem}_{count}"
        names.append(name)
    return [part._replace(name=name) for part, name in zip(full, names)]


def _read_stl(content):
    """The solids of an STL file; triangles have their own vertices there, equal ones are merged."""
    if not _is_binary(content):
        return _read_stl_text(content)
    parts, start = [], 0
    while len(content) - start >= _HEAD:
        count = int.from_bytes(content[start + 80 : start + _HEAD], "little")
        whole = start + _HEAD + 50 * count
        if whole > len(content):
            if parts:  # not another solid, but other bytes
                break
            raise ValueError(
                f"it is cut off: {len(content):,} bytes, {count:,} triangles need {whole:,}"
            )
        rows = np.frombuffer(content, _TRIANGLE, count, start + _HEAD)
        parts.append(_soup("", rows["corners"].astype(np.float64)))
        start = whole
        if count == 0:
            if len(parts) == 1 and len(content) > start:
                raise ValueError(f"it declares 0 triangles, and has {len(content):,} bytes")
            break
    if start < len(content):
        more = len(content) - start
        parts[0].notes.append(f"{more} bytes behind the last triangle left out")
    return parts


def _has_stl_length(content):
    """Whether content is as long as a binary STL file of its triangles, of which it has some."""
    count = int.from_bytes(content[80:_HEAD], "little")
    return count > 0 and len(content) == _HEAD + 50 * count


def _is_binary(content):
    """Whether an STL file is binary: by its length, or by bytes that no text has."""
    if _has_stl_length(content):
        return True
    text = content.lstrip(b"\xef\xbb\xbf \t\r\n")[:5].lower() == b"solid"
    return len(content) >= _HEAD and (not text or b"\0" in content)


def _read_stl_text(content):
    parts = []
    name = b""
    start = None
    content = content.removeprefix(b"\xef\xbb\xbf").replace(b"\r", b"\n")
    if re.search(rb"vertex\s+\S*\d,\d", content, re.IGNORECASE):
        raise ValueError("its numbers have a decimal comma; write them with a point")
    for match in [*_SOLID.finditer(content), None]:
        if start is not None and (match is None or match[1] is None):
            raise ValueError(f"it is cut off: solid {name.decode('utf-8', 'replace')!r} has no end")
        if match is None:
            break
        if match[1] is None:
            name, start = match[2].strip(), match.end()
            continue
        if start is None:
            raise ValueError("a solid ends that has not begun")
        inside = content[start : match.start()]
        corners = np.array(_VERTEX.findall(inside)).astype(np.float64)
        facets = len(re.findall(rb"\bendfacet\b", inside, re.IGNORECASE))
        if len(corners) != 3 * facets:
            raise ValueError(f"{len(corners)} corners of {facets} triangles")
        parts.append(_soup(name.decode("utf-8", "replace"), corners.reshape(-1, 3, 3)))
        start = None
    if not parts:
        raise ValueError("neither text from 'solid' to 'endsolid' nor binary")
    return parts


def _soup(name, corners):
    """Triangles (m, 3, 3) as a mesh whose equal corners are one vertex, in order of first use."""
    # Bytes sort faster than rows; 0.0 is -0.0.
    rows = np.ascontiguousarray(corners.reshape(-1, 3) + 0.0)
    _, first, inverse = np.unique(rows.view("V24").ravel(), return_index=True, return_inverse=True)
    order = np.argsort(first)
    return FilePart(name, rows[first[order]], np.argsort(order)[inverse].reshape(-1, 3), [])


def _read_ply(path, content):
    """The mesh of a PLY file: triangles by trimesh; polygons, which it cuts into fans, by VTK."""
    import trimesh

    try:
        with warnings.catch_warnings():
            # Older NumPy warns of text that is no number and goes on.
            warnings.filterwarnings("error", "string or file could not be read", DeprecationWarning)
            # Vertices are not split where textures meet.
            mesh = trimesh.load(
                io.BytesIO(content),
                file_type="ply",
                process=False,
                force="mesh",
                fix_texture=False,
                skip_materials=True,
            )
    except (*BROKEN_FILE, DeprecationWarning) as error:  # VTK may read it
        try:
            return _read_polydata(path)
        except MeshError:
            if isinstance(error, UnboundLocalError):  # trimesh finds none
                error = ValueError("its header declares no list of the faces' vertex numbers")
            raise error from None
    faces = np.asarray(getattr(mesh, "faces", ()), np.int64).reshape(-1, 3)
    declared = re.search(rb"element\s+face\s+(\d+)", content[:10000])
    if not len(faces) and not (declared and int(declared[1])):
        points = re.search(rb"element\s+vertex\s+(\d+)", content[:10000])
        strips = " but strips" if b"element tristrips" in content[:10000] else ""
        count = int(points[1]) if points else 0
        raise ValueError(f"it has {count} points and no faces{strips}; export its triangles")
    if declared and int(declared[1]) != len(faces):
        return _read_polydata(path, declared=int(declared[1]))
    vertices = np.asarray(mesh.vertices, np.float64)
    return FilePart("", vertices, faces, [], _ply_corners(mesh, faces))


def _ply_corners(mesh, faces):
    """Texture coordinates, by vertex or by corner, and normals of a PLY file."""
    raw = mesh.metadata.get("_ply_raw", {})
    vertex, face = (raw.get(name, {}).get("data") for name in ("vertex", "face"))
    columns = vertex.dtype.names if isinstance(vertex, np.ndarray) else (vertex or ())
    normals = None
    if {"nx", "ny", "nz"} <= set(columns):
        normals = np.stack([vertex[name] for name in ("nx", "ny", "nz")], axis=1)
    found = vertex_corners(faces, getattr(mesh.visual, "uv", None), normals)
    fields = face.dtype.names if isinstance(face, np.ndarray) else (face or ())
    if "texcoord" in fields:
        pairs = face["texcoord"]
        pairs = np.asarray(pairs["f1"] if isinstance(face, np.ndarray) else pairs)
        found = found._replace(texture=NO_CORNERS.texture, texture_faces=NO_CORNERS.texture_faces)
        if pairs.shape == (len(faces), 6) and np.isfinite(pairs).all():
            pairs, own = np.unique(pairs.reshape(-1, 2), axis=0, return_inverse=True)
            found = found._replace(texture=pairs.astype(float), texture_faces=own.reshape(-1, 3))
    return found


def _read_polydata(path, declared=0):
    found = read_polydata(path)
    whole = int((np.diff(found.ends) > 0).sum())
    if whole < declared:
        raise ValueError(f"it is cut off: it declares {declared} faces and holds {whole}")
    places, notes = cut_polygons(found.points, found.ends, found.numbers)
    faces = found.numbers[places]
    other = max(len(found.line_ends) - 1, 0) + found.single
    if other:
        notes.append(f"{other} lines and points left out")
    return FilePart(
        "", found.points, faces, notes, vertex_corners(faces, found.texture, found.normals)
    )


def read_vertex_array(path: Path, name: str) -> Floats:
    """The array (n,) of that name at the vertices of a PLY, VTK or VTP file, or MeshError."""
    suffix = path.suffix.lower()
    if suffix in (".vtk", ".vtp"):
        return read_polydata(path, array=name).values
    if suffix != ".ply":
        raise MeshError(f"{path}: has no vertex arrays; save the mesh as PLY or VTP with them")
    import trimesh

    raw = trimesh.load(path, process=False, force="mesh").metadata.get("_ply_raw", {})
    data = raw.get("vertex", {}).get("data")
    names = list(data.dtype.names if isinstance(data, np.ndarray) else data or ())
    if name not in names:
        raise MeshError(f"{path}: no vertex array {name!r}, {did_you_mean(name, names)}")
    return np.asarray(data[name], dtype=np.float64).ravel()
