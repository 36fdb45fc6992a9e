"""The patella against the femur while the knee bends: in its groove, its ligament as long as at rest.

In the plane of knee flexion the patella turns by 0.7 of the knee's angle (Amis et al. 2006), keeps its least gap to
the groove of the femur (outline of trochlea and condyles beside it about the knee's axis), and lies where the
ligament from its apex to the tibial tuberosity has its length at rest (as in the model of Yamaguchi and Zajac 1989).
Points of the plane are complex numbers about the knee's axis: forwards, and i times downwards.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rbfmuscle.importers.guess.anatomy import JointGuess, rounded
from rbfmuscle.importers.guess.landmarks import across, unit
from rbfmuscle.importers.guess.parts import Part

# Knee flexion from the rest pose [degree] at which the path is taken.
FLEXIONS = tuple(range(0, 131, 10))
TURN = 0.7
# Half the breadth beside the patella's middle that counts as its groove, and its part of the tibia [mm].
GROOVE, TUBEROSITY = 10.0, 15.0
# Length of the ligament that anatomy allows [mm].
LIGAMENT = (25.0, 80.0)
# Angles about the knee's axis that the outline covers, its steps, the order of the polynomial through it [degree].
OUTLINE, STEP, ORDER = (-50.0, 125.0), 5.0, 6


class PatellaPath(NamedTuple):
    """Place (3,) and the ligament's ends (2, 3), at rest, and the custom joint's rotations and translations."""

    centre: np.ndarray
    ligament: np.ndarray
    tables: dict[str, list]


def patella_path(
    femur: Part, tibia: Part, patella: Part, knee: JointGuess, millimetre: float
) -> PatellaPath | None:
    """The path of a patella, None where its groove or its ligament is not found; ``knee`` has its axis and rest."""
    axis = knee.axis
    down = unit(across(-femur.frame.superior, axis))
    front = np.cross(down, axis)
    side = float((patella.points.mean(axis=0) - knee.centre) @ axis)

    def flat(points, half):
        away = points - knee.centre
        away = away[np.abs(away @ axis - side) < half * millimetre]
        return away @ front + 1j * (away @ down)

    groove = _Groove(flat(np.vstack([femur.points, femur.faces[0]]), GROOVE))
    outline = flat(patella.points, np.inf)
    shin, apex = flat(tibia.points, TUBEROSITY), outline[np.argmax(outline.imag)]
    gaps = np.abs(shin - apex) / millimetre
    shin = shin[(gaps > LIGAMENT[0]) & (gaps < LIGAMENT[1]) & (shin.imag > apex.imag)]
    middle = outline.mean()
    if len(shin) == 0 or not groove.low < np.angle(middle, deg=True) < groove.high:
        return None
    tuberosity = shin[np.argmax(shin.real)]
    shifts = _follow(groove, outline, middle, apex, tuberosity)
    flexions = np.array(FLEXIONS, dtype=float)

    def table(direction, values):
        spline = {"x": rounded(knee.rest + flexions, 3), "y": rounded(values, 6)}
        return {"axis": rounded(direction, 6), "coordinates": ["flexion"], "spline": spline}

    tables = {
        "rotations": [table(axis, TURN * flexions)],
        "translations": [table(front, shifts.real), table(down, shifts.imag)],
    }

    def place(point):
        return knee.centre + side * axis + point.real * front + point.imag * down

    return PatellaPath(place(middle), np.stack([place(apex), place(tuberosity)]), tables)


class _Groove:
    """Outline of the femur about the knee's axis in the plane of flexion."""

    def __init__(self, points):
        angle, marks, radii = np.angle(points, deg=True), [], []
        for low in np.arange(*OUTLINE, STEP):
            inside = np.abs(points[(angle >= low) & (angle < low + STEP)])
            if len(inside) > 3:
                marks.append(low + 0.5 * STEP)
                radii.append(np.percentile(inside, 95))
        self.low, self.high = (marks[0], marks[-1]) if marks else (0.0, 0.0)
        if marks:
            self.curve = np.polynomial.Polynomial.fit(marks, radii, min(ORDER, max(len(marks) - 2, 1)))

    def gap(self, outline):
        """Least distance of an outline to the groove, towards the knee's axis."""
        angle = np.clip(np.angle(outline, deg=True), self.low, self.high)
        return float((np.abs(outline) - self.curve(angle)).min())


def _follow(groove, outline, middle, apex, tuberosity):
    """Shifts of the patella: at each flexion the place along the groove, from the one before on."""
    length, least, shifts = abs(apex - tuberosity), groove.gap(outline), []
    angle, radius = float(np.angle(middle, deg=True)), float(abs(middle))
    for flexion in FLEXIONS:
        end, turn, best = tuberosity * _turn(flexion), _turn(TURN * flexion), (np.inf, 0.0, 0.0)
        for tried in np.arange(angle, angle + 20.0, 0.5) if flexion else (angle,):
            outward, there = _turn(tried), radius
            for _ in range(6):
                there += least - groove.gap((outline - middle) * turn + there * outward)
            error = abs(abs(there * outward + (apex - middle) * turn - end) - length)
            best = min(best, (error, float(tried), there))
        _, angle, radius = best
        shifts.append(radius * _turn(angle) - middle)
    return np.array(shifts)


def _turn(degrees):
    """The factor that turns points of the plane by an angle."""
    return np.exp(1j * np.radians(degrees))
