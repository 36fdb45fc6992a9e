"""Hip, knee, ankle and patella with the methods, names, signs and ranges that anatomy has for them."""

from __future__ import annotations

from typing import Any

import numpy as np

from rbfmuscle.importers.guess.anatomy import COORDINATES
from rbfmuscle.importers.guess.landmarks import fit_condyles, fit_dome, sole_direction
from rbfmuscle.importers.guess.orientation import Orientation, shank_up
from rbfmuscle.importers.guess.patella import FLEXIONS, patella_path

# Greatest misfit of a condyle or a dome against its radius.
MISFIT = 0.05


def as_anatomy_has_it(
    joint: Any, bones: list[Any], joints: list[Any], orientation: Orientation, millimetre: float
) -> Any:
    """The joint with the method and the coordinates that anatomy has for it, as it is where it is none of these."""
    pair, right = (joint.parent.kind, joint.child.kind), orientation.right
    if pair[1] == "femur" and joint.kind == "ball":
        side = orientation.sides.get(id(joint.child)) or joint.child.side or "r"
        up = joint.centre - joint.child.points[np.argmin(joint.child.points @ orientation.superior)]
        up = up - up @ right * right
        up = up / np.linalg.norm(up)
        inward = 1.0 if side == "r" else -1.0
        axes = (right, inward * np.cross(up, right), inward * up)
        joint.axes, joint.ranges = dict(zip(COORDINATES["hip"], axes)), COORDINATES["hip"]
        return joint
    if pair == ("femur", "tibia"):
        fit, sign = fit_condyles(joint.parent, orientation.frames[id(joint.parent)], millimetre), -1.0
        method, coordinate = "posterior condyles, radii {}", "knee"
    elif pair == ("tibia", "talus"):
        knee = next((j for j in joints if j.child is joint.parent and j.kind == "hinge"), None)
        start = right if knee is None else -next(iter(knee.axes.values()))
        fit, sign = fit_dome(joint.child, joint.parent, shank_up(joint.parent, bones), start, millimetre), 1.0
        method, coordinate = "talar dome and tibial plafond, radii {}", "ankle"
    else:
        if joint.kind == "hinge" and next(iter(joint.axes.values())) @ right < 0.0:
            joint.axes = {"angle": -next(iter(joint.axes.values()))}
        return joint
    joint.kind, joint.ranges = "hinge", COORDINATES[coordinate]
    name = next(iter(joint.ranges))
    if fit is None:
        joint.reason, joint.confidence = f"{method.split(',')[0]} not found: the axis is across the body", 0.1
        joint.axes = {name: sign * right}
        return joint
    radii = " and ".join(f"{radius:.4g}" for radius in fit.radii)
    joint.centre, joint.reason = fit.centre, f"{method.format(radii)}, misfit {fit.misfit:.2g}"
    joint.axes = {name: sign * fit.axis * np.sign(fit.axis @ right)}
    joint.confidence = max(1.0 - 0.5 * fit.misfit / (MISFIT * min(fit.radii)), 0.1) - 0.2 * (
        len(fit.radii) < 2
    )
    if fit.wrong:
        joint.reason, joint.confidence = f"{joint.reason}; {fit.wrong}: refused, correct it", 0.1
    return joint


def set_rest(joints: list[Any], bones: list[Any], orientation: Orientation) -> None:
    """Set the knee flexion and ankle dorsiflexion of the meshes: by axes of the bones and the sole of the foot."""
    for joint in joints:
        if "flexion" in joint.axes and joint.child.kind == "tibia":
            axis = joint.axes["flexion"]
            thigh, shank = orientation.frames[id(joint.parent)].superior, shank_up(joint.child, bones)
            for other in joints:  # from centre to centre where both ends have one
                if other.child is joint.parent and other.kind == "ball":
                    thigh = other.centre - joint.centre
                if other.parent is joint.child and "dorsiflexion" in other.axes:
                    shank = joint.centre - other.centre
            joint.rest = _angle_about(axis, thigh, shank)
        elif "dorsiflexion" in joint.axes:
            feet = [b.points for b in bones if b.kind in ("foot", "calcaneus") and b.side == joint.child.side]
            axis, up = joint.axes["dorsiflexion"], shank_up(joint.parent, bones)
            if feet:
                joint.rest = _angle_about(axis, np.cross(up, axis), sole_direction(np.vstack(feet), axis, up))
        joint.ranges = {
            name: (min(low, joint.rest), max(high, joint.rest)) for name, (low, high) in joint.ranges.items()
        }


def _angle_about(axis, start, end):
    """Angle [degree] about an axis from one direction to another, both seen along it."""
    start, end = (v - v @ axis * axis for v in (start, end))
    return float(round(np.degrees(np.arctan2(np.cross(start, end) @ axis, start @ end)), 1))


def place_patellae(joints: list[Any], orientation: Orientation, millimetre: float) -> None:
    """Patellae glide in their grooves as the knee bends; about its axis where no groove is found."""
    for joint in joints:
        knee = next((j for j in joints if j.child.kind == "tibia" and j.parent is joint.parent), None)
        if joint.child.kind != "patella" or knee is None or knee.kind != "hinge":
            continue
        axis = next(iter(knee.axes.values()))
        up = orientation.frames[id(joint.parent)].superior
        parts = (joint.parent, knee.child, joint.child)
        joint.path = patella_path(*parts, knee.centre, axis, up, millimetre)
        joint.axes, joint.rest = {"flexion": axis}, knee.rest
        if joint.path is None:
            joint.kind, joint.centre, joint.confidence = "hinge", knee.centre, 0.2
            joint.reason = "no groove or no ligament was found: it turns about the knee's axis"
            continue
        joint.kind, joint.centre, joint.confidence = "custom", joint.path.centre, 0.6
        joint.follows = (knee.coordinate,)
        ligament = f"{joint.path.ligament / millimetre:.3g} mm"
        joint.reason = f"in its groove, on a ligament of {ligament}, to {FLEXIONS[-1]} degrees"
