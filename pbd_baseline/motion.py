"""Where vertices go when the bones move: harmonic weights between rigid motions."""

from __future__ import annotations

import numpy as np

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.geometry.harmonic import blended_motion
from rbfmuscle.jit import compiled


def carry(points: Floats, weights: Floats, motions: Floats) -> None:
    """Move points (n, 3) in place by a weighted mean of rigid motions (b, 4, 4); weights (n, b).

    Where all bones but one rest, the mean is a rotation about that bone's axis by a share of its angle, and
    one loop does it; any other case goes through the general blend.
    """
    still = np.array([np.array_equal(motion, np.eye(4)) for motion in motions])
    if still.all():
        return
    if (~still).sum() == 1:
        b = int(np.flatnonzero(~still)[0])
        _carry_loop(points, np.ascontiguousarray(weights[:, b]), *_screw(motions[b]))
        return
    points[:] = blended_motion(points, weights, motions)


def _screw(motion):
    """Axis (3,), angle, a point on the axis (3,) and the shift along it (3,) of a rigid motion."""
    from scipy.spatial.transform import Rotation

    vector = Rotation.from_matrix(motion[:3, :3]).as_rotvec()
    angle = float(np.linalg.norm(vector))
    shift = motion[:3, 3]
    if angle < 1e-12:
        return np.array([1.0, 0.0, 0.0]), 0.0, np.zeros(3), shift.copy()
    axis = vector / angle
    along = axis * (axis @ shift)
    across = shift - along
    foot = 0.5 * (across + np.cross(axis, across) / np.tan(0.5 * angle))
    return axis, angle, foot, along


@compiled
def _carry_loop(points, weight, axis, angle, foot, shift):
    kx, ky, kz = axis[0], axis[1], axis[2]
    for i in range(len(points)):
        w = weight[i]
        if w == 0.0:
            continue
        sine, cosine = np.sin(w * angle), np.cos(w * angle)
        x, y, z = points[i, 0] - foot[0], points[i, 1] - foot[1], points[i, 2] - foot[2]
        along = (kx * x + ky * y + kz * z) * (1.0 - cosine)
        points[i, 0] = foot[0] + w * shift[0] + cosine * x + sine * (ky * z - kz * y) + along * kx
        points[i, 1] = foot[1] + w * shift[1] + cosine * y + sine * (kz * x - kx * z) + along * ky
        points[i, 2] = foot[2] + w * shift[2] + cosine * z + sine * (kx * y - ky * x) + along * kz
