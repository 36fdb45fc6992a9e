"""Polygons of any number of corners cut into triangles, concave ones by ears."""

import numpy as np

from rbfmuscle.geometry.arrays import Booleans, Floats, Integers
from rbfmuscle.geometry.vectors import unit

# Sine of a corner's turn below which the corner counts as straight.
STRAIGHT = 1e-9


def cut_polygons(vertices: Floats, ends: Integers, numbers: Integers) -> tuple[Integers, list[str]]:
    """Return the triangles of polygons in their order, by the places (m, 3) of their corners in
    ``numbers``, and notes of what was left out.

    ``numbers`` are the vertices of all polygons, one after the other; those of polygon k are
    ``numbers[ends[k] : ends[k + 1]]``. Every corner is kept, on straight sides too, so that
    neighbours still fit.
    """
    ends, kept = _without_repeats(ends, numbers)
    sizes = np.diff(ends)
    notes = []
    if (sizes < 3).any():
        few = int((sizes < 3).sum())
        notes.append(f"{few} polygons of fewer than three corners left out")
    triangles = np.empty((int(np.maximum(sizes - 2, 0).sum()), 3), dtype=np.int64)
    place = np.concatenate([[0], np.cumsum(np.maximum(sizes - 2, 0))])
    crossed = 0
    for size in np.unique(sizes[sizes >= 3]):
        chosen = np.flatnonzero(sizes == size)
        corners = kept[ends[chosen][:, None] + np.arange(size)]
        first = np.repeat(corners[:, :1], size - 2, axis=1)
        fan = np.stack([first, corners[:, 1:-1], corners[:, 2:]], axis=2)
        if size > 3:
            points = vertices[numbers[corners]]
            for k in np.flatnonzero(~_convex(points)):
                ears = _ears(points[k])
                crossed += ears is None
                fan[k] = fan[k] if ears is None else corners[k][ears]
        triangles[place[chosen][:, None] + np.arange(size - 2)] = fan
    if crossed:
        notes.append(f"{crossed} polygons cross themselves: their triangles are a guess")
    return triangles, notes


def _without_repeats(ends: Integers, numbers: Integers) -> tuple[Integers, Integers]:
    """Ends and places in ``numbers`` of the corners, of polygons of more than three without those
    that repeat the one before.
    """
    sizes = np.diff(ends)
    before = np.arange(len(numbers)) - 1
    full = sizes > 0
    before[ends[:-1][full]] = ends[1:][full] - 1
    again = (numbers == numbers[before]) & np.repeat(sizes > 3, sizes)
    if not again.any():
        return ends, np.arange(len(numbers))
    dropped = np.concatenate([[0], np.cumsum(again)])
    return ends - dropped[ends], np.flatnonzero(~again)


def _normals(points):
    """Area vectors (k, 3) of polygons (k, n, 3) [unit^2], by Newell's sum."""
    offset = points - points[:, :1]
    return 0.5 * np.cross(offset[:, 1:-1], offset[:, 2:]).sum(axis=1)


def _convex(points: Floats) -> Booleans:
    """Which polygons (k, n, 3) turn the same way at every corner, and once around."""
    normal = unit(_normals(points))
    before = points - np.roll(points, 1, axis=1)
    after = np.roll(before, -1, axis=1)
    sine = np.einsum("knj,kj->kn", np.cross(before, after), normal)
    cosine = np.einsum("knj,knj->kn", before, after)
    once = np.arctan2(sine, cosine).sum(axis=1) < 3 * np.pi  # a star turns twice around
    scale = np.linalg.norm(before, axis=2) * np.linalg.norm(after, axis=2)
    return (sine > STRAIGHT * scale).all(axis=1) & once


def _ears(points: Floats) -> Integers | None:
    """Triangles (n - 2, 3) of one polygon (n, 3) as numbers of its corners, those of the best shape
    first; None where it crosses itself or has no area.
    """
    from vtkmodules.vtkCommonCore import vtkIdList
    from vtkmodules.vtkCommonDataModel import vtkPolygon

    if not np.isfinite(points).all():
        return None
    polygon, ears = vtkPolygon(), vtkIdList()
    polygon.GetPointIds().SetNumberOfIds(len(points))
    polygon.GetPoints().SetNumberOfPoints(len(points))
    for k, point in enumerate(points - points.mean(axis=0)):
        polygon.GetPointIds().SetId(k, k)
        polygon.GetPoints().SetPoint(k, *point)
    done = polygon.TriangulateLocalIds(0, ears)
    found = np.array([ears.GetId(k) for k in range(ears.GetNumberOfIds())], dtype=np.int64)
    return found.reshape(-1, 3) if done and len(found) == 3 * (len(points) - 2) else None
