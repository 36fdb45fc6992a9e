"""``.osim`` files of every version that the public collection has, as an `OsimModel`."""

import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from rbfmuscle.importers.opensim.elements import (
    GROUND,
    ModelJoint,
    ModelMesh,
    Node,
    OsimModel,
    Reading,
    Steps,
    frame_at,
    joints_between,
    read_xml,
    socket,
)
from rbfmuscle.importers.opensim.joints import read_constraints, read_joint
from rbfmuscle.importers.opensim.muscles import read_muscles
from rbfmuscle.scene.joints import all_coordinates, ordered
from rbfmuscle.scene.objects import plain_name
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
        names = _moving(joints_between(steps, first, second))
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
    wanted = {name for ring in rings for name in _moving(ring)}
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


def _moving(joints: list[ModelJoint]) -> list[str]:
    """Full names of the coordinates of some joints."""
    return [f"{joint.name}.{name}" for joint in joints for name in joint.coordinates]


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
    names = _moving(ring)
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
    read_muscles(reading, [*node.objects("ForceSet"), *own])
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
