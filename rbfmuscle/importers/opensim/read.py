"""``.osim`` files of every version that the public collection has, as an `OsimModel`."""

import itertools
from pathlib import Path

import numpy as np

from rbfmuscle.importers.opensim.assembly import assemble
from rbfmuscle.importers.opensim.elements import Frames, frame_at, socket
from rbfmuscle.importers.opensim.joints import Reading, read_constraints, read_joint
from rbfmuscle.importers.opensim.model import ModelMesh, OsimModel
from rbfmuscle.importers.opensim.muscles import read_muscles
from rbfmuscle.importers.opensim.xml import Node, read_xml
from rbfmuscle.scene.names import plain_name
from rbfmuscle.validation import SceneError

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
    _take_defaults(node)
    notes = _name_joints(node)
    frames = Frames(node)
    model = OsimModel(plain_name(node.name or path.stem), version, path)
    model.notes += notes
    model.bodies = list(frames.bodies.values())
    _note_names(model, frames)
    if version > NEWEST or not version:
        said = f"is of version {version}, newer than 4.6" if version else "states no version"
        model.notes.append(f"the file {said}: read as one of version 4.6 where nothing else shows")
    units = node.word("length_units", "meters")
    if units not in ("meters", "m", "metres"):
        words = "lengths are read as metres, as OpenSim reads them"
        model.notes.append(f"<length_units> says {units!r}; {words}")
    reading = Reading(model, frames)
    own = node.objects("components")
    if version >= SOCKETS or node.child("JointSet") is not None:
        joints = [*node.objects("JointSet"), *own]
        _read_sockets(reading, node, [one for one in joints if one.tag.endswith("Joint")])
    else:
        _read_nested(reading, [b for b in node.objects("BodySet") if b.tag == "Body"])
    constraints = [*node.objects("ConstraintSet"), *own]
    read_constraints(reading, [one for one in constraints if one.tag.endswith("Constraint")])
    read_muscles(reading, node, [*node.objects("ForceSet"), *own])
    return assemble(model)


def _take_defaults(node):
    """Take the defaults of a file out of the model, and give them to the elements of their tags."""
    prototypes: dict[str, Node] = {}
    for defaults in node.findall("defaults"):
        node.remove(defaults)
        prototypes |= {inner.tag: inner for inner in defaults.nodes()}
    if prototypes:
        for element in node.iter():
            element.prototype = prototypes.get(element.tag)


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


def _note_names(model, frames):
    """Say which bodies have another name in the scene."""
    changed = [f"{old!r} as {new}" for old, new in frames.bare.items() if old != new]
    if changed:
        more = f" and {len(changed) - MOST_RENAMED} more" if len(changed) > MOST_RENAMED else ""
        listed = ", ".join(changed[:MOST_RENAMED])
        model.notes.append(f"names are written in plain letters: {listed}{more}")


def _read_sockets(reading, node, joints):
    """Versions from 4 on: joints in a set, which name frames; geometry attached to frames."""
    model, frames = reading.model, reading.frames
    for joint in joints:
        ends = []
        for role in ("parent", "child"):
            name = socket(joint, f"{role}_frame")
            if not name:
                raise joint.error(f"names no {role} frame; give it one")
            ends.append(frames.place(name, inside=joint.path))
        read_joint(reading, joint, ends, "coordinates")
    for attached in node.iter("attached_geometry"):
        owner = attached.owner
        if owner.path not in (*frames.bodies, *frames.offsets):
            model.notes.append(f"{owner.place}: geometry of a {owner.tag} is not taken")
            continue
        body, transform = frames.place(owner.path)
        for shape in attached.nodes():
            if shape.tag != "Mesh":
                what = f"geometry {shape.name or shape.tag!r} is a {shape.tag}"
                model.notes.append(f"body {body!r}: {what}, no mesh: not taken")
                continue
            look = shape.child("Appearance")
            shown = look is None or look.truth("visible", True)
            scale = shape.vector("scale_factors", "1 1 1")
            _add_mesh(model, shape.word("mesh_file"), body, scale, transform, shown)


def _read_nested(reading, bodies):
    """Versions before 4: each joint stands inside the body that is its child."""
    model, frames = reading.model, reading.frames
    for body in bodies:
        own = frames.bare[body.name]
        for joint in body.objects("Joint"):
            parent = frames.place(joint.word("parent_body"), inside=joint.path)[0]
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
