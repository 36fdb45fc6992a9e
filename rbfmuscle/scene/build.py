"""Building a scene, part by part, and checking that it is whole. Each function is a method of
`Scene` too.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias, TypeVar

from numpy.typing import ArrayLike

from rbfmuscle.geometry.arrays import MeshLike
from rbfmuscle.scene.activation.contraction import resolve_contraction
from rbfmuscle.scene.activation.keys import contraction_keys
from rbfmuscle.scene.attachments import AttachTable, resolve_attachments, tendon_ends
from rbfmuscle.scene.bone import Bone
from rbfmuscle.scene.joints.joint import Coupling, Joint, all_coordinates, ordered
from rbfmuscle.scene.joints.tables import CouplingTable, JointTable, make_coupling
from rbfmuscle.scene.meshes.read import as_mesh, read_fibres
from rbfmuscle.scene.meshes.repair import ReadMesh
from rbfmuscle.scene.motion import make_motion
from rbfmuscle.scene.objects import Attachment, Muscle, SceneData, find_named
from rbfmuscle.scene.options import MotionOptions
from rbfmuscle.scene.tendons import tendon_name
from rbfmuscle.validation import SceneError, did_you_mean, shown

S = TypeVar("S", bound=SceneData)
MeshInput: TypeAlias = str | Path | ReadMesh | MeshLike
_NAME_CHARACTERS = set("abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ0123456789_-")


def add_bone(scene: S, name: str, mesh: MeshInput | None = None, *, scale: float = 1.0) -> S:
    """Add a bone and return the scene.

    Parameters
    ----------
    name : str
    mesh : path, trimesh.Trimesh, (vertices, faces) or ReadMesh, optional
        Mended where that is safe; holes are kept, with a note. A bone without one carries joints
        only.
    scale : float
        Factor from the mesh's unit to the scene's.
    """
    check_new_name(scene.bones, name, "bone")
    if name in scene.links:
        raise SceneError(f"bone {name!r} is given twice")
    if mesh is None:
        scene.links.append(name)
    else:
        read = as_mesh(mesh, name, scale, may_be_open=True)
        scene.bones.append(Bone(name, read.mesh, read.source, read.closed, read.notes))
    return scene


def add_joint(
    scene: S,
    name: str,
    parent: str,
    child: str,
    centre: ArrayLike | None = None,
    axes: Mapping[str, ArrayLike] | None = None,
    **keys: Any,
) -> S:
    """Add a joint, a ball where no ``type`` is given, and return the scene.

    Parameters
    ----------
    name, parent, child : str
        The child bone moves; a bone may be the child of one joint.
    centre : (3,) array_like
    axes : dict of str -> (3,) array_like
        Axis of each coordinate, in any length.
    **keys
        Any other key of ``[[joint]]`` [degree, scene unit]: ``type``, ``coordinates``,
        ``rotations``, ...
    """
    row = {
        "name": name,
        "parent": parent,
        "child": child,
        "centre": centre,
        "axes": axes and dict(axes),
    }
    row |= keys
    return place_joint(scene, JointTable.build(row, place=f"joint {name!r}: ").joint())


def place_joint(scene: S, joint: Joint) -> S:
    """Add a `Joint` and return the scene; bones and joints form a tree."""
    place, child = f"joint {joint.name!r}: ", joint.child
    check_new_name(scene.joints, joint.name, "joint")
    for bone in (joint.parent, child):
        if bone not in scene.links:
            find_named(scene.bones, bone, "bone", place=place)
    parents, ancestor = {other.child: other.parent for other in scene.joints}, joint.parent
    if child in parents:
        raise SceneError(f"{place}bone {child!r} is already the child of another joint")
    while ancestor is not None:
        if ancestor == child:
            raise SceneError(f"{place}{child!r} would hang on itself, joints must form a tree")
        ancestor = parents.get(ancestor)
    scene.joints.append(joint)
    return scene


def add_coupling(scene: S, coordinate: str, of: Sequence[str], **function: Any) -> S:
    """Let a coordinate follow others by a function, as in ``[[coupling]]``, and return the scene.

    Parameters
    ----------
    coordinate : str
    of : list of str
    **function
        One of ``constant``, ``linear``, ``polynomial``, ``piecewise`` and ``spline`` [degree, scene
        unit].
    """
    row = {"coordinate": coordinate, "of": list(of), **function}
    table = CouplingTable.build(row, place=f"coupling of {coordinate!r}: ")
    return place_coupling(scene, make_coupling(table, scene.joints))


def place_coupling(scene: S, coupling: Coupling) -> S:
    """Add a `Coupling` and return the scene."""
    scene.couplings = ordered([*scene.couplings, coupling])
    return scene


def add_muscle(
    scene: S,
    name: str,
    mesh: MeshInput,
    *,
    attach: Sequence[Attachment | AttachTable | dict[str, Any]] = (),
    model: dict[str, Any] | str = "rbf",
    fibres: str | Path | Sequence[ArrayLike] | None = None,
    scale: float = 1.0,
    **contraction: Any,
) -> S:
    """Add a muscle and return the scene.

    Parameters
    ----------
    name : str
    mesh : path, trimesh.Trimesh, (vertices, faces) or ReadMesh
        Closed; mended where that is safe.
    attach : list of Attachment or dict
        A dict holds ``bone`` and one of ``vertices`` (indices or a file), ``near`` (distance) and
        ``sphere`` (``centre``, ``radius``); a ``tendon`` (``to``, ``via``) where the mesh ends
        short of the bone.
    model : str or dict
        A model's name, or a table with ``name`` and the model's own options.
    fibres : path or list of (k, 3) array_like, optional
    scale : float
        Factor from the mesh's unit to the scene's; fibres are scaled alike.
    **contraction
        ``activation``, ``fibre_stretch_at_rest``, ``tendon``.
    """
    check_new_name(scene.muscles, name, "muscle")
    read = as_mesh(mesh, name, scale, may_be_open=False)
    model_name, options = split_model(model, place=f"muscle {name!r}")
    attachments = resolve_attachments(attach, read, scene.bones, muscle=name)
    lines = None if fibres is None else read_fibres(fibres, scale=scale, muscle=name)
    keys = contraction_keys(contraction, muscle=name)
    muscle = Muscle(
        name, read.mesh, model_name, options, attachments, lines, read.source, read.notes, keys
    )
    muscle.tendons = tendon_ends(muscle, scene)
    scene.muscles.append(muscle)
    return scene


def set_motion(scene: S, *, folder: Path | None = None, **options: Any) -> S:
    """Set the motion from the keys of ``[motion]`` (angles in degrees) and return the scene.

    Parameters
    ----------
    folder : path, optional
        What a relative ``file`` is relative to.
    **options
        ``ramp``, ``waypoints`` with ``step``, or ``file``.
    """
    scene.motion = make_motion(
        scene, MotionOptions.build(options, place="[motion] ", folder=folder)
    )
    return scene


def validate(scene: S) -> S:
    """Return the scene, or raise SceneError if it cannot be simulated: no bones, no muscles, loose
    muscles.
    """
    for what in ("bones", "muscles"):
        if not getattr(scene, what):
            raise SceneError(f"scene {scene.name!r} has no {what}, add a [[{what[:-1]}]]")
    _check_file_names(scene)
    known = all_coordinates(scene.joints)
    for name in (name for frame in scene.motion.frames for name in frame):
        if name not in known:
            raise SceneError(
                f"[motion]: unknown coordinate {name!r}, {did_you_mean(name, sorted(known))}"
            )
    for muscle in scene.muscles:
        place, bones = f"muscle {muscle.name!r}", sorted({a.bone for a in muscle.attachments})
        if not bones:
            raise SceneError(f"{place} has no attachment, give attach a place on two bones")
        if len(bones) == 1:
            raise SceneError(f"{place} is attached to {bones[0]!r} only, give attach a second bone")
        if muscle.contraction is not None:
            resolve_contraction(muscle)
    return scene


def _check_file_names(scene: SceneData) -> None:
    """Raise SceneError if two meshes of a run would have one file."""
    muscles = {muscle.name.lower(): muscle.name for muscle in scene.muscles}
    for muscle in scene.muscles:
        other = muscles.get(tendon_name(muscle.name).lower())
        if muscle.tendons and other is not None:
            raise SceneError(
                f"muscle {other!r} has the name of the tendons of {muscle.name!r}; choose another"
            )
    bones = {bone.name.lower() for bone in scene.bones}
    for bone in scene.bones:
        stem, _, number = bone.name.lower().rpartition("_")
        if stem in bones and len(number) >= 4 and number.isdecimal():
            raise SceneError(
                f"bone {bone.name!r} has the name of a frame of bone {stem!r}; choose another"
            )


def split_model(model: dict[str, Any] | str, *, place: str) -> tuple[str, dict[str, Any]]:
    """Return (name, options) of a model given as a name or as a table with ``name``."""
    if isinstance(model, str):
        return model, {}
    if isinstance(model, dict):
        options = dict(model)
        name = options.pop("name", "rbf")
        if isinstance(name, str):
            return name, options
    raise SceneError(f"{place}: model must be a name or a table with a name, got {shown(model)}")


def check_name(name: object, what: str) -> None:
    """Raise SceneError if a name is no name for a file."""
    if not isinstance(name, str) or not name or not set(name) <= _NAME_CHARACTERS:
        allowed = "letters, digits, '_' and '-' only (it becomes a file name)"
        raise SceneError(f"{what} name {shown(repr(name))} may hold {allowed}")


def check_new_name(items: Sequence[Bone | Joint | Muscle], name: str, what: str) -> None:
    """Raise SceneError if a name is no name for a file, or taken, in letters of another case
    too.
    """
    check_name(name, what)
    if name == "all":
        raise SceneError(f"{what} name 'all' stands for the whole scene in tables, choose another")
    same = [item.name for item in items if item.name.lower() == name.lower()]
    if name in same:
        raise SceneError(f"{what} {name!r} is given twice")
    if same and what != "joint":
        raise SceneError(
            f"{what} {name!r} differs from {same[0]!r} in case alone, and their files would be one "
            "on some systems; choose another name"
        )
