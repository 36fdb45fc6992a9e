"""The patella against the femur while the knee bends: in its groove, its ligament as long as at
rest.

In the plane of knee flexion the patella turns by 0.7 of the knee's angle (Amis et al. 2006), keeps
its distance from the middle of its groove (a circle through the outline of the trochlea about the
knee's axis), and lies where the ligament from its apex to the tibial tuberosity has its length at
rest (as in the model of Yamaguchi and Zajac 1989). Points of the plane are complex numbers about
the knee's axis: forwards, and i times downwards.
"""

import numpy as np

from rbfmuscle.anatomy.bones import fit_sphere
from rbfmuscle.geometry.vectors import across, unit
from rbfmuscle.importers.guess.anatomy import JointGuess, rounded

FLEXIONS = tuple(
    range(0, 131, 10)
)  # knee flexion from the rest pose [degree] at which the path is taken
TURN = 0.7  # of the knee's flexion (Amis et al. 2006)
# Half the breadth beside the patella's middle that counts as its groove, and its part of the tibia
# [mm].
GROOVE, TUBEROSITY = 10.0, 15.0
LIGAMENT = (25.0, 80.0)  # length of the ligament that anatomy allows [mm]
# Angles about the knee's axis that the outline covers, its steps [degree], and the fewest points of
# it.
OUTLINE = (-30.0, 90.0)
STEP = 5.0
FEWEST = 6


def place_patellae(joints: list[JointGuess], millimetre: float) -> None:
    """Patellae glide in their grooves as the knee bends; about its axis where no groove is
    found.
    """
    for joint in joints:
        knee = next(
            (j for j in joints if j.child.kind == "tibia" and j.parent is joint.parent), None
        )
        if joint.child.kind != "patella" or knee is None or knee.kind != "hinge":
            continue
        joint.axes, joint.rest = {"flexion": knee.axis}, knee.rest
        if not _put_in_groove(joint, knee, millimetre):
            joint.kind = "hinge"
            joint.centre = knee.centre
            joint.confidence = 0.2
            joint.reason = "no groove or no ligament was found: it turns about the knee's axis"


def _put_in_groove(joint, knee, millimetre):
    """Make a patella's joint the custom one of its path; False where its groove or its ligament is
    not found.
    """
    femur, axis = joint.parent, knee.axis
    down = unit(across(-femur.frame.superior, axis))
    front = np.cross(down, axis)
    side = float((joint.child.points.mean(axis=0) - knee.centre) @ axis)

    def flat(points, half):
        away = points - knee.centre
        away = away[np.abs(away @ axis - side) < half * millimetre]
        return away @ front + 1j * (away @ down)

    groove = _outline(flat(np.vstack([femur.points, femur.faces[0]]), GROOVE))
    outline = flat(joint.child.points, np.inf)
    shin, apex = flat(knee.child.points, TUBEROSITY), outline[np.argmax(outline.imag)]
    gaps = np.abs(shin - apex) / millimetre
    shin = shin[(gaps > LIGAMENT[0]) & (gaps < LIGAMENT[1]) & (shin.imag > apex.imag)]
    if len(shin) == 0 or len(groove) < FEWEST:
        return False
    middle, tuberosity = outline.mean(), shin[np.argmax(shin.real)]
    centre, _ = fit_sphere(np.stack([groove.real, groove.imag], axis=1), np.ones(len(groove)))
    shifts = _follow(complex(*centre), middle, apex, tuberosity)
    flexions = np.array(FLEXIONS, dtype=float)

    def table(direction, values):
        spline = {"x": rounded(knee.rest + flexions, 3), "y": rounded(values, 6)}
        return {"axis": rounded(direction, 6), "coordinates": ["flexion"], "spline": spline}

    def place(point):
        return knee.centre + side * axis + point.real * front + point.imag * down

    joint.tables["rotations"] = [table(axis, TURN * flexions)]
    joint.tables["translations"] = [table(front, shifts.real), table(down, shifts.imag)]
    joint.kind = "custom"
    joint.centre = place(middle)
    joint.confidence = 0.6
    joint.follows, joint.ligament = knee.coordinate, np.stack([place(apex), place(tuberosity)])
    length = abs(apex - tuberosity) / millimetre
    joint.reason = f"in its groove, on a ligament of {length:.3g} mm, to {FLEXIONS[-1]} degrees"
    return True


def _outline(points):
    """The outermost points of the femur about the knee's axis, step by step of the angle."""
    angle, found = np.angle(points, deg=True), []
    for low in np.arange(*OUTLINE, STEP):
        inside = np.abs(points[(angle >= low) & (angle < low + STEP)])
        if len(inside) > 3:
            found.append(np.percentile(inside, 95) * _turn(low + 0.5 * STEP))
    return np.array(found)


def _follow(centre, middle, apex, tuberosity):
    """Shifts of the patella: at each flexion the place about the groove's centre, from the one
    before on.
    """
    length = abs(apex - tuberosity)
    angle = 0.0
    shifts = []
    for flexion in FLEXIONS:
        end, tip = tuberosity * _turn(flexion), (apex - middle) * _turn(TURN * flexion)
        tried = np.arange(angle, angle + 20.0, 0.5) if flexion else np.zeros(1)
        places = centre + (middle - centre) * _turn(tried)
        best = np.argmin(np.abs(np.abs(places + tip - end) - length))
        angle = tried[best]
        shifts.append(places[best] - middle)
    return np.array(shifts)


def _turn(degrees):
    """The factor that turns points of the plane by an angle."""
    return np.exp(1j * np.radians(degrees))
