"""Rotations as unit quaternions (w, x, y, z), for compiled loops."""

import numpy as np

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.jit import compiled


def turned_quaternions(quaternions: Floats, rotation: Floats) -> Floats:
    """Unit quaternions (n, 4), each followed by a rotation (3, 3)."""
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(rotation).as_quat()
    left = np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
    return np.ascontiguousarray(quaternions @ left.T)


@compiled(error_model="numpy", inline="always")
def quaternion_matrix(q):
    """Rows of the rotation matrix of a unit quaternion, as three tuples."""
    w, x, y, z = q[0], q[1], q[2], q[3]
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


@compiled
def turn_quaternion(q, x, y, z):
    """q <- q (1, x, y, z), normalised: right to third order, and the fixed point is unchanged."""
    a, b, c, d = q[0], q[1], q[2], q[3]
    q[0] = a - b * x - c * y - d * z
    q[1] = b + a * x + c * z - d * y
    q[2] = c + a * y + d * x - b * z
    q[3] = d + a * z + b * y - c * x
    size = np.sqrt(q[0] ** 2 + q[1] ** 2 + q[2] ** 2 + q[3] ** 2)
    for k in range(4):
        q[k] /= size


@compiled(error_model="numpy")
def rotation_loop(m, q):
    """Turn the unit quaternion q in place towards the rotational part of the 3x3 matrix m (Müller 2016)."""
    for _ in range(20):
        w, x, y, z = q[0], q[1], q[2], q[3]
        (r00, r01, r02), (r10, r11, r12), (r20, r21, r22) = quaternion_matrix(q)
        # Sum of cross products of the columns of R and of m: the torque that aligns them.
        ox = r10 * m[2, 0] - r20 * m[1, 0] + r11 * m[2, 1] - r21 * m[1, 1] + r12 * m[2, 2] - r22 * m[1, 2]
        oy = r20 * m[0, 0] - r00 * m[2, 0] + r21 * m[0, 1] - r01 * m[2, 1] + r22 * m[0, 2] - r02 * m[2, 2]
        oz = r00 * m[1, 0] - r10 * m[0, 0] + r01 * m[1, 1] - r11 * m[0, 1] + r02 * m[1, 2] - r12 * m[0, 2]
        trace = (
            r00 * m[0, 0] + r10 * m[1, 0] + r20 * m[2, 0] + r01 * m[0, 1] + r11 * m[1, 1] + r21 * m[2, 1]
        ) + (r02 * m[0, 2] + r12 * m[1, 2] + r22 * m[2, 2])
        scale = 1.0 / (abs(trace) + 1e-12)
        ox, oy, oz = ox * scale, oy * scale, oz * scale
        angle = np.sqrt(ox * ox + oy * oy + oz * oz)
        if angle < 1e-8:
            break
        half = 0.125 * angle * angle
        if angle < 1e-2:
            # Series that are exact to rounding: the angles are small but for the first of them.
            s, c = 0.5 - half * (1.0 - 0.1 * half) / 6.0, 1.0 - half * (1.0 - half / 6.0)
        else:
            s, c = np.sin(0.5 * angle) / angle, np.cos(0.5 * angle)
        dx, dy, dz = ox * s, oy * s, oz * s
        q[0] = c * w - dx * x - dy * y - dz * z
        q[1] = c * x + dx * w + dy * z - dz * y
        q[2] = c * y - dx * z + dy * w + dz * x
        q[3] = c * z + dx * y - dy * x + dz * w
        norm = 1.0 / np.sqrt(q[0] ** 2 + q[1] ** 2 + q[2] ** 2 + q[3] ** 2)
        for k in range(4):
            q[k] *= norm
