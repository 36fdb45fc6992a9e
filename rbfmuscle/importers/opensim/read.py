"""``.osim`` files of every version that the public collection has, as an `OsimModel`."""

from pathlib import Path

import numpy as np

from rbfmuscle.importers.opensim.elements import Frames, frame_at, read_function, socket
from rbfmuscle.importers.opensim.model import (
    GROUND,
    ModelJoint,
    ModelMesh,
    ModelMuscle,
    OsimModel,
    WrapShape,
    finish,
)
from rbfmuscle.importers.opensim.xml import plain_name, read_xml
from rbfmuscle.scene.joints.functions import Linear, scaled
from rbfmuscle.scene.joints.joint import KINDS, Coordinate, Coupling, TransformAxis, motion_of
from rbfmuscle.validation import SceneError

SOCKETS = 40000  # from this version on joints stand in a set of their own and name their frames
# What OpenSim calls otherwise than our table of joints; where both have one, its coordinates are in
# the same order.
RENAMED = {"weld": "fixed", "pin": "hinge", "gimbal": "ball"}
# Force per area of muscle [N/m2] (Arnold et al. 2010, Ann Biomed Eng 38: 269; Rajagopal et al. 2016
# have 60 N/cm2).
SPECIFIC_TENSION = 61e4


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
    for defaults in node.findall("defaults"):
        node.remove(defaults)
    bodies = [body for body in node.objects("BodySet") if body.tag == "Body"]
    model = OsimModel(node.name or plain_name(path.stem), version, path)
    model.bodies = [GROUND, *(body.name for body in bodies if body.name != GROUND)]
    units = node.word("length_units", "meters")
    if units not in ("meters", "m", "metres"):
        words = "lengths are read as metres, as OpenSim reads them"
        model.notes.append(f"<length_units> says {units!r}; {words}")
    frames = Frames(node)
    if version >= SOCKETS or node.child("JointSet") is not None:
        _read_sockets(model, node, frames)
    else:
        _read_nested(model, bodies)
    _read_couplings(model, node)
    model.muscles = _read_muscles(model, node, frames)
    return finish(model)


def _read_sockets(model, node, frames):
    """Versions from 4 on: joints in a set, which name frames; geometry attached to frames."""
    for joint in node.objects("JointSet"):
        ends = []
        for role in ("parent", "child"):
            name = socket(joint, f"{role}_frame")
            if not name:
                raise joint.error(f"names no {role} frame; give it one")
            ends.append(frames.place(name, inside=joint.path))
        model.joints.append(_joint(joint, ends, "coordinates", model))
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


def _read_nested(model, bodies):
    """Versions before 4: each joint stands inside the body that is its child."""
    for body in bodies:
        for joint in body.objects("Joint"):
            ends = []
            for name, where, turn in (
                (
                    plain_name(joint.word("parent_body")),
                    "location_in_parent",
                    "orientation_in_parent",
                ),
                (body.name, "location", "orientation"),
            ):
                # Six digits: so OpenSim 4 rounds these when it reads an older file.
                six = [
                    [float(f"{value:.6g}") for value in joint.vector(tag)] for tag in (where, turn)
                ]
                ends.append((name, frame_at(np.array(six[0]), six[1])))
            if joint.truth("reverse"):
                ends.reverse()
            model.joints.append(_joint(joint, ends, "CoordinateSet", model))
        visible = body.child("VisibleObject")
        if visible is None:
            continue
        whole = visible.vector("scale_factors", "1 1 1")
        for file in visible.word("geometry_files").split():
            _add_mesh(model, file, body.name, whole, np.eye(4), True)
        for shape in visible.objects("GeometrySet"):
            six, file = (
                shape.numbers("transform", "0 0 0 0 0 0", count=6),
                shape.word("geometry_file"),
            )
            scale, shown = (
                whole * shape.vector("scale_factors", "1 1 1"),
                shape.word("display_preference"),
            )
            _add_mesh(
                model, file, body.name, scale, frame_at(np.array(six[3:]), six[:3]), shown != "0"
            )


def _add_mesh(model, file, body, scale, transform, shown):
    if file in ("", "Unassigned"):
        return
    if not shown or not all(scale):
        why = f"scaled to nothing ({scale.tolist()})" if shown else "hidden in the model"
        model.notes.append(f"body {body!r}: mesh {file!r} is {why}: not taken")
        return
    model.meshes.append(ModelMesh(file, body, tuple(scale.tolist()), transform))


def _joint(node, ends, holder, model):
    """One joint from its element, its ends as (body, frame), and the tag of what holds its
    coordinates.
    """
    (parent, first), (child, second) = ends
    kind = node.tag.removesuffix("Joint").lower()
    kind = RENAMED.get(kind, kind)
    if kind not in KINDS:
        why = f"is not in the table of joints, so body {child!r} cannot be placed"
        raise node.error(
            f"{parent} to {child}: its kind {why}; replace it by a CustomJoint in OpenSim"
        )
    found = [inner for inner in node.objects(holder) if inner.tag == "Coordinate"]
    names, (turns, shifts) = [inner.name for inner in found], KINDS[kind][:2]
    if kind == "custom":
        axes = _custom_axes(node, names)
    else:
        needed = len(turns) + len(shifts)
        if len(names) != needed:
            raise node.error(f"a {node.tag} has {needed} coordinates, {len(names)} are given")
        axes = {
            "rotation": tuple(TransformAxis(axis, (name,)) for axis, name in zip(turns, names)),
            "translation": tuple(
                TransformAxis(a, (n,)) for a, n in zip(shifts, names[len(turns) :])
            ),
        }
    slopes = [
        (sort, axis.coordinates, next(iter(getattr(axis.function, "slopes", ())), 0.0))
        for sort, group in axes.items()
        for axis in group
    ]
    used = {name for _, names, _ in slopes for name in names}
    model.notes += [
        f"coordinate {name!r} moves nothing: it is left out" for name in names if name not in used
    ]
    kept = [inner for inner in found if inner.name in used]
    coordinates = {
        inner.name: _coordinate(inner, motion_of(inner.name, slopes), model) for inner in kept
    }
    return ModelJoint(
        node.name,
        parent,
        child,
        np.zeros(3),
        coordinates,
        axes["rotation"],
        axes["translation"],
        kind,
        parent_frame=first,
        child_frame=second,
    )


def _custom_axes(node, names):
    """The rotations and the translations of a custom joint, in order."""
    table = node.child("SpatialTransform")
    if table is None and node.child("TransformAxisSet") is not None:
        raise node.error("is written as OpenSim 1 did; open the model in OpenSim 4 and save it")
    axes = {}
    for axis in [] if table is None else table.nodes():
        direction, of = axis.vector("axis", "1 0 0"), axis.names("coordinates")
        function = read_function(axis)
        if function is None:
            if of:
                raise axis.error(f"follows {' '.join(of)} by no function; give it one")
            continue
        if not direction.any():
            raise axis.error("its direction is zero; give it one")
        for name in of:
            if name not in names:
                raise axis.error(f"follows {name!r}, which is no coordinate of this joint")
        _check_count(function, len(of), axis)
        axes[axis.name] = TransformAxis(
            tuple((direction / np.linalg.norm(direction)).tolist()), of, function
        )
    slots = ("rotation", "translation")
    return {
        slot: tuple(axes[f"{slot}{k}"] for k in (1, 2, 3) if f"{slot}{k}" in axes) for slot in slots
    }


def _check_count(function, count, node):
    if isinstance(function, Linear) and len(function.slopes) > count:
        slopes = len(function.slopes)
        raise node.error(f"a linear function of {slopes} coordinates, {count} are named")
    if count == 0 and not isinstance(function, Linear):
        raise node.error("a function of a coordinate, and none is named")


def _coordinate(node, motion, model):
    rest = node.number("default_value")
    limits = tuple(node.numbers("range", count=2)) if node.word("range") else None
    if limits is not None and limits[0] > limits[1]:
        raise node.error(f"its range {node.word('range')!r} goes downwards; turn it round")
    if node.truth("prescribed"):
        what = f"coordinate {node.name!r} is prescribed by a function of time"
        model.notes.append(f"{what}: not taken, it stays at {rest:g}")
    clamped = node.truth("clamped") and limits is not None
    return Coordinate(motion, rest, limits, clamped, node.truth("locked"))


def _read_couplings(model, node):
    coordinates = model.coordinates()
    for constraint in node.objects("ConstraintSet"):
        if constraint.tag != "CoordinateCouplerConstraint":
            what = f"constraint {constraint.name!r} ({constraint.tag})"
            model.notes.append(f"{what} is not taken: bodies move by coordinates alone")
            continue
        if not constraint.truth("isEnforced", True) or constraint.truth("isDisabled"):
            continue
        function = read_function(constraint.child("coupled_coordinates_function"))
        if function is None:
            raise constraint.error("has no function; give it one")
        of = constraint.names("independent_coordinate_names")
        target = plain_name(constraint.word("dependent_coordinate_name"))
        if not of or not target:
            raise constraint.error("names no coordinates; give it some")
        _check_count(function, len(of), constraint)
        factor = constraint.number("scale_factor", 1.0)
        model.couplings.append(
            Coupling(target, of, scaled(function, factor) if factor != 1.0 else function)
        )
        if target in coordinates and coordinates[target].locked:
            model.notes.append(f"coordinate {target!r} is locked and follows others: it follows")


def _read_muscles(model, node, frames):
    """The muscles of a model that have a path, a maximum isometric force and an optimal fibre
    length.
    """
    ground = node.child("Ground")
    shapes = {}
    for body in [*([ground] if ground is not None else []), *node.objects("BodySet")]:
        for shape in body.objects("WrapObjectSet"):
            radii = _radii(shape)
            if radii is None:
                model.notes.append(f"wrapping object {shape.name!r} ({shape.tag}) is not taken")
            elif shape.truth("active", True) and min(radii) > 0:
                frame = frame_at(
                    shape.vector("translation"), shape.vector("xyz_body_rotation").tolist()
                )
                quadrant = (
                    shape.word("quadrant", "all").lower().removeprefix("+").replace("all", "")
                )
                body_name = body.name or GROUND
                shapes[shape.name] = WrapShape(
                    body_name, frame, np.array(radii), shape.tag, quadrant
                )
    muscles, resting = [], {name: facts.rest for name, facts in model.coordinates().items()}
    for force in node.objects("ForceSet"):
        path = force.child("GeometryPath")
        if path is None or not force.word("optimal_fiber_length"):
            continue
        points = [_path_point(point, frames, resting) for point in path.objects("PathPointSet")]
        names = [plain_name(wrap.word("wrap_object")) for wrap in path.objects("PathWrapSet")]
        volume = (
            force.number("max_isometric_force")
            * force.number("optimal_fiber_length")
            / SPECIFIC_TENSION
        )
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
    """Body and place in it of a path point where coordinates are at their defaults; None where it
    is not active.
    """
    body, frame = frames.place(point.word("socket_parent_frame") or point.word("body"))

    def value_of(tag):
        return resting.get(
            plain_name(point.word(f"socket_{tag}") or point.word(tag)).split("/")[-1], 0.0
        )

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
