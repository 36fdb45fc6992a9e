"""Muscles of a model and what their paths go around, as ``.osim`` files write them."""

from collections import defaultdict

import numpy as np

from rbfmuscle.importers.opensim.elements import (
    ModelMuscle,
    Node,
    Reading,
    WrapShape,
    frame_at,
    read_function,
    socket,
)
from rbfmuscle.scene.joints import Linear, all_coordinates
from rbfmuscle.scene.objects import new_name
from rbfmuscle.validation import SceneError

# Force per area of muscle [N/m2] (Arnold et al. 2010, Ann Biomed Eng 38: 269; Rajagopal et al. 2016
# have 60 N/cm2).
SPECIFIC_TENSION = 61e4
# What OpenSim takes where a muscle, and the defaults of its file, say nothing [N], [m].
FORCE, FIBRE = 1000.0, 0.1
ENDLESS = 1.0  # half the length [m] of a cylinder of contact geometry, which has no ends
GEOMETRY = "GeometryPath"
# Paths of other kinds, and sets of points beside a path, as old versions write them.
PATHS = (GEOMETRY, "Scholz2015GeometryPath", "FunctionBasedPath")
POINTS = ("PathPointSet", "MusclePointSet")
WRAPS = ("PathWrapSet", "MuscleWrapSet")

# Points that are there for some values of a coordinate, and points that move with coordinates.
CONDITIONAL = ("ConditionalPathPoint", "MuscleViaPoint")
MOVING = ("MovingPathPoint", "MovingMusclePoint")


def read_muscles(reading: Reading, forces: list[Node]) -> None:
    """Add the muscles among the forces of a model; those that cannot be taken, and what else has a
    path, are named.
    """
    others = defaultdict(list)
    for force in forces:
        path = next((force.child(tag) for tag in PATHS if force.child(tag) is not None), None)
        if path is None and any(force.child(tag) is not None for tag in POINTS):
            path = force
        muscle = "Muscle" in force.tag or force.child("optimal_fiber_length") is not None
        if not muscle:
            others[force.tag] += [force.name or force.tag] if path is not None else []
            continue
        title = f"{force.tag} {force.name!r}"
        if force.truth("isDisabled") or not force.truth("appliesForce", True):
            reading.model.notes.append(f"{title} is switched off in the model: taken all the same")
        try:
            if path is None:
                raise SceneError("it has no path; give it one")
            if path.tag == "FunctionBasedPath":
                raise SceneError(
                    "its FunctionBasedPath "
                    "gives its length and no points; give it a mesh, or the model before"
                )
            reading.model.muscles.append(_read_muscle(reading, force, path, title))
        except SceneError as error:
            reading.model.doubts.append(f"{title} is not taken: {error}")
    for tag, names in others.items():
        if names:
            reading.model.notes.append(f"{tag} is no muscle: {', '.join(names)} not taken")


def _read_muscle(reading, force, path, title):
    resting = reading.model.resolved()
    points, wraps, changes = [], [], []
    if path.tag == "Scholz2015GeometryPath":
        for element in path.objects("path_elements"):
            inner = next((node for node in element.nodes() if node.tag.endswith("Point")), None)
            if inner is not None:
                points.append(_read_point(reading, inner, resting)[0])
            else:
                wraps.append(_obstacle(reading, element, title))
    else:
        for tag in POINTS:
            for point in path.objects(tag):
                place, change = _read_point(reading, point, resting)
                points.append(place)
                changes += [change] if change else []
        for tag in WRAPS:
            names = [wrap.word("wrap_object") for wrap in path.objects(tag)]
            wraps += [_wrapping(reading, name, title) for name in names]
    if changes:
        reading.model.doubts.append(
            f"{title}: {', '.join(changes)}; its tube stays as at rest, so its lengths and moment "
            "arms are not the model's"
        )
    force_most = force.number("max_isometric_force", FORCE)
    volume = force_most * force.number("optimal_fiber_length", FIBRE) / SPECIFIC_TENSION
    name = new_name(force.name or force.tag, [one.name for one in reading.model.muscles])
    points = [point for point in points if point is not None]
    wraps = [shape for shape in wraps if shape is not None]
    return ModelMuscle(name, points, wraps, volume, title)


def _wrapping(reading, name, title):
    """The shape of a wrapping object by its name, or by owner and name; None where it is not taken.

    Of several of one name it is the first, as OpenSim takes it.
    """
    words = [word for word in name.strip().split("/") if word != "wrapobjectset"]
    found = reading.wraps.get(words[-1], [])
    found = [s for s in found if len(words) > 1 and _owner(s).name == words[-2]] or found
    if not found:
        _note(reading, f"{title}: there is no wrapping object {name!r}; correct its path")
        return None
    shape = found[0]
    owner = _owner(shape)
    body, frame = reading.place(owner.name if owner.tag == "Body" else owner.path)
    if len(found) > 1:
        _note(
            reading,
            f"{len(found)} wrapping objects are named {name!r}: "
            f"the first, on {body}, is taken, as OpenSim does",
        )
    radii = _radii(shape)
    if radii is None:
        _note(reading, f"{title}: its wrapping object {name!r} ({shape.tag}) is not taken")
        return None
    if not shape.truth("active", True) or min(radii) <= 0.0:
        return None
    own = frame_at(shape.vector("translation"), shape.vector("xyz_body_rotation").tolist())
    quadrant = shape.word("quadrant", "all").lower().removeprefix("+").replace("all", "")
    return WrapShape(body, frame @ own, np.array(radii), shape.tag, quadrant)


def _obstacle(reading, element, title):
    """The contact geometry that a path goes around, on the side of its hint."""
    name = socket(element, "contact_geometry")
    shape = reading.contacts.get(name)
    radii = None if shape is None else _radii(shape)
    if radii is None:
        what = "not there" if shape is None else shape.tag
        _note(reading, f"{title}: its obstacle {name!r} ({what}) is not taken")
        return None
    body, frame = reading.place(socket(shape, "frame"), inside=shape.path)
    own = frame_at(shape.vector("location"), shape.vector("orientation").tolist())
    hint = element.vector("contact_hint")[: 2 if shape.tag == "ContactCylinder" else 3]
    k = int(np.argmax(np.abs(hint)))
    quadrant = "" if hint[k] == 0.0 else f"{'-' if hint[k] < 0.0 else ''}{'xyz'[k]}"
    kind = shape.tag.replace("Contact", "Wrap")
    return WrapShape(body, frame @ own, np.array(radii), kind, quadrant)


def _note(reading, text):
    if text not in reading.model.notes:
        reading.model.notes.append(text)


def _owner(shape):
    """The body or frame that a wrapping object stands in."""
    owner = shape.owner
    while owner.tag in ("objects", "WrapObjectSet"):
        owner = owner.owner
    return owner


def _radii(shape):
    """Radii along x, y and z [m], of a cylinder with half its length; None of other shapes."""
    kind = shape.tag.replace("Wrap", "Contact")
    if kind == "ContactCylinder":
        half = 0.5 * shape.number("length", 2.0 * ENDLESS if shape.tag == kind else 0.0)
        return [shape.number("radius")] * 2 + [half]
    if kind == "ContactSphere":
        return [shape.number("radius")] * 3
    if kind == "ContactEllipsoid":
        return shape.numbers("radii" if shape.tag == kind else "dimensions", "0 0 0", count=3)
    return None


def _driving(reading, point, tag):
    """Full name of the coordinate that a point names, in any of the ways of its version."""
    return reading.coordinate(
        point.word(f"socket_{tag}") or point.word(tag) or point.word(f"{tag}_name")
    )


def _read_point(reading, point, resting):
    """Body and place in it of a path point where coordinates are at their defaults, None where it
    is not active; and how it comes, goes or moves with coordinates, empty where it does not.
    """
    where = socket(point, "parent_frame") or point.word("body")
    body, frame = reading.place(where, inside=point.path)
    at = point.vector("location")
    active = True
    change = ""
    if point.tag in CONDITIONAL:
        low, high = point.numbers("range", "-1e9 1e9", count=2)
        name = _driving(reading, point, "coordinate")
        active = low <= resting.get(name, 0.0) <= high
        coordinate = all_coordinates(reading.model.joints).get(name)
        reached = None if coordinate is None else coordinate.range
        if reached is None or min(reached) < low or max(reached) > high:
            change = (
                f"point {point.name!r} is on its path for {name} from {low:g} to {high:g} alone"
            )
    if point.tag in MOVING:
        moving = []
        for k, axis in enumerate("xyz"):
            function = read_function(point.child(f"{axis}_location"))
            if function is None:
                continue
            name = _driving(reading, point, f"{axis}_coordinate")
            at[k] = function(resting.get(name, 0.0))
            if not isinstance(function, Linear) or any(function.slopes):
                moving.append(name)
        if moving:
            change = f"point {point.name!r} moves with {', '.join(dict.fromkeys(moving))}"
    place = (body, frame[:3, :3] @ at + frame[:3, 3]) if active else None
    return place, change
