"""The patella against the femur while the knee bends: in its groove, its ligament as long as at rest.

In the plane of knee flexion the patella turns by 0.7 of the knee's angle (Amis et al. 2006), keeps its least gap to
the groove of the femur (outline of trochlea and condyles beside it about the knee's axis), and lies where the
ligament from its apex to the tibial tuberosity has its length at rest (as in the model of Yamaguchi and Zajac 1989).
Points of the plane are complex numbers about the knee's axis: forwards, and i times downwards.
"""

from __future__ import annotations

import numpy as np

from rbfmuscle.importers.guess.anatomy import JointGuess, rounded
from rbfmuscle.importers.guess.landmarks import across, unit

# Knee flexion from the rest pose [degree] at which the path is taken.
FLEXIONS = tuple(range(0, 131, 10))
TURN = 0.7
# Half the breadth beside the patella's middle that counts as its groove, and its part of the tibia [mm].
GROOVE, TUBEROSITY = 10.0, 15.0
# Length of the ligament that anatomy allows [mm].
LIGAMENT = (25.0, 80.0)
# Angles about the knee's axis that the outline covers, its steps, the order of the polynomial through it [degree].
OUTLINE, STEP, ORDER = (-50.0, 125.0), 5.0, 6


def place_patellae(joints: list[JointGuess], millimetre: float) -> None:
    """Patellae glide in their grooves as the knee bends; about its axis where no groove is found."""
    for joint in joints:
        knee = next((j for j in joints if j.child.kind == "tibia" and j.parent is joint.parent), None)
        if joint.child.kind != "patella" or knee is None or knee.kind != "hinge":
            continue
        joint.axes, joint.rest = {"flexion": knee.axis}, knee.rest
        if not _put_in_groove(joint, knee, millimetre):
            joint.kind, joint.centre, joint.confidence = "hinge", knee.centre, 0.2
            joint.reason = "no groove or no ligament was found: it turns about the knee's axis"


def _put_in_groove(joint, knee, millimetre):
    """Make a patella's joint the custom one of its path; False where its groove or its ligament is not found."""
    femur, axis = joint.parent, knee.axis
    down = unit(across(-femur.frame.superior, axis))
    front = np.cross(down, axis)
    side = float((joint.child.points.mean(axis=0) - knee.centre) @ axis)

    def flat(points, half):
        away = points - knee.centre
        away = away[np.abs(away @ axis - side) < half * millimetre]
        return away @ front + 1j * (away @ down)

    groove = _Groove(flat(np.vstack([femur.points, femur.faces[0]]), GROOVE))
    outline = flat(joint.child.points, np.inf)
    shin, apex = flat(knee.child.points, TUBEROSITY), outline[np.argmax(outline.imag)]
    gaps = np.abs(shin - apex) / millimetre
    shin = shin[(gaps > LIGAMENT[0]) & (gaps < LIGAMENT[1]) & (shin.imag > apex.imag)]
    middle = outline.mean()
    if len(shin) == 0 or not groove.low < np.angle(middle, deg=True) < groove.high:
        return False
    tuberosity = shin[np.argmax(shin.real)]
    shifts = _follow(groove, outline, middle, apex, tuberosity)
    flexions = np.array(FLEXIONS, dtype=float)

    def table(direction, values):
        spline = {"x": rounded(knee.rest + flexions, 3), "y": rounded(values, 6)}
        return {"axis": rounded(direction, 6), "coordinates": ["flexion"], "spline": spline}

    def place(point):
        return knee.centre + side * axis + point.real * front + point.imag * down

    joint.tables["rotations"] = [table(axis, TURN * flexions)]
    joint.tables["translations"] = [table(front, shifts.real), table(down, shifts.imag)]
    joint.kind, joint.centre, joint.confidence = "custom", place(middle), 0.6
    joint.follows, joint.ligament = knee.coordinate, np.stack([place(apex), place(tuberosity)])
    length = abs(apex - tuberosity) / millimetre
    joint.reason = f"in its groove, on a ligament of {length:.3g} mm, to {FLEXIONS[-1]} degrees"
    return True


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
