"""Texts of small OpenSim models, part by part."""


def offset(name, parent, at="0 0 0", turn="0 0 0"):
    return (
        f'<PhysicalOffsetFrame name="{name}"><socket_parent>{parent}</socket_parent>'
        f"<translation>{at}</translation><orientation>{turn}</orientation></PhysicalOffsetFrame>"
    )


def coordinate(name, value=0.0, more=""):
    return f'<Coordinate name="{name}"><default_value>{value}</default_value>{more}</Coordinate>'


def joint(kind, name, ends, *, own="", more="", at=("0 0 0", "0 0 0"), child=("0 0 0", "0 0 0")):
    """A joint between two frames, offset from them; ``own`` are its coordinates."""
    inner = f"<coordinates>{own}</coordinates>" if own else ""
    named = f' name="{name}"' if name else ""
    frames = offset("first", ends[0], *at) + offset("second", ends[1], *child)
    return (
        f"<{kind}{named}><socket_parent_frame>first</socket_parent_frame>"
        f"<socket_child_frame>second</socket_child_frame>{inner}<frames>{frames}</frames>"
        f"{more}</{kind}>"
    )


def pin(name, parent, child, value=0.0, at="0 0 0", child_at="0 0 0"):
    own = coordinate(f"{name}_q", value)
    where = {"at": (at, "0 0 0"), "child": (child_at, "0 0 0")}
    return joint("PinJoint", name, (_path(parent), _path(child)), own=own, **where)


def axis_joint(name, parent, child, functions, own=""):
    """A custom joint: for each of the six axes (coordinates, function)."""
    directions = {
        "rotation1": "0 0 1",
        "rotation2": "0 1 0",
        "rotation3": "1 0 0",
        "translation1": "1 0 0",
        "translation2": "0 1 0",
        "translation3": "0 0 1",
    }
    axes = ""
    for key, direction in directions.items():
        of, function = functions.get(key, ("", "<function/>"))
        axes += (
            f'<TransformAxis name="{key}"><coordinates>{of}</coordinates>'
            f"<axis>{direction}</axis>{function}</TransformAxis>"
        )
    ends = (_path(parent), _path(child))
    more = f"<SpatialTransform>{axes}</SpatialTransform>"
    return joint("CustomJoint", name, ends, own=own, more=more)


def body(name, inner=""):
    return f'<Body name="{name}">{inner}<mass>1</mass><inertia>1 1 1 0 0 0</inertia></Body>'


def mesh(file="wedge.obj"):
    return (
        '<attached_geometry><Mesh name="m"><socket_frame>..</socket_frame>'
        f"<mesh_file>{file}</mesh_file></Mesh></attached_geometry>"
    )


def point(name, owner, at, tag="PathPoint"):
    return (
        f'<{tag} name="{name}"><socket_parent_frame>{_path(owner)}</socket_parent_frame>'
        f"<location>{at}</location></{tag}>"
    )


def muscle(name, points, *, wraps=(), more="", kind="Thelen2003Muscle"):
    wrapped = "".join(f"<PathWrap><wrap_object>{w}</wrap_object></PathWrap>" for w in wraps)
    path = (
        f"<PathPointSet><objects>{''.join(points)}</objects></PathPointSet>"
        f"<PathWrapSet><objects>{wrapped}</objects></PathWrapSet>"
    )
    return f'<{kind} name="{name}"><GeometryPath name="p">{path}</GeometryPath>{more}</{kind}>'


def model(bodies, joints, *, forces=(), constraints=(), first="", more=""):
    def objects(tag, parts):
        inner = "".join(parts)
        return f'<{tag} name="{tag.lower()}"><objects>{inner}</objects></{tag}>' if inner else ""

    written = [part if part.startswith("<") else body(part) for part in bodies]
    return (
        '<?xml version="1.0" encoding="UTF-8"?><OpenSimDocument Version="40000">'
        f'<Model name="m">{first}<Ground name="ground"/>{objects("BodySet", written)}'
        f"{objects('JointSet', joints)}{objects('ConstraintSet', constraints)}"
        f"{objects('ForceSet', forces)}{more}</Model></OpenSimDocument>"
    )


def _path(name):
    return name if name.startswith("/") else "/ground" if name == "ground" else f"/bodyset/{name}"
