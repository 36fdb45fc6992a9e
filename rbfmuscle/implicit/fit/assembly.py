"""Systems of RBF fits: the coordinates that they are scaled to, their matrices and right sides.

Unknowns of a Hermite fit are grouped: all values, then all x-, y- and z-derivatives (or all normal
derivatives), so that every column of every block is one contiguous run. Only the lower triangle (Fortran
order) is filled.
"""

import numpy as np

from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.implicit.evaluation import _offsets_loop
from rbfmuscle.implicit.kernels.radial import _radial_loop
from rbfmuscle.implicit.kernels.table import Kernel
from rbfmuscle.jit import compiled
from rbfmuscle.validation import UsageError


def exponents(degree: int) -> Integers:
    """Exponents (q, 3) of the monomials of total degree up to ``degree``; (0, 3) for degree -1."""
    rows = [
        (i, j, total - i - j)
        for total in range(degree + 1)
        for i in range(total, -1, -1)
        for j in range(total - i, -1, -1)
    ]
    return np.array(rows, dtype=np.int64).reshape(-1, 3)


def monomials(points: Floats, powers: Integers) -> Floats:
    """Monomials at points: (q, n)."""
    out = np.ones((len(powers), len(points)))
    for row, power in zip(out, powers):
        for axis in range(3):
            if power[axis]:
                row *= points[:, axis] ** power[axis]
    return out


def monomial_gradients(points: Floats, powers: Integers) -> Floats:
    """Derivatives of the monomials at points: (3, q, n)."""
    out = np.zeros((3, len(powers), len(points)))
    for axis in range(3):
        lower = powers.copy()
        lower[:, axis] -= 1
        some = lower[:, axis] >= 0
        out[axis, some] = powers[some, axis, None] * monomials(points, lower[some])
    return out


@compiled(error_model="numpy")
def _value_matrix_loop(x, epsilon, form, out):
    """out[j, i] = phi(|x_i - x_j|); x is (3, n)."""
    n = x.shape[1]
    d, u, work, radial = np.empty((3, n)), np.empty(n), np.empty((3, n)), np.empty((3, n))
    for j in range(n):
        _offsets_loop(x, (x[0, j], x[1, j], x[2, j]), epsilon * epsilon, d, u)
        _radial_loop(form, 1, u, work, radial)
        for i in range(n):
            out[j, i] = radial[0, i]


@compiled(error_model="numpy")
def _hermite_matrix_loop(x, epsilon, form, out):
    """Lower triangle of the Hermite matrix; out[column, row] is its transpose."""
    n = x.shape[1]
    d, u, work, radial = np.empty((3, n)), np.empty(n), np.empty((3, n)), np.empty((3, n))
    for j in range(n):
        _offsets_loop(x, (x[0, j], x[1, j], x[2, j]), epsilon * epsilon, d, u)
        _radial_loop(form, 7, u, work, radial)
        _hermite_columns_loop(j, epsilon * epsilon, d, radial, out)


@compiled(error_model="numpy")
def _cubic_hermite_matrix_loop(x, epsilon, out):
    """As `_hermite_matrix_loop` for the kernel s^3, which muscles use and which should not wait for the others."""
    n = x.shape[1]
    d, u, radial = np.empty((3, n)), np.empty(n), np.empty((3, n))
    for j in range(n):
        _offsets_loop(x, (x[0, j], x[1, j], x[2, j]), epsilon * epsilon, d, u)
        for i in range(n):
            s = np.sqrt(u[i])
            radial[0, i] = u[i] * s
            radial[1, i] = 3.0 * s
            radial[2, i] = 3.0 / s if s > 0.0 else 0.0
        _hermite_columns_loop(j, epsilon * epsilon, d, radial, out)


@compiled(error_model="numpy")
def _hermite_columns_loop(j, e2, d, radial, out):
    """The four columns of centre j, from the offsets of all centres and the radial functions there.

    Blocks: (value, value) phi; (d/dx_c, value) first * d_c;
    (d/dx_c, d/dx_e) -(first * delta + second * d_c d_e).
    """
    n = d.shape[1]
    for i in range(j, n):
        out[j, i] = radial[0, i]
    for c in range(3):
        for i in range(n):
            out[j, (c + 1) * n + i] = e2 * radial[1, i] * d[c, i]
    for e in range(3):
        column = (e + 1) * n + j
        for i in range(j, n):
            out[column, (e + 1) * n + i] = -e2 * (radial[1, i] + e2 * radial[2, i] * d[e, i] * d[e, i])
        for c in range(e + 1, 3):
            for i in range(n):
                out[column, (c + 1) * n + i] = -e2 * e2 * radial[2, i] * d[c, i] * d[e, i]


@compiled(error_model="numpy")
def _normal_matrix_loop(x, normals, epsilon, form, out):
    """As `_hermite_matrix_loop`, with the derivative along the unit normal (3, n) alone.

    Blocks: (value, value) phi; (normal i, value j) first (d . n_i);
    (normal i, normal j) -(first n_i . n_j + second (d . n_i)(d . n_j)).
    """
    n = x.shape[1]
    e2 = epsilon * epsilon
    d, u, work, radial = np.empty((3, n)), np.empty(n), np.empty((3, n)), np.empty((3, n))
    for j in range(n):
        _offsets_loop(x, (x[0, j], x[1, j], x[2, j]), e2, d, u)
        _radial_loop(form, 7, u, work, radial)
        nx, ny, nz = normals[0, j], normals[1, j], normals[2, j]
        for i in range(j, n):
            out[j, i] = radial[0, i]
        for i in range(n):
            at_i = d[0, i] * normals[0, i] + d[1, i] * normals[1, i] + d[2, i] * normals[2, i]
            at_j = d[0, i] * nx + d[1, i] * ny + d[2, i] * nz
            both = nx * normals[0, i] + ny * normals[1, i] + nz * normals[2, i]
            out[j, n + i] = e2 * radial[1, i] * at_i
            out[n + j, n + i] = -e2 * (radial[1, i] * both + e2 * radial[2, i] * at_i * at_j)


_NO_NORMALS = np.zeros((0, 3))


class Basis:
    """Scaled centres, kernel and polynomial part of one fit.

    ``points`` (K, 3) are scaled to order one, as ``epsilon`` is. ``kind`` is "value", "gradient" (values and all
    derivatives) or "normal" (values and derivatives along unit ``normals`` (K, 3)).
    """

    def __init__(
        self,
        points: Floats,
        kernel: Kernel,
        epsilon: float,
        *,
        kind: str = "value",
        normals: Floats = _NO_NORMALS,
    ) -> None:
        self.points, self.kernel, self.epsilon = points, kernel, float(epsilon)
        self.kind, self.normals = kind, normals
        self.powers = exponents(kernel.degree)
        blocks = [monomials(points, self.powers)]
        if kind == "gradient":
            blocks += [*monomial_gradients(points, self.powers)]
        elif kind == "normal":
            blocks += [np.einsum("cqn,nc->qn", monomial_gradients(points, self.powers), normals)]
        self.polynomials = np.ascontiguousarray(np.hstack(blocks))
        self.size = self.polynomials.shape[1]

    def matrix(self) -> Floats:
        """A, lower triangle valid, Fortran order: (size, size)."""
        out, form = np.empty((self.size, self.size)), self.kernel.form
        x = np.ascontiguousarray(self.points.T)
        if self.kind == "value":
            _value_matrix_loop(x, self.epsilon, form, out)
        elif self.kind == "normal":
            _normal_matrix_loop(x, np.ascontiguousarray(self.normals.T), self.epsilon, form, out)
        elif self.kernel.plain_cube:
            _cubic_hermite_matrix_loop(x, self.epsilon, out)
        else:
            _hermite_matrix_loop(x, self.epsilon, form, out)
        return out.T

    def full_matrix(self) -> Floats:
        """The augmented matrix [A P^T; P 0], both triangles: (size + q, size + q)."""
        size, q = self.size, len(self.powers)
        full = np.zeros((size + q, size + q))
        lower = np.tril(self.matrix())
        full[:size, :size] = lower + np.tril(lower, -1).T
        full[size:, :size], full[:size, size:] = self.polynomials, self.polynomials.T
        return full


def frame(points: Floats) -> tuple[Floats, float]:
    """Origin (3,) and scale: the points lie in the unit ball of (x - origin) / scale."""
    if not len(points):
        raise UsageError("a fit needs at least one point, got none")
    origin = 0.5 * (points.min(axis=0) + points.max(axis=0))
    scale = float(np.sqrt(((points - origin) ** 2).sum(axis=1).max()))
    return origin, scale if scale > 0 else 1.0


def hermite_system(
    points: Floats, normals: Floats, kernel: Kernel, epsilon: float, derivatives: str
) -> tuple[Basis, Floats, Floats, float]:
    """Basis, right side, origin and scale of a Hermite fit (arguments as in `RBFField.fit_hermite`)."""
    origin, scale = frame(points)
    shape = epsilon * scale if kernel.has_epsilon else 1.0
    scaled = (points - origin) / scale
    if derivatives == "all":
        basis = Basis(scaled, kernel, shape, kind="gradient")
        return basis, np.concatenate([np.zeros(len(points)), normals.T.ravel()]) * scale, origin, scale
    lengths = np.linalg.norm(normals, axis=1)
    if not lengths.all():
        raise UsageError(f"normals must not be zero, row {int(np.argmin(lengths))} is")
    unit = normals / lengths[:, None]
    basis = Basis(scaled, kernel, shape, kind="normal", normals=unit)
    return basis, np.concatenate([np.zeros(len(points)), lengths]) * scale, origin, scale


def centre_weights(basis: Basis, weights: Floats) -> Floats:
    """Weights (K,), or of a Hermite fit rows (a, B) for each centre (K, 4), from the solution of a system."""
    if basis.kind == "value":
        return weights
    if basis.kind == "gradient":
        return weights.reshape(4, -1).T.copy()
    value, along = weights.reshape(2, -1)
    return np.column_stack([value, along[:, None] * basis.normals])


def check_count(kernel: Kernel, count: int) -> None:
    """Raise LinAlgError where a kernel's polynomial has more terms than there are points."""
    degree = kernel.degree
    terms = (degree + 1) * (degree + 2) * (degree + 3) // 6
    if terms > count:
        raise np.linalg.LinAlgError(
            f"degree {degree} of kernel '{kernel.name}' has {terms} polynomial terms, more than the {count} points; "
            "degree too high: use a kernel of lower order or add points"
        )
