"""What one centre adds to values, gradients and Hessians of a field at a block of points."""

import numpy as np

from rbfmuscle.compiled.loop import compiled


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


@compiled(error_model="numpy", fastmath={"contract"})
def _add_hessian_loop(a, b, e2, hermite, radial, d, h):
    """Add the second derivatives to h (6: xx yy zz xy xz yz).

    a (first I + second d d^T), less second ((B . d) I + d B^T + B d^T) + third (B . d) d d^T for Hermite weights B.
    """
    bx, by, bz = b
    first, second, third = radial[1], radial[2], radial[3]
    e4 = e2 * e2
    for i in range(d.shape[1]):
        x, y, z = d[0, i], d[1, i], d[2, i]
        s = e4 * second[i]
        on, outer = a * e2 * first[i], a * s
        if hermite:
            bd = bx * x + by * y + bz * z
            on -= s * bd
            outer -= e4 * e2 * third[i] * bd
        else:
            s = 0.0
        h[0, i] += on + outer * x * x - 2.0 * s * bx * x
        h[1, i] += on + outer * y * y - 2.0 * s * by * y
        h[2, i] += on + outer * z * z - 2.0 * s * bz * z
        h[3, i] += outer * x * y - s * (bx * y + by * x)
        h[4, i] += outer * x * z - s * (bx * z + bz * x)
        h[5, i] += outer * y * z - s * (by * z + bz * y)
