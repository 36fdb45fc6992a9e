"""``attach``: the ways to say which vertices of a muscle a bone holds."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, ClassVar, cast

import numpy as np
import trimesh
from pydantic import BeforeValidator, ValidationInfo, model_validator
from scipy.spatial import cKDTree

from rbfmuscle.geometry.arrays import Booleans, Floats, Integers, box_size
from rbfmuscle.geometry.surfaces import barycentric_weights, edge_lengths
from rbfmuscle.scene.bone import Bone
from rbfmuscle.scene.meshes.read import MeshTransform, read_part, read_vertex_array
from rbfmuscle.scene.meshes.repair import ReadMesh
from rbfmuscle.scene.objects import LineTable
from rbfmuscle.scene.options import (
    FileName,
    GuessTable,
    NotNegative,
    Positive,
    Table,
    Vector,
    in_folder,
)
from rbfmuscle.validation import MeshError, SceneError, check_points, read_text, shown, shown_path

FEWEST = 3  # picked points of a patch
# A patch reaches so many times the greatest distance of a picked point from its nearest neighbour;
# the middle of three points is 0.58 of their distance away.
REACH = 0.6
# Picked points lie no farther from the muscle than this share of its size.
AWAY = 0.05
SHADE = 40.0  # greatest difference of a colour, of 255 in each channel
# Columns of points, as ParaView, Blender's exporters and people name them.
_AXES = (
    {"x", "points:0", "points_0", "px", "x coordinate"},
    {"y", "points:1", "points_1", "py", "y coordinate"},
    {"z", "points:2", "points_2", "pz", "z coordinate"},
)


def read_points(path: Path, *, context: str) -> Floats:
    """Points (n, 3) of a text file: columns by their names in a first line, else the first
    three.
    """
    lines = [line for line in read_text(path, context=context).splitlines() if line.strip()]
    context = f"{context}{shown_path(path)}: "
    rows = [
        [word.strip(" \"'") for word in re.split(r"[,;\t]|\s+", line.strip())] for line in lines
    ]
    columns = [0, 1, 2]
    if lines:
        try:
            float(rows[0][0])
        except ValueError:  # names of columns, which may hold blanks
            head = [word.strip(" \"'") for word in re.split(r"[,;\t]", lines[0].strip())]
            head = [word.lower() for word in (rows[0] if len(head) == 1 else head)]
            columns = [next((k for k, word in enumerate(head) if word in a), -1) for a in _AXES]
            rows = rows[1:]
            if min(columns) < 0:
                raise SceneError(
                    f"{context}no columns x, y and z in {shown(repr(lines[0]))}"
                ) from None
    try:
        points = np.array([[float(row[k]) for k in columns] for row in rows])
    except (ValueError, IndexError):
        raise SceneError(f"{context}every line must hold three coordinates") from None
    if not len(points) or not np.isfinite(points).all():
        raise SceneError(f"{context}{len(points)} points, all must be finite")
    return points


def picked_vertices(points: Floats, vertices: Floats, *, context: str) -> Integers:
    """The vertices (n, 3) about picked points (k, 3)."""
    tree = cKDTree(points)
    away, nearest = cKDTree(vertices).query(points)
    size = box_size(vertices)
    if away.max() > AWAY * size:
        far = int(away.argmax())
        place = ", ".join(f"{value:.4g}" for value in points[far])
        raise SceneError(
            f"{context}point {far + 1} of {len(points)}, ({place}), lies {away[far]:.4g} units of "
            "the scene away from the muscle; pick points on its mesh, in the scene's frame and unit"
        )
    spacing = float(tree.query(points, k=2)[0][:, 1].max())
    near = np.flatnonzero(tree.query(vertices)[0] <= REACH * spacing)
    return np.union1d(near, nearest)


def _painted(colour: str, path: Path, count: int, context: str) -> Booleans:
    """Whether each of the ``count`` vertices of a file has a colour (``"#rrggbb"``)."""
    if re.fullmatch(r"#[0-9a-fA-F]{6}", colour) is None:
        raise SceneError(f"{context}colour must be like '#ff0000', got {shown(repr(colour))}")
    visual = trimesh.load(path, process=False).visual
    if getattr(visual, "kind", None) != "vertex" or len(visual.vertex_colors) != count:
        raise SceneError(
            f"{context}{shown_path(path)} holds no vertex colours; save the mesh as PLY with them"
        )
    wanted = np.array([int(colour[k : k + 2], 16) for k in (1, 3, 5)], dtype=float)
    away = np.abs(np.asarray(visual.vertex_colors, dtype=float)[:, :3] - wanted).max(axis=1)
    return away <= SHADE


def region_vertices(
    path: Path, transform: MeshTransform, colour: str | None, mesh: trimesh.Trimesh, *, context: str
) -> Integers:
    """The vertices of a muscle's mesh on another mesh, or on what is painted there.

    Nearer to it than half an edge, of the mesh whose edges are longer; ``transform`` takes the
    other mesh to the scene.
    """
    import igl

    try:
        part = read_part(path)
    except MeshError as error:
        raise SceneError(f"{context}{error}") from None
    painted = np.ones(len(part.vertices), dtype=bool)
    if colour is not None:
        painted = _painted(colour, path, len(part.vertices), context)
    other = transform.points(part.vertices)
    square, nearest, places = igl.point_mesh_squared_distance(
        np.asarray(mesh.vertices), other, np.ascontiguousarray(part.faces)
    )[:3]
    corners = part.faces[nearest]
    share = (barycentric_weights(places, other[corners]) * painted[corners]).sum(axis=1)
    own = np.median(edge_lengths(np.asarray(mesh.vertices), np.asarray(mesh.faces)[:, :2]))
    edge = max(own, np.median(edge_lengths(other, part.faces[:, :2])))
    away = np.sqrt(square)
    chosen = np.flatnonzero((share >= 1 / 2) & (away <= 0.5 * edge))
    if not len(chosen):
        words = f"the nearest is {away.min():.4g} away" if painted.any() else "nothing is painted"
        raise SceneError(f"{context}no vertex of the muscle lies on {shown_path(path)}, {words}")
    return chosen


def _check_vertices(value: object, info: ValidationInfo) -> object:
    value = value.tolist() if isinstance(value, np.ndarray) else value
    if isinstance(value, (list, tuple)) and all(type(number) is int for number in value):
        return list(value)
    if value is None or isinstance(value, (str, Path)):
        return value if value is None else in_folder(value, info)
    raise ValueError("must be a file or a list of vertex numbers")


def _check_places(value: object, info: ValidationInfo) -> object:
    if value is None or isinstance(value, (str, Path)):
        return value if value is None else in_folder(value, info)
    try:
        return check_points(cast(list, value)).tolist()
    except (TypeError, ValueError):
        raise ValueError("must be a file or a list of points [x, y, z]") from None


class PatchTable(Table):
    """A part of a muscle's surface: a file or list of vertex numbers, a vertex array of the mesh's
    file, points or a file of them (maybe with a radius), a painted colour, or a region of another
    mesh (maybe of a colour).
    """

    hints: ClassVar[Mapping[str, str]] = {"sphere": "write points = [CENTRE], radius = RADIUS"}
    ways: ClassVar[tuple[str, ...]] = ("vertices", "array", "points", "colour", "region")

    vertices: Annotated[Path | list[int] | None, BeforeValidator(_check_vertices)] = None
    array: str | None = None
    points: Annotated[Path | list[Vector] | None, BeforeValidator(_check_places)] = None
    radius: Positive | None = None
    colour: str | None = None
    region: FileName | None = None

    @model_validator(mode="after")
    def _check_ways(self):
        given = [key for key in self.ways if getattr(self, key) is not None]
        if given != ["colour", "region"] and len(given) != 1:
            raise ValueError(
                f"give one of {', '.join(self.ways[:-1])} and {self.ways[-1]}, got "
                f"{' and '.join(given) or 'none'}"
            )
        if self.radius is not None and self.points is None:
            raise ValueError("radius belongs to points")
        return self


class AponeurosesTable(Table):
    """The two patches of a pennate muscle's surface between which its fibres run."""

    origin: PatchTable
    insertion: PatchTable


class AttachTable(PatchTable):
    """A bone, and what it holds: a patch, or all within a distance ``near`` of the bone; maybe a
    tendon. With ``via`` the muscle passes there on its way.
    """

    ways: ClassVar[tuple[str, ...]] = ("vertices", "array", "near", "points", "colour", "region")

    bone: str
    near: NotNegative | None = None
    tendon: LineTable | None = None
    via: bool = False
    guess: GuessTable | None = None

    @model_validator(mode="after")
    def _check_via(self):
        if self.via and self.tendon is not None:
            raise ValueError("a tendon belongs to an end of the muscle, which via is not")
        return self


def select_vertices(
    table: PatchTable,
    read: ReadMesh,
    transform: MeshTransform,
    *,
    context: str,
    bone: Bone | None = None,
) -> Integers:
    """The vertices (n,) of a muscle's mesh that a table says, for an attachment with its bone;
    SceneError that begins with ``context`` where there are none.

    ``transform`` says where the muscle's file, and the mesh of a region, lie in the scene.
    """
    points = np.asarray(read.mesh.vertices)
    if table.vertices is not None:
        return _kept(read, _listed(table.vertices, len(read.vertex_map), context), context)
    if table.array is not None:
        return _kept(read, _marked(table.array, read, context), context)
    if table.points is not None:
        return _about(table.points, table.radius, points, context)
    if table.region is not None:
        return region_vertices(table.region, transform, table.colour, read.mesh, context=context)
    if table.colour is not None:
        if not read.source:
            raise SceneError(f"{context}a colour needs a mesh that was read from a file")
        painted = _painted(table.colour, Path(read.source), len(read.vertex_map), context)
        kept = read.vertex_map[painted]
        if not (kept >= 0).any():
            raise SceneError(f"{context}no vertex has the colour {table.colour}, or one near to it")
        return np.unique(kept[kept >= 0])
    if bone is None or not isinstance(table, AttachTable):
        raise TypeError("near belongs to an attachment and its bone")
    return _within(bone.distances(points), table.near or 0.0, "near", context)


def _kept(read: ReadMesh, numbers: Integers, context: str) -> Integers:
    """Vertices of the mended mesh that those of the file became."""
    kept = read.vertex_map[numbers]
    if not (kept >= 0).any():
        raise SceneError(f"{context}none of its vertices is part of the mended surface")
    return kept[kept >= 0]


def _marked(name: str, read: ReadMesh, context: str) -> Integers:
    """Vertices of the muscle's file at which an array of it is not zero."""
    if not read.source:
        raise SceneError(f"{context}an array needs a mesh that was read from a file")
    try:
        values = read_vertex_array(Path(read.source), name)
    except MeshError as error:
        raise SceneError(f"{context}{error}") from None
    if len(values) != len(read.vertex_map) or not values.any():
        words = "is zero at every vertex" if not values.any() else "is not of the mesh's vertices"
        raise SceneError(f"{context}the array {shown(repr(name))} of {read.source} {words}")
    return np.flatnonzero(values)


def _about(given: Path | list, radius: float | None, points: Floats, context: str) -> Integers:
    """Vertices about landmarks: within a radius, or the patch that picked points cover."""
    places = read_points(given, context=context) if isinstance(given, Path) else np.array(given)
    if radius is None:
        context += f"{shown_path(given)}: " if isinstance(given, Path) else ""
        if len(places) < FEWEST:
            raise SceneError(
                f"{context}{len(places)} points, at least {FEWEST} make a patch; give a radius"
            )
        return picked_vertices(places, points, context=context)
    away = np.min([np.linalg.norm(points - place, axis=1) for place in places], axis=0)
    return _within(away, radius, "radius", context)


def _within(distance: Floats, limit: float, what: str, context: str) -> Integers:
    chosen = np.flatnonzero(distance <= limit)
    if len(chosen) == 0:
        raise SceneError(
            f"{context}{what} = {limit:g} reaches no vertex of the muscle, "
            f"the nearest is {distance.min():.4g} away; raise it"
        )
    return chosen


def _listed(listed: Path | list[int], count: int, context: str) -> Integers:
    """Vertex numbers of a list or of a text file, below ``count``; ``context`` begins each
    message.
    """
    numbers = listed if isinstance(listed, list) else []
    if isinstance(listed, Path):
        words = read_text(listed, context=context).split()
        context = f"{context}{shown_path(listed)}: "
        for word in words:
            try:
                numbers.append(int(word))
            except ValueError:
                raise SceneError(f"{context}{shown(repr(word))} is not a vertex number") from None
    if not numbers:
        raise SceneError(f"{context}no vertex numbers")
    for number in numbers:
        if not 0 <= number < count:
            raise SceneError(
                f"{context}vertex {shown(number)} is out of range, the mesh has vertices 0 to "
                f"{count - 1}"
            )
    return np.array(numbers, dtype=np.int64)
