"""Length and sections of a muscle, and the shortest path over the bones between its ends.

The length is that of a line through the slices of a harmonic field between origin and insertion.
The path is a taut string of `NODES` nodes that starts along it: the nodes take the places where the
sum of the segments' squared lengths is least while each is on the outer side of the plane that
touches the nearest bone there, as far from it as the muscle's half thickness at rest. Planes are
taken again until the nodes are where they were one or two rounds before.
"""

from collections.abc import Collection, Mapping, Sequence

import numpy as np
import scipy.sparse as sparse
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree

from rbfmuscle.geometry.arrays import Floats, Integers, to_local, unit
from rbfmuscle.geometry.harmonic import harmonic_weights
from rbfmuscle.geometry.lines import distance_along, line_length, points_along
from rbfmuscle.geometry.mesh_distance import MeshDistance
from rbfmuscle.geometry.surfaces import connected_vertices, vertex_areas
from rbfmuscle.loops import loop
from rbfmuscle.metrics.rows import bones_about
from rbfmuscle.scene.bone import BoneDistance
from rbfmuscle.scene.joints import Joint, all_coordinates, rigid_body
from rbfmuscle.scene.objects import Attachment, Muscle
from rbfmuscle.scene.scene import Scene
from rbfmuscle.scene.tendons import TendonLine

_LEVELS = 120  # by which the line is measured at rest

# Of origin or insertion each attachment: its bone or tendon, attached vertices (k, 3) at rest, and
# their areas (k,): where triangles are small there are more vertices, which must not draw the end
# of a line there.
End = list[tuple[str, Floats, Floats]]
STATIONS = 48  # sections along the line of action
CALIPERS = 36  # directions in which a section's width is taken
NODES = 33
ROUNDS = 40  # in which planes are taken, at most
STILL = 1e-4  # of the string's length: what counts as the same place
SWEEPS, OVER_RELAXATION = 100, 1.8  # of a round
# Of its distance to the nearest bone: a node that has moved farther gets another plane.
RENEWED = 0.1
# Nearer to a bone than this its distance is no way to tell the normal, in lengths of the string.
TOUCHING = 1e-9


class Centreline:
    """The centreline of one muscle on a mesh of constant topology: vertices (n, 3) at rest [scene
    unit], faces (m, 3).

    The harmonic field is 0 on the origin and 1 on the insertion. So many slices are taken at levels
    whose centroids lie evenly along the muscle at rest. Each centroid is a fixed linear combination
    of the vertices, so the line costs one sparse product a frame. Its ends are the centroids of the
    attached patches of the input mesh, by area, moved by their bones. Bones that no joint, or
    none of the ``moving`` ones, separates count as one.
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
        rest = np.asarray(muscle.mesh.vertices, dtype=float)
        areas = vertex_areas(rest, np.asarray(muscle.mesh.faces))
        self.ends: list[End] = [
            [(a.attachment_frame, rest[a.vertices], areas[a.vertices]) for a in group]
            for group in split_ends(muscle, joints, moving)
        ]
        sides = _sides(muscle, self.ends, vertices)
        field = harmonic_weights(vertices, faces, sides)[:, 1]
        levels = np.linspace(0.0, 1.0, _LEVELS + 2)[1:-1]
        fine = slice_operator(vertices, faces, field, levels)
        along = distance_along(fine @ vertices)
        even = np.interp(np.linspace(0.0, along[-1], slices), along, levels)
        self.operator = slice_operator(vertices, faces, field, even)
        first, last = (_rest_middle(end) for end in self.ends)
        line = np.vstack([first, self.operator @ vertices, last])
        # Of the line at rest to the surface, at even distances along it; 0 at both ends.
        distance = MeshDistance(vertices, faces).unsigned(line)
        distance[[0, -1]] = 0.0
        places = distance_along(line)
        self.clearance = np.interp(np.linspace(0.0, places[-1], NODES), places, distance)
        #: What the shortest path goes through: patches as those of an end, by its node.
        self.via = _passed(muscle, areas, resampled(line, NODES - 1))
        #: Shortest paths that did not come to rest, since they were last asked for.
        self.unsettled = 0
        # From the points along the line to the last shortest path.
        self._pulled: Floats | None = None

    def points(self, vertices: Floats, poses: Mapping[str, Floats]) -> Floats:
        """The line now, (k, 3), from the material mesh (n, 3) and the poses (4, 4) of the bones."""
        first, last = (_moved_middle(end, poses) for end in self.ends)
        return np.vstack([first, self.operator @ vertices, last])

    def length(self, vertices: Floats, poses: Mapping[str, Floats]) -> float:
        """Length of the line now, without tendons [scene unit]."""
        return float(distance_along(self.points(vertices, poses))[-1])

    def measure(
        self, vertices: Floats, poses: dict[str, Floats], probes: list[BoneDistance]
    ) -> tuple[float, float]:
        """Length of the line now, and over that of the shortest path, which begins beside it as in
        the last frame.
        """
        line = self.points(vertices, poses)
        via = {node: _moved_middle(patch, poses) for node, patch in self.via.items()}
        path, settled = shortest_path(line, probes, poses, self.clearance, self._pulled, via)
        self.unsettled += not settled
        self._pulled = path - resampled(line, NODES - 1) if len(path) == NODES else None
        length, shortest = float(distance_along(line)[-1]), float(distance_along(path)[-1])
        return length, length / shortest if shortest > 0.0 else np.nan

    def section(
        self, vertices: ArrayLike, faces: ArrayLike, poses: Mapping[str, Floats]
    ) -> dict[str, float]:
        """`belly_measures` of a surface across the line between the middles of origin and
        insertion.
        """
        first, last = (_moved_middle(end, poses) for end in self.ends)
        return belly_measures(np.asarray(vertices), np.asarray(faces), first, last)

    def tendon_length(self, tendons: Mapping[str, TendonLine]) -> float:
        """Length of the tendons at both ends now [scene unit]; of several attachments of an end the
        mean by area.
        """
        total = 0.0
        for end in self.ends:
            areas = [patch.sum() for _, _, patch in end]
            lengths = [
                line_length(tendons[name].points) if name in tendons else 0.0 for name, _, _ in end
            ]
            total += float(np.average(lengths, weights=areas))
        return total


def _passed(muscle: Muscle, areas: Floats, path: Floats) -> dict[int, End]:
    """Connected patches via bones, by the node of a path at rest that is nearest to each."""
    found, rest = {}, np.asarray(muscle.mesh.vertices, dtype=float)
    faces = np.asarray(muscle.mesh.faces)
    for held in muscle.attachments:
        for patch in connected_vertices(faces, held.vertices) if held.via else ():
            end = [(held.attachment_frame, rest[patch], areas[patch])]
            away = np.linalg.norm(path[1:-1] - _rest_middle(end), axis=1)
            found[1 + int(np.argmin(away))] = end
    return found


def resampled(line: Floats, segments: int) -> Floats:
    """Points (segments + 1, 3) at even distances along a line (n, 3)."""
    return points_along(line, np.linspace(0.0, distance_along(line)[-1], segments + 1))


def split_ends(
    muscle: Muscle, joints: Sequence[Joint], moving: Collection[str] | None = None
) -> list[list[Attachment]]:
    """The attachments of the origin and those of the insertion.

    The origin is every attachment on the same rigid body as the first one; the rest is the
    insertion. Bones whose joint does not move are one body with its parent. Where all are on one
    body, the first attachment is the origin. Those via a bone count to neither.
    """
    held = [a for a in muscle.attachments if not a.via]
    bodies = [rigid_body(a.bone, joints, moving) for a in held]
    origin = [a for a, owner in zip(held, bodies) if owner == bodies[0]]
    insertion = [a for a, owner in zip(held, bodies) if owner != bodies[0]]
    if insertion:
        return [origin, insertion]
    if moving is not None:
        return split_ends(muscle, joints)
    return [held[:1], held[1:]]


def moving_joints(scene: Scene) -> set[str]:
    """Names of the joints that a scene's motion moves, those that follow others among them."""
    known = all_coordinates(scene.joints)
    names = {
        name for frame in scene.motion.frames for name, x in frame.items() if x != known[name].rest
    }
    for coupling in scene.couplings:  # in an order in which what they follow is known
        if names & set(coupling.of):
            names.add(coupling.coordinate)
    return {name.rpartition(".")[0] for name in names}


def slice_operator(
    vertices: Floats, faces: Integers, field: Floats, levels: Floats
) -> sparse.csr_matrix:
    """Sparse matrix (k, n), rows of sum one, that maps vertices to the centroids of a field's
    isolines.

    The isolines' lengths at ``vertices`` (n, 3) weigh the centroids; ``field`` is (n,), and
    ``levels`` (k,) lie strictly between its least and its greatest value.
    """
    (a, b, c), (s, t), row = _crossed_edges(faces, field, np.asarray(levels, dtype=float))
    p = vertices[a] + s[:, None] * (vertices[b] - vertices[a])
    q = vertices[a] + t[:, None] * (vertices[c] - vertices[a])
    share = np.linalg.norm(p - q, axis=1)
    share = share / np.bincount(row, share, minlength=len(levels))[row] / 2
    values = np.concatenate([share * (2 - s - t), share * s, share * t])
    where = np.tile(row, 3), np.concatenate([a, b, c])
    return sparse.csr_matrix((values, where), shape=(len(levels), len(vertices)))


def _crossed_edges(faces, field, levels):
    """Of each face that an isoline crosses: the corner alone on its side, the others, shares of
    both edges, level.
    """
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
    """Carried vertices of origin and insertion: those whose nearest input vertex is attached
    there.
    """
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


def _rest_middle(end: End) -> Floats:
    """Middle (3,) of an end's patches at rest."""
    return _moved_middle(end, {frame_name: np.eye(4) for frame_name, _, _ in end})


def _moved_middle(end: End, poses: Mapping[str, Floats]) -> Floats:
    """Middle (3,) of an end's patches where its bones (their poses (4, 4)) carry them."""
    placed = [(poses[bone], points, areas) for bone, points, areas in end]
    moved = [
        pose[:3, :3] @ (areas @ points) + areas.sum() * pose[:3, 3]
        for pose, points, areas in placed
    ]
    return np.sum(moved, axis=0) / sum(areas.sum() for *_, areas in placed)


def belly_measures(
    vertices: Floats, faces: Integers, first: Floats, last: Floats
) -> dict[str, float]:
    """Greatest section of a closed surface across the line between two points (3,): area [unit²],
    place, width.
    """
    length = float(np.linalg.norm(last - first))
    axis = (last - first) / length
    height = (vertices - first) @ axis
    places = height.min() + np.ptp(height) * (np.arange(STATIONS) + 0.5) / STATIONS
    # Segments of the isolines on the outward surface, in one direction.
    (a, b, c), (s, t), station = _crossed_edges(faces, height, places)
    one = vertices[a] + s[:, None] * (vertices[b] - vertices[a])
    other = vertices[a] + t[:, None] * (vertices[c] - vertices[a])
    below = (height[a] <= places[station])[:, None]
    start, end = np.where(below, other, one), np.where(below, one, other)
    areas = np.abs(
        np.bincount(station, 0.5 * np.cross(start - first, end - first) @ axis, STATIONS)
    )
    best = int(np.argmax(areas))
    area, place = areas[best], places[best]
    if 0 < best < STATIONS - 1:
        before, after = areas[best - 1], areas[best + 1]
        bend = before - 2.0 * area + after
        shift = 0.5 * (before - after) / bend if bend < 0.0 else 0.0
        place += shift * (places[1] - places[0])
        area -= 0.25 * (before - after) * shift
    thickness = _thickness(start[station == best], axis)
    return {
        "csa_max": float(area),
        "csa_place": float(place / length),
        "belly_thickness": thickness,
    }


def _thickness(points: Floats, axis: Floats) -> float:
    """Least width of a section's points over all directions across the axis."""
    u = unit(np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))]))
    v = np.cross(axis, u)
    angle = np.pi * np.arange(CALIPERS) / CALIPERS
    directions = np.cos(angle)[:, None] * u + np.sin(angle)[:, None] * v
    return float(np.ptp(points @ directions.T, axis=0).min())


def shortest_path(
    line: Floats,
    probes: list[BoneDistance],
    poses: dict[str, Floats],
    clearance: Floats,
    offset: Floats | None = None,
    via: Mapping[int, Floats] | None = None,
) -> tuple[Floats, bool]:
    """Nodes (`NODES`, 3) of the shortest path over the bones between the ends of a line, beside
    which it begins.

    ``line`` (n, 3) says which side of the bones the path takes; the bones have poses (4, 4) by
    name. Each node keeps its ``clearance`` (`NODES`,) [scene unit] from them. ``offset`` (`NODES`,
    3) leads from the points at even distances along the line to where the string begins: what it
    did in the frame before. Some nodes are held at places (3,), ``via`` by number. Only these and
    the ends where no bone is near. Also whether the path came to rest within `ROUNDS`.
    """
    via = dict(sorted((via or {}).items()))
    size = float(distance_along(line)[-1])
    widest = clearance.max()
    near = bones_about(np.vstack([line - widest, line + widest]), probes, poses)
    if not near:
        return np.array([line[0], *via.values(), line[-1]]), True
    string = resampled(line, NODES - 1) + (0.0 if offset is None else offset)
    held = np.isin(np.arange(len(string)), [0, len(string) - 1, *via])
    for node, place in via.items():
        string[node] = place
    earlier = [string]
    gap, normal = _planes(string, near, poses, TOUCHING * size)
    taken = string.copy()
    offsets = np.einsum("ij,ij->i", normal, string) - gap + clearance
    for _ in range(ROUNDS):
        string = string.copy()
        _tighten_loop(string, held, normal, offsets, SWEEPS, OVER_RELAXATION)
        # A node between two planes can go to and fro.
        if min(np.abs(string - other).max() for other in earlier) < STILL * size:
            return string, True
        earlier = [earlier[-1], string]
        renewed = np.abs(string - taken).max(axis=1) > RENEWED * np.abs(gap)
        gap[renewed], normal[renewed] = _planes(string[renewed], near, poses, TOUCHING * size)
        taken[renewed] = string[renewed]
        touching = np.einsum("ij,ij->i", normal, string) - gap
        offsets[renewed] = (touching + clearance)[renewed]
    return string, False


def _planes(
    points: Floats, probes: list[BoneDistance], poses: dict[str, Floats], least: float
) -> tuple[Floats, Floats]:
    """Signed distance (n,) to the nearest bone and the unit normal (n, 3) of the plane that touches
    it there.
    """
    gap, normal = np.full(len(points), np.inf), np.zeros((len(points), 3))
    for probe in probes:
        pose = poses[probe.name]
        local = to_local(points, pose)
        distance, closest, outward = probe.nearest(local)
        far = np.abs(distance) > least
        outward[far] = (local[far] - closest[far]) / distance[far, None]
        here = distance < gap
        gap[here], normal[here] = distance[here], outward[here] @ pose[:3, :3].T
    return gap, normal


@loop
def _tighten_loop(string, held, normal, offset, sweeps, relaxation):
    """Move nodes that are not held (n,) to where the squared segments are least with normal · node
    >= offset, by projected SOR.
    """
    for _ in range(sweeps):
        for n in range(1, len(string) - 1):
            if held[n]:
                continue
            along = -offset[n]
            for a in range(3):
                middle = 0.5 * (string[n - 1, a] + string[n + 1, a])
                string[n, a] += relaxation * (middle - string[n, a])
                along += normal[n, a] * string[n, a]
            if along < 0.0:
                for a in range(3):
                    string[n, a] -= along * normal[n, a]
