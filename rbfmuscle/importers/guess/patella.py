"""The patella against the femur while the knee bends: in its groove, its ligament as long as at rest.

In the plane of knee flexion the patella turns by 0.7 of the knee's angle (Amis et al. 2006), keeps its least gap to
the groove of the femur (outline of trochlea and condyles beside it about the knee's axis), and lies where the
ligament from its apex to the tibial tuberosity has its length at rest (as in the model of Yamaguchi and Zajac 1989).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

# Knee flexion from the rest pose [degree] at which the path is taken.
FLEXIONS = tuple(range(0, 131, 10))
TURN = 0.7
# Half the breadth beside the patella's middle that counts as its groove, and its part of the tibia [mm].
GROOVE, TUBEROSITY = 10.0, 15.0
# Angles about the knee's axis that the outline covers, its steps, the order of the polynomial through it [degree].
OUTLINE, STEP, ORDER = (-50.0, 125.0), 5.0, 6


@dataclass
class PatellaPath:
    """How the patella moves.

    Attributes
    ----------
    centre : (3,) ndarray
        Its place against the groove at rest [scene unit].
    axis, front, down : (3,) ndarray
        Unit: the knee's axis, forwards and downwards at rest.
    turns : (n,) ndarray
        About the axis at `FLEXIONS` [degree].
    shifts : (n, 2) ndarray
        Along ``front`` and ``down`` [scene unit].
    ligament : float
        Length of the ligament [scene unit].
    """

    centre: np.ndarray
    axis: np.ndarray
    front: np.ndarray
    down: np.ndarray
    turns: np.ndarray
    shifts: np.ndarray
    ligament: float

    def pose(self, flexion: float) -> np.ndarray:
        """Motion (4, 4) against the femur at a knee flexion from rest on [degree]."""
        turn = Rotation.from_rotvec(
            np.radians(np.interp(flexion, FLEXIONS, self.turns)) * self.axis
        ).as_matrix()
        shift = [np.interp(flexion, FLEXIONS, self.shifts[:, k]) for k in (0, 1)]
        motion = np.eye(4)
        motion[:3, :3] = turn
        motion[:3, 3] = self.centre - turn @ self.centre + shift[0] * self.front + shift[1] * self.down
        return motion


class _Groove:
    """Outline of the femur about the knee's axis in the plane of flexion."""

    def __init__(self, femur, knee, axis, front, down, side, millimetre):
        self.knee, self.front, self.down = knee, front, down
        points = np.vstack([femur.points, femur.mesh.triangles_center])
        points = points[np.abs((points - knee) @ axis - side) < GROOVE * millimetre]
        angle = np.degrees(np.arctan2((points - knee) @ down, (points - knee) @ front))
        distance = np.hypot((points - knee) @ down, (points - knee) @ front)
        marks, radii = [], []
        for low in np.arange(*OUTLINE, STEP):
            inside = distance[(angle >= low) & (angle < low + STEP)]
            if len(inside) > 3:
                marks.append(low + 0.5 * STEP)
                radii.append(np.percentile(inside, 95))
        self.curve = (
            np.polynomial.Polynomial.fit(marks, radii, min(ORDER, max(len(marks) - 2, 1))) if marks else None
        )
        self.low, self.high = (marks[0], marks[-1]) if marks else (0.0, 0.0)

    def gap(self, outline):
        """Least distance of an outline (n, 2) to the groove, along the way to the knee's axis."""
        angle = np.clip(np.degrees(np.arctan2(outline[:, 1], outline[:, 0])), self.low, self.high)
        return float((np.hypot(*outline.T) - self.curve(angle)).min())


def patella_path(
    femur: Any,
    tibia: Any,
    patella: Any,
    knee: np.ndarray,
    axis: np.ndarray,
    up: np.ndarray,
    millimetre: float,
) -> PatellaPath | None:
    """The path of a patella, None where its groove or its ligament is not found.

    Parameters
    ----------
    femur, tibia, patella : Part
    knee, axis : (3,) ndarray
        The knee's centre and its axis, flexion positive.
    up : (3,) ndarray
        Along the femur.
    """
    down = -(up - up @ axis * axis)
    down = down / np.linalg.norm(down)
    front = np.cross(down, axis)
    side = float((patella.points.mean(axis=0) - knee) @ axis)
    groove = _Groove(femur, knee, axis, front, down, side, millimetre)
    if groove.curve is None:
        return None

    def flat(points):
        return np.column_stack([(points - knee) @ front, (points - knee) @ down])

    outline = flat(patella.points)
    apex = outline[np.argmax(outline[:, 1])]
    shin = flat(tibia.points[np.abs((tibia.points - knee) @ axis - side) < TUBEROSITY * millimetre])
    gaps = np.linalg.norm(shin - apex, axis=1) / millimetre
    shin = shin[(gaps > 25.0) & (gaps < 80.0) & (shin[:, 1] > apex[1])]
    middle = outline.mean(axis=0)
    if len(shin) == 0 or not groove.low < np.degrees(np.arctan2(middle[1], middle[0])) < groove.high:
        return None
    shifts, ligament = _follow(groove, outline, middle, apex, shin[np.argmax(shin[:, 0])])
    centre = knee + side * axis + np.column_stack([front, down]) @ middle
    return PatellaPath(centre, axis, front, down, TURN * np.array(FLEXIONS, dtype=float), shifts, ligament)


def _follow(groove, outline, middle, apex, tuberosity):
    """Shifts and the ligament's length: at each flexion the place along the groove, from the one before on."""
    length, least, shifts = float(np.linalg.norm(apex - tuberosity)), groove.gap(outline), []
    angle, radius = float(np.degrees(np.arctan2(middle[1], middle[0]))), float(np.hypot(*middle))
    for flexion in FLEXIONS:
        end, best = _turned(tuberosity, flexion), None
        turned, tip = (_turned(part - middle, TURN * flexion) for part in (outline, apex))
        for tried in np.arange(angle, angle + 20.0, 0.5) if flexion else (angle,):
            way, there = _turned(np.array([1.0, 0.0]), tried), radius
            for _ in range(6):
                there += least - groove.gap(turned + there * way)
            error = abs(float(np.linalg.norm(there * way + tip - end)) - length)
            if best is None or error < best[0]:
                best = (error, float(tried), there)
        angle, radius = best[1:]
        shifts.append(_turned(np.array([radius, 0.0]), angle) - middle)
    return np.array(shifts), length


def _turned(points, degrees):
    c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return points @ np.array([[c, s], [-s, c]])
