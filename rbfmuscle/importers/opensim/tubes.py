"""Muscles without meshes: tapered tubes along the paths of a model.

A tube has the volume of its fibres: maximum isometric force times optimal fibre length over the
specific tension. Its middle line is the model's path in its default pose, over its wrapping
objects, kept out of the bones.
"""

import itertools
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from rbfmuscle.geometry.arrays import to_world, unit
from rbfmuscle.geometry.exact_distance import ExactDistance
from rbfmuscle.geometry.lines import distance_along, line_length, points_along, tube_mesh
from rbfmuscle.geometry.surfaces import mesh_volume, unique_edges
from rbfmuscle.importers.opensim.elements import ModelMuscle, WrapShape
from rbfmuscle.validation import SceneError

ARC = 24  # points of a path on a shape
PLANES = 48  # planes through both points that are tried around a sphere or an ellipsoid

# Share of its radius above a shape at which a point counts as on it, and so as inside.
ON_SURFACE = 1e-6


def wrap_path(
    points: np.ndarray, wraps: list[tuple[WrapShape, np.ndarray]]
) -> tuple[np.ndarray, np.ndarray]:
    """A path (n, 3) with points between its own where it goes around shapes, and which of the
    result (m, 3) are its own, (n,).

    ``wraps`` are shapes and their frames (4, 4). Each goes on what the ones before made of the
    path.
    """
    pieces = list(itertools.pairwise(points))
    lines = [np.stack(piece) for piece in pieces]
    for wrap, frame in wraps:
        lines = [_wrap_line(wrap, frame, line) for line in lines]
    own = np.cumsum([0, *(len(line) - 1 for line in lines)])
    return np.concatenate([*(line[:-1] for line in lines), points[-1:]]), own


def _wrap_line(wrap, frame, line):
    """The line (n, 3) with the part between two points that meets the shape first drawn around
    it.
    """
    local = to_world(line, np.linalg.inv(frame))
    for k in range(len(local) - 1):
        arc = around_shape(wrap, local[k], local[k + 1])
        if len(arc):
            return np.concatenate([line[: k + 1], to_world(arc, frame), line[k + 1 :]])
    return line


def around_shape(wrap: WrapShape, start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Points (k, 3) on a shape, in its frame, over which the path between two points (3,) goes;
    none where it goes straight.

    As in OpenSim it goes straight where either point is inside, and where it misses the shape; a
    cylinder it misses only on the side of the quadrant, where there is one.
    """
    width = 2 if wrap.kind == "WrapCylinder" else 3
    ends = np.stack([start, end])
    scaled = ends[:, :width] / wrap.radii[:width]
    if (np.linalg.norm(scaled, axis=1) < 1.0 + ON_SURFACE).any():
        return np.empty((0, 3))
    axis = "xyz".find(wrap.quadrant[-1:] or "?")
    sign = -1.0 if wrap.quadrant.startswith("-") else 1.0
    sided = 0 <= axis < width
    # The point of the straight line that is nearest to the origin.
    along = scaled[1] - scaled[0]
    share = -(scaled[0] @ along) / max(float(along @ along), 1e-300)
    nearest = scaled[0] + np.clip(share, 0.0, 1.0) * along
    wrong_side = sided and width == 2 and sign * nearest[axis] < 0.0
    if np.linalg.norm(nearest) >= 1.0 and not wrong_side:
        return np.empty((0, 3))
    best, least = np.empty((0, 3)), np.inf
    for arc in _cylinder_arcs(wrap, ends) if width == 2 else _ellipsoid_arcs(wrap, ends):
        if sided and sign * arc[len(arc) // 2, axis] < 0.0:
            continue
        length = line_length(np.concatenate([ends[:1], arc, ends[1:]]))
        if length < least:
            best, least = arc, length
    return best


def _tangent_arcs(points, radius):
    """Both ways around a circle about the origin between two points (2, 2) outside it: places
    (ARC, 2) from one point of contact to the other.
    """
    angle = np.arctan2(points[:, 1], points[:, 0])
    open_ = np.arccos(np.clip(radius / np.linalg.norm(points, axis=1), -1.0, 1.0))
    for sense in (1.0, -1.0):
        first, last = angle[0] + sense * open_[0], angle[1] - sense * open_[1]
        turn = sense * ((sense * (last - first)) % (2.0 * np.pi))
        places = np.linspace(first, first + turn, ARC)
        yield radius * np.stack([np.cos(places), np.sin(places)], axis=1)


def _cylinder_arcs(wrap: WrapShape, ends: np.ndarray) -> Iterator[np.ndarray]:
    """Both helices, straight on the unrolled cylinder; those beyond its ends are none."""
    for arc in _tangent_arcs(ends[:, :2], wrap.radii[0]):
        flat = np.concatenate([ends[:1, :2], arc, ends[1:, :2]])
        along = np.cumsum(np.linalg.norm(np.diff(flat, axis=0), axis=1))
        height = ends[0, 2] + (ends[1, 2] - ends[0, 2]) * along[:-1] / along[-1]
        if np.abs(height).min() < wrap.radii[2]:
            yield np.column_stack([arc, height])


def _ellipsoid_arcs(wrap: WrapShape, ends: np.ndarray) -> Iterator[np.ndarray]:
    """Both ways around its section by each of some planes through both points.

    Where the radii are one, the plane section is a circle. The shortest of these is, but for the
    planes' number, the shortest on a sphere, and within a few thousandths of it on an ellipsoid.
    """
    points = ends / wrap.radii
    chord = unit(points[1] - points[0])
    first = unit(np.cross(chord, np.eye(3)[np.argmin(np.abs(chord))]))
    second = np.cross(chord, first)
    # The plane through the centre is the shortest on a sphere, so it is among them.
    away = points[0] - (points[0] @ chord) * chord
    middle = np.arctan2(away @ second, away @ first)
    for turn in middle + np.pi * np.arange(PLANES) / PLANES:
        up = np.cos(turn) * first + np.sin(turn) * second
        normal = np.cross(chord, up)
        centre = (points[0] @ normal) * normal
        squared = 1.0 - float(centre @ centre)
        if squared <= 0.0:
            continue
        axes = np.stack([chord, up])
        for arc in _tangent_arcs((points - centre) @ axes.T, np.sqrt(squared)):
            yield (centre + arc @ axes) * wrap.radii


# Sections along a tube and vertices of each; radius at the ends against the middle; share of the
# length held at an end.
SECTIONS = 40
SIDES = 16
END_RADIUS = 0.3
HELD = 0.06
# Of bones that a tube lies on: the gap left [m], the depth to which its vertices are brought out
# [m], and how often, as what leaves one bone may enter another.
MARGIN = 5e-4
FLATTENED = 0.03
FLATTENINGS = 8
# Rounds in which the radius is fitted to the volume, at most, and the share of it left open.
FITTINGS = 12
FITTED = 1e-5
MOST_MISSED = 0.1  # share of the volume that a tube beside bones may miss
# A tube is smooth: fewer centres fit it as well, its own vertices meet the bones, and as its shape
# is none that was measured, half the usual nodes are enough.
TUBE_MODEL = {"name": "rbf", "centres": 100, "samples": SECTIONS * SIDES + 2, "nodes": 150}
ROUNDS = 60  # rounds in which the middle line is put out of bones in its way


@dataclass
class Tube:
    """A tube: vertices [metre], triangles, the vertices that bones hold at both ends and those that
    bones hold on its way, by what share its volume misses the muscle's, and the bones that its
    path crosses, where it could not be kept out of them.
    """

    vertices: np.ndarray
    faces: np.ndarray
    held: dict[str, np.ndarray]
    via: dict[str, np.ndarray]
    volume_error: float
    crossed: list[str]


def make_tube(
    muscle: ModelMuscle,
    places: dict[str, np.ndarray],
    bones: dict[str, ExactDistance],
    attachment_frames: dict[str, str],
) -> Tube:
    """The tube of a muscle in the scene, or SceneError where no two bodies with a mesh hold it.

    ``places`` are (4, 4) from every body of the model to the scene [metre], ``bones`` their meshes,
    ``attachment_frames`` the body that holds what is fixed to each.
    """
    bodies = [attachment_frames[body] for body, _ in muscle.points]
    if muscle.volume <= 0.0:
        raise SceneError("it has no volume; give it a force and a fibre length above zero")
    if len(set(bodies[:1] + bodies[-1:])) < 2:
        raise SceneError("its path does not go from one moving body to another")
    for body in (bodies[0], bodies[-1]):
        if body not in bones:
            raise SceneError(f"body {body!r} has no mesh to hold it; give it one")
    points = np.array(
        [places[body][:3, :3] @ at + places[body][:3, 3] for body, at in muscle.points]
    )
    wraps = [(wrap, places[wrap.body] @ wrap.frame) for wrap in muscle.wraps]
    path, own = wrap_path(points, wraps)
    along = distance_along(path)
    line = points_along(path, np.linspace(0.0, along[-1], SECTIONS))
    # The path's points in the line.
    fixed = np.rint(along[own] / max(along[-1], 1e-300) * (SECTIONS - 1)).astype(int)
    length = line_length(line)
    share = END_RADIUS + (1.0 - END_RADIUS) * np.sin(np.pi * np.linspace(0.0, 1.0, len(line)))
    radius = share * np.sqrt(muscle.volume / (np.pi * length * np.mean(share**2)))
    held, via = _held(bodies, fixed, bones)
    vertices, faces, missed = _fitted(line, fixed, radius, list(bones.values()), muscle.volume)
    crossed: list[str] = []
    if missed > MOST_MISSED:
        vertices, faces, missed = _fitted(line, fixed, radius, [], muscle.volume)
        crossed = [name for name, bone in bones.items() if (bone.signed_distance(line) < 0.0).any()]
    if missed > MOST_MISSED:
        raise SceneError(
            "its path turns too sharply for a tube of its volume; give it a mesh, or fewer points"
        )
    return Tube(vertices, faces, held, via, missed, crossed)


def _fitted(line, fixed, radius, bones, target):
    """Vertices and faces of a tube of a volume about a line, beside bones, and by what share its
    volume misses; inf where there is no such tube.
    """
    line = _clear_line(line, fixed, radius, bones)
    reach = FLATTENED + 2.0 * float(radius.max())
    low, high = line.min(axis=0) - reach, line.max(axis=0) + reach
    near = [
        bone
        for bone in bones
        if (bone.vertices.min(axis=0) < high).all() and (bone.vertices.max(axis=0) > low).all()
    ]
    for _ in range(FITTINGS):
        vertices, faces = tube_mesh(line, radius, SIDES)
        vertices = _beside_bones(vertices, faces, near)
        volume = mesh_volume(vertices, faces)
        # Where a line passes through a bone, what comes out of it on both sides is no tube.
        if not volume > 0.0:
            return vertices, faces, np.inf
        # As its square, but for where sections run into each other or lie flat on a bone.
        ratio = float(np.sqrt(target / volume))
        if abs(ratio - 1.0) < FITTED:
            break
        radius = radius * ratio
    return vertices, faces, abs(volume / target - 1.0)


def _clear_line(line, fixed, radius, bones):
    """The line rounded at its points, and moved out of bones by its radius, smoothly."""
    line = line.copy()
    bends = fixed[(fixed > 0) & (fixed < len(line) - 1)]
    line[bends] = 0.25 * (line[bends - 1] + 2.0 * line[bends] + line[bends + 1])
    shift = np.zeros_like(line)
    for number in range(ROUNDS):
        shift[1:-1] = 0.25 * (shift[:-2] + 2.0 * shift[1:-1] + shift[2:])
        shift[fixed] *= 0.5
        if number % 10 == 9:
            for bone in bones:
                points = line + shift
                reach = 0.8 * radius
                # No nearer to the bone than that; what is deeper in it is left where it is.
                distance, closest, *_ = bone.nearest(points, reach=float(reach.max()))
                away = (points - closest) / np.where(distance == 0.0, 1.0, distance)[:, None]
                shift = (
                    np.where((distance < reach)[:, None], closest + away * reach[:, None], points)
                    - line
                )
    return line + shift


def _beside_bones(vertices, faces, bones):
    """A tube's vertices (n, 3), out of all bones by `MARGIN` where they are no deeper than
    `FLATTENED`: there the tube lies flat on them, and is smooth beside.
    """
    edges = unique_edges(faces)
    count = np.bincount(edges.ravel(), minlength=len(vertices))
    shift = np.zeros_like(vertices)
    for number in range(FLATTENINGS):
        beside = np.zeros_like(shift)
        np.add.at(beside, edges[:, 0], shift[edges[:, 1]])
        np.add.at(beside, edges[:, 1], shift[edges[:, 0]])
        if number < FLATTENINGS - 1:  # in the last round what is out stays out
            shift = 0.5 * (shift + beside / count[:, None])
        points = vertices + shift
        for bone in bones:
            # What is in a bone, but not deep in it, is moved to `MARGIN` before it.
            distance, closest, *_ = bone.nearest(points, reach=FLATTENED)
            inside = (distance < MARGIN) & (distance > -FLATTENED)
            away = (points - closest) / np.where(distance == 0.0, 1.0, distance)[:, None]
            points = np.where(inside[:, None], closest + MARGIN * away, points)
        if number >= FLATTENINGS // 2:  # coarse faces cut across what is between their corners
            points = points + _pressed_in(points, faces, bones)
        shift = points - vertices
    return vertices + shift


def _pressed_in(vertices, faces, bones):
    """Shifts (n, 3) of a tube's vertices that take its faces off vertices of bones inside it, no
    deeper than `FLATTENED`.
    """
    surface = ExactDistance(vertices, faces)
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    shift = np.zeros_like(vertices)
    size = np.zeros(len(vertices))
    for bone in bones:
        inside = bone.vertices[((bone.vertices > low) & (bone.vertices < high)).all(axis=1)]
        distance, closest, face, _ = surface.nearest(inside, reach=FLATTENED)
        deep = np.flatnonzero((distance < 0.0) & (face >= 0))
        for k in deep[np.argsort(-distance[deep])]:  # the deepest decides
            corners = faces[face[k]]
            way = inside[k] - closest[k]
            further = corners[-distance[k] > size[corners]]
            shift[further], size[further] = way, -distance[k]
    return shift


def _held(bodies, fixed, bones):
    """Vertices by bone: those of the sections at both ends, and those that bones hold on the way.

    On the way are what lies between an end and the points that follow it on its body, and a section
    at each other point.
    """
    few = max(1, round(HELD * SECTIONS))
    ends = {bodies[0]: range(few + 1), bodies[-1]: range(SECTIONS - 1 - few, SECTIONS)}
    first = next(k for k, body in enumerate(bodies) if body != bodies[0])
    last = len(bodies) - next(k for k, body in enumerate(reversed(bodies)) if body != bodies[-1])
    start = min(fixed[first - 1], SECTIONS // 3)
    end = max(fixed[last], SECTIONS - 1 - SECTIONS // 3)
    passed = {bodies[0]: list(range(few + 1, start + 1))}
    passed.setdefault(bodies[-1], []).extend(range(end, SECTIONS - 1 - few))
    for body, place in zip(bodies[first:last], fixed[first:last].tolist()):
        if body in bones and max(few, start) < place < min(SECTIONS - 1 - few, end):
            passed.setdefault(body, []).append(place)
    tips = {bodies[0]: [SECTIONS * SIDES], bodies[-1]: [SECTIONS * SIDES + 1]}
    held = {body: np.append(_rings(sections), tips[body]) for body, sections in ends.items()}
    return held, {body: np.unique(_rings(some)) for body, some in passed.items() if some}


def _rings(sections):
    """Vertices of sections."""
    return np.concatenate([np.arange(k * SIDES, (k + 1) * SIDES) for k in sections])
