"""Matrices of RBF systems.

Unknowns of a Hermite fit are grouped: all values, then all x-, y- and z-derivatives (or all normal
derivatives), so that every column of every block is one contiguous run. Only the lower triangle (Fortran
order) is filled.
"""

from __future__ import annotations

import numpy as np

from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.implicit.evaluation import _offsets_loop
from rbfmuscle.implicit.kernels.radial import _radial_loop
from rbfmuscle.jit import compiled


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


def hermite_polynomials(points: Floats, powers: Integers) -> Floats:
    """Polynomial block (q, 4n): values, then the three derivatives, at each point."""
    return np.hstack([monomials(points, powers), *monomial_gradients(points, powers)])


@compiled(error_model="numpy")
def _value_matrix_loop(x, epsilon, form, out):
    """out[j, i] = phi(|x_i - x_j|); x is (3, n)."""
    n = x.shape[1]
    d, u, work, radial = np.empty((3, n)), np.empty(n), np.empty((3, n)), np.empty((3, n))
    for j in range(n):
        _offsets_loop(x, (x[0, j], x[1, j], x[2, j]), epsilon * epsilon, d, u)
        _radial_loop(form, 1, u, work, radial)
        out[j] = radial[0]


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
    phi, first, second = radial[0], radial[1], radial[2]
    column = out[j]
    for i in range(j, n):
        column[i] = phi[i]
    for c in range(3):
        target, dc = column[(c + 1) * n : (c + 2) * n], d[c]
        for i in range(n):
            target[i] = e2 * first[i] * dc[i]
    for e in range(3):
        de = d[e]
        column = out[(e + 1) * n + j]
        for i in range(j, n):
            column[(e + 1) * n + i] = -e2 * (first[i] + e2 * second[i] * de[i] * de[i])
        for c in range(e + 1, 3):
            target, dc = column[(c + 1) * n : (c + 2) * n], d[c]
            for i in range(n):
                target[i] = -e2 * e2 * second[i] * dc[i] * de[i]


def normal_polynomials(points: Floats, normals: Floats, powers: Integers) -> Floats:
    """Polynomial block (q, 2n): values, then derivatives along the normals, at each point."""
    along = np.einsum("cqn,nc->qn", monomial_gradients(points, powers), normals)
    return np.hstack([monomials(points, powers), along])


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
        phi, first, second = radial[0], radial[1], radial[2]
        value, slope = out[j], out[n + j]
        nx, ny, nz = normals[0, j], normals[1, j], normals[2, j]
        for i in range(j, n):
            value[i] = phi[i]
        for i in range(n):
            at_i = d[0, i] * normals[0, i] + d[1, i] * normals[1, i] + d[2, i] * normals[2, i]
            at_j = d[0, i] * nx + d[1, i] * ny + d[2, i] * nz
            both = nx * normals[0, i] + ny * normals[1, i] + nz * normals[2, i]
            value[n + i] = e2 * first[i] * at_i
            slope[n + i] = -e2 * (first[i] * both + e2 * second[i] * at_i * at_j)
