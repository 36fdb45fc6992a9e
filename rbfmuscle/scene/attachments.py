"""Which vertices of a muscle are held by which bone."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import BeforeValidator, ValidationInfo

from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.geometry.surfaces import vertex_areas
from rbfmuscle.scene.bone import Bone
from rbfmuscle.scene.joints.joint import Joint, bones_between
from rbfmuscle.scene.meshes.repair import ReadMesh
from rbfmuscle.scene.objects import Attachment, LineTable, Muscle, ViaTable, find_named
from rbfmuscle.scene.options import FileName, NotNegative, Positive, Table, Vector, in_folder
from rbfmuscle.scene.picked import painted_vertices, picked_vertices, read_points
from rbfmuscle.scene.tendons import BonePoint, TendonEnd
from rbfmuscle.validation import SceneError, read_text, shown, shown_path

THIN = 0.05  # section of a tendon as it is drawn, over the mean section of its muscle
_WAYS = ("vertices", "near", "sphere", "points", "colour")  # to say what a bone holds
PATCH = 16  # points of a belly's end that are kept out of bones, at most


class SphereTable(Table):
    """All vertices of the muscle within a ball."""

    centre: Vector
    radius: Positive


def _check_vertices(value: object, info: ValidationInfo) -> object:
    value = value.tolist() if isinstance(value, np.ndarray) else value
    if isinstance(value, (list, tuple)) and all(type(number) is int for number in value):
        return list(value)
    if value is None or isinstance(value, (str, Path)):
        return value if value is None else in_folder(value, info)
    raise ValueError("must be a file or a list of vertex numbers")


class AttachTable(Table):
    """A bone, and one of: a file or list of vertex numbers, a distance to the bone, a ball, a file
    of picked points, a painted colour; maybe a tendon.
    """

    bone: str
    vertices: Annotated[Path | list[int] | None, BeforeValidator(_check_vertices)] = None
    near: NotNegative | None = None
    sphere: SphereTable | None = None
    points: FileName | None = None
    colour: str | None = None
    tendon: LineTable | None = None


def resolve_attachments(
    attach: Sequence[Attachment | AttachTable | dict[str, Any]],
    read: ReadMesh,
    bones: list[Bone],
    *,
    muscle: str,
) -> list[Attachment]:
    """Return the attachments of the muscle of that name and mesh.

    SceneError on an unknown bone, an empty selection, an index out of range, or a vertex held by
    two bones.
    """
    found = []
    for number, entry in enumerate(attach):
        context = f"muscle {muscle!r} attach {number + 1}: "
        if not isinstance(entry, AttachTable):
            row = vars(entry) if isinstance(entry, Attachment) else entry
            entry = AttachTable.build(
                {k: v for k, v in row.items() if k != "attachment_frame"}, context=context
            )
        bone = find_named(bones, entry.bone, "bone", context=context)
        attachment_frame = (
            "" if entry.tendon is None else f"{muscle} tendon {number + 1} to {bone.name}"
        )
        held = Attachment(
            bone.name,
            np.unique(_select(entry, read, bone, context)),
            entry.tendon,
            attachment_frame,
        )
        for name in held.bones:
            find_named(bones, name, "bone", context=f"{context}tendon: ")
        found.append(held)
    for first, second in itertools.combinations(found, 2):
        shared = np.intersect1d(first.vertices, second.vertices)
        if first.attachment_frame != second.attachment_frame and len(shared):
            raise SceneError(
                f"muscle {muscle!r}: {len(shared)} vertices (first: {shared[0]}) are attached "
                "to both "
                f"{first.bone!r} and {second.bone!r}, make the attachments smaller"
            )
    return found


def tendon_ends(muscle: Muscle, bones: list[Bone], joints: list[Joint]) -> list[TendonEnd]:
    """The ends of a muscle's belly that tendons hold, in the order of its attachments."""
    vertices = np.asarray(muscle.mesh.vertices, dtype=float)
    areas = vertex_areas(vertices, np.asarray(muscle.mesh.faces))
    ends = []
    for attachment in muscle.attachments:
        if attachment.tendon is not None:
            line = _line(attachment.bone, attachment.tendon)
            middle, radius = _patch(
                vertices[attachment.vertices], areas[attachment.vertices], line[0][1]
            )
            section = abs(muscle.mesh.volume) / np.linalg.norm(vertices - middle, axis=1).max()
            thin = float(np.sqrt(THIN * section / np.pi))
            radii = radius, min(thin, radius)
            patch = vertices[attachment.vertices[:: -(-len(attachment.vertices) // PATCH)]]
            ends.append(TendonEnd(attachment.attachment_frame, patch, middle, radii, line))
    held = [attachment for attachment in muscle.attachments if attachment.tendon is None]
    widest = max(held, key=lambda attachment: areas[attachment.vertices].sum(), default=None)
    for end in ends:
        opposite = next((other for other in ends if other is not end), None)
        if widest is not None:
            patch = widest.vertices
            end.other = [(widest.bone, np.average(vertices[patch], axis=0, weights=areas[patch]))]
        elif opposite is not None:
            end.other = opposite.line[::-1]
        names = bones_between(joints, [bone for bone, _ in (*end.other, *end.line)])
        end.obstacles = [bone for bone in bones if bone.name in names]
    for end, opposite in zip(ends, ends[::-1]):
        end.slack = 0.0 if held else opposite.length
    return ends


def _line(bone: str, tendon: LineTable) -> list[BonePoint]:
    """Via points and insertion of a tendon to a bone."""
    return [
        (point.bone, np.array(point.point))
        if isinstance(point, ViaTable)
        else (bone, np.array(point))
        for point in [*tendon.via, tendon.to]
    ]


def _patch(points: Floats, areas: Floats, towards: Floats) -> tuple[Floats, float]:
    """Middle of an end, and its radius about the line towards the tendon, as of a disc with the
    same moment of area.
    """
    middle = np.average(points, axis=0, weights=areas)
    direction = (towards - middle) / max(float(np.linalg.norm(towards - middle)), 1e-300)
    away = np.linalg.norm(np.cross(points - middle, direction), axis=1)
    return middle, float(np.sqrt(2.0 * np.average(away**2, weights=areas)))


def _select(table, read, bone, context):
    given = [key for key in _WAYS if getattr(table, key) is not None]
    if len(given) != 1:
        raise SceneError(
            f"{context}give one of {', '.join(_WAYS[:-1])} and {_WAYS[-1]}, got "
            f"{' and '.join(given) or 'none'}"
        )
    if table.vertices is not None:
        kept = read.vertex_map[_listed(table.vertices, len(read.vertex_map), context)]
        if not (kept >= 0).any():
            raise SceneError(f"{context}none of its vertices is part of the mended surface")
        return kept[kept >= 0]
    points = np.asarray(read.mesh.vertices)
    if table.points is not None:
        return picked_vertices(read_points(table.points, context=context), points, context=context)
    if table.colour is not None:
        return painted_vertices(table.colour, read, context=context)
    if table.sphere is not None:
        distance = np.linalg.norm(points - table.sphere.centre, axis=1)
        limit, what = table.sphere.radius, "sphere.radius"
    else:
        distance = bone.distances(points)
        limit, what = table.near, "near"
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
        words, context = (
            read_text(listed, context=context).split(),
            f"{context}{shown_path(listed)}: ",
        )
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
