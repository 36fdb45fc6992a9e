"""A scene from an OpenSim model: bodies as bones where the default pose puts them, joints as they are."""

import re
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from rbfmuscle.importers.opensim.geometry import body_meshes
from rbfmuscle.importers.opensim.model import OsimModel
from rbfmuscle.importers.opensim.muscles import bone_distances, make_tube, scaled
from rbfmuscle.importers.opensim.read import read_osim
from rbfmuscle.scene.joints.functions import Function
from rbfmuscle.scene.joints.joint import Coordinate, Coupling, Joint, TransformAxis
from rbfmuscle.scene.objects import MM_PER_UNIT
from rbfmuscle.scene.scene import Scene
from rbfmuscle.validation import MeshError, SceneError, did_you_mean


@dataclass
class Imported:
    """A scene made from a model.

    Attributes
    ----------
    scene : Scene
    model : OsimModel
    places : dict of str to (4, 4) ndarray
        From every body of the model to the scene, rest pose [scene unit], by the model's names.
    names : dict of str to str
        The scene's name of every body.
    notes : list of str
        What was not taken, or taken otherwise than one may expect.
    lost : dict of str to str
        Why a muscle is not in the scene, by name.
    """

    scene: Scene
    model: OsimModel
    places: dict[str, np.ndarray]
    names: dict[str, str]
    notes: list[str] = field(default_factory=list)
    lost: dict[str, str] = field(default_factory=dict)


def import_osim(
    path: Path | str,
    *,
    units: str = "m",
    geometry: list[Path] | None = None,
    bodies: list[str] | None = None,
    muscles: bool = True,
) -> Imported:
    """Make a scene of an OpenSim model.

    Meshes stand where the model's default pose puts them, which is then the rest pose of the scene. A body without a
    mesh becomes a bone without one.

    Parameters
    ----------
    path : path
        An ``.osim`` file.
    units : {"m", "cm", "mm"}
        Unit of the scene's lengths.
    geometry : list of path, optional
        Folders with meshes, after the model's own and its ``Geometry``.
    bodies : list of str, optional
        Take these and what lies between them and the ground; all where not given.
    muscles : bool
        Make a tube of each of the model's muscles.

    Returns
    -------
    Imported

    Raises
    ------
    SceneError
        If the model cannot be read, or has a joint that the table of joints lacks.
    """
    model = read_osim(path)
    if bodies:
        _keep(model, bodies)
    scene = Scene(clean_name(model.name or Path(path).stem, set()), units=units)
    metre = 1000.0 / MM_PER_UNIT[units]
    names = {}
    for body in model.bodies:
        names[body] = clean_name(body, set(names.values()))
    ground = model.transforms()
    meshes, notes = body_meshes(model, ground, metre, list(geometry or []))
    notes = [*model.notes, *notes]
    notes += [f"body {body!r} is named {names[body]!r} here" for body in model.bodies if names[body] != body]
    for body in model.bodies:
        if body in meshes:
            scene.add_bone(names[body], meshes[body])
            notes += [f"body {body!r}: {note}" for note in meshes[body].notes]
        else:
            scene.add_link(names[body])
    places = {body: scaled(place, metre) for body, place in ground.items()}
    _add_joints(scene, model, places, names, metre, notes)
    scene.superior, scene.anterior = [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]
    found = Imported(scene, model, places, names, notes)
    if muscles:
        _add_muscles(found, metre)
    return found


def _add_muscles(found, metre):
    """A tube for each muscle of the model."""
    scene, distances = found.scene, bone_distances(found.scene)
    for muscle in found.model.muscles:
        name = clean_name(muscle.name, {other.name for other in scene.muscles})
        try:
            tube = make_tube(muscle, found.places, found.names, distances, metre)
            attach: Any = [{"bone": bone, "vertices": held.tolist()} for bone, held in tube.held.items()]
            scene.add_muscle(name, (tube.vertices, tube.faces), attach=attach)
        except (SceneError, MeshError) as error:
            found.lost[name] = str(error)
            found.notes.append(f"muscle {name!r} is not taken: {error}")


def clean_name(name: str, taken: set[str]) -> str:
    """Return a name of letters, digits, ``_`` and ``-`` that is not taken yet."""
    base = re.sub(r"[^A-Za-z0-9_-]+", "_", name).strip("_") or "body"
    made, number = base, 2
    while made in taken:
        made, number = f"{base}_{number}", number + 1
    return made


def _keep(model, bodies):
    """Leave out every body that is neither named nor on the way from one of those to the ground."""
    towards = {}
    for joint, backward in model.tree():
        child, parent = (joint.parent, joint.child) if backward else (joint.child, joint.parent)
        towards[child] = parent
    kept = {model.bodies[0]}
    for body in bodies:
        if body not in model.bodies:
            raise SceneError(f"{model.path}: there is no body {body!r}, {did_you_mean(body, model.bodies)}")
        while body is not None and body not in kept:
            kept.add(body)
            body = towards.get(body)
    model.bodies = [body for body in model.bodies if body in kept]
    model.joints = [joint for joint in model.joints if {joint.parent, joint.child} <= kept]
    model.meshes = [mesh for mesh in model.meshes if mesh.body in kept]
    model.muscles = [m for m in model.muscles if all(body in kept for body, _ in m.points)]
    known = model.coordinates()
    model.couplings = [c for c in model.couplings if all(n in known for n in (c.coordinate, *c.of))]


def _add_joints(scene, model, places, names, metre, notes):
    factor = {n: metre if c.motion == "translation" else 1.0 for n, c in model.coordinates().items()}
    titles, full, taken = {}, {}, set()
    for joint, backward in model.tree():
        name = clean_name(joint.name, taken)
        taken.add(name)
        own = {}
        for coordinate in joint.moves.coordinates:
            own[coordinate] = clean_name(coordinate, set(own.values()))
            full[coordinate] = f"{name}.{own[coordinate]}"
            if own[coordinate] != coordinate:
                notes.append(f"coordinate {coordinate!r} is named {own[coordinate]!r} here")
        titles[joint.name] = name
        ends = (joint.child, joint.parent) if backward else (joint.parent, joint.child)
        frame = places[joint.parent] @ scaled(joint.parent_frame, metre)
        moves = joint.moves
        scene.place_joint(
            Joint(
                name, names[ends[0]], names[ends[1]], frame,
                {own[n]: _scaled_coordinate(c, factor[n]) for n, c in moves.coordinates.items()},
                tuple(_scaled_axis(axis, own, factor, 1.0) for axis in moves.rotations),
                tuple(_scaled_axis(axis, own, factor, metre) for axis in moves.translations),
                moves.kind, backward,
            )
        )  # fmt: skip
    known = {n for joint, _ in model.tree() for n in joint.moves.coordinates}
    for coupling in model.couplings:
        if {coupling.coordinate, *coupling.of} <= known:
            function = _rescaled(coupling.function, coupling.of, factor, factor[coupling.coordinate])
            of = tuple(full[name] for name in coupling.of)
            scene.place_coupling(Coupling(full[coupling.coordinate], of, function))


def _scaled_coordinate(facts: Coordinate, factor: float) -> Coordinate:
    limits: Any = None if facts.range is None else tuple(end * factor for end in facts.range)
    return replace(facts, rest=facts.rest * factor, range=limits)


def _scaled_axis(axis, own, factor, output):
    function = _rescaled(axis.function, axis.coordinates, factor, output)
    return TransformAxis(axis.direction, tuple(own[name] for name in axis.coordinates), function)


def _rescaled(function: Function, of: Any, factor: Any, output: Any) -> Function:
    inputs = [factor[name] for name in of]
    return function if output == 1.0 and all(f == 1.0 for f in inputs) else function.rescaled(inputs, output)
