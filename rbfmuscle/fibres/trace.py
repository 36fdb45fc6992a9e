"""Fibres of a muscle at rest: lines from its origin to its insertion along a flux."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from rbfmuscle.fibres.flux import FluxField
from rbfmuscle.geometry.arrays import Booleans, Floats, Integers
from rbfmuscle.geometry.mesh_distance import MeshDistance
from rbfmuscle.geometry.tubes import distance_along, points_along
from rbfmuscle.geometry.vectors import box_size, unit
from rbfmuscle.scene.bone import BoneDistance

POINTS = 25  # of a fibre, at even distances along it
STEP = 0.5  # of a line that is traced, in cells
LONGEST = 6.0  # of a line, in diagonals of the muscle's box
SPARE = 1.5  # lines traced for each one wanted, as some do not reach both ends
ROUNDS = 4  # in which points are moved into the muscle and out of bones
DEPTH = 0.05  # of points inside the surface, in cells


class Traced(NamedTuple):
    """Fibres at rest: lines (n, `POINTS`, 3) from origin to insertion, and of both ends of each the
    number (n, 2) of the point of the patches that it ends on.
    """

    lines: Floats
    ends: Integers


def trace_fibres(
    mesh: MeshDistance,
    ends: tuple[Floats, Floats],
    count: int,
    *,
    polylines: Sequence[Floats] | None = None,
    bones: Sequence[BoneDistance] = (),
) -> Traced:
    """Lines from origin to insertion along the flux between them, evenly by volume.

    Parameters
    ----------
    mesh : MeshDistance
        The muscle at rest, in which all lines lie.
    ends : pair of (k, 3) ndarray
        Points evenly over the patches of the origin and of the insertion, on which lines end.
    count : int
        Of the lines; fewer come out where some do not reach both ends.
    polylines : sequence of (k, 3) ndarray, optional
        That the lines follow.
    bones : sequence of BoneDistance
        At rest, of which all inner points of the lines stay out.

    Returns
    -------
    Traced

    Raises
    ------
    numpy.linalg.LinAlgError
        If the flux cannot be had, see `FluxField`, or no line reaches both ends.
    """
    flux = FluxField(mesh, ends, polylines)
    seeds = even_seeds(mesh, int(np.ceil(SPARE * count)))
    tracer = _Tracer(mesh, flux, ends)
    back, origin = tracer.trace(seeds, -1)
    ahead, insertion = tracer.trace(seeds, 1)
    whole = np.flatnonzero((origin >= 0) & (insertion >= 0))[:count]
    lines = [np.concatenate([back[k][::-1], ahead[k][1:]]) for k in whole]
    if not lines:
        raise np.linalg.LinAlgError("no line reaches from the origin to the insertion")
    even = _kept_inside(np.array([_even(line) for line in lines]), mesh, bones, DEPTH * flux.side)
    return Traced(even, np.stack([origin[whole], insertion[whole]], axis=1))


def even_seeds(mesh: MeshDistance, count: int) -> Floats:
    """So many points (count, 3) spread evenly over the volume of a closed mesh.

    Of an additive recurrence of the root of x⁴ = x + 1 in the mesh's box, those inside: it fills
    volume, and any section through it, more evenly than random points do (Roberts 2018).
    """
    root = 1.2207440846057596
    step = root ** -np.arange(1.0, 4.0)
    low = mesh.vertices.min(axis=0)
    extent = np.ptp(mesh.vertices, axis=0)
    found = np.empty((0, 3))
    first = 0
    while len(found) < count:
        number = np.arange(first, first + 4 * count)
        points = low + extent * ((0.5 + number[:, None] * step) % 1.0)
        found = np.concatenate([found, points[mesh.inside(points)]])
        first += 4 * count
    return found[:count]


class _Tracer:
    """Follows a flux from seeds to the patches at its ends."""

    def __init__(self, mesh: MeshDistance, flux: FluxField, ends: tuple[Floats, Floats]) -> None:
        from scipy.spatial import cKDTree

        self.mesh = mesh
        self.flux = flux
        self.ends = [cKDTree(end) for end in ends]
        self.step = STEP * flux.side
        size = box_size(mesh.vertices)
        self.most = int(LONGEST * size / self.step)

    def trace(self, seeds: Floats, sense: int) -> tuple[list[Floats], Integers]:
        """Lines from the seeds (n, 3) along the flux, or against it where ``sense`` is -1, and the
        number (n,) of the patch's point at which each arrives, -1 where it does not.
        """
        patch = self.ends[(sense + 1) // 2]
        lines = [[seed] for seed in seeds]
        arrived = np.full(len(seeds), -1)
        here = seeds.copy()
        open_lines = np.arange(len(seeds))
        for _ in range(self.most):
            here = self._ahead(here, sense)
            here, beyond = self._inside(here)
            distance, nearest = patch.query(here)
            # At the surface and nearer to the patch than a cell: it has come through it.
            done = beyond & (distance < self.flux.side)
            for k, line in enumerate(open_lines):
                lines[line].append(patch.data[nearest[k]] if done[k] else here[k])
            arrived[open_lines[done]] = nearest[done]
            open_lines = open_lines[~done]
            here = here[~done]
            if not len(open_lines):
                break
        return [np.array(line) for line in lines], arrived

    def _ahead(self, here: Floats, sense: int) -> Floats:
        half = here + 0.5 * sense * self.step * unit(self.flux(here))
        return here + sense * self.step * unit(self.flux(half))

    def _inside(self, points: Floats) -> tuple[Floats, Booleans]:
        """Points (n, 3), those outside moved to the surface, and which (n,) these are."""
        outside = ~self.mesh.inside(points)
        if outside.any():
            points[outside] = self.mesh.nearest(points[outside])[1]
        return points, outside


def _even(line: Floats) -> Floats:
    """`POINTS` at even distances along a line (n, 3)."""
    return points_along(line, np.linspace(0.0, distance_along(line)[-1], POINTS))


def _kept_inside(
    lines: Floats, mesh: MeshDistance, bones: Sequence[BoneDistance], depth: float
) -> Floats:
    """Lines (n, k, 3) smoothed, their inner points moved inside the muscle and out of bones."""
    inner = lines[:, 1:-1]
    for _ in range(ROUNDS):
        smooth = 0.25 * (lines[:, :-2] + 2.0 * inner + lines[:, 2:])
        points = np.ascontiguousarray(smooth.reshape(-1, 3))
        for bone in bones:
            points = _moved_off(points, bone, 1.0, 0.0)
        points = _moved_off(points, mesh, -1.0, depth)
        inner[:] = points.reshape(inner.shape)
    return lines


def _moved_off(points: Floats, mesh: MeshDistance, side: float, depth: float) -> Floats:
    """Points (n, 3), those not farther out (side 1) or in (-1) than a depth moved there."""
    distance, closest, outward = mesh.nearest(points)
    distance = np.where(mesh.inside(points), -np.abs(distance), np.abs(distance))
    wrong = side * distance < depth
    points[wrong] = closest[wrong] + side * depth * unit(outward[wrong])
    return points
