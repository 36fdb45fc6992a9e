"""Reading surface meshes: STL, OBJ, PLY, VTK and VTP PolyData, mended where that is safe; fibres
from JSON.

Vertex numbers in files stay usable: a read mesh knows which of its vertices each vertex of the file
became.
"""

import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Literal, TypeAlias

import numpy as np
from numpy.typing import ArrayLike
from pydantic import BeforeValidator, Field
from scipy.spatial.transform import Rotation

from rbfmuscle.geometry.arrays import Floats, Integers, MeshLike
from rbfmuscle.geometry.vectors import to_world
from rbfmuscle.scene.meshes.formats import read_part
from rbfmuscle.scene.meshes.polydata import read_polydata
from rbfmuscle.scene.meshes.repair import ReadMesh, input_order, repair
from rbfmuscle.scene.options import Finite, Positive, Table, Vector
from rbfmuscle.validation import (
    MeshError,
    SceneError,
    check_mesh,
    check_points,
    read_text,
    shown,
)

FLAT = 1e-9  # least determinant of a transform, over the cube of its largest entry
TransformInput: TypeAlias = ArrayLike | Mapping[str, Sequence[float]] | None
AXES = {"x": 0, "y": 1, "z": 2}


class TransformParts(Table):
    """``transform`` by its parts: turns about the scene's x, then y, then z axis through the
    origin [degree], then a shift [scene unit].
    """

    rotate: Vector = Field(default=[0.0, 0.0, 0.0])
    translate: Vector = Field(default=[0.0, 0.0, 0.0])

    def matrix(self) -> Floats:
        """The transform (4, 4)."""
        matrix = np.eye(4)
        matrix[:3, :3] = Rotation.from_euler("xyz", self.rotate, degrees=True).as_matrix()
        matrix[:3, 3] = self.translate
        return matrix


def _as_matrix(value: object) -> object:
    """Parts, or an array, as rows of a matrix."""
    if value is None:
        return None
    if isinstance(value, dict):
        return TransformParts.build(value, context="").matrix().tolist()
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
            matrix[:, AXES[self.mirror]] *= -1.0
        return matrix

    def points(self, points: Floats) -> Floats:
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
        *_placed(part.vertices, part.faces, transform),
        context=str(path),
        name=name or path.stem,
        may_be_open=may_be_open,
    )
    read.notes[:0] = part.notes
    read.source = str(path)
    return read


def _placed(vertices, faces, transform):
    """Vertices and triangles of a file in the scene."""
    with np.errstate(over="ignore", invalid="ignore"):
        vertices = transform.points(vertices)
    mirrored = transform.matrix is not None and np.linalg.det(transform.matrix[:3, :3]) < 0.0
    return vertices, faces[:, ::-1] if mirrored else faces


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
    vertices, faces = np.asarray(vertices, dtype=np.float64), np.asarray(faces)
    return prepare_mesh(
        *_placed(vertices, faces, transform),
        context=f"mesh {name!r}",
        name=name,
        may_be_open=may_be_open,
    )


def prepare_mesh(
    vertices: Floats,
    faces: Integers,
    *,
    context: str,
    name: str,
    may_be_open: bool = False,
) -> ReadMesh:
    """Return the ReadMesh of given arrays, mended like a file's; ``context`` begins messages."""
    vertices, faces = np.asarray(vertices), np.asarray(faces)
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
    if path.suffix.lower() in (".vtk", ".vtp"):
        return _read_polylines(path, context)
    text = read_text(path, context=context)
    try:
        found = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise SceneError(f"{context}{path}: not JSON ({shown(str(error))})") from None
    lines = found.get("polylines") if isinstance(found, dict) else found
    if not isinstance(lines, list):
        raise SceneError(f"{context}{path}: needs a list 'polylines'")
    return lines


def _read_polylines(path, context):
    """The lines of a VTK or VTP file."""
    if not path.is_file():
        raise SceneError(f"{context}{path}: cannot read it: no such file")
    try:
        found = read_polydata(path)
    except MeshError as error:
        raise SceneError(f"{context}{error}") from None
    pieces = np.split(found.line_numbers, found.line_ends[1:-1]) if len(found.line_ends) else []
    return [found.points[piece] for piece in pieces if len(piece)]
