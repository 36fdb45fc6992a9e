"""Systems of RBF fits: the coordinates that they are scaled to, their matrices and right sides.

Unknowns of a Hermite fit are grouped: all values, then all x-, y- and z-derivatives (or all normal derivatives), so
that every column of every block is one contiguous run. Only the lower triangle (Fortran order) is filled.
"""

import numpy as np

from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.implicit.evaluation import _offsets_loop
from rbfmuscle.implicit.kernels.radial import _radial_loop
from rbfmuscle.implicit.kernels.table import Kernel
from rbfmuscle.jit import compiled
from rbfmuscle.validation import UsageError

_KINDS = ("value", "gradient", "normal")
_VALUE, _GRADIENT, _NORMAL = range(3)


def exponents(degree: int) -> Integers:
    """Exponents (q, 3) of the monomials of total degree up to ``degree``; (0, 3) for degree -1."""
    every = [power for power in np.ndindex(*[degree + 1] * 3) if sum(power) <= degree]
    every.sort(key=lambda power: (sum(power), *(-p for p in power)))
    return np.array(every, dtype=np.int64).reshape(-1, 3)


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
def _matrix_loop(x, normals, epsilon, form, kind, out):
    """Lower triangle of the matrix of a basis of some kind; out[column, row] is its transpose, x is (3, n)."""
    n, e2 = x.shape[1], epsilon * epsilon
    d, u, work, radial = np.empty((3, n)), np.empty(n), np.empty((3, n)), np.empty((3, n))
    for j in range(n):
        _offsets_loop(x, (x[0, j], x[1, j], x[2, j]), e2, d, u)
        _radial_loop(form, 1 if kind == _VALUE else 7, u, work, radial)
        for i in range(j, n):
            out[j, i] = radial[0, i]
        if kind == _GRADIENT:
            _gradient_columns_loop(j, e2, d, radial, out)
        elif kind == _NORMAL:
            _normal_columns_loop(j, e2, d, normals, radial, out)


@compiled(error_model="numpy")
def _cubic_hermite_matrix_loop(x, epsilon, out):
    """As `_matrix_loop` with gradients for the kernel s^3, which muscles use and which should not wait for others."""
    n = x.shape[1]
    d, u, radial = np.empty((3, n)), np.empty(n), np.empty((3, n))
    for j in range(n):
        _offsets_loop(x, (x[0, j], x[1, j], x[2, j]), epsilon * epsilon, d, u)
        for i in range(n):
            s = np.sqrt(u[i])
            radial[1, i] = 3.0 * s
            radial[2, i] = 3.0 / s if s > 0.0 else 0.0
            out[j, i] = u[i] * s
        _gradient_columns_loop(j, epsilon * epsilon, d, radial, out)


@compiled(error_model="numpy")
def _gradient_columns_loop(j, e2, d, radial, out):
    """Derivatives in the four columns of centre j, from the offsets of all centres and the radial functions there.

    Blocks: (d/dx_c, value) first * d_c; (d/dx_c, d/dx_e) -(first * delta + second * d_c d_e).
    """
    n = d.shape[1]
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
def _normal_columns_loop(j, e2, d, normals, radial, out):
    """As `_gradient_columns_loop`, with the derivative along the unit normals (3, n) alone.

    Blocks: (normal i, value j) first (d . n_i); (normal i, normal j) -(first n_i . n_j + second (d . n_i)(d . n_j)).
    """
    n, (nx, ny, nz) = d.shape[1], (normals[0, j], normals[1, j], normals[2, j])
    for i in range(n):
        at_i = d[0, i] * normals[0, i] + d[1, i] * normals[1, i] + d[2, i] * normals[2, i]
        at_j = d[0, i] * nx + d[1, i] * ny + d[2, i] * nz
        both = nx * normals[0, i] + ny * normals[1, i] + nz * normals[2, i]
        out[j, n + i] = e2 * radial[1, i] * at_i
        out[n + j, n + i] = -e2 * (radial[1, i] * both + e2 * radial[2, i] * at_i * at_j)


class Basis:
    """Centres, kernel and polynomial part of one fit, in coordinates scaled to order one.

    Of points (K, 3) and epsilon [1 / length] as the caller has them: ``points`` are (x - ``origin``) / ``scale``, in
    the unit ball, and ``epsilon`` goes with them. ``kind`` is "value", "gradient" (values and all derivatives) or
    "normal" (values and derivatives along unit ``normals`` (K, 3)). LinAlgError for fewer values than polynomial terms.
    """

    def __init__(
        self, points: Floats, kernel: Kernel, epsilon: float, *, kind: str = "value", normals: Floats | None = None
    ) -> None:  # fmt: skip
        if not len(points):
            raise UsageError("a fit needs at least one point, got none")
        self.origin = 0.5 * (points.min(axis=0) + points.max(axis=0))
        self.scale = float(np.sqrt(((points - self.origin) ** 2).sum(axis=1).max())) or 1.0
        self.points, self.kernel, self.kind = (points - self.origin) / self.scale, kernel, kind
        self.epsilon = epsilon * self.scale if kernel.has_epsilon else 1.0
        self.normals = np.zeros((0, 3)) if normals is None else normals
        self.powers = exponents(kernel.degree)
        if kind == "value" and len(self.powers) > len(points):
            raise np.linalg.LinAlgError(
                f"degree {kernel.degree} of kernel '{kernel.name}' has {len(self.powers)} polynomial terms, more than "
                f"the {len(points)} points; degree too high: use a kernel of lower order or add points"
            )
        blocks = [monomials(self.points, self.powers)]
        if kind == "gradient":
            blocks += [*monomial_gradients(self.points, self.powers)]
        elif kind == "normal":
            blocks += [np.einsum("cqn,nc->qn", monomial_gradients(self.points, self.powers), self.normals)]
        self.polynomials = np.ascontiguousarray(np.hstack(blocks))
        self.size = self.polynomials.shape[1]

    def matrix(self) -> Floats:
        """A, lower triangle valid, Fortran order: (size, size)."""
        out, x = np.empty((self.size, self.size)), np.ascontiguousarray(self.points.T)
        if self.kind == "gradient" and self.kernel.plain_cube:
            _cubic_hermite_matrix_loop(x, self.epsilon, out)
        else:
            normals, kind = np.ascontiguousarray(self.normals.T), _KINDS.index(self.kind)
            _matrix_loop(x, normals, self.epsilon, self.kernel.form, kind, out)
        return out.T

    def full_matrix(self) -> Floats:
        """The augmented matrix [A P^T; P 0], both triangles: (size + q, size + q)."""
        size, q = self.size, len(self.powers)
        full = np.zeros((size + q, size + q))
        lower = np.tril(self.matrix())
        full[:size, :size] = lower + np.tril(lower, -1).T
        full[size:, :size], full[:size, size:] = self.polynomials, self.polynomials.T
        return full

    def centre_weights(self, weights: Floats) -> Floats:
        """Weights (K,), or of a Hermite fit rows (a, B) for each centre (K, 4), from the solution of a system."""
        if self.kind == "value":
            return weights
        if self.kind == "gradient":
            return weights.reshape(4, -1).T.copy()
        value, along = weights.reshape(2, -1)
        return np.column_stack([value, along[:, None] * self.normals])


def hermite_system(
    points: Floats, normals: Floats, kernel: Kernel, epsilon: float, derivatives: str
) -> tuple[Basis, Floats]:
    """Basis and right side of a Hermite fit (arguments as in `RBFField.fit_hermite`)."""
    zeros = np.zeros(len(points))
    if derivatives == "all":
        basis = Basis(points, kernel, epsilon, kind="gradient")
        return basis, np.concatenate([zeros, normals.T.ravel()]) * basis.scale
    lengths = np.linalg.norm(normals, axis=1)
    if not lengths.all():
        raise UsageError(f"normals must not be zero, row {int(np.argmin(lengths))} is")
    basis = Basis(points, kernel, epsilon, kind="normal", normals=normals / lengths[:, None])
    return basis, np.concatenate([zeros, lengths]) * basis.scale
