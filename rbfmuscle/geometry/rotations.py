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
