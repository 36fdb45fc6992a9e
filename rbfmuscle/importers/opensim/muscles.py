"""The muscles of a model: points of their paths in the default pose, shapes to wrap around, volumes of their fibres."""

import numpy as np

from rbfmuscle.importers.opensim.frames import Frames, frame_at
from rbfmuscle.importers.opensim.functions import read_function
from rbfmuscle.importers.opensim.model import GROUND, ModelMuscle, OsimModel, WrapShape
from rbfmuscle.importers.opensim.xml import Node, plain_name

# Force per area of muscle [N/m2] (Arnold et al. 2010, Ann Biomed Eng 38: 269; Rajagopal et al. 2016 have 60 N/cm2).
SPECIFIC_TENSION = 61e4


def read_muscles(model: OsimModel, node: Node, frames: Frames) -> list[ModelMuscle]:
    """The muscles of a model that have a path, a maximum isometric force and an optimal fibre length."""
    ground = node.child("Ground")
    shapes = {}
    for body in [*([ground] if ground is not None else []), *node.objects("BodySet")]:
        for shape in body.objects("WrapObjectSet"):
            radii = _radii(shape)
            if radii is None:
                model.notes.append(f"wrapping object {shape.name!r} ({shape.tag}) is not taken")
            elif shape.truth("active", True) and min(radii) > 0:
                frame = frame_at(shape.vector("translation"), shape.vector("xyz_body_rotation").tolist())
                quadrant = shape.word("quadrant", "all").lower().removeprefix("+").replace("all", "")
                body_name = body.name or GROUND
                shapes[shape.name] = WrapShape(body_name, frame, np.array(radii), shape.tag, quadrant)
    muscles, resting = [], {name: facts.rest for name, facts in model.coordinates().items()}
    for force in node.objects("ForceSet"):
        path = force.child("GeometryPath")
        if path is None or not force.word("optimal_fiber_length"):
            continue
        points = [_path_point(point, frames, resting) for point in path.objects("PathPointSet")]
        names = [plain_name(wrap.word("wrap_object")) for wrap in path.objects("PathWrapSet")]
        volume = force.number("max_isometric_force") * force.number("optimal_fiber_length") / SPECIFIC_TENSION
        wraps = [shapes[name] for name in names if name in shapes]
        muscles.append(ModelMuscle(force.name, [p for p in points if p is not None], wraps, volume))
    return muscles


def _radii(shape):
    if shape.tag == "WrapCylinder":
        return [shape.number("radius")] * 2 + [0.5 * shape.number("length")]
    if shape.tag == "WrapSphere":
        return [shape.number("radius")] * 3
    return shape.numbers("dimensions", "0 0 0", count=3) if shape.tag == "WrapEllipsoid" else None


def _path_point(point, frames, resting):
    """Body and place in it of a path point where coordinates are at their defaults; None where it is not active."""
    body, frame = frames.place(point.word("socket_parent_frame") or point.word("body"))

    def value_of(tag):
        return resting.get(plain_name(point.word(f"socket_{tag}") or point.word(tag)).split("/")[-1], 0.0)

    if point.tag == "ConditionalPathPoint":
        low, high = point.numbers("range", "-1e9 1e9", count=2)
        if not low <= value_of("coordinate") <= high:
            return None
    at = point.vector("location")
    if point.tag == "MovingPathPoint":
        for k, axis in enumerate("xyz"):
            function = read_function(point.child(f"{axis}_location"))
            if function is not None:
                at[k] = function(value_of(f"{axis}_coordinate"))
    return body, frame[:3, :3] @ at + frame[:3, 3]
