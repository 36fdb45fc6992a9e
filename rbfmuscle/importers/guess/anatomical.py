"""Hip, knee, ankle and patella with the methods, names, signs and ranges that anatomy has for them."""

from __future__ import annotations

import numpy as np

from rbfmuscle.importers.guess.anatomy import COORDINATES, JointGuess
from rbfmuscle.importers.guess.landmarks import across, fit_condyles, fit_dome, sole_direction, unit
from rbfmuscle.importers.guess.orientation import Orientation, shank_up
from rbfmuscle.importers.guess.parts import Part
from rbfmuscle.importers.guess.patella import FLEXIONS, patella_path

# Greatest misfit of a condyle or a dome against its radius.
MISFIT = 0.05


def make_anatomical(
    joint: JointGuess,
    bones: list[Part],
    joints: list[JointGuess],
    orientation: Orientation,
    millimetre: float,
) -> None:
    """Give a joint the method and the coordinates that anatomy has for it; ``joints`` are those before it."""
    pair, right = (joint.parent.kind, joint.child.kind), orientation.right
    if pair[1] == "femur" and joint.kind == "ball":
        lowest = joint.child.points[np.argmin(joint.child.points @ orientation.superior)]
        up = unit(across(joint.centre - lowest, right))
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


def _take(joint, fit, method, name, direction):
    """Take a fitted axis, in about a direction (3,), for a hinge."""
    joint.kind, joint.ranges = "hinge", COORDINATES[name]
    coordinate = next(iter(joint.ranges))
    if fit is None:
        joint.reason, joint.confidence = f"{method} not found: the axis is across the body", 0.1
        joint.axes = {coordinate: direction}
        return
    radii = " and ".join(f"{radius:.4g}" for radius in fit.radii)
    joint.reason = f"{method}, radii {radii}, misfit {fit.misfit:.2g}"
    joint.centre, joint.axes = fit.centre, {coordinate: fit.axis * np.sign(fit.axis @ direction)}
    joint.confidence = max(1.0 - 0.5 * fit.misfit / (MISFIT * min(fit.radii)), 0.1)
    joint.confidence -= 0.2 * (len(fit.radii) < 2)  # one surface alone shows the direction less well
    if fit.wrong:
        joint.reason, joint.confidence = f"{joint.reason}; {fit.wrong}: refused, correct it", 0.1


def set_rest(joints: list[JointGuess], bones: list[Part]) -> None:
    """Set the knee flexion and ankle dorsiflexion of the meshes: by axes of the bones and the sole of the foot."""
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
            feet = [b.points for b in bones if b.kind in ("foot", "calcaneus") and b.side == joint.child.side]
            up = shank_up(joint.parent, bones)
            if feet:
                sole = sole_direction(np.vstack(feet), joint.axis, up)
                joint.rest = _angle_about(joint.axis, np.cross(up, joint.axis), sole)
        joint.ranges = {
            name: (min(low, joint.rest), max(high, joint.rest)) for name, (low, high) in joint.ranges.items()
        }


def _angle_about(axis, start, end):
    """Angle [degree] about an axis from one direction to another, both seen along it."""
    start, end = across(start, axis), across(end, axis)
    return float(round(np.degrees(np.arctan2(np.cross(start, end) @ axis, start @ end)), 1))


def place_patellae(joints: list[JointGuess], millimetre: float) -> None:
    """Patellae glide in their grooves as the knee bends; about its axis where no groove is found."""
    for joint in joints:
        knee = next((j for j in joints if j.child.kind == "tibia" and j.parent is joint.parent), None)
        if joint.child.kind != "patella" or knee is None or knee.kind != "hinge":
            continue
        path = patella_path(joint.parent, knee.child, joint.child, knee, millimetre)
        joint.axes, joint.rest = {"flexion": knee.axis}, knee.rest
        if path is None:
            joint.kind, joint.centre, joint.confidence = "hinge", knee.centre, 0.2
            joint.reason = "no groove or no ligament was found: it turns about the knee's axis"
            continue
        joint.kind, joint.centre, joint.confidence = "custom", path.centre, 0.6
        joint.follows, joint.tables, joint.ligament = (knee.coordinate,), path.tables, path.ligament
        ligament = f"{np.linalg.norm(path.ligament[1] - path.ligament[0]) / millimetre:.3g} mm"
        joint.reason = f"in its groove, on a ligament of {ligament}, to {FLEXIONS[-1]} degrees"
