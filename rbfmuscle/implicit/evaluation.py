"""Values and gradients of an RBF field at many points.

A field is a blend of local fits, F(x) = sum_p w_p f_p(x). Where the weights follow the points
(`weigh`) they have slopes, and grad F = sum_p w_p grad f_p + f_p grad w_p; where they belong to the
material they stay as they are.
"""

from typing import NamedTuple

import numpy as np
from scipy.spatial.distance import cdist

from rbfmuscle.geometry.arrays import Booleans, Floats
from rbfmuscle.geometry.threads import in_chunks
from rbfmuscle.implicit.kernels import Kernel
from rbfmuscle.loops import loop

# Points of a block, which stays in the first-level cache; points below which a thread does not pay;
# points that are weighed at a time.
BLOCK, SERIAL, CHUNK = 256, 1500, 4096
# Numbers of pairs of points and centres that NumPy handles at a time.
PAIRS = 50_000
# Beyond this share of the radius of every ball, all grow until the point lies there in the nearest.
RIM = 0.95
NEAR = 0.15  # how close to a centre its closeness levels off, in radii of the fit's ball


class Terms(NamedTuple):
    """A field of P local fits of n centres each.

    In the coordinates of a fit, (points - origin) / scale with ``origin`` (P, 3) and ``scale``
    (P,): ``centres`` (P, 3, n); ``weights`` (P, 4, n) of the values and of the derivatives, which
    are 0 unless ``hermite``; ``epsilon`` (P,); ``coefficients`` (P, q) and ``powers`` (q, 3) are
    the polynomial's. A fit counts in a ball, in the caller's coordinates, with ``middle`` (P, 3)
    and ``radius`` (P,); a single fit counts everywhere.
    """

    origin: np.ndarray
    scale: np.ndarray
    centres: np.ndarray
    weights: np.ndarray
    hermite: bool
    epsilon: np.ndarray
    coefficients: np.ndarray
    powers: np.ndarray
    middle: np.ndarray
    radius: np.ndarray


class Blend(NamedTuple):
    """Which points a fit counts at, in their order, and how much: those of fit p are
    ``point[start[p] : start[p + 1]]``.
    """

    start: np.ndarray  # (P + 1,)
    point: np.ndarray  # (m,)
    weight: np.ndarray  # (m,)
    slope: np.ndarray  # (m, 3) gradients of the weights; (0, 3) where they stay

    def without(self, least: float, count: int) -> "Blend":
        """The blend of ``count`` points that keeps these weights, without those below ``least``."""
        fit = np.repeat(np.arange(len(self.start) - 1), np.diff(self.start))
        kept = self.weight >= least
        fit, point, weight = fit[kept], self.point[kept], self.weight[kept]
        weight = weight / np.bincount(point, weight, minlength=count)[point]
        start = np.searchsorted(fit, np.arange(len(self.start)))
        return Blend(start, point, weight, np.zeros((0, 3)))


def evaluate(
    points: Floats, terms: Terms, kernel: Kernel, with_gradient: bool
) -> tuple[Floats, Floats]:
    """A field's values (n,) at points (n, 3), and its gradients (n, 3) by these, which mean nothing
    where not wanted.
    """
    count = len(points)
    value, gradient = np.zeros(count), np.zeros((count, 3))

    def work(start: int, stop: int) -> None:
        for low in range(start, stop, CHUNK):
            some = slice(low, min(low + CHUNK, stop))
            blend = weigh(points[some], terms)
            todo = np.ones(some.stop - low, dtype=np.bool_)
            given = points[some], terms, kernel, blend, todo
            _blend_rows(*given, (0, len(todo)), with_gradient, value[some], gradient[some])

    in_chunks(count, work, least=SERIAL)
    return value, gradient


def evaluate_blend(
    points: Floats, terms: Terms, kernel: Kernel, blend: Blend, todo: Booleans | None = None
) -> tuple[Floats, Floats]:
    """Values (n,) and gradients (n, 3) of the blended fits at points (n, 3); 0 at those that
    ``todo`` (n,) leaves out.
    """
    value, gradient = np.zeros(len(points)), np.zeros((len(points), 3))
    todo = np.ones(len(points), dtype=np.bool_) if todo is None else todo

    def work(start: int, stop: int) -> None:
        rows = start, stop
        _blend_rows(points, terms, kernel, blend, todo, rows, True, value, gradient)

    in_chunks(len(points), work, least=SERIAL)
    return value, gradient


def weigh(points: Floats, terms: Terms) -> Blend:
    """The weights of the fits at points (n, 3), which add up to one, and their slopes.

    w is (1 - t^2)^2 at t of the ball's radius, times how close the fit's own centres are: a sheet
    of another part of the muscle may have come into the ball, of which the fit knows nothing. That
    is the sum over the centres of 1 / (distance^2 + soft^2)^4.
    """
    count = len(points)
    if len(terms.middle) == 1:
        return Blend(np.array([0, count]), np.arange(count), np.ones(count), np.zeros((0, 3)))
    square = terms.radius**2
    shares = cdist(terms.middle, points, "sqeuclidean") / square[:, None]
    nearest = shares.argmin(axis=0)
    least = shares[nearest, np.arange(count)]
    least = np.maximum(least, np.finfo(float).tiny)
    growth = np.minimum(1.0, RIM**2 / least)
    grown = -2.0 * (points - terms.middle[nearest]) / (least * square[nearest])[:, None]
    grown[growth == 1.0] = 0.0
    shares *= growth
    fit, point = np.nonzero(shares < 1.0)
    start = np.searchsorted(fit, np.arange(len(shares) + 1))
    close = np.zeros((len(point), 4))
    soft = NEAR * terms.radius / terms.scale
    _closeness_loop(points, start, point, terms.origin, terms.scale, terms.centres, soft, close)
    share = shares[fit, point]
    steep = (2.0 * growth[point] / square[fit])[:, None] * (points[point] - terms.middle[fit])
    steep += share[:, None] * grown[point]
    inside = 1.0 - share
    weight = inside**2 * close[:, 0]
    slope = (-2.0 * inside * close[:, 0])[:, None] * steep + (inside**2)[:, None] * close[:, 1:]
    total = np.bincount(point, weight, minlength=count)[point]
    weight /= total
    for axis in range(3):
        along = np.bincount(point, slope[:, axis], minlength=count)[point]
        slope[:, axis] = (slope[:, axis] - weight * along) / total
    return Blend(start, point, weight, slope)


@loop(fastmath={"contract"})
def _closeness_loop(points, start, point, origin, scale, centres, soft, out):
    """The sum over a fit's centres of 1 / (distance^2 + soft^2)^4, with ``soft`` (P,) in the
    coordinates of the fit, and its gradient, for each pair of fit and point (m, 4).
    """
    for fit in range(len(start) - 1):
        size = scale[fit]
        for pair in range(start[fit], start[fit + 1]):
            x = (points[point[pair], 0] - origin[fit, 0]) / size
            y = (points[point[pair], 1] - origin[fit, 1]) / size
            z = (points[point[pair], 2] - origin[fit, 2]) / size
            for j in range(centres.shape[2]):
                dx = x - centres[fit, 0, j]
                dy = y - centres[fit, 1, j]
                dz = z - centres[fit, 2, j]
                q = 1.0 / (dx * dx + dy * dy + dz * dz + soft[fit] * soft[fit])
                v = (q * q) * (q * q)
                w = -8.0 * v * q
                out[pair, 0] += v
                out[pair, 1] += w * dx
                out[pair, 2] += w * dy
                out[pair, 3] += w * dz
            out[pair, 0] /= size**8
            for c in range(1, 4):
                out[pair, c] /= size**9


def _blend_rows(
    points: Floats,
    terms: Terms,
    kernel: Kernel,
    blend: Blend,
    todo: Booleans,
    rows: tuple[int, int],
    with_gradient: bool,
    value: Floats,
    gradient: Floats,
) -> None:
    """Add the blended fits, and their gradients, of those of points[rows[0]:rows[1]] that ``todo``
    marks.
    """
    low, high = rows
    if terms.hermite and kernel.plain_cube and terms.coefficients.shape[1] == 4:
        _cubic_loop(
            points,
            todo,
            low,
            high,
            blend.start,
            blend.point,
            blend.weight,
            blend.slope,
            terms.origin,
            terms.scale,
            terms.centres,
            terms.weights,
            terms.coefficients,
            value,
            gradient,
        )
        return
    size = max(1, PAIRS // terms.centres.shape[2])
    for fit in range(len(blend.start) - 1):
        pairs = np.arange(blend.start[fit], blend.start[fit + 1])
        near = blend.point[pairs]
        pairs = pairs[(near >= low) & (near < high) & todo[near]]
        for first in range(0, len(pairs), size):
            some = pairs[first : first + size]
            at, weight = blend.point[some], blend.weight[some]
            found, steep = _local_fit(points[at], terms, fit, kernel, with_gradient)
            value[at] += weight * found
            if with_gradient:
                gradient[at] += weight[:, None] * steep
                if len(blend.slope):
                    gradient[at] += blend.slope[some] * found[:, None]


def _local_fit(
    points: Floats, terms: Terms, fit: int, kernel: Kernel, with_gradient: bool
) -> tuple[Floats, Floats]:
    """Values (m,) of one fit at points (m, 3), with any kernel, and its gradients (m, 3), 0 where
    not wanted.

    With B the weights of the derivatives and d the way from a centre the sum over the centres is
    a phi - first (B . d), its gradient a first d - first B - second (B . d) d.
    """
    scale, epsilon = terms.scale[fit], terms.epsilon[fit]
    local = (points - terms.origin[fit]) / scale
    way = local[:, :, None] - terms.centres[fit]
    square = epsilon**2
    found = kernel.radial(
        square * np.einsum("mcn,mcn->mn", way, way), 1 + int(terms.hermite) + int(with_gradient)
    )
    a, slopes = terms.weights[fit, 0], terms.weights[fit, 1:]
    monomials = local[:, None, :] ** terms.powers
    value = found[0] @ a + np.prod(monomials, axis=2) @ terms.coefficients[fit]
    gradient = np.zeros_like(local)
    along = np.einsum("mcn,cn->mn", way, slopes) if terms.hermite else None
    if along is not None:
        value -= square * np.einsum("mn,mn->m", found[1], along)
    if not with_gradient:
        return value, gradient
    factor = square * found[1] * a
    if along is not None:
        factor -= square**2 * found[2] * along
        gradient -= square * (found[1] @ slopes.T)
    gradient += np.einsum("mn,mcn->mc", factor, way)
    for axis in range(3):
        steep = monomials.copy()
        power = terms.powers[:, axis]
        steep[:, :, axis] = power * local[:, None, axis] ** np.maximum(power - 1, 0)
        gradient[:, axis] += np.prod(steep, axis=2) @ terms.coefficients[fit]
    return value, gradient / scale


@loop(fastmath={"contract"})
def _cubic_loop(
    points,
    todo,
    low,
    high,
    start,
    point,
    weight,
    slope,
    origin,
    scale,
    centres,
    weights,
    coefficients,
    value,
    gradient,
):
    """`_blend_rows` for the kernel r^3 of the coordinates of a fit, whose polynomial is linear.

    The sum over the centres is r (a r^2 - 3 B . d), its gradient 3 a r d - 3 r B - 3/r (B . d) d.
    Inner loops run over a block of points, so that they become vector code.
    """
    rows = np.empty(BLOCK, np.int64)
    p = np.empty((3, BLOCK))
    f = np.empty(BLOCK)
    g = np.empty((3, BLOCK))
    for fit in range(len(start) - 1):
        at, end, size = start[fit], start[fit + 1], scale[fit]
        while at < end:
            count = 0
            while at < end and count < BLOCK:
                i = point[at]
                if low <= i < high and todo[i]:
                    rows[count] = at
                    for c in range(3):
                        p[c, count] = (points[i, c] - origin[fit, c]) / size
                    count += 1
                at += 1
            for n in range(count):
                f[n] = coefficients[fit, 0]
                for c in range(3):
                    f[n] += coefficients[fit, 1 + c] * p[c, n]
                    g[c, n] = coefficients[fit, 1 + c]
            for j in range(centres.shape[2]):
                x = centres[fit, 0, j]
                y = centres[fit, 1, j]
                z = centres[fit, 2, j]
                a = weights[fit, 0, j]
                bx = weights[fit, 1, j]
                by = weights[fit, 2, j]
                bz = weights[fit, 3, j]
                for n in range(count):
                    dx = p[0, n] - x
                    dy = p[1, n] - y
                    dz = p[2, n] - z
                    u = dx * dx + dy * dy + dz * dz + 1e-300
                    r = np.sqrt(u)
                    along = 3.0 * (bx * dx + by * dy + bz * dz)
                    f[n] += r * (a * u - along)
                    radial = 3.0 * a * r - along / r
                    g[0, n] += radial * dx - 3.0 * r * bx
                    g[1, n] += radial * dy - 3.0 * r * by
                    g[2, n] += radial * dz - 3.0 * r * bz
            for n in range(count):
                i, share = point[rows[n]], weight[rows[n]]
                value[i] += share * f[n]
                for c in range(3):
                    gradient[i, c] += share * g[c, n] / size
                    if len(slope) > 0:
                        gradient[i, c] += slope[rows[n], c] * f[n]
