"""Length of a muscle: a line through the slices of a harmonic field between its origin and its insertion."""

from collections.abc import Collection, Mapping, Sequence

import numpy as np
import scipy.sparse as sparse
from scipy.spatial import cKDTree

from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.geometry.harmonic import harmonic_weights
from rbfmuscle.geometry.surfaces import vertex_areas
from rbfmuscle.scene.joints.joint import Joint
from rbfmuscle.scene.joints.skeleton import all_coordinates
from rbfmuscle.scene.objects import Attachment, Muscle
from rbfmuscle.scene.scene import Scene
from rbfmuscle.scene.taut_line import line_length
from rbfmuscle.scene.tendons import TendonLine

_LEVELS = 120  # by which the line is measured at rest

# Of origin or insertion each attachment: its bone or tendon, attached vertices (k, 3) at rest, and their areas (k,):
# where triangles are small there are more vertices, which must not draw the end of a line there.
End = list[tuple[str, Floats, Floats]]


class Centreline:
    """The centreline of one muscle on a mesh of constant topology: vertices (n, 3) at rest [scene unit], faces (m, 3).

    The harmonic field is 0 on the origin and 1 on the insertion. So many slices are taken at levels whose centroids lie
    evenly along the muscle at rest. Each centroid is a fixed linear combination of the vertices, so the line costs one
    sparse product a frame. Its ends are the centroids of the attached patches of the input mesh, by area, carried by
    their bones. Bones that no joint, or none of the ``moving`` ones, separates count as one.
    """

    def __init__(
        self,
        muscle: Muscle,
        joints: Sequence[Joint],
        vertices: Floats,
        faces: Integers,
        *,
        moving: Collection[str] | None = None,
        slices: int = 16,
    ) -> None:
        areas = vertex_areas(np.asarray(muscle.mesh.vertices, dtype=float), np.asarray(muscle.mesh.faces))
        self.ends: list[End] = [
            [
                (a.holder, np.asarray(muscle.mesh.vertices[a.vertices], dtype=float), areas[a.vertices])
                for a in group
            ]
            for group in split_ends(muscle, joints, moving)
        ]
        sides = _sides(muscle, self.ends, vertices)
        field = harmonic_weights(vertices, faces, sides)[:, 1]
        levels = np.linspace(0.0, 1.0, _LEVELS + 2)[1:-1]
        fine = slice_operator(vertices, faces, field, levels)
        along = distance_along(fine @ vertices)
        even = np.interp(np.linspace(0.0, along[-1], slices), along, levels)
        self.operator = slice_operator(vertices, faces, field, even)

    def points(self, vertices: Floats, poses: Mapping[str, Floats]) -> Floats:
        """The line now, (k, 3), from the carried mesh (n, 3) and the poses (4, 4) of the bones."""
        first, last = (carried_middle(end, poses) for end in self.ends)
        return np.vstack([first, self.operator @ vertices, last])

    def length(self, vertices: Floats, poses: Mapping[str, Floats]) -> float:
        """Length of the line now, without tendons [scene unit]."""
        return float(distance_along(self.points(vertices, poses))[-1])

    def tendon_length(self, tendons: Mapping[str, TendonLine]) -> float:
        """Length of the tendons at both ends now [scene unit]; of several attachments of an end the mean by area."""
        total = 0.0
        for end in self.ends:
            areas = [patch.sum() for _, _, patch in end]
            lengths = [line_length(tendons[name].points) if name in tendons else 0.0 for name, _, _ in end]
            total += float(np.average(lengths, weights=areas))
        return total


def distance_along(line: Floats) -> Floats:
    """How far along a line each of its points (n, 3) lies, (n,); the last is its length."""
    return np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])


def resampled(line: Floats, segments: int) -> Floats:
    """Points (segments + 1, 3) at even distances along a line (n, 3)."""
    along = distance_along(line)
    even = np.linspace(0.0, along[-1], segments + 1)
    return np.stack([np.interp(even, along, column) for column in line.T], axis=1)


def split_ends(
    muscle: Muscle, joints: Sequence[Joint], moving: Collection[str] | None = None
) -> list[list[Attachment]]:
    """The attachments of the origin and those of the insertion.

    The origin is every attachment on the same rigid body as the first one; the rest is the insertion. Bones whose joint
    does not move are one body with its parent. Where all are on one body, the first attachment is the origin.
    """
    joint_of = {joint.child: joint for joint in joints}

    def body(bone):
        while moving is not None and bone in joint_of and joint_of[bone].name not in moving:
            bone = joint_of[bone].parent
        return bone if bone in joint_of else None

    bodies = [body(a.bone) for a in muscle.attachments]
    origin = [a for a, owner in zip(muscle.attachments, bodies) if owner == bodies[0]]
    insertion = [a for a, owner in zip(muscle.attachments, bodies) if owner != bodies[0]]
    if insertion:
        return [origin, insertion]
    if moving is not None:
        return split_ends(muscle, joints)
    return [muscle.attachments[:1], muscle.attachments[1:]]


def moving_joints(scene: Scene) -> set[str]:
    """Names of the joints that a scene's motion moves, those that follow others among them."""
    facts = all_coordinates(scene.joints)
    names = {
        name for frame in scene.motion.frames for name, value in frame.items() if value != facts[name].rest
    }
    for coupling in scene.couplings:  # in an order in which what they follow is known
        if names & set(coupling.of):
            names.add(coupling.coordinate)
    return {name.rpartition(".")[0] for name in names}


def slice_operator(vertices: Floats, faces: Integers, field: Floats, levels: Floats) -> sparse.csr_matrix:
    """Sparse matrix (k, n), rows of sum one, that maps vertices to the centroids of a field's isolines.

    The isolines' lengths at ``vertices`` (n, 3) weigh the centroids; ``field`` is (n,), and ``levels`` (k,) lie
    strictly between its least and its greatest value.
    """
    (a, b, c), (s, t), row = _crossed_edges(faces, field, np.asarray(levels, dtype=float))
    p = vertices[a] + s[:, None] * (vertices[b] - vertices[a])
    q = vertices[a] + t[:, None] * (vertices[c] - vertices[a])
    share = np.linalg.norm(p - q, axis=1)
    share = share / np.bincount(row, share, minlength=len(levels))[row] / 2
    values = np.concatenate([share * (2 - s - t), share * s, share * t])
    where = np.tile(row, 3), np.concatenate([a, b, c])
    return sparse.csr_matrix((values, where), shape=(len(levels), len(vertices)))


def isolines(
    vertices: Floats, faces: Integers, field: Floats, levels: Floats
) -> tuple[Floats, Floats, Integers]:
    """Segments of a field's isolines on an outward surface, in one direction: start, end (s, 3), level's place (s,)."""
    (a, b, c), (s, t), row = _crossed_edges(faces, field, levels)
    start = vertices[a] + s[:, None] * (vertices[b] - vertices[a])
    end = vertices[a] + t[:, None] * (vertices[c] - vertices[a])
    below = (field[a] <= levels[row])[:, None]
    return np.where(below, end, start), np.where(below, start, end), row


def _crossed_edges(faces, field, levels):
    """Of each face that an isoline crosses: the corner alone on its side, the others, shares of both edges, level."""
    at_corner = field[faces]
    # Levels not below a face's least value and below its greatest.
    low, high = at_corner.min(axis=1)[:, None], at_corner.max(axis=1)[:, None]
    face, row = np.nonzero((low <= levels) & (levels < high))
    level = levels[row]
    crossed, above = faces[face], at_corner[face] > level[:, None]
    lone = np.where(above.sum(axis=1) == 1, above.argmax(axis=1), (~above).argmax(axis=1))
    each = np.arange(len(crossed))
    a, b, c = (crossed[each, (lone + k) % 3] for k in range(3))
    return (a, b, c), [(level - field[a]) / (field[k] - field[a]) for k in (b, c)], row


def _sides(muscle, ends, vertices):
    """Carried vertices of origin and insertion: those whose nearest input vertex is attached there."""
    mesh = np.asarray(muscle.mesh.vertices, dtype=float)
    nearest = cKDTree(mesh).query(vertices)[1]
    sides = []
    for end in ends:
        attached = np.concatenate([points for _, points, _ in end])
        on_end = cKDTree(attached).query(mesh[nearest])[0] == 0.0
        if not on_end.any():
            on_end[cKDTree(vertices).query(attached.mean(axis=0))[1]] = True
        sides.append(np.flatnonzero(on_end))
    return [np.setdiff1d(sides[0], sides[1]), sides[1]]


def carried_middle(end: End, poses: Mapping[str, Floats]) -> Floats:
    """Middle (3,) of an end's patches where its bones (their poses (4, 4)) carry them."""
    total = sum(areas.sum() for _, _, areas in end)
    moved = [
        poses[bone][:3, :3] @ (areas @ points) + areas.sum() * poses[bone][:3, 3]
        for bone, points, areas in end
    ]
    return np.sum(moved, axis=0) / total
