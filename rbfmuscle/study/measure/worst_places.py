"""The places where a fitted surface errs most, with what the mesh is like there: the cause and what would mend it."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from rbfmuscle.geometry.arrays import Floats, Integers

# Places that are named, and how far apart they are, in spacings of the centres.
PLACES, APART = 5, 1.5
# A sheet this much thinner than the spacing is too thin for it; a bend of so many spacings as radius too sharp.
THIN, SHARP = 1.0, 0.75
# Cells that a rim must be thick for the grid to show it.
CELLS = 2.0


def worst_places(
    points: Floats,
    normals: Floats,
    distance: Floats,
    mesh: tuple[Floats, Integers],
    centres: Floats,
    *,
    cell: float,
) -> list[dict[str, Any]]:
    """The largest distances, one a neighbourhood, each with its cause.

    Parameters
    ----------
    points, normals : (n, 3) ndarray
        Of the mesh, spread over it, and its unit normals there.
    distance : (n,) ndarray
        From the fitted surface [length].
    mesh : (vertices, faces)
    centres : (K, 3) ndarray
    cell : float
        Of the grid that showed the surface [length].

    Returns
    -------
    list of dict
        ``point, distance, thickness, gap, radius, spacing`` [length] and ``cause, remedy``, the worst first.
    """
    tree, others = cKDTree(centres), cKDTree(points)
    near = tree.query(centres, k=min(5, len(centres)))[0][:, 1:].mean(axis=1)
    left, found = np.array(distance, dtype=float), []
    for _ in range(PLACES):
        at = int(np.argmax(left))
        if left[at] <= 0.0:
            break
        point, spacing = points[at], float(near[tree.query(points[at])[1]])
        place = {
            "point": point.tolist(), "distance": float(distance[at]), "spacing": spacing,
            "thickness": _across(point, -normals[at], mesh), "gap": _across(point, normals[at], mesh),
            "radius": _radius(at, points, normals, others, 0.5 * spacing),
        }  # fmt: skip
        place["cause"], place["remedy"] = _cause(place, cell, len(centres))
        found.append(place)
        left[others.query_ball_point(point, APART * spacing)] = 0.0
    return found


def _cause(place: dict[str, Any], cell: float, count: int) -> tuple[str, str]:
    """What is too small for what, and how many cells or centres would do."""
    h, thickness, gap, radius = (place[name] for name in ("spacing", "thickness", "gap", "radius"))
    if thickness is not None and thickness < CELLS * cell:
        return (
            f"grid: {thickness:.2g} thick, cells of {cell:.2g}",
            f"cells of {thickness / CELLS:.2g} or smaller",
        )
    if thickness is not None and thickness < THIN * h:
        more = int(round(count * min((h / thickness) ** 2, 16.0), -1))
        return (
            f"rim: {thickness:.2g} thick, centres {h:.2g} apart",
            f"centres {thickness:.2g} apart there ({more} evenly)",
        )
    if gap is not None and gap < THIN * h:
        return f"fold: {gap:.2g} wide, centres {h:.2g} apart", f"centres {gap:.2g} apart there"
    if radius is not None and radius < SHARP * h:
        more = int(round(count * min((SHARP * h / radius) ** 2, 16.0), -1))
        return (
            f"bend: radius {radius:.2g}, centres {h:.2g} apart",
            f"centres {radius:.2g} apart there ({more} evenly)",
        )
    return f"between centres {h:.2g} apart", f"{int(round(2 * count, -1))} centres err about a third as much"


def _across(point: Floats, direction: Floats, mesh: tuple[Floats, Integers]) -> float | None:
    """How far a ray from the surface goes until it meets the mesh again; None where it does not (Moeller, Trumbore)."""
    vertices, faces = mesh
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    first, second = b - a, c - a
    cross = np.cross(direction, second)
    size = np.einsum("ij,ij->i", first, cross)
    safe = np.where(np.abs(size) > 1e-300, size, np.inf)
    offset = point - a
    u = np.einsum("ij,ij->i", offset, cross) / safe
    turned = np.cross(offset, first)
    v = turned @ direction / safe
    t = np.einsum("ij,ij->i", second, turned) / safe
    least = 1e-6 * np.ptp(vertices, axis=0).max()
    hit = (u >= 0) & (v >= 0) & (u + v <= 1) & (t > least) & np.isfinite(safe)
    return float(t[hit].min()) if hit.any() else None


def _radius(at: int, points: Floats, normals: Floats, tree: Any, reach: float) -> float | None:
    """Radius of the sharpest bend within reach: distance over the turn of the normal; None where all is flat."""
    near = [k for k in tree.query_ball_point(points[at], reach) if k != at]
    if not near:
        return None
    offset, turn = np.linalg.norm(points[near] - points[at], axis=1), normals[near] @ normals[at]
    angle = np.arccos(np.clip(turn, -1.0, 1.0))
    far = offset > 0.3 * reach  # facets that meet turn at once
    return float((offset[far] / np.maximum(angle[far], 1e-6)).min()) if far.any() else None
