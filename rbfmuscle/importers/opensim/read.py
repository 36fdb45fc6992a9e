"""``.osim`` files of every version that the public collection has, as an `OsimModel`."""

import itertools
from collections import defaultdict
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from rbfmuscle.importers.opensim.elements import (
    GROUND,
    ModelJoint,
    ModelMesh,
    ModelMuscle,
    Node,
    OsimModel,
    Reading,
    Steps,
    WrapShape,
    frame_at,
    joints_between,
    read_function,
    read_xml,
    socket,
)
from rbfmuscle.importers.opensim.joints import read_constraints, read_joint
from rbfmuscle.scene.joints import Linear, all_coordinates, ordered
from rbfmuscle.scene.objects import new_name, plain_name
from rbfmuscle.validation import SceneError, listed

MOST_ROUNDS = 200  # of meeting the weld constraints; a few are enough where they can be met
LEAST_MOVE = 1e-12  # of a round that goes on [metre and radian]
CLOSED = 1e-9  # what is left of a weld constraint that is met [metre and radian]
NEAR = 1e-6  # a loop is closed where its ends are no farther apart [metre and radian]
STEP = 1e-6  # of the central differences [radian or metre]


def assemble(model: OsimModel) -> OsimModel:
    """The model, its weld constraints met at rest; what is left out or doubtful is named."""
    couplings = model.couplings
    model.couplings = []
    for coupling in couplings:
        try:
            model.couplings = ordered([*model.couplings, coupling])
        except SceneError as error:  # another moves the coordinate, or they form a ring
            of = ", ".join(coupling.of)
            model.doubts.append(
                f"the coupler of {coupling.coordinate} to {of} is not taken: {error}"
            )
    _meet_welds(model)
    steps, roots, left = model.walk()
    for joint in left:
        _name_loop(model, steps, joint)
    for weld in model.welds:
        if weld not in left:
            model.notes.append(
                f"{weld.name} is taken as a fixed joint, {weld.parent} to {weld.child}"
            )
    for title, first, second in model.constraints:
        names = all_coordinates(joints_between(steps, first, second))
        depends = f"; {', '.join(names)} may break it" if names else ""
        model.doubts.append(f"{title} ({first} to {second}) is not taken{depends}")
    for body in roots:
        if body != GROUND:
            model.doubts.append(
                f"body {body!r} is joined to the ground by no joint: it stands where its frame "
                "is, with all that hangs on it"
            )
    return model


def _meet_welds(model):
    """Change the rest values of coordinates as little as the weld constraints need, as OpenSim does
    when it opens a model.
    """
    steps, _, _ = model.walk(welds=False)
    rings = [joints_between(steps, weld.parent, weld.child) for weld in model.welds]
    welds = [weld for weld, ring in zip(model.welds, rings) if ring]
    followers = {coupling.coordinate for coupling in model.couplings}
    known = all_coordinates(model.joints)
    wanted = {name for ring in rings for name in all_coordinates(ring)}
    for coupling in reversed(model.couplings):
        wanted |= set(coupling.of) if coupling.coordinate in wanted else set()
    names = [n for n in known if n in wanted and n not in followers and not known[n].locked]
    if not welds:
        return
    start = np.array([known[name].rest for name in names])

    def apart(values):
        places = model.transforms(dict(zip(names, values.tolist())), welds=False)
        return np.concatenate([_apart(weld, places, {}) for weld in welds])

    values = _nearest_closed(apart, start) if names else start
    if np.abs(apart(values)).max() > CLOSED:
        off = apart(start).reshape(len(welds), 6)
        for weld, row in zip(welds, off):
            if np.abs(row).max() > NEAR:
                model.welds.remove(weld)
                model.doubts.append(
                    f"{weld.name} ({weld.parent} to {weld.child}) cannot be met, it is not taken: "
                    f"{1000.0 * np.linalg.norm(row[:3]):.3g} mm are between its frames"
                )
        return
    for joint in model.joints:
        for name, fact in joint.coordinates.items():
            full = f"{joint.name}.{name}"
            if full in names:
                rest = float(values[names.index(full)])
                joint.coordinates[name] = replace(fact, rest=rest)


def _nearest_closed(apart, start):
    """The values nearest to ``start`` (n,) at which nothing is apart, by Gauss and Newton."""
    values = start
    for _ in range(MOST_ROUNDS):
        slopes = np.stack(
            [
                (apart(values + e) - apart(values - e)) / (2 * STEP)
                for e in STEP * np.eye(len(start))
            ],
            axis=1,
        )
        wanted = slopes @ (values - start) - apart(values)
        target = start + np.linalg.lstsq(slopes, wanted, rcond=1e-9)[0]
        move = target - values
        values = values + move * min(1.0, 1.0 / max(np.abs(move).max(), 1e-300))
        if np.abs(move).max() < LEAST_MOVE:
            break
    return values


def _apart(joint, places, values):
    """Distance (3,) [metre] and turn (3,) [radian] between the ends of a joint."""
    between = np.linalg.inv(places[joint.parent] @ joint.across(values)) @ places[joint.child]
    return np.concatenate([between[:3, 3], Rotation.from_matrix(between[:3, :3]).as_rotvec()])


def _name_loop(model: OsimModel, steps: Steps, joint: ModelJoint) -> None:
    """Name a joint or a weld constraint that closes a loop, the loop, and what is open in it."""
    ring = joints_between(steps, joint.parent, joint.child)
    what = f"{joint.name} ({joint.parent} to {joint.child})"
    if joint.kind == "free":
        model.notes.append(f"{what} holds nothing: other joints hold both bodies; not taken")
        return
    loop = f"closes a loop with {', '.join(one.name for one in ring) or 'itself'}: not taken"
    off = _apart(joint, model.transforms(), model.resolved())
    gap = f", its ends are {1000.0 * np.linalg.norm(off[:3]):.3g} mm apart at rest"
    if np.abs(off).max() <= NEAR:
        gap = ", it is closed at rest"
    names = all_coordinates(ring)
    moved = f"; {', '.join(names)} may open it" if names else ""
    (model.doubts if names or np.abs(off).max() > NEAR else model.notes).append(
        f"{what} {loop}{gap}{moved}"
    )


NEWEST = 40699  # what later versions add is not known here
SOCKETS = 40000  # from this version on joints stand in a set of their own and name their frames
MOST_RENAMED = 6  # names that a note lists


def read_osim(path: Path | str) -> OsimModel:
    """An OpenSim model of version 2 to 4; a SceneError names the object that cannot be taken, and
    the remedy.
    """
    path = Path(path)
    root = read_xml(path)
    try:
        return _read_model(root, path)
    except SceneError as error:
        raise SceneError(f"{path}: {error}") from None


def _read_model(root, path):
    node = root if root.tag == "Model" else root.child("Model")
    if root.tag not in ("OpenSimDocument", "Model") or node is None:
        raise SceneError(f"its root is <{root.tag[:40]}>, no OpenSim model; give an .osim file")
    try:
        version = int(root.get("Version", "0"))
    except ValueError:
        raise SceneError(
            f"version {root.get('Version', '')[:20]!r} is no number; correct it"
        ) from None
    # The defaults of a file are no part of the model: the elements of their tags have them.
    prototypes: dict[str, Node] = {}
    for defaults in node.findall("defaults"):
        node.remove(defaults)
        prototypes |= {inner.tag: inner for inner in defaults.nodes()}
    for element in node.iter() if prototypes else ():
        element.prototype = prototypes.get(element.tag)
    notes = _name_joints(node)
    model = OsimModel(plain_name(node.name or path.stem), version, path, notes=notes)
    reading = Reading(model, node)
    changed = [f"{old!r} as {new}" for old, new in reading.bare.items() if old != new]
    if changed:
        names = listed(changed, MOST_RENAMED)
        model.notes.append(f"names are written in plain letters: {names}")
    if version > NEWEST or not version:
        said = f"is of version {version}, newer than 4.6" if version else "states no version"
        model.notes.append(f"the file {said}: read as one of version 4.6 where nothing else shows")
    units = node.word("length_units", "meters")
    if units not in ("meters", "m", "metres"):
        model.notes.append(
            f"<length_units> says {units!r}; lengths are read as metres, as OpenSim reads them"
        )
    own = node.objects("components")
    if version >= SOCKETS or node.child("JointSet") is not None:
        joints = [*node.objects("JointSet"), *own]
        _read_sockets(reading, node, [one for one in joints if one.tag.endswith("Joint")])
    else:
        _read_nested(reading, [b for b in node.objects("BodySet") if b.tag == "Body"])
    constraints = [*node.objects("ConstraintSet"), *own]
    read_constraints(reading, [one for one in constraints if one.tag.endswith("Constraint")])
    _read_muscles(reading, [*node.objects("ForceSet"), *own])
    return assemble(model)


def _name_joints(node):
    """Give joints without names those that OpenSim gives them, the class numbered from 0, and of
    joints of one name all but the first another; notes of these.
    """
    joints = [one for one in node.iter() if one.tag.endswith("Joint") and one.tag != "Joint"]
    names = {one.name for one in joints}
    taken: set[str] = set()
    notes = []
    for joint in joints:
        found = joint.name
        if not found or found in taken:
            stem = found or joint.tag.lower()
            ends = itertools.chain([""], (f"_{k}" for k in itertools.count()))
            found = next(f for k in ends if (f := stem + k) not in names | taken)
            if joint.name:
                notes.append(f"another joint is named {joint.name!r} too: it is {found!r} here")
            joint.set("name", found)
        taken.add(found)
    return notes


def _read_sockets(reading, node, joints):
    """Versions from 4 on: joints in a set, which name frames; geometry attached to frames."""
    model = reading.model
    for joint in joints:
        ends = []
        for role in ("parent", "child"):
            name = socket(joint, f"{role}_frame")
            if not name:
                raise joint.error(f"names no {role} frame; give it one")
            ends.append(reading.place(name, inside=joint.path))
        read_joint(reading, joint, ends, "coordinates")
    for attached in node.iter("attached_geometry"):
        owner = attached.owner
        if owner.path not in (*reading.bodies, *reading.offsets):
            model.notes.append(f"{owner.place}: geometry of a {owner.tag} is not taken")
            continue
        body, transform = reading.place(owner.path)
        for shape in attached.nodes():
            if shape.tag != "Mesh":
                model.notes.append(
                    f"body {body!r}: geometry {shape.name or shape.tag!r} is a {shape.tag}, no "
                    "mesh: not taken"
                )
                continue
            look = shape.child("Appearance")
            shown = look is None or look.truth("visible", True)
            scale = shape.vector("scale_factors", "1 1 1")
            _add_mesh(model, shape.word("mesh_file"), body, scale, transform, shown)


def _read_nested(reading, bodies):
    """Versions before 4: each joint stands inside the body that is its child."""
    model = reading.model
    for body in bodies:
        own = reading.bare[body.name]
        for joint in body.objects("Joint"):
            parent = reading.place(joint.word("parent_body"), inside=joint.path)[0]
            # Six digits: so OpenSim 4 rounds these when it reads an older file.
            ends = [
                (name, frame_at(_six(joint, where), _six(joint, turn)))
                for name, where, turn in (
                    (parent, "location_in_parent", "orientation_in_parent"),
                    (own, "location", "orientation"),
                )
            ]
            if joint.truth("reverse"):
                ends.reverse()
            read_joint(reading, joint, ends, "CoordinateSet")
        visible = body.child("VisibleObject")
        if visible is None:
            continue
        whole = visible.vector("scale_factors", "1 1 1")
        for file in visible.word("geometry_files").split():
            _add_mesh(model, file, own, whole, np.eye(4), True)
        for shape in visible.objects("GeometrySet"):
            six = shape.numbers("transform", "0 0 0 0 0 0", count=6)
            scale = whole * shape.vector("scale_factors", "1 1 1")
            shown = shape.word("display_preference") != "0"
            frame = frame_at(np.array(six[3:]), six[:3])
            _add_mesh(model, shape.word("geometry_file"), own, scale, frame, shown)


def _six(joint, tag):
    return [float(f"{value:.6g}") for value in joint.vector(tag)]


def _add_mesh(model, file, body, scale, transform, shown):
    if file in ("", "Unassigned"):
        return
    if not shown or not all(scale):
        why = f"scaled to nothing ({scale.tolist()})" if shown else "hidden in the model"
        model.notes.append(f"body {body!r}: mesh {file!r} is {why}: not taken")
        return
    model.meshes.append(ModelMesh(file, body, tuple(scale.tolist()), transform))


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


def _read_muscles(reading, forces):
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
    return ModelMuscle(
        name=new_name(force.name or force.tag, [one.name for one in reading.model.muscles]),
        points=[point for point in points if point is not None],
        wraps=[shape for shape in wraps if shape is not None],
        volume=volume,
        title=title,
    )


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
    return WrapShape(
        body=body,
        frame=frame @ own,
        radii=np.array(radii),
        kind=shape.tag,
        quadrant=shape.word("quadrant", "all").lower().removeprefix("+").replace("all", ""),
    )


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
    return WrapShape(
        body=body,
        frame=frame @ own,
        radii=np.array(radii),
        kind=shape.tag.replace("Contact", "Wrap"),
        quadrant="" if hint[k] == 0.0 else f"{'-' if hint[k] < 0.0 else ''}{'xyz'[k]}",
    )


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
