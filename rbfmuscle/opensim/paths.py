"""Muscle paths of a model: points, conditions and moving points."""

from collections.abc import Callable

import numpy as np

from rbfmuscle.opensim.frames import Frames
from rbfmuscle.opensim.functions import find_function, numbers, read_function, vector
from rbfmuscle.opensim.model import ModelPath, ModelPoint, OsimModel
from rbfmuscle.opensim.xml import Node
from rbfmuscle.sim.joints.functions import Constant
from rbfmuscle.validation import SceneError

# OpenSim widens a condition's range by this at both ends.
CONDITION_MARGIN = 1e-5


def read_paths(model: OsimModel, node: Node, frames: Frames, problem: Callable) -> list[ModelPath]:
    """Return the path of every actuator that has one; what is wrong with a path is noted, and the path left out."""
    found = []
    for force in node.objects("ForceSet"):
        path = force.child("GeometryPath") or _held_path(force)
        if path is None:
            continue
        try:
            points = [_point(point, force.name, frames, problem) for point in path.objects("PathPointSet")]
        except SceneError as error:
            model.notes.append(f"{str(error).removeprefix(f'{model.path}: ')}: the path is not taken")
            continue
        wraps = [wrap.word("wrap_object") for wrap in path.objects("PathWrapSet")]
        if len(points) > 1:
            found.append(ModelPath(force.name, force.tag, points, wraps))
    return found


def _held_path(force):
    holder = force.child("path")
    return None if holder is None else holder.child("GeometryPath")


def _point(point, muscle, frames, problem):
    place = f"muscle {muscle!r}: point {point.name!r}"
    name = point.word("socket_parent_frame") or point.word("body")
    if not name:
        raise problem(f"{place}: names no body; give it one")
    body, frame = frames.place(name)
    where = np.array(vector(point, "location", "0 0 0", place=place, problem=problem))
    condition, moving = None, None
    if point.tag == "ConditionalPathPoint":
        coordinate = _coordinate(point, "coordinate")
        low, high = numbers(point.word("range"), place=f"{place}: range", problem=problem, count=2)
        condition = (coordinate, low, high)
    elif point.tag == "MovingPathPoint":
        parts = []
        for axis in "xyz":
            inner = find_function(point.child(f"{axis}_location"))
            at = f"{place}: {axis}_location"
            function = Constant(0.0) if inner is None else read_function(inner, place=at, problem=problem)
            parts.append((_coordinate(point, f"{axis}_coordinate") or None, function))
        moving = tuple(parts)
    return ModelPoint(point.name, body, where, frame, condition, moving)


def _coordinate(point, tag):
    return (point.word(f"socket_{tag}") or point.word(tag)).rsplit("/", 1)[-1]


def active_points(
    model: OsimModel, path: ModelPath, values: dict[str, float] | None = None
) -> list[tuple[ModelPoint, np.ndarray]]:
    """Return the points that count at some coordinates, each with its place in its body (3,) [metre].

    Parameters
    ----------
    values : dict of str to float, optional
        As for `OsimModel.resolve`.
    """
    resolved, facts = model.resolve(values), model.coordinates()
    found = []
    for point in path.points:
        if point.condition is not None:
            name, low, high = point.condition
            if not low - CONDITION_MARGIN <= resolved.get(name, low) <= high + CONDITION_MARGIN:
                continue
        place = point.place
        if point.moving is not None:
            place = np.array([_moved(name, function, resolved, facts) for name, function in point.moving])
        found.append((point, point.frame[:3, :3] @ place + point.frame[:3, 3]))
    return found


def _moved(name, function, resolved, facts):
    if name not in resolved:
        return function(0.0)
    limits = facts[name].range
    value = resolved[name] if limits is None else min(max(resolved[name], limits[0]), limits[1])
    return function(value)
