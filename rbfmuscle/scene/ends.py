"""What a muscle is whatever the order of its scene: numbering by place, and its two ends."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np
import trimesh

from rbfmuscle.geometry.arrays import Integers
from rbfmuscle.geometry.rest_frame import numbered_by_place
from rbfmuscle.geometry.surfaces import vertex_areas
from rbfmuscle.scene.joints.joint import Joint, rigid_body
from rbfmuscle.scene.objects import Attachment, Muscle


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

    first, last = max(combinations(groups, 2), key=lambda pair: away(*pair))
    to_last = {body: away(body, last) < away(body, first) for body in groups}
    return (
        [a for body, group in groups.items() if not to_last[body] for a in group],
        [a for body, group in groups.items() if to_last[body] for a in group],
    )
