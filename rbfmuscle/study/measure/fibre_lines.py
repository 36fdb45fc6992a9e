"""Fibres of a muscle at rest: streamlines of its harmonic field, each with the same share of the flux."""

from __future__ import annotations

import warnings

import numpy as np
from scipy.spatial import cKDTree

from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.study.measure.fibre_field import FibreField, attachment_points
from rbfmuscle.validation import NumericalWarning, SolveError

# A step of a streamline, how deep it is kept below the surface, and where it has arrived, in cells.
_STEP, _SKIN, _ARRIVED = 0.5, 0.3, 1.2
# A streamline that is longer than this many diagonals of the muscle has lost its way.
_LONGEST = 4.0
_ROUNDS = 12


def grow_fibres(
    vertices: Floats, faces: Integers, ends: list[Integers], *, count: int = 100, segments: int = 15
) -> Floats:
    """Fibres of a muscle at rest.

    They start at points spread evenly over the larger attachment, through which the flux is even, so that
    each stands for the same share of the muscle.

    Parameters
    ----------
    vertices, faces : (n, 3) and (m, 3) ndarray
        The input mesh: closed, outward [scene unit].
    ends : pair of (k,) ndarray of int
        Attached vertices of the origin and of the insertion.
    count : int
        Number of fibres.
    segments : int
        Segments of each, equally long at rest.

    Returns
    -------
    (count, segments + 1, 3) ndarray
        Each from a point of the origin to a point of the insertion. Fewer, with a NumericalWarning, where
        streamlines end before the other attachment.

    Raises
    ------
    SolveError
        If the inside of the mesh does not lead from one attachment to the other.
    """
    vertices = np.asarray(vertices, dtype=np.float64)
    edge = np.median(np.linalg.norm(vertices[faces[:, 0]] - vertices[faces[:, 1]], axis=1))
    sides = [attachment_points(vertices, faces, np.asarray(end), 0.5 * edge) for end in ends]
    field = FibreField(vertices, faces, sides)
    wide = int(sides[1][1].sum() > sides[0][1].sum())
    seeds = spread(sides[wide][0], count)
    longest = _LONGEST * float(np.linalg.norm(np.ptp(vertices, axis=0)))
    lines = _trace(field, seeds, 1.0 - 2.0 * wide, sides[1 - wide][0], longest)
    if len(lines) < 0.5 * count:
        raise SolveError(f"{count - len(lines)} of {count} fibres do not reach the other attachment")
    if len(lines) < count:
        message = f"{count - len(lines)} of {count} fibres do not reach the other attachment and are left out"
        warnings.warn(message, NumericalWarning, stacklevel=2)
    return np.array([resampled(line[::-1] if wide else line, segments) for line in lines])


def spread(points: Floats, count: int) -> Floats:
    """Choose ``count`` of the points, spread evenly: the farthest first, then moved to their cells' means.

    Parameters
    ----------
    points : (n, 3) ndarray
    count : int

    Returns
    -------
    (count, 3) ndarray
        Of the points; some repeat where there are fewer points than asked for.
    """
    chosen = [int(np.argmin(np.linalg.norm(points - points.mean(axis=0), axis=1)))]
    away = np.full(len(points), np.inf)
    while len(chosen) < count:
        away = np.minimum(away, ((points - points[chosen[-1]]) ** 2).sum(axis=1))
        chosen.append(int(np.argmax(away)))
    tree, seeds = cKDTree(points), points[chosen]
    for _ in range(_ROUNDS):
        owner = cKDTree(seeds).query(points)[1]
        size = np.bincount(owner, minlength=count)
        for k in range(3):
            mean = np.bincount(owner, weights=points[:, k], minlength=count) / np.maximum(size, 1)
            seeds[:, k] = np.where(size > 0, mean, seeds[:, k])
        seeds = points[tree.query(seeds)[1]]
    return seeds


def resampled(line: Floats, segments: int) -> Floats:
    """A polyline's points at ``segments + 1`` equal distances along it."""
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    even = np.linspace(0.0, along[-1], segments + 1)
    return np.stack([np.interp(even, along, line[:, k]) for k in range(3)], axis=1)


def _trace(field, seeds, sign, goal, longest):
    """Streamlines from the seeds, up (1) or down (-1) the field, that arrive at the attachment ``goal``."""
    tree = cKDTree(goal)
    step = _STEP * field.spacing
    here = seeds - (field.depth(seeds) + field.spacing)[:, None] * field.outward(seeds)
    going, arrived = np.ones(len(seeds), dtype=bool), np.zeros(len(seeds), dtype=bool)
    lines = [[seed, first] for seed, first in zip(seeds, here.copy())]
    for _ in range(int(longest / step)):
        moving = np.flatnonzero(going)
        if not len(moving):
            break
        now = here[moving]
        middle = now + 0.5 * step * sign * _direction(field, now)
        after = now + step * sign * _direction(field, middle)
        after = _kept_inside(field, after, tree)
        here[moving] = after
        for line, point in zip(moving, after):
            lines[line].append(point)
        arrived[moving] = tree.query(after)[0] < _ARRIVED * field.spacing
        stuck = np.linalg.norm(after - now, axis=1) < 1e-3 * step
        going[moving[arrived[moving] | stuck]] = False
    ends = goal[tree.query(here)[1]]
    return [np.vstack([*lines[k], ends[k]]) for k in np.flatnonzero(arrived)]


def _direction(field, points):
    way = field.gradient(points)
    return way / np.maximum(np.linalg.norm(way, axis=1, keepdims=True), 1e-300)


def _kept_inside(field, points, tree):
    """Points that came too near the surface are put back below it, except at the attachment they go to."""
    excess = field.depth(points) + _SKIN * field.spacing
    excess[tree.query(points)[0] < 2.0 * field.spacing] = 0.0
    return points - np.maximum(excess, 0.0)[:, None] * field.outward(points)
