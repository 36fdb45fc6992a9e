"""Rotations as unit quaternions (w, x, y, z), for compiled loops."""

import numpy as np

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.jit import compiled


def turned_quaternions(quaternions: Floats, rotation: Floats) -> Floats:
    """Unit quaternions (n, 4), each followed by a rotation (3, 3)."""
    w, x, y, z = matrix_quaternion(rotation)
    left = np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
    return np.ascontiguousarray(quaternions @ left.T)


@compiled(error_model="numpy")
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


@compiled(error_model="numpy", inline="always")
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


@compiled
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


@compiled(error_model="numpy", fastmath={"contract"})
def rotation_loop(m, q):
    """Turn the unit quaternion q in place to the rotational part of the 3x3 matrix m, by Newton's
    method.

    The torque that aligns R with m is the skew part of P = m Rᵀ, and tr(P) I - P its change with
    the angle. Where that is not positive definite, as far from the solution, steps are those of
    Müller et al. (2016).
    """
    # From the last iteration's rotation one to three steps do; what is left when there are no more
    # is motion of the solve that asked, whose residual shows it.
    for _ in range(20):
        w = q[0]
        x = q[1]
        y = q[2]
        z = q[3]
        (r00, r01, r02), (r10, r11, r12), (r20, r21, r22) = quaternion_matrix(q)
        p00 = m[0, 0] * r00 + m[0, 1] * r01 + m[0, 2] * r02
        p01 = m[0, 0] * r10 + m[0, 1] * r11 + m[0, 2] * r12
        p02 = m[0, 0] * r20 + m[0, 1] * r21 + m[0, 2] * r22
        p10 = m[1, 0] * r00 + m[1, 1] * r01 + m[1, 2] * r02
        p11 = m[1, 0] * r10 + m[1, 1] * r11 + m[1, 2] * r12
        p12 = m[1, 0] * r20 + m[1, 1] * r21 + m[1, 2] * r22
        p20 = m[2, 0] * r00 + m[2, 1] * r01 + m[2, 2] * r02
        p21 = m[2, 0] * r10 + m[2, 1] * r11 + m[2, 2] * r12
        p22 = m[2, 0] * r20 + m[2, 1] * r21 + m[2, 2] * r22
        ox = p21 - p12
        oy = p02 - p20
        oz = p10 - p01
        a = p11 + p22
        b = p00 + p22
        c = p00 + p11
        d = -0.5 * (p01 + p10)
        e = -0.5 * (p02 + p20)
        f = -0.5 * (p12 + p21)
        ab = e * f - d * c
        ac = d * f - b * e
        bc = d * e - a * f
        det = a * (b * c - f * f) + d * ab + e * ac
        newton = a > 0.0 and a * b > d * d and det > 1e-9 * (a + b + c) ** 3
        if newton:
            t = 1.0 / det
            vx = t * ((b * c - f * f) * ox + ab * oy + ac * oz)
            vy = t * (ab * ox + (a * c - e * e) * oy + bc * oz)
            vz = t * (ac * ox + bc * oy + (a * b - d * d) * oz)
        else:
            t = 1.0 / (abs(p00 + p11 + p22) + 1e-12)
            vx = t * ox
            vy = t * oy
            vz = t * oz
        square = vx * vx + vy * vy + vz * vz
        if square < 1e-16:
            break
        if square > 1.0:
            t = 1.0 / np.sqrt(square)
            vx = t * vx
            vy = t * vy
            vz = t * vz
        vx = 0.5 * vx
        vy = 0.5 * vy
        vz = 0.5 * vz
        q0, q1 = w - vx * x - vy * y - vz * z, x + vx * w + vy * z - vz * y
        q2, q3 = y - vx * z + vy * w + vz * x, z + vx * y - vy * x + vz * w
        t = 1.0 / np.sqrt(q0 * q0 + q1 * q1 + q2 * q2 + q3 * q3)
        q[0] = q0 * t
        q[1] = q1 * t
        q[2] = q2 * t
        q[3] = q3 * t
        if newton and square < 1e-8:
            break  # the next step would be of the order of its square
