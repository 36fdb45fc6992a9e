"""What one centre adds to values and gradients of a field at a block of points."""

import numpy as np

from rbfmuscle.jit import compiled


@compiled(error_model="numpy", fastmath={"contract"})
def _cubic_gradient_loop(p, at, a, acc, g):
    """acc += a r^3, g += 3 a r d."""
    for i in range(acc.size):
        dx, dy, dz = p[0, i] - at[0], p[1, i] - at[1], p[2, i] - at[2]
        u = dx * dx + dy * dy + dz * dz
        w = a * np.sqrt(u)
        acc[i] += w * u
        g[0, i] += 3.0 * w * dx
        g[1, i] += 3.0 * w * dy
        g[2, i] += 3.0 * w * dz


@compiled(error_model="numpy", fastmath={"contract"})
def _cubic_hermite_value_loop(p, at, a, b, acc):
    """acc += a r^3 - 3 r (B . d)."""
    bx, by, bz = b
    for i in range(acc.size):
        dx, dy, dz = p[0, i] - at[0], p[1, i] - at[1], p[2, i] - at[2]
        u = dx * dx + dy * dy + dz * dz
        acc[i] += np.sqrt(u) * (a * u - 3.0 * (bx * dx + by * dy + bz * dz))


@compiled(error_model="numpy", fastmath={"contract"})
def _cubic_hermite_gradient_loop(p, at, a, b, acc, g):
    """Adds 3 a r d - 3 r B - 3/r (B . d) d to g, the value to acc."""
    bx, by, bz = b
    for i in range(acc.size):
        dx, dy, dz = p[0, i] - at[0], p[1, i] - at[1], p[2, i] - at[2]
        u = dx * dx + dy * dy + dz * dz + 1e-300
        r = np.sqrt(u)
        bd = 3.0 * (bx * dx + by * dy + bz * dz)
        acc[i] += r * (a * u - bd)
        radial = 3.0 * a * r - bd / r
        r3 = 3.0 * r
        g[0, i] += radial * dx - r3 * bx
        g[1, i] += radial * dy - r3 * by
        g[2, i] += radial * dz - r3 * bz


@compiled(error_model="numpy", fastmath={"contract"})
def _offsets_loop(p, at, e2, d, u):
    """d = p - centre, u = e2 |d|^2."""
    for i in range(u.size):
        dx, dy, dz = p[0, i] - at[0], p[1, i] - at[1], p[2, i] - at[2]
        d[0, i] = dx
        d[1, i] = dy
        d[2, i] = dz
        u[i] = e2 * (dx * dx + dy * dy + dz * dz)


@compiled(error_model="numpy", fastmath={"contract"})
def _add_value_loop(a, b, e2, hermite, radial, d, acc):
    """acc += a phi - first (B . d)."""
    bx, by, bz = b
    phi, first = radial[0], radial[1]
    if not hermite:
        for i in range(acc.size):
            acc[i] += a * phi[i]
        return
    for i in range(acc.size):
        acc[i] += a * phi[i] - e2 * first[i] * (bx * d[0, i] + by * d[1, i] + bz * d[2, i])


@compiled(error_model="numpy", fastmath={"contract"})
def _add_gradient_loop(a, b, e2, hermite, radial, d, g):
    """g += a first d - first B - second (B . d) d."""
    bx, by, bz = b
    first, second = radial[1], radial[2]
    if not hermite:
        for i in range(d.shape[1]):
            w = a * e2 * first[i]
            g[0, i] += w * d[0, i]
            g[1, i] += w * d[1, i]
            g[2, i] += w * d[2, i]
        return
    e4 = e2 * e2
    for i in range(d.shape[1]):
        bd = bx * d[0, i] + by * d[1, i] + bz * d[2, i]
        f = e2 * first[i]
        w = a * f - e4 * second[i] * bd
        g[0, i] += w * d[0, i] - f * bx
        g[1, i] += w * d[1, i] - f * by
        g[2, i] += w * d[2, i] - f * bz
