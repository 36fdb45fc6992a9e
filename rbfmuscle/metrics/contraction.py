"""What is measured of muscles that contract: fibres of the scene, thickness and greatest section."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RBFInterpolator
from scipy.spatial import cKDTree

from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.metrics.centreline import MuscleAtRest, carried_middle, end_groups, isolines, resampled
from rbfmuscle.scene.activation.resolve import resolve_contraction

SEGMENTS = 16  # of each fibre
STATIONS = 48  # sections along the line of action
CARRIERS = 600  # vertices of the carried mesh that carry the fibres
CALIPERS = 36  # directions in which a section's width is taken


class ContractionStudy:
    """Measures one muscle that contracts, frame by frame, whatever model moves it.

    Parameters
    ----------
    rest : MuscleAtRest
        Its muscle has keys of contraction. Fibres are followed where the scene gives them; without any there is
        nothing of them is measured.
    """

    def __init__(self, rest: MuscleAtRest) -> None:
        muscle, vertices = rest.muscle, rest.vertices
        self.name = muscle.name
        self.ends = end_groups(muscle, rest.joints, rest.moving)
        self.weights = None
        if not muscle.fibres:
            return
        lines = np.array([resampled(np.asarray(line, dtype=float), SEGMENTS) for line in muscle.fibres])
        self.shape = lines.shape
        self.carriers = np.unique(np.linspace(0, len(vertices) - 1, CARRIERS).astype(int))
        # Cubic radial functions with a linear polynomial reproduce every affine motion of the vertices.
        units = np.eye(len(self.carriers))
        carried = RBFInterpolator(vertices[self.carriers], units, kernel="cubic", degree=1)
        self.weights = carried(lines.reshape(-1, 3))
        nearest = cKDTree(np.asarray(muscle.mesh.vertices, dtype=float)).query(lines)[1]
        tendon = resolve_contraction(muscle).tendon[nearest]
        # A segment is belly where neither end is tendon; a line of tendon alone counts for nothing.
        self.belly = ~(tendon[:, 1:] | tendon[:, :-1])
        self.rest_lengths = _segments(self.lines(vertices))

    def lines(self, vertices: NDArray[np.float64]) -> NDArray[np.float64]:
        """The fibres (n, k, 3) that a carried mesh with these vertices holds; there must be some."""
        middle = vertices.mean(axis=0)
        return (self.weights @ (vertices[self.carriers] - middle) + middle).reshape(self.shape)

    def measure(self, vertices: Floats, poses: dict[str, Any], surface: Any = None) -> dict[str, float]:
        """Quantities of a frame.

        Parameters
        ----------
        vertices : (n, 3) ndarray
            The carried mesh.
        poses : dict of str to (4, 4) ndarray
        surface : ModelSurface, optional
            Sections are of this surface; without one there are none.

        Returns
        -------
        dict of str to float
            Lengths in scene units, ``pennation`` in degrees, ``csa_place`` as a share of the line of action.
        """
        first, last = (carried_middle(end, poses) for end in self.ends)
        found = {}
        if self.weights is not None:
            lines = self.lines(vertices)
            lengths = _segments(lines)
            counted = self.belly.any(axis=1)
            found = {
                "fibre_length": float((lengths * self.belly).sum(axis=1)[counted].mean()),
                "fibre_stretch": float((lengths / self.rest_lengths)[self.belly].mean()),
                "pennation": pennation(lines, self.belly, (last - first) / np.linalg.norm(last - first)),
            }
        if surface is not None:
            found.update(belly_measures(surface.vertices, np.asarray(surface.faces), first, last))
        return found


def pennation(lines: Any, counted: Any, axis: Any) -> float:
    """Mean angle [degree] between the segments (n, k) of lines (n, k + 1, 3) that count and an axis (3,)."""
    along = np.diff(lines, axis=1)[counted]
    cosine = np.abs(along @ axis) / np.linalg.norm(along, axis=1)
    return float(np.degrees(np.arccos(np.clip(cosine, 0.0, 1.0))).mean())


def belly_measures(vertices: Floats, faces: Integers, first: Floats, last: Floats) -> dict[str, float]:
    """Greatest section of a closed surface across a line, where it lies, and how thick it is.

    Parameters
    ----------
    vertices, faces : (n, 3) and (m, 3) ndarray
    first, last : (3,) ndarray
        Ends of the line of action.

    Returns
    -------
    dict
        ``csa_max`` [unit²], ``csa_place`` (0 at ``first``, 1 at ``last``), ``belly_thickness``: the least width of
        that section.
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


def _thickness(points, axis):
    """Least width of a section's points over all directions across the axis."""
    helper = np.eye(3)[np.argmin(np.abs(axis))]
    u = np.cross(axis, helper)
    u /= np.linalg.norm(u)
    v = np.cross(axis, u)
    angle = np.pi * np.arange(CALIPERS) / CALIPERS
    directions = np.cos(angle)[:, None] * u + np.sin(angle)[:, None] * v
    return float(np.ptp(points @ directions.T, axis=0).min())


def _segments(lines):
    return np.linalg.norm(np.diff(lines, axis=1), axis=2)
