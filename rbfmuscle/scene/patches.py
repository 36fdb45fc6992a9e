"""``attach``: the ways to say which vertices of a muscle a bone holds."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, ClassVar, cast

import numpy as np
from pydantic import BeforeValidator, ValidationInfo, model_validator

from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.scene.bone import Bone
from rbfmuscle.scene.guesses import GuessTable
from rbfmuscle.scene.meshes.formats import read_vertex_array
from rbfmuscle.scene.meshes.repair import ReadMesh
from rbfmuscle.scene.meshes.transform import MeshTransform
from rbfmuscle.scene.objects import LineTable
from rbfmuscle.scene.options import FileName, NotNegative, Positive, Table, Vector, in_folder
from rbfmuscle.scene.picked import (
    check_patch,
    painted_vertices,
    picked_vertices,
    read_points,
    region_vertices,
)
from rbfmuscle.validation import MeshError, SceneError, check_points, read_text, shown, shown_path


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
            words = f"{', '.join(self.ways[:-1])} and {self.ways[-1]}"
            raise ValueError(f"give one of {words}, got {' and '.join(given) or 'none'}")
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
        place = transform, table.colour
        return region_vertices(table.region, *place, read.mesh, context=context)
    if table.colour is not None:
        return painted_vertices(table.colour, read, context=context)
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
        return picked_vertices(check_patch(places, context=context), points, context=context)
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
            words = f"out of range, the mesh has vertices 0 to {count - 1}"
            raise SceneError(f"{context}vertex {shown(number)} is {words}")
    return np.array(numbers, dtype=np.int64)
