"""Reading surface meshes: the parts of an STL, OBJ, PLY, VTK or VTP file by their names, polygons
cut into triangles, mended where that is safe; fibres from JSON.

Vertex numbers in files stay usable: a read mesh knows which of its vertices each vertex of the file
became.
"""

import io
import json
import os
import re
import warnings
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Literal, NamedTuple, TypeAlias

import numpy as np
import trimesh
from numpy.typing import ArrayLike
from pydantic import BeforeValidator, Field
from scipy.spatial.transform import Rotation

from rbfmuscle.geometry.arrays import Booleans, Floats, Integers, MeshLike, to_world, unit
from rbfmuscle.geometry.surfaces import joined_meshes
from rbfmuscle.scene.meshes.polydata import read_polydata
from rbfmuscle.scene.meshes.repair import ReadMesh, input_order, repair
from rbfmuscle.scene.options import Finite, Positive, Table, Vector
from rbfmuscle.validation import (
    BROKEN_FILE,
    MeshError,
    SceneError,
    check_mesh,
    check_points,
    did_you_mean,
    read_text,
    shown,
    shown_path,
)

# Sine of a corner's turn below which the corner counts as straight.
STRAIGHT = 1e-9


def cut_polygons(vertices: Floats, ends: Integers, numbers: Integers) -> tuple[Integers, list[str]]:
    """Return the triangles of polygons in their order, by the places (m, 3) of their corners in
    ``numbers``, and notes of what was left out.

    ``numbers`` are the vertices of all polygons, one after the other; those of polygon k are
    ``numbers[ends[k] : ends[k + 1]]``. Every corner is kept, on straight sides too, so that
    neighbours still fit.
    """
    ends, kept = _without_repeats(ends, numbers)
    sizes = np.diff(ends)
    notes = []
    if (sizes < 3).any():
        few = int((sizes < 3).sum())
        notes.append(f"{few} polygons of fewer than three corners left out")
    triangles = np.empty((int(np.maximum(sizes - 2, 0).sum()), 3), dtype=np.int64)
    place = np.concatenate([[0], np.cumsum(np.maximum(sizes - 2, 0))])
    crossed = 0
    for size in np.unique(sizes[sizes >= 3]):
        chosen = np.flatnonzero(sizes == size)
        corners = kept[ends[chosen][:, None] + np.arange(size)]
        first = np.repeat(corners[:, :1], size - 2, axis=1)
        fan = np.stack([first, corners[:, 1:-1], corners[:, 2:]], axis=2)
        if size > 3:
            points = vertices[numbers[corners]]
            for k in np.flatnonzero(~_convex(points)):
                ears = _ears(points[k])
                crossed += ears is None
                fan[k] = fan[k] if ears is None else corners[k][ears]
        triangles[place[chosen][:, None] + np.arange(size - 2)] = fan
    if crossed:
        notes.append(f"{crossed} polygons cross themselves: their triangles are a guess")
    return triangles, notes


def _without_repeats(ends: Integers, numbers: Integers) -> tuple[Integers, Integers]:
    """Ends and places in ``numbers`` of the corners, of polygons of more than three without those
    that repeat the one before.
    """
    sizes = np.diff(ends)
    before = np.arange(len(numbers)) - 1
    full = sizes > 0
    before[ends[:-1][full]] = ends[1:][full] - 1
    again = (numbers == numbers[before]) & np.repeat(sizes > 3, sizes)
    if not again.any():
        return ends, np.arange(len(numbers))
    dropped = np.concatenate([[0], np.cumsum(again)])
    return ends - dropped[ends], np.flatnonzero(~again)


def _convex(points: Floats) -> Booleans:
    """Which polygons (k, n, 3) turn the same way at every corner, and once around."""
    offset = points - points[:, :1]
    # Area vectors by Newell's sum.
    normal = unit(np.cross(offset[:, 1:-1], offset[:, 2:]).sum(axis=1))
    before = points - np.roll(points, 1, axis=1)
    after = np.roll(before, -1, axis=1)
    sine = np.einsum("knj,kj->kn", np.cross(before, after), normal)
    cosine = np.einsum("knj,knj->kn", before, after)
    once = np.arctan2(sine, cosine).sum(axis=1) < 3 * np.pi  # a star turns twice around
    scale = np.linalg.norm(before, axis=2) * np.linalg.norm(after, axis=2)
    return (sine > STRAIGHT * scale).all(axis=1) & once


def _ears(points: Floats) -> Integers | None:
    """Triangles (n - 2, 3) of one polygon (n, 3) as numbers of its corners, those of the best shape
    first; None where it crosses itself or has no area.
    """
    from vtkmodules.vtkCommonCore import vtkIdList
    from vtkmodules.vtkCommonDataModel import vtkPolygon

    if not np.isfinite(points).all():
        return None
    polygon, ears = vtkPolygon(), vtkIdList()
    polygon.GetPointIds().SetNumberOfIds(len(points))
    polygon.GetPoints().SetNumberOfPoints(len(points))
    for k, point in enumerate(points - points.mean(axis=0)):
        polygon.GetPointIds().SetId(k, k)
        polygon.GetPoints().SetPoint(k, *point)
    done = polygon.TriangulateLocalIds(0, ears)
    found = np.array([ears.GetId(k) for k in range(ears.GetNumberOfIds())], dtype=np.int64)
    return found.reshape(-1, 3) if done and len(found) == 3 * (len(points) - 2) else None


MESH_SUFFIXES = (".stl", ".obj", ".ply", ".vtk", ".vtp")
# Part of a file's path that names one of its meshes, and what names all of them.
_PART = re.compile(r"(.+\.(?:stl|obj|ply|vtk|vtp))#(.+)", re.IGNORECASE)
ALL = "*"
# A binary STL file: bytes of its header with the number of triangles, and of each triangle.
_HEAD, _TRIANGLE = 84, 50
_SOLID = re.compile(rb"^[ \t]*(end)?solid\b([^\r\n]*)", re.IGNORECASE | re.MULTILINE)
# Elements of an OBJ file that are no faces.
_NO_FACES = (b"l", b"p", b"curv", b"curv2", b"surf")
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
    """One mesh of a file: vertices (n, 3), triangles (m, 3), and what was left out or assumed."""

    name: str  # empty where the file gives none
    vertices: Floats
    faces: Integers
    notes: list[str]


def read_part(path: Path) -> FilePart:
    """Return the mesh of a file, or of ``FILE#NAME``, or all of ``FILE#*`` as one; or raise
    MeshError.

    A file of several meshes is refused where none is named.
    """
    match = _PART.fullmatch(path.name)
    file, name = (path.with_name(match[1]), match[2]) if match else (path, "")
    parts = read_file(file)
    if name == ALL:
        notes = [note for part in parts for note in part.notes]
        if len(parts) > 1:
            notes.append(f"{len(parts)} meshes of the file taken as one")
        whole = joined_meshes([part.vertices for part in parts], [part.faces for part in parts])
        return FilePart("", *whole, notes)
    if not name and len(parts) == 1:
        return parts[0]
    names = [part.name for part in parts]
    if name in names:
        return parts[names.index(name)]
    if name:
        raise MeshError(f"{path}: no mesh of this name in the file, {did_you_mean(name, names)}")
    raise MeshError(
        f"{path}: {len(parts)} meshes in one file ({', '.join(names[:8])}); name one of them, as "
        f"{file.name}#{names[0]}, or take all as one rigid mesh by {file.name}#{ALL}"
    )


def read_file(path: Path) -> list[FilePart]:
    """Return the meshes of a file as they stand, at least one; several have names, each another."""
    suffix = path.suffix.lower()
    if suffix not in MESH_SUFFIXES:
        raise MeshError(
            f"{shown_path(path)}: "
            f"{shown(suffix) or 'no suffix'} is not a mesh format, use {', '.join(MESH_SUFFIXES)}"
        )
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
            return _named(_read_obj(content))
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
    """The solids of an STL file, each read by trimesh after a check of what it passes over: bytes
    that are missing or left over, corners that make no triangle, solids without any.
    """
    # Binary by its length, or by bytes that no text has.
    text = content.lstrip(b"\xef\xbb\xbf \t\r\n")[:5].lower() == b"solid"
    no_text = len(content) >= _HEAD and (not text or b"\0" in content)
    if not (_has_stl_length(content) or no_text):
        return _read_stl_text(content)
    parts, start = [], 0
    while len(content) - start >= _HEAD:
        count = int.from_bytes(content[start + 80 : start + _HEAD], "little")
        whole = start + _HEAD + _TRIANGLE * count
        if whole > len(content):
            if parts:  # not another solid, but other bytes
                break
            raise ValueError(
                f"it is cut off: {len(content):,} bytes, {count:,} triangles need {whole:,}"
            )
        parts.append(_read_solid("", content[start:whole]))
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
    return count > 0 and len(content) == _HEAD + _TRIANGLE * count


def _read_stl_text(content):
    parts = []
    name, begun = "", None
    content = content.removeprefix(b"\xef\xbb\xbf").replace(b"\r", b"\n")
    if re.search(rb"vertex\s+\S*\d,\d", content, re.IGNORECASE):
        raise ValueError("its numbers have a decimal comma; write them with a point")
    for match in [*_SOLID.finditer(content), None]:
        if match is None or match[1] is None:
            if begun is not None:
                raise ValueError(f"it is cut off: solid {name!r} has no end")
            begun = match
            name = "" if match is None else match[2].strip().decode("utf-8", "replace")
            continue
        if begun is None:
            raise ValueError("a solid ends that has not begun")
        # A name may hold the words by which trimesh finds numbers.
        inside = b"solid\n" + content[begun.end() : match.start()] + b"\nendsolid\n"
        part = _read_solid(name, inside)
        facets = len(re.findall(rb"\bendfacet\b", inside, re.IGNORECASE))
        corners = len(re.findall(rb"\bvertex\b", inside, re.IGNORECASE))
        if not corners == 3 * facets == 3 * len(part.faces):
            raise ValueError(f"{corners} corners of {facets} triangles")
        parts.append(part)
        begun = None
    if not parts:
        raise ValueError("neither text from 'solid' to 'endsolid' nor binary")
    return parts


def _read_solid(name, content):
    """One solid of an STL file; its triangles have their own corners there, equal ones become one
    vertex, in order of first use.
    """
    mesh = _load("stl", content)
    # Bytes sort faster than rows; 0.0 is -0.0.
    corners = np.asarray(mesh.triangles, np.float64).reshape(-1, 3) + 0.0
    rows = np.ascontiguousarray(corners).view("V24").ravel()
    _, first, inverse = np.unique(rows, return_index=True, return_inverse=True)
    order = np.argsort(first)
    return FilePart(name, corners[first[order]], np.argsort(order)[inverse].reshape(-1, 3), [])


def _load(kind, content):
    """What trimesh reads, as it stands; text that is no number is an error."""
    with warnings.catch_warnings():
        # NumPy warns and goes on.
        warnings.filterwarnings("error", "string or file could not be read", DeprecationWarning)
        return trimesh.load(
            io.BytesIO(content),
            file_type=kind,
            process=False,
            force="mesh",
            fix_texture=False,  # vertices are not split where textures meet
            skip_materials=True,
        )


def _read_obj(content):
    """The meshes of an OBJ file: its objects, or groups that have no vertex in common.

    trimesh cuts polygons into fans, which leave a concave one, and VTK has single precision and
    splits vertices where textures meet, so that the lines are read here. Where there are several
    meshes, the vertices of each are its own, in the order of the file.
    """
    points, numbers, ends, labels, objects, other = _obj_lines(content)
    vertices = np.array(points, dtype=np.float64).reshape(-1, 3)
    numbers, ends = np.array(numbers, dtype=np.int64), np.array(ends)
    places, notes = cut_polygons(vertices, ends, numbers)
    polygon = np.searchsorted(ends, places[:, 0], side="right") - 1
    faces, used = numbers[places], np.repeat(np.arange(len(labels)), np.diff(ends))
    if other:
        notes.append(f"{other} lines, points and curves left out")
    full = {name for _, name, _ in labels}
    if empty := [name for name in objects if name not in full]:
        notes.append(f"{len(empty)} objects without faces ({', '.join(empty[:8])})")
    # By the places of objects, by their names, by groups.
    for column, apart in ((0, True), (1, False), (2, True)):
        first: dict[object, int] = {}
        label = np.array([first.setdefault(row[column], k) for k, row in enumerate(labels)], int)
        if len(first) > 1:
            pairs = np.unique(np.column_stack([numbers, label[used]]), axis=0)
            if not (apart and len(np.unique(pairs[:, 0])) < len(pairs)):
                break
    else:
        return [FilePart("", vertices, faces, notes)]
    parts = []
    for k in first.values():
        own, mine = np.unique(faces[label[polygon] == k], return_inverse=True)
        name = labels[k][2 if column == 2 else 1]
        parts.append(FilePart(name, vertices[own], mine.reshape(-1, 3), list(notes)))
    return parts


def _obj_lines(content):
    """Vertices, the vertices of all polygons and where each polygon ends, the object of each by
    place and name and its group, the names of objects, and the number of lines that are no faces.
    """
    points: list[tuple[float, float, float]] = []
    numbers: list[int] = []
    ends, lines = [0], []
    labels: list[tuple[int, str, str]] = []
    objects: list[str] = []
    group, other = "", 0
    for number, line in _joined_lines(content.removeprefix(b"\xef\xbb\xbf")):
        key, *words = line.partition(b"#")[0].split() or [b""]
        try:
            if key == b"v":
                if len(words) < 3:
                    raise ValueError(f"{len(words)} coordinates, a vertex has three")
                points.append((float(words[0]), float(words[1]), float(words[2])))
            elif key == b"f":
                numbers += [_obj_vertex(word, len(points)) for word in words]
                ends.append(len(numbers))
                lines.append(number)
                labels.append((len(objects), objects[-1] if objects else "", group))
        except (ValueError, OverflowError) as error:
            said = line.decode("utf-8", "replace").strip()[:60]
            raise ValueError(f"line {number}, {said!r}: {error}") from None
        if key == b"o":
            objects.append(b" ".join(words).decode("utf-8", "replace"))
        elif key == b"g":
            group = b" ".join(words).decode("utf-8", "replace")
        elif key in _NO_FACES:
            other += 1
    if numbers and max(numbers) >= len(points):
        wrong = next(k for k, vertex in enumerate(numbers) if vertex >= len(points))
        line = lines[int(np.searchsorted(ends, wrong, side="right")) - 1]
        raise ValueError(
            f"line {line}: a face names vertex {numbers[wrong] + 1}, there are {len(points)}"
        )
    return points, numbers, ends, labels, objects, other


def _obj_vertex(word, count):
    """The vertex, from 0 on, of a corner ``a/b/c`` behind ``count`` vertices."""
    number = int(word.partition(b"/")[0])
    if number == 0 or number < -count:
        raise ValueError(f"vertex {number}; numbers begin at 1, or count back from -1 to {-count}")
    return number - 1 if number > 0 else count + number


def _joined_lines(content):
    """Number and text of each line, those that a backslash continues as one."""
    text = content.replace(b"\r\n", b"\n").replace(b"\r", b"\n").removesuffix(b"\n")
    number = 1
    for line in re.split(rb"(?<!\\)\n", text):
        yield number, line.replace(b"\\\n", b" ")
        number += 1 + line.count(b"\n")


def _read_ply(path, content):
    """The mesh of a PLY file: triangles by trimesh; polygons, which it cuts into fans, by VTK."""
    try:
        mesh = _load("ply", content)
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
    return FilePart("", np.asarray(mesh.vertices, np.float64), faces, [])


def _read_polydata(path, declared=0):
    found = read_polydata(path)
    whole = int((np.diff(found.ends) > 0).sum())
    if whole < declared:
        raise ValueError(f"it is cut off: it declares {declared} faces and holds {whole}")
    places, notes = cut_polygons(found.points, found.ends, found.numbers)
    other = max(len(found.line_ends) - 1, 0) + found.single
    if other:
        notes.append(f"{other} lines and points left out")
    return FilePart("", found.points, found.numbers[places], notes)


def read_vertex_array(path: Path, name: str) -> Floats:
    """The array (n,) of that name at the vertices of a PLY, VTK or VTP file, or MeshError."""
    suffix = path.suffix.lower()
    if suffix in (".vtk", ".vtp"):
        return read_polydata(path, array=name).values
    if suffix != ".ply":
        raise MeshError(f"{path}: has no vertex arrays; save the mesh as PLY or VTP with them")
    raw = trimesh.load(path, process=False, force="mesh").metadata.get("_ply_raw", {})
    data = raw.get("vertex", {}).get("data")
    names = list(data.dtype.names if isinstance(data, np.ndarray) else data or ())
    if name not in names:
        raise MeshError(f"{path}: no vertex array {name!r}, {did_you_mean(name, names)}")
    return np.asarray(data[name], dtype=np.float64).ravel()


FLAT = 1e-9  # least determinant of a transform, over the cube of its largest entry
TransformInput: TypeAlias = ArrayLike | Mapping[str, Sequence[float]] | None


class TransformParts(Table):
    """``transform`` by its parts: turns about the scene's x, then y, then z axis through the
    origin [degree], then a shift [scene unit].
    """

    rotate: Vector = Field(default=[0.0, 0.0, 0.0])
    translate: Vector = Field(default=[0.0, 0.0, 0.0])


def _as_matrix(value: object) -> object:
    """Parts, or an array, as rows of a matrix."""
    if value is None:
        return None
    if isinstance(value, dict):
        parts = TransformParts.build(value, context="")
        matrix = np.eye(4)
        matrix[:3, :3] = Rotation.from_euler("xyz", parts.rotate, degrees=True).as_matrix()
        matrix[:3, 3] = parts.translate
        return matrix.tolist()
    try:
        matrix = np.array(value, dtype=float)
    except (TypeError, ValueError):
        matrix = np.empty(0)
    if matrix.shape != (4, 4):
        raise ValueError("must be a table with rotate and translate, or 4 rows of 4 numbers")
    if not (np.isfinite(matrix).all() and (matrix[3] == [0.0, 0.0, 0.0, 1.0]).all()):
        raise ValueError("needs finite numbers, and 0, 0, 0, 1 in its last row")
    if abs(np.linalg.det(matrix[:3, :3])) <= FLAT * np.abs(matrix[:3, :3]).max() ** 3:
        raise ValueError("makes the mesh flat, its first three columns must be independent")
    return matrix.tolist()


class MeshTransform(Table):
    """Keys of a bone or a muscle that say where its mesh lies: the scale first, then the mirror,
    then the transform.
    """

    scale: Positive = 1.0
    mirror: Literal["x", "y", "z"] | None = None
    transform: Annotated[list[list[Finite]] | None, BeforeValidator(_as_matrix)] = None

    @property
    def matrix(self) -> Floats | None:
        """Mirror and transform (4, 4) of points in the scene's unit; None where neither is given.

        A file without them has exactly its own points times the scale.
        """
        if self.mirror is None and self.transform is None:
            return None
        matrix = np.eye(4) if self.transform is None else np.array(self.transform)
        if self.mirror is not None:
            matrix[:, "xyz".index(self.mirror)] *= -1.0
        return matrix

    def points(self, points: ArrayLike) -> Floats:
        """Points (n, 3) of a file, in the scene."""
        scaled, matrix = np.asarray(points, dtype=float) * self.scale, self.matrix
        return scaled if matrix is None else to_world(scaled, matrix)


# In any unit: beyond it, squares of squares of lengths leave the range in which volumes are exact.
LARGEST_COORDINATE = 1e12
IN_PLACE = MeshTransform()
MeshInput: TypeAlias = str | Path | ReadMesh | MeshLike


def read_mesh(
    path: str | Path,
    *,
    name: str | None = None,
    transform: MeshTransform = IN_PLACE,
    may_be_open: bool = False,
) -> ReadMesh:
    """Read a surface mesh (``.stl``, ``.obj``, ``.ply``, ``.vtk``, ``.vtp``, or one of several in a
    file as ``FILE#NAME``) and mend what is safe to mend.

    ``name`` is what messages call it, the file's stem by default; ``transform`` says where it lies
    in the scene. Holes that cannot be closed safely are kept, with a note, where it
    ``may_be_open`` (bones). MeshError if the file is missing, unreadable or empty, or the surface
    cannot be made closed and manifold.
    """
    path = Path(path)
    part = read_part(path)
    read = prepare_mesh(
        part.vertices,
        part.faces,
        context=str(path),
        name=name or path.stem,
        transform=transform,
        may_be_open=may_be_open,
    )
    read.notes[:0] = part.notes
    read.source = str(path)
    return read


def as_mesh(
    mesh: str | Path | ReadMesh | MeshLike,
    name: str,
    transform: MeshTransform,
    *,
    may_be_open: bool,
) -> ReadMesh:
    """Return the ReadMesh of a path, a trimesh.Trimesh, (vertices, faces) or of what is read
    already.
    """
    if isinstance(mesh, ReadMesh):
        return mesh
    if isinstance(mesh, (str, Path)):
        return read_mesh(mesh, name=name, transform=transform, may_be_open=may_be_open)
    vertices, faces = mesh if isinstance(mesh, tuple) else (mesh.vertices, mesh.faces)
    return prepare_mesh(
        vertices,
        faces,
        context=f"mesh {name!r}",
        name=name,
        transform=transform,
        may_be_open=may_be_open,
    )


def prepare_mesh(
    vertices: ArrayLike,
    faces: ArrayLike,
    *,
    context: str,
    name: str,
    transform: MeshTransform = IN_PLACE,
    may_be_open: bool = False,
) -> ReadMesh:
    """Return the ReadMesh of given arrays, mended like a file's; ``context`` begins messages."""
    with np.errstate(over="ignore", invalid="ignore"):
        vertices = transform.points(vertices)
    faces = np.asarray(faces)
    if transform.matrix is not None and np.linalg.det(transform.matrix[:3, :3]) < 0.0:
        faces = faces[:, ::-1]
    if not len(vertices) or not len(faces):
        raise MeshError(
            f"{context}: the mesh is empty ({len(vertices)} vertices, {len(faces)} triangles)"
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
                f"{context}: {len(bad)} vertices are {words}, the first is number {bad[0]} "
                f"{vertices[bad[0]].tolist()}; correct the scale, or export the mesh again"
            )
    try:
        vertices, faces = check_mesh(vertices, faces, name=name)
    except MeshError as error:
        raise MeshError(f"{context}: {error}") from None
    read = repair(vertices, faces, context=context, may_be_open=may_be_open)
    if not may_be_open:  # what may be open is shown as it is mended
        read.given = input_order(read, faces)
    return read


def read_fibres(
    fibres: str | Path | Iterable[ArrayLike],
    *,
    transform: MeshTransform = IN_PLACE,
    muscle: str = "",
) -> list[Floats]:
    """Return fibres as a list of (k, 3) arrays in the scene, ``transform`` saying where those of
    a file, or given arrays, lie.

    A JSON file holds ``{"polylines": [[[x, y, z], ...], ...]}`` or that list alone, a VTK or VTP
    file polylines.
    """
    context = f"muscle {muscle!r} fibres"
    if isinstance(fibres, (str, Path)):
        context, fibres = f"{context}: {fibres}", _read_lines(Path(fibres), f"{context}: ")
    lines = []
    for number, line in enumerate(fibres):
        try:
            points = check_points(line, name=f"polyline {number}")
        except (ValueError, TypeError) as error:
            raise SceneError(f"{context}: {error}") from None
        kept = np.append(True, np.diff(points, axis=0).any(axis=1))[: len(points)]
        points = points[kept]  # none twice in a row
        if len(points) < 2:
            raise SceneError(
                f"{context}: polyline {number} has {len(points)} points, a fibre needs two or more"
            )
        lines.append(transform.points(points))
    if not lines:
        raise SceneError(f"{context}: no polylines")
    return lines


def _read_lines(path, context):
    """The lines of a VTK or VTP file, or the list in a JSON file."""
    if path.suffix.lower() in (".vtk", ".vtp"):
        if not path.is_file():
            raise SceneError(f"{context}{path}: cannot read it: no such file")
        try:
            data = read_polydata(path)
        except MeshError as error:
            raise SceneError(f"{context}{error}") from None
        pieces = np.split(data.line_numbers, data.line_ends[1:-1]) if len(data.line_ends) else []
        return [data.points[piece] for piece in pieces if len(piece)]
    text = read_text(path, context=context)
    try:
        found = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise SceneError(f"{context}{path}: not JSON ({shown(str(error))})") from None
    lines = found.get("polylines") if isinstance(found, dict) else found
    if not isinstance(lines, list):
        raise SceneError(f"{context}{path}: needs a list 'polylines'")
    return lines
