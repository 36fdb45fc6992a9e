"""Parents of bones; hip, knee and ankle with methods, names, signs and ranges of anatomy; a joint
as guessed.
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
    shank_up,
    sole_direction,
)
from rbfmuscle.geometry.vectors import across, unit

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
