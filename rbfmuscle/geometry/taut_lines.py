"""A taut line between two points that passes obstacles on one side."""

from collections.abc import Sequence

import numpy as np

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.loops import loop

STEEPEST = 2.0  # greatest slope of a line against the chord of its ends
DIRECTIONS = 64  # directions in which a convex hull is begun


def taut_line(
    start: Floats, end: Floats, side: Floats, bones: Sequence[tuple[Floats, Floats]], width: float
) -> Floats:
    """Points (n, 3) of the taut line between two points (3,) that passes bones on one side, a
    direction (3,).

    The line lies in the plane of its ends and ``side``. A point of a bone at a distance z from the
    plane is an obstacle in it, lower by z² / (2 ``width``), as for a round band. One that the line
    could only pass by leaving an end more steeply than `STEEPEST` is lowered below that slope by as
    much as it is above. So the line changes continuously where the plane comes to meet a bone, and
    parts of bones that lie far to the side do not count. ``bones`` are poses (4, 4) and points (n,
    3) at rest.
    """
    size = float(np.linalg.norm(end - start))
    along = (end - start) / max(size, 1e-300)
    up = side - (side @ along) * along
    up = up / max(float(np.linalg.norm(up)), 1e-300)
    axes = np.stack([along, up, np.cross(along, up)])
    profile = []
    for pose, points in bones:
        turn = axes @ pose[:3, :3]
        shift = axes @ (pose[:3, 3] - start)
        found = np.empty((len(points), 2))
        profile.append(found[: _profile_loop(points, turn, shift, size, max(width, 1e-300), found)])
    if not any(len(found) for found in profile):
        return np.stack([start, end])
    return start + _upper_hull(np.concatenate([[[0.0, 0.0], [size, 0.0]], *profile])) @ axes[:2]


@loop
def _profile_loop(points, turn, shift, size, width, found):
    """Fill ``found`` with points along and above a chord, counted as in `taut_line`; return how
    many there are.
    """
    count = 0
    for i in range(len(points)):
        a = points[i, 0]
        b = points[i, 1]
        c = points[i, 2]
        x = turn[0, 0] * a + turn[0, 1] * b + turn[0, 2] * c + shift[0]
        if x <= 0.0 or x >= size:
            continue
        y = turn[1, 0] * a + turn[1, 1] * b + turn[1, 2] * c + shift[1]
        z = turn[2, 0] * a + turn[2, 1] * b + turn[2, 2] * c + shift[2]
        y = min(y, 2.0 * STEEPEST * min(x, size - x) - y) - z * z / (2.0 * width)
        if y > 0.0:
            found[count, 0], found[count, 1] = x, y
            count += 1
    return count


def _upper_hull(points: Floats) -> Floats:
    """Upper convex hull (k, 2) of points (n, 2), from left to right (Andrew 1979)."""
    # Nearly all points lie below the hull of those that are outermost in some directions.
    angles = np.linspace(0.0, np.pi, DIRECTIONS)
    outermost = np.unique(
        np.argmax(np.stack([-np.cos(angles), np.sin(angles)], axis=1) @ points.T, axis=1)
    )
    outermost = outermost[np.argsort(points[outermost, 0], kind="stable")]
    above = points[:, 1] >= np.interp(points[:, 0], *points[outermost].T)
    hull: list[Floats] = []
    for point in points[above][np.lexsort(points[above].T[::-1])]:
        while len(hull) > 1:
            (ax, ay), (bx, by) = hull[-2], hull[-1]
            if (bx - ax) * (point[1] - ay) < (by - ay) * (point[0] - ax):
                break
            hull.pop()
        hull.append(point)
    return np.array(hull)
