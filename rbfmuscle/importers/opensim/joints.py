"""Joints, coordinates and couplers of a model, as ``.osim`` files write them."""

import math

import numpy as np

from rbfmuscle.importers.opensim.elements import (
    ModelJoint,
    Node,
    Reading,
    frame_at,
    read_function,
)
from rbfmuscle.scene.joints import (
    KINDS,
    Coordinate,
    Coupling,
    Function,
    Linear,
    Multivariate,
    TransformAxis,
    X,
    Y,
    Z,
    all_coordinates,
    motion_of,
    scaled,
)
from rbfmuscle.scene.objects import new_name
from rbfmuscle.validation import SceneError

# What OpenSim calls otherwise than our table of joints; where both have one, its coordinates are in
# the same order.
RENAMED = {"slider": "slide", "pin": "hinge", "gimbal": "ball"}
# Joints that become custom ones: turns about these axes, which carry the child over a surface.
CARRYING = {
    "ellipsoid": ((X, Y, Z), ()),
    "scapulothoracic": ((X, Y, Z), ()),
    "constantcurvature": ((X, Z, Y), ()),
}
TAKEN = KINDS | CARRYING
QUARTER = frame_at((0.0, 0.0, 0.0), (0.0, 0.0, 0.5 * math.pi))

End = tuple[str, np.ndarray]


def read_joint(reading: Reading, node: Node, ends: list[End], tag: str) -> None:
    """Add a joint from its element, its ends as (body, frame), and the tag of the element that
    lists its coordinates.
    """
    (parent, first), (child, second) = ends
    model = reading.model
    if parent == child:
        raise node.error(f"joins body {parent!r} to itself; correct its frames")
    kind = node.tag.removesuffix("Joint").lower()
    kind = RENAMED.get(kind, kind)
    if kind not in TAKEN:
        raise node.error(
            f"{parent} to {child}: its kind is not in the table of joints, so body {child!r} "
            "cannot be placed; replace it by a CustomJoint in OpenSim"
        )
    taken = [joint.name for joint in model.joints]
    name = new_name(node.name, taken, file=False)
    found, names = _coordinates(node, tag, kind)
    # Scene names of the coordinates, by the file's.
    plain: dict[str, str] = {}
    for one in names:
        plain[one] = new_name(one, plain.values(), file=False)
    if kind == "custom":
        rotations, translations = _custom_axes(node, plain)
    else:
        turns, shifts = TAKEN[kind]
        own = [TransformAxis(axis, (plain[one],)) for axis, one in zip((*turns, *shifts), names)]
        rotations = tuple(own[: len(turns)])
        translations = tuple(own[len(turns) :])
    joint = ModelJoint(
        name,
        parent,
        child,
        np.zeros(3),
        {},
        rotations,
        translations,
        kind=kind,
        parent_frame=first,
        child_frame=second,
    )
    joints = [joint]
    if kind in CARRYING:
        joints = _carrying(reading, node, joint, kind, list(plain.values()))
    for joint in joints:
        _add_coordinates(reading, node, joint, found, plain)
    for one, own_name in plain.items():
        if not any(own_name in joint.coordinates for joint in joints):
            model.notes.append(f"coordinate {one!r} moves nothing: it is left out")
    model.joints += joints


def _coordinates(node, tag, kind):
    """Elements of a joint's coordinates by name, and their names in order.

    Those that the file leaves out have the names that OpenSim gives them.
    """
    found: dict[str, Node] = {}
    for inner in node.objects(tag):
        if inner.tag == "Coordinate":
            if inner.name in found:
                raise node.error(f"two of its coordinates are named {inner.name!r}; rename one")
            found[inner.name] = inner
    names = list(found)
    if kind == "custom":
        table = node.child("SpatialTransform")
        if not names and table is not None:
            named = [name for axis in table.nodes() for name in axis.word("coordinates").split()]
            names = list(dict.fromkeys(named))
        return found, names
    turns, shifts = TAKEN[kind]
    needed = len(turns) + len(shifts) + (kind == "scapulothoracic")
    names += [f"_coord_{k}" for k in range(len(names), needed)]
    if len(names) != needed:
        raise node.error(f"a {node.tag} has {needed} coordinates, {len(names)} are given")
    return found, names


def _carrying(reading, node, joint, kind, names):
    """Custom joints for one that carries its child over a surface, for a scapula two with a link
    between them.
    """
    joint.kind = "custom"
    if kind == "constantcurvature":
        joint.arc = node.number("length", 1.0)
        neutral = node.vector("neutral_angle_x_z_y").tolist()
        joint.rotations = tuple(
            TransformAxis(axis.direction, axis.coordinates, Linear((1.0,), angle))
            for axis, angle in zip(joint.rotations, neutral)
        )
        return [joint]
    if kind == "ellipsoid":
        joint.radii = _radii(node, "radii_x_y_z")
        return [joint]
    # Seth et al. 2016: an ellipsoid turned by a right angle, then a hinge, the axis of winging.
    x, y, z = _radii(node, "thoracic_ellipsoid_radii_x_y_z")
    joint.radii = (y, x, z)
    direction = node.number("scapula_winging_axis_direction")
    origin = node.numbers("scapula_winging_axis_origin", "0 0", count=2)
    axis = frame_at((*origin, 0.0), (-0.5 * math.pi, 0.0, 0.0))
    axis[:3, :3] = frame_at((0.0, 0.0, 0.0), (0.0, 0.0, direction))[:3, :3] @ axis[:3, :3]
    bodies = reading.model.bodies
    link = new_name(f"{joint.name}_surface", bodies)
    bodies.append(link)
    winging = ModelJoint(
        new_name(f"{joint.name}_winging", [one.name for one in reading.model.joints]),
        link,
        joint.child,
        np.zeros(3),
        {},
        (TransformAxis(Z, (names[3],)),),
        kind="hinge",
        parent_frame=axis,
        child_frame=joint.child_frame @ axis,
    )
    joint.child = link
    joint.parent_frame, joint.child_frame = joint.parent_frame @ QUARTER, QUARTER
    return [joint, winging]


def _add_coordinates(reading, node, joint, found, plain):
    """Give a joint the coordinates of its axes, and note what the file calls them."""
    groups = {"rotation": joint.rotations, "translation": joint.translations}
    axes = [(sort, axis) for sort, group in groups.items() for axis in group]
    for one, name in plain.items():
        if not any(name in axis.coordinates for _, axis in axes):
            continue
        motion = motion_of(name, axes)
        joint.coordinates[name] = _coordinate(found.get(one), motion, reading.model)
        full = f"{joint.name}.{name}"
        reading.called[f"{node.name}/{one}"] = full
        reading.called.setdefault(one, full)


def _radii(node, tag):
    x, y, z = node.numbers(tag, "nan", count=3)
    if min(x, y, z) <= 0.0:
        raise node.error(f"{tag}: the radii {x:g} {y:g} {z:g} must be above zero")
    return x, y, z


def _custom_axes(node, plain):
    """The rotations and the translations of a custom joint, in order; ``plain`` are scene names of
    its coordinates, by the file's.
    """
    table = node.child("SpatialTransform")
    if table is None and node.child("TransformAxisSet") is not None:
        raise node.error("is written as OpenSim 1 did; open the model in OpenSim 4 and save it")
    axes = {}
    for axis in [] if table is None else table.nodes():
        direction, of = axis.vector("axis", "1 0 0"), axis.word("coordinates").split()
        function = read_function(axis)
        if function is None and of and axis.child("function") is not None:
            function = Linear((1.0,))  # so OpenSim takes an empty one; without any nothing moves
        if function is None:
            continue
        if not direction.any():
            raise axis.error("its direction is zero; give it one")
        for name in of:
            if name not in plain:
                raise axis.error(f"follows {name!r}, which is no coordinate of this joint")
        check_count(function, len(of), axis)
        axes[axis.name] = TransformAxis(
            tuple((direction / np.linalg.norm(direction)).tolist()),
            tuple(plain[name] for name in of),
            function,
        )
    return tuple(
        tuple(axes[f"{slot}{k}"] for k in (1, 2, 3) if f"{slot}{k}" in axes)
        for slot in ("rotation", "translation")
    )


def check_count(function: Function, count: int, node: Node) -> None:
    """SceneError where a function is of another number of coordinates than are named."""
    if isinstance(function, Linear) and len(function.slopes) > count:
        slopes = len(function.slopes)
        raise node.error(f"a linear function of {slopes} coordinates, {count} are named")
    if isinstance(function, Multivariate):
        needed = len(function.terms[0]) - 1
        if needed != count:
            raise node.error(f"a polynomial of {needed} coordinates, {count} are named")
    if count == 0 and not isinstance(function, Linear):
        raise node.error("a function of a coordinate, and none is named")


def _coordinate(node, motion, model):
    if node is None:  # the file leaves it out
        return Coordinate(motion)
    rest = node.number("default_value")
    limits = tuple(node.numbers("range", count=2)) if node.word("range") else None
    if limits is not None and limits[0] > limits[1]:
        raise node.error(f"its range {node.word('range')!r} goes downwards; turn it round")
    if node.truth("prescribed"):
        model.notes.append(
            f"coordinate {node.name!r} is prescribed by a function of time: not taken, it stays "
            f"at {rest:g}"
        )
    return Coordinate(
        motion,
        rest,
        limits,
        clamped=node.truth("clamped") and limits is not None,
        locked=node.truth("locked"),
    )


def read_constraints(reading: Reading, constraints: list[Node]) -> None:
    """Add couplers as couplings, weld constraints as fixed joints; others are named."""
    model = reading.model
    for node in constraints:
        if not node.truth("isEnforced", True) or node.truth("isDisabled"):
            continue
        if node.tag == "CoordinateCouplerConstraint":
            _read_coupler(reading, node)
            continue
        title = f"{node.tag} {node.name!r}" if node.name else node.tag
        ends = _constraint_ends(reading, node)
        if len(ends) != 2 or ends[0][0] == ends[1][0]:
            model.doubts.append(f"{title} is not taken: bodies move by coordinates alone")
        elif node.tag == "WeldConstraint":
            taken = [joint.name for joint in (*model.joints, *model.welds)]
            name = new_name(node.name or node.tag.lower(), taken)
            (parent, first), (child, second) = ends
            weld = ModelJoint(
                name,
                parent,
                child,
                np.zeros(3),
                {},
                kind="weld",
                parent_frame=first,
                child_frame=second,
            )
            model.welds.append(weld)
        else:
            model.constraints.append((title, ends[0][0], ends[1][0]))


def _constraint_ends(reading, node):
    """The bodies that a constraint names, each with a frame in it (4, 4)."""
    ends = []
    for inner in node.nodes():
        tag = inner.tag
        if tag.startswith("socket_") or tag in ("body_1", "body_2", "line_body", "follower_body"):
            try:
                ends.append(reading.place(node.word(tag), inside=node.path))
            except SceneError:
                continue
    for body, number in zip(range(len(ends)), ("1", "2")):
        at, turn = f"location_body_{number}", f"orientation_body_{number}"
        if node.child(at) is not None or node.child(turn) is not None:
            own = frame_at(node.vector(at), node.vector(turn).tolist())
            ends[body] = ends[body][0], ends[body][1] @ own
    return ends


def _read_coupler(reading, node):
    function = read_function(node.child("coupled_coordinates_function"))
    if function is None:
        raise node.error("has no function; give it one")
    named = node.word("independent_coordinate_names").split()
    target = node.word("dependent_coordinate_name")
    if not named or not target:
        raise node.error("names no coordinates; give it some")
    check_count(function, len(named), node)
    factor = node.number("scale_factor", 1.0)
    full = [reading.coordinate(name) for name in (target, *named)]
    for name, known in zip((target, *named), full):
        if not known:
            raise node.error(f"names coordinate {name!r}, which moves no joint; correct it")
    function = scaled(function, factor) if factor != 1.0 else function
    reading.model.couplings.append(Coupling(full[0], tuple(full[1:]), function))
    if all_coordinates(reading.model.joints)[full[0]].locked:
        reading.model.notes.append(
            f"coordinate {target!r} is locked and follows others: it follows"
        )
