"""Paths around wrapping shapes: the shortest line over a cylinder, sphere or ellipsoid between two
points, on the side that its quadrant asks for.
"""

import itertools
from collections.abc import Iterator

import numpy as np

from rbfmuscle.geometry.lines import line_length
from rbfmuscle.geometry.vectors import to_world, unit
from rbfmuscle.importers.opensim.model import WrapShape

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
    nearest = _nearest_to_origin(scaled)
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


def _nearest_to_origin(points):
    """The point nearest to the origin of the straight line between two points (2, k)."""
    along = points[1] - points[0]
    share = -(points[0] @ along) / max(float(along @ along), 1e-300)
    return points[0] + np.clip(share, 0.0, 1.0) * along


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
