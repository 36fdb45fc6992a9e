"""Which vertices of a muscle are held by which bone."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence

import numpy as np

from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.geometry.surfaces import vertex_areas
from rbfmuscle.scene.bone import Bone
from rbfmuscle.scene.joints.joint import Joint, bones_between
from rbfmuscle.scene.meshes.repair import ReadMesh
from rbfmuscle.scene.meshes.transform import MeshTransform
from rbfmuscle.scene.objects import Attachment, LineTable, Muscle, ViaTable, find_named
from rbfmuscle.scene.patches import AponeurosesTable, AttachTable, select_vertices
from rbfmuscle.scene.tendons import BonePoint, TendonEnd
from rbfmuscle.validation import SceneError

THIN = 0.05  # section of a tendon as it is drawn, over the mean section of its muscle
PATCH = 16  # points of a belly's end that are kept out of bones, at most


def make_attachments(
    attach: Sequence[Attachment | AttachTable | Mapping[str, object]],
    read: ReadMesh,
    bones: list[Bone],
    *,
    muscle: str,
    transform: MeshTransform,
) -> list[Attachment]:
    """Return the attachments of the muscle of that name and mesh, which lies in the scene by
    ``transform``.

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
            np.unique(select_vertices(entry, read, transform, context=context, bone=bone)),
            entry.tendon,
            attachment_frame,
            entry.via,
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


def resolve_aponeuroses(
    given: AponeurosesTable | Mapping[str, object] | None,
    read: ReadMesh,
    *,
    muscle: str,
    transform: MeshTransform,
) -> list[Integers]:
    """Vertices of the aponeuroses of origin and insertion, none where none are given; SceneError on
    an empty selection, or a vertex of both.
    """
    if given is None:
        return []
    context = f"muscle {muscle!r} aponeuroses: "
    table = (
        given
        if isinstance(given, AponeurosesTable)
        else AponeurosesTable.build(given, context=context)
    )
    found = [
        np.unique(select_vertices(patch, read, transform, context=f"{context}{end}: "))
        for end, patch in (("origin", table.origin), ("insertion", table.insertion))
    ]
    shared = np.intersect1d(found[0], found[1])
    if len(shared):
        raise SceneError(
            f"{context}{len(shared)} vertices (first: {shared[0]}) belong to both, "
            "make the patches smaller"
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
        end.opposite_length = 0.0 if held else opposite.length
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
