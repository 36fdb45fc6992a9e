"""PartitionField: a field through many points with normals, from local Hermite fits blended by a partition of unity.

f(x) = b F(x) + (1 - b) f0(x), F = sum_i w_i f_i / sum_i w_i over the balls that hold x (Franke and Nielson 1980,
Wendland 2002): w_i is Wendland's C2 bump of a ball, f_i the Hermite fit to the points in it, f0 a coarse fit that knows
inside from outside far from the surface, and b rises smoothly from 0 to 1 where the balls end. Each point lies well
inside a ball, so that values and gradients there are exact; time and memory grow in proportion to the points.
"""

from __future__ import annotations

import math
import warnings
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree

from rbfmuscle.compiled.loop import compiled
from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.geometry.threads import in_chunks
from rbfmuscle.implicit.field import RBFField
from rbfmuscle.implicit.fit.fitting import DOUBTFUL
from rbfmuscle.validation import NumericalWarning, UsageError, check_points, check_vectors

# The kernel of the local fits: r^3. Of higher order they are ill-conditioned where the points of a part all but lie in
# a plane (quintic: 2e14 on an ellipsoid).
KERNEL = "cubic"
# Points of one part, and the ball's radius over that of the part: what it overlaps with others.
PART, OVERLAP = 30, 1.5
# Points of the coarse field; sum of the bumps above which it does not count. The least at a point is 0.045.
COARSE, COVERED = 400, 0.02
# Points in a ball, at least; cells of the grid in which balls are looked up, at most.
LEAST, MOST_CELLS = 20, 4_000_000
_CHUNK = 20_000


class Balls(NamedTuple):
    """Arrays of all balls: P of them, N points in them, C cells of the grid.

    ``centre`` (P, 3), ``radius`` (P,), ``origin`` (P, 3) and ``scale`` (P,) of each one's own coordinates;
    ``start`` (P + 1,) into ``points`` (N, 3) in these coordinates and ``weights`` (N, 4); ``coefficients`` (P, q) of
    the monomials ``powers`` (q, 3); ``low`` (3,), ``cell`` and ``shape`` (3,) of the grid, ``first`` (C + 1,) into
    ``inside``, the balls that reach into a cell.
    """

    centre: Any
    radius: Any
    origin: Any
    scale: Any
    start: Any
    points: Any
    weights: Any
    coefficients: Any
    powers: Any
    low: Any
    cell: float
    shape: Any
    first: Any
    inside: Any


class PartitionField:
    """A field of many centres; made by `fit_hermite`.

    Attributes
    ----------
    centres : (K, 3) ndarray
    parts : int
        Local fits.
    condition : float
        The greatest of theirs.

    Examples
    --------
    >>> import trimesh
    >>> ball = trimesh.creation.icosphere(4, 1.0)
    >>> field = PartitionField.fit_hermite(ball.vertices, ball.vertex_normals)
    >>> bool(abs(field.surface(resolution=24).volume - 4.19) < 0.05)
    True
    """

    def __init__(self, centres: Floats, balls: Balls, coarse: RBFField, condition: float) -> None:
        self.centres, self.coarse, self.condition = centres, coarse, condition
        self.parts, self._balls = len(balls.radius), balls

    @classmethod
    def fit_hermite(cls, points: ArrayLike, normals: ArrayLike) -> PartitionField:
        """Fit f = 0 and grad f = normal at every point.

        Parameters
        ----------
        points : (K, 3) array_like
            Points of the surface [scene unit], at least 20.
        normals : (K, 3) array_like
            Unit vectors, outward.

        Returns
        -------
        PartitionField

        Raises
        ------
        UsageError
            For too few points.
        numpy.linalg.LinAlgError
            If a local system is singular.
        """
        points = check_points(points)
        normals = check_vectors(normals, len(points))
        if len(points) < LEAST:
            raise UsageError(f"a partition of unity needs at least {LEAST} points, got {len(points)}")
        centre, radius, members = _cover(points)
        fits = _fit_all(points, normals, members)
        few = _spread(points, min(COARSE, len(points)))
        coarse = RBFField.fit_hermite(points[few], normals[few], kernel=KERNEL)
        condition = max(coarse.condition, *(fit.condition for fit in fits))
        return cls(points, _pack(centre, radius, fits), coarse, float(condition))

    def __call__(self, points: ArrayLike) -> Floats:
        """Field value at (n, 3) points: (n,), negative inside."""
        return self._evaluate(check_points(points), False)[0]

    def gradient(self, points: ArrayLike) -> Floats:
        """Gradient at (n, 3) points: (n, 3)."""
        return self._evaluate(check_points(points), True)[1]

    def value_and_gradient(self, points: ArrayLike) -> tuple[Floats, Floats]:
        """Value (n,) and gradient (n, 3) at (n, 3) points."""
        return self._evaluate(check_points(points), True)

    def surface(self, resolution: int = 64) -> Any:
        """Zero set as a closed outward ``trimesh.Trimesh``; resolution in cells along the longest side."""
        import trimesh

        from rbfmuscle.implicit.extraction.surface import extract_surface

        result = extract_surface(self, points=self.centres, resolution=resolution)
        return trimesh.Trimesh(result.vertices, result.faces, process=False)

    def _evaluate(self, points: Floats, gradient: bool) -> tuple[Floats, Floats]:
        # sums of w f, w, and with gradient of grad (w f), grad w
        sums = np.zeros((len(points), 8 if gradient else 2))
        in_chunks(len(points), lambda a, b: _evaluate_loop(points[a:b], self._balls, gradient, sums[a:b]))
        total = sums[:, 1]
        t = np.minimum(total / COVERED, 1.0)
        share = t * t * (3.0 - 2.0 * t)
        safe = np.where(total > 0.0, total, 1.0)
        value = np.where(total > 0.0, sums[:, 0] / safe, 0.0)
        slope = np.zeros((len(points), 3))
        if gradient:
            slope = (sums[:, 2:5] - value[:, None] * sums[:, 5:8]) / safe[:, None]
        rest = np.flatnonzero(share < 1.0)
        for low in range(0, len(rest), _CHUNK):
            some = rest[low : low + _CHUNK]
            far, pull = self.coarse.value_and_gradient(points[some])
            b = share[some]
            if gradient:
                rise = (6.0 * t[some] * (1.0 - t[some]) / COVERED)[:, None] * sums[some, 5:8]
                slope[some] = (
                    b[:, None] * slope[some] + (1.0 - b)[:, None] * pull + (value[some] - far)[:, None] * rise
                )
            value[some] = b * value[some] + (1.0 - b) * far
        return value, slope


def fit_points_with_normals(
    points: ArrayLike, normals: ArrayLike, *, most: int = 2000
) -> RBFField | PartitionField:
    """A dense fit up to ``most`` points, a partition of unity beyond.

    Parameters
    ----------
    points, normals : (K, 3) array_like
    most : int
        A dense fit of K points takes a matrix of (4K)^2 numbers: 0.5 GB for 2,000.

    Returns
    -------
    RBFField or PartitionField
    """
    points = check_points(points)
    if len(points) > most:
        return PartitionField.fit_hermite(points, normals)
    return RBFField.fit_hermite(points, normals, kernel=KERNEL)


def _spread(points: Floats, count: int) -> Integers:
    """Some of the points, spread evenly: one of each part of a balanced tree."""
    parts = split_points(points, max(len(points) // count, 1))
    return np.array([part[len(part) // 2] for part in parts])


def split_points(points: Floats, most: int) -> list[Integers]:
    """Parts of at most ``most`` points, halved along their longest sides: indices of each.

    Parameters
    ----------
    points : (n, 3) ndarray
    most : int
    """
    parts, stack = [], [np.arange(len(points))]
    while stack:
        part = stack.pop()
        if len(part) <= most:
            parts.append(part)
            continue
        axis = int(np.argmax(np.ptp(points[part], axis=0)))
        middle = len(part) // 2
        order = np.argpartition(points[part, axis], middle)
        stack += [part[order[:middle]], part[order[middle:]]]
    return parts


def _cover(points: Floats) -> tuple[Floats, Floats, list[Integers]]:
    """Centres (P, 3) and radii (P,) of balls around all parts, and the points in each."""
    parts, tree = split_points(points, PART), cKDTree(points)
    centre = np.array([0.5 * (points[p].min(axis=0) + points[p].max(axis=0)) for p in parts])
    own = np.array([np.sqrt(((points[p] - c) ** 2).sum(axis=1).max()) for p, c in zip(parts, centre)])
    least = tree.query(centre, k=min(2 * PART, len(points)))[0][:, -1]
    radius = np.maximum(OVERLAP * own, least * (1.0 + 1e-9))
    return centre, radius, [np.array(some) for some in tree.query_ball_point(centre, radius)]


def _fit_all(points: Floats, normals: Floats, members: list[Integers]) -> list[RBFField]:
    """The local fits; one warning for all that are doubtful, as where points all but coincide."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NumericalWarning)
        fits = [RBFField.fit_hermite(points[some], normals[some], kernel=KERNEL) for some in members]
    doubtful = sum(fit.condition >= DOUBTFUL for fit in fits)
    if doubtful:
        warnings.warn(
            f"{doubtful} of {len(fits)} local fits have a condition beyond {DOUBTFUL:g}: points there all but "
            "coincide, and are met to a few digits only; thin them out",
            NumericalWarning,
            stacklevel=3,
        )
    return fits


def _pack(centre: Floats, radius: Floats, fits: list[RBFField]) -> Balls:
    """The balls' arrays, and the grid in which they are looked up."""
    sizes = np.array([len(fit.centres) for fit in fits])
    low, high = (centre - radius[:, None]).min(axis=0), (centre + radius[:, None]).max(axis=0)
    cell = float(np.median(radius))
    while np.prod(np.ceil((high - low) / cell)) > MOST_CELLS:
        cell *= 1.3
    shape = np.maximum(np.ceil((high - low) / cell), 1).astype(np.int64)
    count = np.zeros(int(np.prod(shape)) + 1, dtype=np.int64)
    _count_cells_loop(centre, radius, low, cell, shape, count)
    first = np.concatenate([[0], np.cumsum(count[:-1])])
    inside = np.empty(int(first[-1]), dtype=np.int32)
    _fill_cells_loop(centre, radius, low, cell, shape, first.copy(), inside)
    return Balls(
        centre, radius, np.array([f.origin for f in fits]), np.array([f.scale for f in fits]),
        np.concatenate([[0], np.cumsum(sizes)]),
        np.concatenate([(f.centres - f.origin) / f.scale for f in fits]),
        np.concatenate([f.weights for f in fits]), np.array([f.coefficients for f in fits]),
        np.asarray(fits[0].powers, dtype=np.int64), low, cell, shape, first, inside,
    )  # fmt: skip


@compiled(error_model="numpy")
def _reach(centre, radius, low, cell, size):
    """First and last cell along one axis."""
    a = min(max(int((centre - radius - low) / cell), 0), size - 1)
    b = min(max(int((centre + radius - low) / cell), 0), size - 1)
    return a, b


@compiled(error_model="numpy")
def _count_cells_loop(centre, radius, low, cell, shape, count):
    """Balls in each cell."""
    for p in range(len(radius)):
        a, b = _reach(centre[p, 0], radius[p], low[0], cell, shape[0])
        c, d = _reach(centre[p, 1], radius[p], low[1], cell, shape[1])
        e, f = _reach(centre[p, 2], radius[p], low[2], cell, shape[2])
        for i in range(a, b + 1):
            for j in range(c, d + 1):
                for k in range(e, f + 1):
                    count[(i * shape[1] + j) * shape[2] + k] += 1


@compiled(error_model="numpy")
def _fill_cells_loop(centre, radius, low, cell, shape, at, inside):
    """Their numbers; ``at`` runs through the cells' places."""
    for p in range(len(radius)):
        a, b = _reach(centre[p, 0], radius[p], low[0], cell, shape[0])
        c, d = _reach(centre[p, 1], radius[p], low[1], cell, shape[1])
        e, f = _reach(centre[p, 2], radius[p], low[2], cell, shape[2])
        for i in range(a, b + 1):
            for j in range(c, d + 1):
                for k in range(e, f + 1):
                    n = (i * shape[1] + j) * shape[2] + k
                    inside[at[n]] = p
                    at[n] += 1


@compiled(error_model="numpy")
def _monomial(y, powers, q, axis):
    """Monomial q at y (axis -1), or its derivative along an axis."""
    out = 1.0
    for c in range(3):
        exponent = powers[q, c]
        if c == axis:
            if exponent == 0:
                return 0.0
            out *= exponent
            exponent -= 1
        for _ in range(exponent):
            out *= y[c]
    return out


@compiled(error_model="numpy")
def _evaluate_loop(points, balls, gradient, sums):
    """Sums over the balls that hold each point: w f, w, and with gradient grad (w f), grad w."""
    y, d, slope, pull = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    for n in range(len(points)):
        place, out = 0, False
        for c in range(3):
            k = int(np.floor((points[n, c] - balls.low[c]) / balls.cell))
            if k < 0 or k >= balls.shape[c]:
                out = True
            place = place * balls.shape[c] + k
        if out:
            continue
        for entry in range(balls.first[place], balls.first[place + 1]):
            p = balls.inside[entry]
            square = 0.0
            for c in range(3):
                d[c] = points[n, c] - balls.centre[p, c]
                square += d[c] * d[c]
            radius = balls.radius[p]
            if square >= radius * radius:
                continue
            r = math.sqrt(square) / radius
            w = (1.0 - r) ** 4 * (4.0 * r + 1.0)
            rise = -20.0 * (1.0 - r) ** 3 / (radius * radius)
            for c in range(3):
                pull[c] = rise * d[c]
                y[c] = (points[n, c] - balls.origin[p, c]) / balls.scale[p]
            value = _local_value(y, balls, p, gradient, slope)
            sums[n, 0] += w * value
            sums[n, 1] += w
            if gradient:
                for c in range(3):
                    sums[n, 2 + c] += w * slope[c] / balls.scale[p] + pull[c] * value
                    sums[n, 5 + c] += pull[c]


@compiled(error_model="numpy")
def _local_value(y, balls, p, gradient, slope):
    """Value of the p-th fit at y in its own coordinates; its gradient there goes to ``slope``."""
    value = 0.0
    slope[:] = 0.0
    for j in range(balls.start[p], balls.start[p + 1]):
        d0, d1, d2 = y[0] - balls.points[j, 0], y[1] - balls.points[j, 1], y[2] - balls.points[j, 2]
        a, b0, b1, b2 = balls.weights[j, 0], balls.weights[j, 1], balls.weights[j, 2], balls.weights[j, 3]
        r = math.sqrt(d0 * d0 + d1 * d1 + d2 * d2)
        along = b0 * d0 + b1 * d1 + b2 * d2
        value += a * r * r * r - 3.0 * r * along
        if gradient:
            both = 3.0 * (a * r - along / r) if r > 0.0 else 0.0
            slope[0] += both * d0 - 3.0 * r * b0
            slope[1] += both * d1 - 3.0 * r * b1
            slope[2] += both * d2 - 3.0 * r * b2
    for q in range(balls.powers.shape[0]):
        value += balls.coefficients[p, q] * _monomial(y, balls.powers, q, -1)
        if gradient:
            for c in range(3):
                slope[c] += balls.coefficients[p, q] * _monomial(y, balls.powers, q, c)
    return value
