"""Greatest section of a muscle across its line of action."""

import numpy as np

from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.metrics.centreline import isolines

STATIONS = 48  # sections along the line of action
CALIPERS = 36  # directions in which a section's width is taken


def belly_measures(vertices: Floats, faces: Integers, first: Floats, last: Floats) -> dict[str, float]:
    """Greatest section of a closed surface across the line between two points (3,), where it lies, and how thick it is.

    ``csa_max`` [unit²], ``csa_place`` (0 at ``first``, 1 at ``last``), and ``belly_thickness``, the least width of that
    section.
    """
    length = float(np.linalg.norm(last - first))
    axis = (last - first) / length
    height = (vertices - first) @ axis
    places = height.min() + np.ptp(height) * (np.arange(STATIONS) + 0.5) / STATIONS
    start, end, station = isolines(vertices, faces, height, places)
    areas = np.abs(np.bincount(station, 0.5 * np.cross(start - first, end - first) @ axis, STATIONS))
    best = int(np.argmax(areas))
    area, place = areas[best], places[best]
    if 0 < best < STATIONS - 1:
        before, after = areas[best - 1], areas[best + 1]
        bend = before - 2.0 * area + after
        shift = 0.5 * (before - after) / bend if bend < 0.0 else 0.0
        place += shift * (places[1] - places[0])
        area -= 0.25 * (before - after) * shift
    return {
        "csa_max": float(area),
        "csa_place": float(place / length),
        "belly_thickness": _thickness(start[station == best], axis),
    }


def _thickness(points: Floats, axis: Floats) -> float:
    """Least width of a section's points over all directions across the axis."""
    helper = np.eye(3)[np.argmin(np.abs(axis))]
    u = np.cross(axis, helper)
    u /= np.linalg.norm(u)
    v = np.cross(axis, u)
    angle = np.pi * np.arange(CALIPERS) / CALIPERS
    directions = np.cos(angle)[:, None] * u + np.sin(angle)[:, None] * v
    return float(np.ptp(points @ directions.T, axis=0).min())
