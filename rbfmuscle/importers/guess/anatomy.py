"""The patella against the femur while the knee bends: in its groove, its ligament as long as at
rest.

In the plane of knee flexion the patella turns by 0.7 of the knee's angle (Amis et al. 2006), keeps
its distance from the middle of its groove (a circle through the outline of the trochlea about the
knee's axis), and lies where the ligament from its apex to the tibial tuberosity has its length at
rest (as in the model of Yamaguchi and Zajac 1989). Points of the plane are complex numbers about
the knee's axis: forwards, and i times downwards.
"""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from rbfmuscle.anatomy.bones import (
    Fit,
    Orientation,
    Part,
    fit_condyles,
    fit_dome,
    fit_sphere,
    shank_up,
    sole_direction,
)
from rbfmuscle.geometry.arrays import across, unit

# Class of bone: its possible parents, the likeliest first, and the kind of joint between.
PARENTS = {
    "ilium": (("pelvis", "weld"), ("sacrum", "weld")),
    "ischium": (("ilium", "weld"), ("pelvis", "weld")),
    "pubis": (("ilium", "weld"), ("pelvis", "weld")),
    "pelvis": (("pelvis", "weld"), ("sacrum", "weld")),
    "sacrum": (("pelvis", "weld"), ("ilium", "weld")),
    "femur": (("pelvis", "ball"), ("ilium", "ball"), ("ischium", "ball")),
    "patella": (("femur", "hinge"),),
    "tibia": (("femur", "hinge"),),
    "fibula": (("tibia", "weld"), ("femur", "hinge")),
    "talus": (("tibia", "hinge"), ("fibula", "hinge")),
    "calcaneus": (("talus", "weld"), ("tibia", "hinge")),
    "foot": (("calcaneus", "weld"), ("talus", "weld"), ("foot", "weld"), ("tibia", "hinge")),
    "vertebra": (("vertebra", "weld"), ("sacrum", "weld"), ("pelvis", "weld")),
    "scapula": (("clavicle", "weld"), ("rib", "weld"), ("sternum", "weld")),
    "clavicle": (("sternum", "weld"), ("rib", "weld")),
    "humerus": (("scapula", "ball"),),
    "ulna": (("humerus", "hinge"),),
    "radius": (("ulna", "weld"), ("humerus", "hinge")),
    "hand": (("radius", "ball"), ("ulna", "ball"), ("hand", "weld")),
}
ROOTS = ("pelvis", "ilium", "sacrum", "scapula", "rib", "vertebra", "femur", "humerus", "tibia")
# Class of the child: name of its joint with one of its parents above.
JOINTS = dict(
    femur="hip", tibia="knee", talus="ankle", patella="patella", humerus="shoulder", ulna="elbow"
)
# Joint: coordinates and ranges [degree] (American Academy of Orthopaedic Surgeons 1965, Joint
# Motion). Positive as the International Society of Biomechanics has it (Wu et al. 2002): flexion,
# adduction, internal rotation, dorsiflexion.
COORDINATES = {
    "hip": {"flexion": (-30.0, 120.0), "adduction": (-45.0, 30.0), "rotation": (-45.0, 45.0)},
    "knee": {"flexion": (-10.0, 135.0)},
    "ankle": {"dorsiflexion": (-50.0, 20.0)},
}
CUT = 0.4  # confidence in axes of a bone that is cut off where a scan ends
MISFIT = 0.05  # greatest misfit of a condyle or a dome against its radius


@dataclass
class JointGuess:
    """A joint as guessed."""

    parent: Part
    child: Part
    kind: str  # "ball", "hinge", "custom" (the patella) or "weld"
    centre: np.ndarray  # (3,) [scene unit]
    axes: dict[str, np.ndarray]  # (3,) by coordinate
    # 0 to 1: where something was fitted, one minus half the misfit over its limit.
    confidence: float
    reason: str
    name: str = ""
    ranges: dict[str, tuple] = field(default_factory=dict)  # of coordinates [degree]
    rest: float = 0.0  # value of the first coordinate in the pose of the meshes [degree]
    tables: dict[str, list] = field(
        default_factory=dict
    )  # rotations and translations of a custom joint
    follows: str = ""  # full name of the coordinate that the first one follows
    # Ends (2, 3) of a patella's, on it and on the tibia, at rest.
    ligament: np.ndarray | None = None

    @property
    def axis(self) -> np.ndarray:
        """Axis (3,) of the first coordinate."""
        return next(iter(self.axes.values()))

    @property
    def coordinate(self) -> str:
        """Full name of the first coordinate."""
        return f"{self.name}.{next(iter(self.axes))}"

    def row(self) -> dict[str, object]:
        """The joint's table in the scene file [degree, scene unit]."""
        row: dict[str, object] = {
            "name": self.name,
            "parent": self.parent.name,
            "child": self.child.name,
        }
        row["type"] = self.kind
        if self.kind == "weld":
            return row
        row["centre"] = rounded(self.centre, 6)
        if not self.tables:
            row["axes"] = {name: rounded(axis, 6) for name, axis in self.axes.items()}
        facts: dict[str, dict] = {
            name: {"range": rounded(ends, 1)} for name, ends in self.ranges.items()
        }
        first = facts.setdefault(next(iter(self.axes)), {})
        first |= ({"rest": self.rest} if self.rest else {}) | (
            {"motion": "rotation"} if self.tables else {}
        )
        return row | self.tables | ({"coordinates": facts} if first else {})


def rounded(values: ArrayLike, digits: int) -> list[float]:
    """Numbers rounded for the scene file."""
    return np.round(np.asarray(values, dtype=float), digits).tolist()


def make_anatomical(
    joint: JointGuess,
    bones: list[Part],
    joints: list[JointGuess],
    orientation: Orientation,
    millimetre: float,
) -> None:
    """Give a joint the method and the coordinates that anatomy has for it; ``joints`` are those
    before it.
    """
    pair, right = (joint.parent.kind, joint.child.kind), orientation.right
    if pair[1] == "femur" and joint.kind == "ball":
        lowest = joint.child.points[np.argmin(joint.child.points @ orientation.superior)]
        up = unit(across(joint.centre - lowest, right))
        if joint.child.cut is not None:
            up = unit(across(joint.child.frame.superior, right))
            joint.confidence = min(joint.confidence, CUT)
            joint.reason += f"; {joint.child.name} is cut off: its axes are those of its cut"
        inward = 1.0 if joint.child.frame.side == "r" else -1.0
        axes = (right, inward * np.cross(up, right), inward * up)
        joint.axes, joint.ranges = dict(zip(COORDINATES["hip"], axes)), COORDINATES["hip"]
    elif pair == ("femur", "tibia"):
        fit = fit_condyles(joint.parent, joint.parent.frame, millimetre)
        _take(joint, fit, "posterior condyles", "knee", -right)
    elif pair == ("tibia", "talus"):
        knee = next((j for j in joints if j.child is joint.parent and j.kind == "hinge"), None)
        start = right if knee is None else -knee.axis
        fit = fit_dome(joint.child, joint.parent, shank_up(joint.parent, bones), start, millimetre)
        _take(joint, fit, "talar dome and tibial plafond", "ankle", right)
    elif joint.kind == "hinge":
        joint.axes = {"angle": joint.axis * (-1.0 if joint.axis @ right < 0.0 else 1.0)}


def _take(
    joint: JointGuess, fit: Fit | None, method: str, name: str, direction: np.ndarray
) -> None:
    """Take a fitted axis, in about a direction (3,), for a hinge."""
    joint.kind, joint.ranges = "hinge", COORDINATES[name]
    coordinate = next(iter(joint.ranges))
    if fit is None:
        joint.reason, joint.confidence = f"{method} not found: the axis is across the body", 0.1
        joint.axes = {coordinate: direction}
        return
    radii = " and ".join(f"{radius:.4g}" for radius in fit.radii)
    joint.reason = f"{method}, radii {radii}, misfit {fit.misfit:.2g}"
    joint.centre = fit.centre
    joint.axes = {coordinate: fit.axis * np.copysign(1.0, fit.axis @ direction)}
    joint.confidence = max(1.0 - 0.5 * fit.misfit / (MISFIT * min(fit.radii)), 0.1)
    joint.confidence -= 0.2 * (
        len(fit.radii) < 2
    )  # one surface alone shows the direction less well
    if fit.wrong:
        joint.reason, joint.confidence = f"{joint.reason}; {fit.wrong}: refused, correct it", 0.1


def set_rest(joints: list[JointGuess], bones: list[Part]) -> None:
    """Set the knee flexion and ankle dorsiflexion of the meshes: by axes of the bones and the sole
    of the foot.
    """
    for joint in joints:
        if joint.child.kind == "tibia" and "flexion" in joint.axes:
            thigh, shank = joint.parent.frame.superior, shank_up(joint.child, bones)
            for other in joints:  # from centre to centre where both ends have one
                if other.child is joint.parent and other.kind == "ball":
                    thigh = other.centre - joint.centre
                if other.parent is joint.child and "dorsiflexion" in other.axes:
                    shank = joint.centre - other.centre
            joint.rest = _angle_about(joint.axis, thigh, shank)
        elif "dorsiflexion" in joint.axes:
            feet = [
                b.points
                for b in bones
                if b.kind in ("foot", "calcaneus") and b.side == joint.child.side
            ]
            up = shank_up(joint.parent, bones)
            if feet:
                sole = sole_direction(np.vstack(feet), joint.axis, up)
                joint.rest = _angle_about(joint.axis, np.cross(up, joint.axis), sole)
        joint.ranges = {
            name: (min(low, joint.rest), max(high, joint.rest))
            for name, (low, high) in joint.ranges.items()
        }


def _angle_about(axis, start, end):
    """Angle [degree] about an axis from one direction to another, both seen along it."""
    start, end = across(start, axis), across(end, axis)
    return float(round(np.degrees(np.arctan2(np.cross(start, end) @ axis, start @ end)), 1))


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
