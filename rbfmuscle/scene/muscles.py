"""A muscle from its mesh: which vertices are held by which bone, fibres, ends of tendons; what its
size and place must be.
"""

import itertools
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import TypeAlias

import numpy as np
import trimesh
from numpy.typing import ArrayLike

from rbfmuscle.geometry.arrays import Floats, Integers, box_size
from rbfmuscle.geometry.frames import numbered_by_place
from rbfmuscle.geometry.surfaces import vertex_areas
from rbfmuscle.scene.activation import contraction_keys, make_contraction
from rbfmuscle.scene.bone import Bone
from rbfmuscle.scene.file import ClassTable
from rbfmuscle.scene.joints import Joint, bones_between, rigid_body
from rbfmuscle.scene.meshes.read import MeshInput, MeshTransform, as_mesh, read_fibres
from rbfmuscle.scene.meshes.repair import ReadMesh
from rbfmuscle.scene.objects import (
    MM_PER_UNIT,
    Attachment,
    Motion,
    Muscle,
    ViaTable,
    find_named,
    split_model,
)
from rbfmuscle.scene.options import KEYS, ActivationTable
from rbfmuscle.scene.patches import AponeurosesTable, AttachTable, select_vertices
from rbfmuscle.scene.tendons import TendonEnd, tendon_name
from rbfmuscle.validation import MeshError, SceneError


def ordered_muscle(muscle: Muscle) -> tuple[Muscle, Integers]:
    """A muscle whose vertices, faces and attachments stand in an order that follows from its shape
    and its bones' names; the number (n,) that each of its vertices had.
    """
    order, faces = numbered_by_place(
        np.asarray(muscle.mesh.vertices, dtype=float), np.asarray(muscle.mesh.faces)
    )
    place = np.argsort(order)
    mesh = trimesh.Trimesh(np.asarray(muscle.mesh.vertices)[order], faces, process=False)
    ends = [
        replace(attachment, vertices=np.sort(place[attachment.vertices]))
        for attachment in muscle.attachments
    ]
    ends.sort(key=lambda attachment: (attachment.attachment_frame, attachment.vertices.tolist()))
    return replace(muscle, mesh=mesh, attachments=ends), order


def attachment_ends(
    muscle: Muscle, joints: Sequence[Joint]
) -> tuple[list[Attachment], list[Attachment]] | None:
    """The attachments at both ends of a muscle, None where it has one.

    Attachments on one rigid body belong together; where all are on one body, each stands for
    itself. Of several the two farthest apart are the ends, and the others belong to the nearer of
    these. Those via a bone belong to neither.
    """
    held = [a for a in muscle.attachments if not a.via]
    areas = vertex_areas(np.asarray(muscle.mesh.vertices), np.asarray(muscle.mesh.faces))
    bodies = [rigid_body(a.bone, joints) or "" for a in held]
    if len(set(bodies)) == 1:
        bodies = [str(k) for k in range(len(held))]
    groups = {
        body: [a for a, own in zip(held, bodies) if own == body] for body in sorted(set(bodies))
    }
    if len(groups) < 2:
        return None
    vertices = np.asarray(muscle.mesh.vertices, dtype=float)
    middle = {}
    for body, group in groups.items():
        patch = np.unique(np.concatenate([a.vertices for a in group]))
        middle[body] = np.average(vertices[patch], axis=0, weights=areas[patch])

    def away(one: str, other: str) -> float:
        return float(np.linalg.norm(middle[one] - middle[other]))

    first, last = max(itertools.combinations(groups, 2), key=lambda pair: away(*pair))
    to_last = {body: away(body, last) < away(body, first) for body in groups}
    return (
        [a for body, group in groups.items() if not to_last[body] for a in group],
        [a for body, group in groups.items() if to_last[body] for a in group],
    )


THIN = 0.05  # section of a tendon as it is drawn, over the mean section of its muscle
PATCH = 16  # points of a belly's end that are kept out of bones, at most


def make_muscle(
    name: str,
    mesh: MeshInput,
    bones: list[Bone],
    attach: Sequence[Attachment | AttachTable | Mapping[str, object]],
    model: Mapping[str, object] | str,
    fibres: str | Path | Sequence[ArrayLike] | None,
    aponeuroses: AponeurosesTable | Mapping[str, object] | None,
    keys: Mapping[str, object],
) -> Muscle:
    """A muscle without the ends of its tendons; `Scene.add_muscle` says what it is given."""
    context = f"muscle {name!r}"
    given = {key: value for key, value in keys.items() if value is not None}
    placed = ClassTable.build(given, context=f"{context} ")
    read = as_mesh(mesh, name, placed, may_be_open=False)
    model_name, options = split_model(model, context=context)
    return Muscle(
        name,
        read.mesh,
        model_name,
        options,
        make_attachments(attach, read, bones, muscle=name, transform=placed),
        None if fibres is None else read_fibres(fibres, transform=placed, muscle=name),
        read.source,
        read.notes,
        contraction_keys({key: given[key] for key in KEYS if key in given}, muscle=name),
        given=read.given,
        aponeuroses=resolve_aponeuroses(aponeuroses, read, muscle=name, transform=placed),
    )


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
            entry.guess,
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
            # Via points and insertion of the tendon.
            line = [
                (point.bone, np.array(point.point))
                if isinstance(point, ViaTable)
                else (attachment.bone, np.array(point))
                for point in [*attachment.tendon.via, attachment.tendon.to]
            ]
            points, weights = vertices[attachment.vertices], areas[attachment.vertices]
            middle = np.average(points, axis=0, weights=weights)
            # About the line towards the tendon, of a disc with the same moment of area.
            towards = line[0][1] - middle
            direction = towards / max(float(np.linalg.norm(towards)), 1e-300)
            away = np.linalg.norm(np.cross(points - middle, direction), axis=1)
            radius = float(np.sqrt(2.0 * np.average(away**2, weights=weights)))
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


def check_muscle(muscle: Muscle, motion: Motion) -> None:
    """Raise SceneError if fewer than two bones hold a muscle, or its fibres, tendon or activation
    do not fit it.
    """
    bones = sorted({attachment.bone for attachment in muscle.attachments})
    if not bones:
        raise SceneError(
            f"muscle {muscle.name!r} has no attachment, give attach a place on two bones"
        )
    if len(bones) == 1:
        raise SceneError(
            f"muscle {muscle.name!r} is attached to {bones[0]!r} only, give attach a second bone"
        )
    if muscle.contraction is not None:
        make_contraction(muscle)
        given = muscle.contraction.activation
        if isinstance(given, ActivationTable) and given.times is not None and motion.times is None:
            raise SceneError(
                f"muscle {muscle.name!r} activation: "
                "goes by time, and the motion has none; give frames, or a motion file with time"
            )


def check_file_names(bones: list[Bone], muscles: list[Muscle]) -> None:
    """Raise SceneError if two meshes of a run would have one file."""
    names = {muscle.name.lower(): muscle.name for muscle in muscles}
    for muscle in muscles:
        other = names.get(tendon_name(muscle.name).lower())
        if muscle.tendons and other is not None:
            raise SceneError(
                f"muscle {other!r} has the name of the tendons of {muscle.name!r}; choose another"
            )
    stems = {bone.name.lower() for bone in bones}
    for bone in bones:
        stem, _, number = bone.name.lower().rpartition("_")
        if stem in stems and len(number) >= 4 and number.isdecimal():
            raise SceneError(
                f"bone {bone.name!r} has the name of a frame of bone {stem!r}; choose another"
            )


def attachment_frames(bones: Sequence[Bone], muscle: Muscle) -> list[str]:
    """Names of the bones, then of the ends that tendons of a muscle hold."""
    return [*(bone.name for bone in bones), *(end.name for end in muscle.tendons)]


Item: TypeAlias = Bone | Muscle | ReadMesh

SMALLEST_MM = 2.0  # across: the bones of a mouse
LARGEST_MM = 3000.0  # across: a person with arms raised
# A muscle further from the bones than this many diagonals of their box is in another frame.
FAR_AWAY = 1.0
# The same for the centre of a joint: a nearly straight path has one far away.
FARTHEST_CENTRE = 1000.0


def check_size(kind: str, name: str, item: Item, units: str) -> None:
    """Raise MeshError for a mesh smaller than a mouse's or larger than a person's."""
    size = box_size(item.mesh.vertices)
    millimetres = size * MM_PER_UNIT[units]
    if not SMALLEST_MM <= millimetres <= LARGEST_MM:
        best = 10.0 ** round(math.log10(300.0 / max(millimetres, 1e-12)))
        raise MeshError(
            f"{kind} {name!r} ({item.source or 'built in code'}) is {size:.4g} {units} "
            "across, which "
            f"cannot be right; correct the scene's units, or set its scale ({best:g} times the "
            "present one would "
            f"make it {millimetres * best:.4g} mm)"
        )


def check_place(name: str, muscle: Item, bones: list[Bone], units: str) -> None:
    """Raise MeshError for a muscle of a wrong size, or one that lies far away from all bones."""
    check_size("muscle", name, muscle, units)
    away, size = _away_from_bones(bones, *muscle.mesh.bounds)
    if away > FAR_AWAY * size:
        raise MeshError(
            f"muscle {name!r} ({muscle.source or 'built in code'}) lies {away:.4g} {units} "
            "away from "
            "all bones; bring the meshes into one frame and unit (scale)"
        )


def check_centre(name: str, centre: Floats, bones: list[Bone], units: str) -> None:
    """Raise SceneError for a joint whose centre lies so far from all bones that poses lose their
    digits.
    """
    away, size = _away_from_bones(bones, centre, centre)
    if away > FARTHEST_CENTRE * size:
        raise SceneError(
            f"joint {name!r}: centre {np.asarray(centre).tolist()} lies {away:.4g} {units} "
            "away from all bones; "
            f"correct it, it is in the scene's unit ({units})"
        )


def _away_from_bones(bones, low, high):
    """Distance of a box from that of all bones, and the diagonal of that; no distance without
    bones.
    """
    if not bones:
        return 0.0, 0.0
    corners = np.concatenate([bone.mesh.bounds for bone in bones])
    least, most = corners.min(axis=0), corners.max(axis=0)
    away = np.maximum(least - high, low - most).clip(min=0)
    return float(np.linalg.norm(away)), float(np.linalg.norm(most - least))
