"""Muscles of a model and what their paths go around, as ``.osim`` files write them."""

from collections import defaultdict

import numpy as np

from rbfmuscle.importers.opensim.elements import (
    ModelMuscle,
    Node,
    WrapShape,
    frame_at,
    read_function,
    socket,
)
from rbfmuscle.importers.opensim.joints import Reading
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


def read_muscles(reading: Reading, model: Node, forces: list[Node]) -> None:
    """Add the muscles among the forces of a model; those that cannot be taken, and what else has a
    path, are named.
    """
    shapes = _Shapes(reading, model)
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
            reading.model.muscles.append(_read_muscle(reading, force, path, title, shapes))
        except SceneError as error:
            reading.model.doubts.append(f"{title} is not taken: {error}")
    for tag, names in others.items():
        if names:
            reading.model.notes.append(f"{tag} is no muscle: {', '.join(names)} not taken")


def _read_muscle(reading, force, path, title, shapes):
    resting = reading.model.resolved()
    points, wraps, changes = [], [], []
    if path.tag == "Scholz2015GeometryPath":
        for element in path.objects("path_elements"):
            inner = next((node for node in element.nodes() if node.tag.endswith("Point")), None)
            if inner is not None:
                points.append(_path_point(inner, reading, resting))
            else:
                shape = shapes.obstacle(element, title)
                wraps += [] if shape is None else [shape]
    else:
        for tag in POINTS:
            points += [_path_point(point, reading, resting) for point in path.objects(tag)]
            changes += [_change(point, reading) for point in path.objects(tag)]
        for tag in WRAPS:
            found = [shapes.wrap(wrap.word("wrap_object"), title) for wrap in path.objects(tag)]
            wraps += [shape for shape in found if shape is not None]
    changing = [change for change in changes if change]
    if changing:
        reading.model.doubts.append(
            f"{title}: {', '.join(changing)}; its tube stays as at rest, so its lengths and moment "
            "arms are not the model's"
        )
    force_most = force.number("max_isometric_force", FORCE)
    volume = force_most * force.number("optimal_fiber_length", FIBRE) / SPECIFIC_TENSION
    name = new_name(force.name or force.tag, [one.name for one in reading.model.muscles])
    kept = [point for point in points if point is not None]
    return ModelMuscle(name, kept, wraps, volume, title)


class _Shapes:
    """What paths go around: wrapping objects by owner, and contact geometry by its path."""

    def __init__(self, reading: Reading, model: Node) -> None:
        self._notes = reading.model.notes
        self._frames = reading.frames
        self._wraps: dict[str, list[Node]] = defaultdict(list)
        nodes = [node for node in model.iter() if isinstance(node, Node)]
        for owner in nodes:
            for shape in owner.objects("WrapObjectSet"):
                self._wraps[shape.name].append(shape)
        self._geometry = {node.path: node for node in nodes if node.tag.startswith("Contact")}

    def wrap(self, name: str, title: str) -> WrapShape | None:
        """A wrapping object by its name, or by owner and name; None where it is not taken.

        Of several of one name it is the first, as OpenSim takes it.
        """
        words = [word for word in name.strip().split("/") if word != "wrapobjectset"]
        found = self._wraps.get(words[-1], [])
        found = [s for s in found if len(words) > 1 and _owner(s).name == words[-2]] or found
        if not found:
            self._note(f"{title}: there is no wrapping object {name!r}; correct its path")
            return None
        shape = found[0]
        owner = _owner(shape)
        body, frame = self._frames.place(owner.name if owner.tag == "Body" else owner.path)
        if len(found) > 1:
            self._note(
                f"{len(found)} wrapping objects are named {name!r}: "
                f"the first, on {body}, is taken, as OpenSim does"
            )
        radii = _radii(shape)
        if radii is None:
            self._note(f"{title}: its wrapping object {name!r} ({shape.tag}) is not taken")
            return None
        if not shape.truth("active", True) or min(radii) <= 0.0:
            return None
        own = frame_at(shape.vector("translation"), shape.vector("xyz_body_rotation").tolist())
        quadrant = shape.word("quadrant", "all").lower().removeprefix("+").replace("all", "")
        return WrapShape(body, frame @ own, np.array(radii), shape.tag, quadrant)

    def obstacle(self, element: Node, title: str) -> WrapShape | None:
        """The contact geometry that a path goes around, on the side of its hint."""
        name = socket(element, "contact_geometry")
        shape = self._geometry.get(name)
        radii = None if shape is None else _radii(shape)
        if shape is None or radii is None:
            self._note(
                f"{title}: its "
                f"obstacle {name!r} ({'not there' if shape is None else shape.tag})"
                " is not taken"
            )
            return None
        body, frame = self._frames.place(socket(shape, "frame"), inside=shape.path)
        own = frame_at(shape.vector("location"), shape.vector("orientation").tolist())
        hint = element.vector("contact_hint")[: 2 if shape.tag == "ContactCylinder" else 3]
        k = int(np.argmax(np.abs(hint)))
        quadrant = "" if hint[k] == 0.0 else f"{'-' if hint[k] < 0.0 else ''}{'xyz'[k]}"
        kind = shape.tag.replace("Contact", "Wrap")
        return WrapShape(body, frame @ own, np.array(radii), kind, quadrant)

    def _note(self, text):
        if text not in self._notes:
            self._notes.append(text)


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


def _coordinate_name(point, tag):
    """The coordinate that a point names, in any of the ways of its version."""
    return point.word(f"socket_{tag}") or point.word(tag) or point.word(f"{tag}_name")


def _change(point, reading):
    """How a point comes, goes or moves with coordinates; empty where it does not."""
    if point.tag in CONDITIONAL:
        low, high = point.numbers("range", "-1e9 1e9", count=2)
        name = reading.coordinate(_coordinate_name(point, "coordinate"))
        coordinate = all_coordinates(reading.model.joints).get(name)
        reached = None if coordinate is None else coordinate.range
        if reached is not None and low <= min(reached) and max(reached) <= high:
            return ""
        return f"point {point.name!r} is on its path for {name} from {low:g} to {high:g} alone"
    if point.tag in MOVING:
        names = []
        for axis in "xyz":
            function = read_function(point.child(f"{axis}_location"))
            constant = isinstance(function, Linear) and not any(function.slopes)
            if function is not None and not constant:
                names.append(reading.coordinate(_coordinate_name(point, f"{axis}_coordinate")))
        if names:
            return f"point {point.name!r} moves with {', '.join(dict.fromkeys(names))}"
    return ""


def _path_point(point, reading, resting):
    """Body and place in it of a path point where coordinates are at their defaults; None where it
    is not active.
    """
    where = socket(point, "parent_frame") or point.word("body")
    body, frame = reading.frames.place(where, inside=point.path)

    def value_of(tag):
        return resting.get(reading.coordinate(_coordinate_name(point, tag)), 0.0)

    if point.tag in CONDITIONAL:
        low, high = point.numbers("range", "-1e9 1e9", count=2)
        if not low <= value_of("coordinate") <= high:
            return None
    at = point.vector("location")
    if point.tag in MOVING:
        for k, axis in enumerate("xyz"):
            function = read_function(point.child(f"{axis}_location"))
            if function is not None:
                at[k] = function(value_of(f"{axis}_coordinate"))
    return body, frame[:3, :3] @ at + frame[:3, 3]
