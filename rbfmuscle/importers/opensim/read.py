"""``.osim`` files of every version that the public collection has, as an `OsimModel`."""

from pathlib import Path

import numpy as np

from rbfmuscle.importers.opensim.frames import Frames
from rbfmuscle.importers.opensim.functions import find_function, numbers, read_function, truth, vector
from rbfmuscle.importers.opensim.model import (
    GROUND,
    JOINT_KINDS,
    ModelJoint,
    ModelMesh,
    OsimModel,
    finish,
    joint_motion,
    motion_kinds,
)
from rbfmuscle.importers.opensim.muscles import read_muscles
from rbfmuscle.importers.opensim.xml import read_xml
from rbfmuscle.scene.joints.functions import Linear, scaled
from rbfmuscle.scene.joints.joint import Coordinate, Coupling, TransformAxis, frame_at
from rbfmuscle.validation import SceneError

# From this version on joints stand in a set of their own and name their frames.
SOCKETS = 40000
# A name that means that there is no file.
NO_FILE = ("", "Unassigned")


def read_osim(path: Path | str) -> OsimModel:
    """Read an OpenSim model.

    Parameters
    ----------
    path : path
        An ``.osim`` file of version 2 to 4.

    Returns
    -------
    OsimModel
        In metres and radians.

    Raises
    ------
    SceneError
        Naming the file, the object and the remedy, where something cannot be taken.
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
        raise SceneError(f"version {root.get('Version', '')[:20]!r} is no number; correct it") from None
    model = OsimModel(node.name or path.stem, version, path, [GROUND])
    units = node.word("length_units", "meters")
    if units not in ("meters", "m", "metres"):
        model.notes.append(
            f"<length_units> says {units!r}; OpenSim reads all lengths as metres, and so is done here"
        )
    bodies = [body for body in node.objects("BodySet") if body.tag == "Body"]
    model.bodies += [body.name for body in bodies if body.name != GROUND]
    frames = Frames(node, bodies)
    if version >= SOCKETS or node.child("JointSet") is not None:
        _read_new(model, node, bodies, frames)
    else:
        _read_old(model, bodies)
    _read_constraints(model, node)
    model.muscles = read_muscles(model, node, bodies, frames)
    return finish(model)


def _read_new(model, node, bodies, frames):
    for joint in node.objects("JointSet"):
        parts = [frames.of_joint(joint, role) for role in ("parent", "child")]
        model.joints.append(_joint(joint, parts, "coordinates", model))
    grounds = [child for child in node.nodes() if child.tag == "Ground"]
    for body in [*grounds, *bodies]:
        _meshes_of(model, body, body.name or GROUND, frames)
    for joint in node.objects("JointSet"):
        for frame in frames.of(joint):
            _add_meshes(model, frame, *frames.place(f"/jointset/{joint.name}/{frame.name}"))


def _meshes_of(model, body, name, frames):
    _add_meshes(model, body, name, np.eye(4))
    owner = "/ground" if name == GROUND else f"/bodyset/{name}"
    for frame in frames.of(body):
        _add_meshes(model, frame, *frames.place(f"{owner}/{frame.name}"))


def _add_meshes(model, owner, body, transform):
    """Geometry that hangs on a body or on a frame of it."""
    attached = owner.child("attached_geometry")
    for shape in [] if attached is None else attached.nodes():
        if shape.tag != "Mesh":
            model.notes.append(
                f"body {body!r}: geometry {shape.name or shape.tag!r} is a {shape.tag}, no mesh: not taken"
            )
            continue
        place = f"body {body!r}: mesh {shape.name!r}"
        look = shape.child("Appearance")
        visible = truth(look, "visible", True) if look is not None else True
        scale = vector(shape, "scale_factors", "1 1 1", place=place)
        _add_mesh(model, shape.word("mesh_file"), body, scale, transform, visible)


def _add_mesh(model, file, body, scale, transform, visible):
    if file in NO_FILE:
        return
    if not visible:
        model.notes.append(f"body {body!r}: mesh {file!r} is hidden in the model: not taken")
        return
    if not all(scale):
        model.notes.append(f"body {body!r}: mesh {file!r} is scaled to nothing ({scale}): not taken")
        return
    model.meshes.append(ModelMesh(file, body, tuple(scale), transform))


def _read_old(model, bodies):
    """Versions before 4: each joint lies inside the body that is its child."""
    for body in bodies:
        attached_bone = body.child("Joint")
        for joint in [] if attached_bone is None else attached_bone.nodes():
            place = f"joint {joint.name!r}"
            ends = []
            for where, turn in (("location_in_parent", "orientation_in_parent"), ("location", "orientation")):
                origin = _as_upgraded(vector(joint, where, "0 0 0", place=place))
                angles = _as_upgraded(vector(joint, turn, "0 0 0", place=place))
                ends.append(frame_at(np.array(origin), angles))
            names = [joint.word("parent_body"), body.name]
            if truth(joint, "reverse"):
                names, ends = names[::-1], ends[::-1]
            found = _joint(joint, list(zip(names, ends)), "CoordinateSet", model)
            model.joints.append(found)
        _old_meshes(model, body)


def _as_upgraded(values):
    """Six digits: so OpenSim 4 rounds these when it reads an older file, and its skeleton is the measure."""
    return [float(f"{value:.6g}") for value in values]


def _old_meshes(model, body):
    visible = body.child("VisibleObject")
    if visible is None:
        return
    whole = np.array(vector(visible, "scale_factors", "1 1 1", place=f"body {body.name!r}"))
    for file in visible.word("geometry_files").split():
        _add_mesh(model, file, body.name, whole.tolist(), np.eye(4), True)
    for shape in visible.objects("GeometrySet"):
        file = shape.word("geometry_file")
        place = f"body {body.name!r}: mesh {file!r}"
        six = numbers(shape.word("transform", "0 0 0 0 0 0"), place=f"{place}: transform", count=6)
        scale = whole * vector(shape, "scale_factors", "1 1 1", place=place)
        shown = shape.word("display_preference", "4") != "0"
        _add_mesh(model, file, body.name, scale.tolist(), frame_at(np.array(six[3:]), six[:3]), shown)


def _joint(joint, ends, attached_bone, model):
    """One joint from its element, its ends as (body, frame), and the tag of what holds its coordinates."""
    (parent, first), (child, second) = ends
    place = f"joint {joint.name!r} ({parent} to {child})"
    kind = JOINT_KINDS.get(joint.tag)
    if kind is None:
        raise SceneError(
            f"{place}: a {joint.tag} is not in the table of joints, so body {child!r} cannot be placed; "
            "replace it by a CustomJoint in OpenSim"
        )
    found = [node for node in joint.objects(attached_bone) if node.tag == "Coordinate"]
    axes, slopes = ({}, {})
    if kind == "custom":
        axes, slopes = _axes(joint, place)
    names = [node.name for node in found]
    for axis in axes.values():
        for name in axis.coordinates:
            if name not in names:
                raise SceneError(f"{place}: an axis follows {name!r}, which is no coordinate of this joint")
    kinds = motion_kinds(kind, names, axes, slopes)
    needed = {"fixed": 0, "custom": len(names), "ball": 3, "universal": 2, "planar": 3, "free": 6}.get(
        kind, 1
    )
    if len(names) != needed:
        raise SceneError(f"{place}: a {joint.tag} has {needed} coordinates, {len(names)} are given")
    coordinates = {node.name: _coordinate(node, motion, place, model) for node, motion in zip(found, kinds)}
    return ModelJoint(
        joint.name, kind, parent, child, first, second, joint_motion(joint.name, kind, coordinates, axes)
    )


def _axes(joint, place):
    """The axes of a custom joint by name, and the slopes of those that are plain linear functions."""
    table = joint.child("SpatialTransform")
    if table is None:
        if joint.child("TransformAxisSet") is not None:
            raise SceneError(f"{place}: is written as OpenSim 1 did; open the model in OpenSim 4 and save it")
        return {}, {}
    axes, slopes = {}, {}
    for node in table.nodes():
        if node.tag != "TransformAxis":
            continue
        at = f"{place}: axis {node.name!r}"
        direction = np.array(vector(node, "axis", "1 0 0", place=at))
        size = np.linalg.norm(direction)
        names = tuple(name for name in node.word("coordinates").split())
        inner = find_function(node)
        if inner is None:
            if names:
                raise SceneError(f"{at}: follows {' '.join(names)} by no function; give it one")
            continue
        function = read_function(inner, place=at)
        if size == 0:
            raise SceneError(f"{at}: its direction is zero; give it one")
        _check_count(function, len(names), at)
        axes[node.name] = TransformAxis(tuple((direction / size).tolist()), names, function)
        if isinstance(function, Linear) and len(function.slopes) == 1 and inner.tag == "LinearFunction":
            slopes[node.name] = function.slopes[0]
    return axes, slopes


def _check_count(function, count, at):
    slopes = len(function.slopes) if isinstance(function, Linear) else None
    if slopes is not None and slopes > count:
        raise SceneError(f"{at}: a linear function of {slopes} coordinates, {count} are named")
    if slopes is None and count == 0 and type(function).__name__ != "Constant":
        raise SceneError(f"{at}: a function of a coordinate, and none is named")


def _coordinate(node, motion, place, model):
    at = f"{place}: coordinate {node.name!r}"
    rest = numbers(node.word("default_value", "0"), place=f"{at}: default_value", count=1)[0]
    text = node.word("range")
    limits = numbers(text, place=f"{at}: range", count=2) if text else None
    if limits is not None and limits[0] > limits[1]:
        raise SceneError(f"{at}: its range {text!r} goes downwards; turn it round")
    if truth(node, "prescribed"):
        model.notes.append(
            f"{at.split(': ')[-1]} is prescribed by a function of time: not taken, it stays at {rest:g}"
        )
    return Coordinate(
        motion,
        rest,
        None,
        None if limits is None else tuple(limits),
        truth(node, "clamped") and limits is not None,
        truth(node, "locked"),
    )


def _read_constraints(model, node):
    for constraint in node.objects("ConstraintSet"):
        if constraint.tag != "CoordinateCouplerConstraint":
            model.notes.append(
                f"constraint {constraint.name!r} ({constraint.tag}) is not taken: bodies move by coordinates alone"
            )
            continue
        place = f"coupler {constraint.name!r}"
        if not truth(constraint, "isEnforced", True) or truth(constraint, "isDisabled", False):
            continue
        inner = find_function(constraint.child("coupled_coordinates_function"))
        if inner is None:
            raise SceneError(f"{place}: has no function; give it one")
        function = read_function(inner, place=place)
        scale = numbers(constraint.word("scale_factor", "1"), place=place, count=1)[0]
        of = tuple(constraint.word("independent_coordinate_names").split())
        target = constraint.word("dependent_coordinate_name")
        if not of or not target:
            raise SceneError(f"{place}: names no coordinates; give it some")
        model.couplings.append(Coupling(target, of, function if scale == 1.0 else scaled(function, scale)))
    dependents = {coupling.coordinate for coupling in model.couplings}
    for name, facts in model.coordinates().items():
        if facts.locked and name in dependents:
            model.notes.append(f"coordinate {name!r} is locked and follows others: it follows")
