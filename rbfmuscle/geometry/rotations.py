"""Rotations as unit quaternions (w, x, y, z), for compiled loops."""

import numpy as np

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.loops import loop


def turned_quaternions(quaternions: Floats, rotation: Floats) -> Floats:
    """Unit quaternions (n, 4), each followed by a rotation (3, 3)."""
    w, x, y, z = matrix_quaternion(rotation)
    left = np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
    return np.ascontiguousarray(quaternions @ left.T)


@loop
def matrix_quaternion(m):
    """Unit quaternion of a rotation matrix, as four numbers, from the greatest of them (Shepperd
    1978).
    """
    trace, i = m[0, 0] + m[1, 1] + m[2, 2], 0
    for k in range(1, 3):
        if m[k, k] > m[i, i]:
            i = k
    j, k = (i + 1) % 3, (i + 2) % 3
    q = np.empty(4)
    if trace > m[i, i]:
        q[0] = 1.0 + trace
        q[1] = m[2, 1] - m[1, 2]
        q[2] = m[0, 2] - m[2, 0]
        q[3] = m[1, 0] - m[0, 1]
    else:
        q[0], q[1 + i] = m[k, j] - m[j, k], 1.0 + 2.0 * m[i, i] - trace
        q[1 + j], q[1 + k] = m[j, i] + m[i, j], m[k, i] + m[i, k]
    length = np.sqrt(q[0] ** 2 + q[1] ** 2 + q[2] ** 2 + q[3] ** 2)
    return q[0] / length, q[1] / length, q[2] / length, q[3] / length


@loop
def quaternion_matrix(q):
    """Rows of the rotation matrix of a unit quaternion, as three tuples."""
    w = q[0]
    x = q[1]
    y = q[2]
    z = q[3]
    return (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )


@loop
def rotate(q, v):
    """Rotate a vector by a unit quaternion; returns three numbers."""
    tx = 2.0 * (q[2] * v[2] - q[3] * v[1])
    ty = 2.0 * (q[3] * v[0] - q[1] * v[2])
    tz = 2.0 * (q[1] * v[1] - q[2] * v[0])
    return (
        v[0] + q[0] * tx + q[2] * tz - q[3] * ty,
        v[1] + q[0] * ty + q[3] * tx - q[1] * tz,
        v[2] + q[0] * tz + q[1] * ty - q[2] * tx,
    )


@loop
def dot(u, v):
    """Product of two vectors of three numbers."""
    return u[0] * v[0] + u[1] * v[1] + u[2] * v[2]


@loop
def cross(u, v):
    """Vector product of two vectors of three numbers."""
    return u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]


@loop
def turn_towards(m, q):
    """The unit quaternion q a step nearer to the rotational part of a matrix m, given as rows.

    The torque that aligns R with m is the skew part of P = m Rᵀ, and tr(P) I - P its change with
    the angle, so a step is one of Newton's method. Where that is not positive definite, as far from
    the solution, it is that of Müller et al. (2016). No step turns by more than a radian.
    """
    r = quaternion_matrix(q)
    p00 = dot(m[0], r[0])
    p11 = dot(m[1], r[1])
    p22 = dot(m[2], r[2])
    p01 = dot(m[0], r[1])
    p10 = dot(m[1], r[0])
    p02 = dot(m[0], r[2])
    p20 = dot(m[2], r[0])
    p12 = dot(m[1], r[2])
    p21 = dot(m[2], r[1])
    x = p21 - p12
    y = p02 - p20
    z = p10 - p01
    a = p11 + p22
    b = p00 + p22
    c = p00 + p11
    d = -0.5 * (p01 + p10)
    e = -0.5 * (p02 + p20)
    f = -0.5 * (p12 + p21)
    # The adjugate of the symmetric matrix with a, b, c on its diagonal and d, e, f beside it.
    aa = b * c - f * f
    bb = a * c - e * e
    cc = a * b - d * d
    ab = e * f - d * c
    ac = d * f - b * e
    bc = d * e - a * f
    det = a * aa + d * ab + e * ac
    newton = (a > 0.0) & (cc > 0.0) & (det > 1e-9 * (a + b + c) ** 3)
    share = 1.0 / (det if newton else abs(p00 + p11 + p22) + 1e-12)
    u = share * (aa * x + ab * y + ac * z if newton else x)
    v = share * (ab * x + bb * y + bc * z if newton else y)
    w = share * (ac * x + bc * y + cc * z if newton else z)
    half = 0.5 / np.sqrt(max(u * u + v * v + w * w, 1.0))
    return _turned(q, half * u, half * v, half * w)


@loop
def _turned(q, u, v, w):
    """Unit quaternion q followed by a small rotation, by twice the vector (u, v, w)."""
    a = q[0] - u * q[1] - v * q[2] - w * q[3]
    b = q[1] + u * q[0] + v * q[3] - w * q[2]
    c = q[2] - u * q[3] + v * q[0] + w * q[1]
    d = q[3] + u * q[2] - v * q[1] + w * q[0]
    share = 1.0 / np.sqrt(a * a + b * b + c * c + d * d)
    return share * a, share * b, share * c, share * d
