"""A scene from an OpenSim model: bodies as bones where the default pose puts them, joints as they are."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from rbfmuscle.geometry.exact_distance import ExactDistance
from rbfmuscle.importers.opensim.geometry import body_meshes
from rbfmuscle.importers.opensim.model import OsimModel
from rbfmuscle.importers.opensim.read import read_osim
from rbfmuscle.importers.opensim.tubes import make_tube, scaled
from rbfmuscle.scene.joints.functions import Function
from rbfmuscle.scene.joints.joint import Coupling, Joint, TransformAxis
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
    scene = Scene(_clean_name(model.name or Path(path).stem, ()), units=units)
    metre = 1000.0 / MM_PER_UNIT[units]
    ground = model.transforms()
    names = _clean_names(model.bodies)
    meshes, notes = body_meshes(model, ground, metre, list(geometry or []))
    notes = [*model.notes, *notes]
    notes += [f"body {body!r} is named {names[body]!r} here" for body in model.bodies if names[body] != body]
    for body in model.bodies:
        if body in meshes:
            scene.add_bone(names[body], meshes[body])
            notes += [f"body {body!r}: {note}" for note in meshes[body].notes]
        else:
            scene.add_link(names[body])
    found = Imported(scene, model, {body: scaled(t, metre) for body, t in ground.items()}, names, notes)
    _add_joints(found, metre)
    scene.superior, scene.anterior = [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]
    if muscles:
        _add_muscles(found, metre)
    return found


def _add_muscles(found, metre):
    """A tube for each muscle of the model."""
    scene, meshes = found.scene, {bone.name: bone.mesh for bone in found.scene.bones}
    bones = {
        body: ExactDistance(meshes[name].vertices, meshes[name].faces)
        for body, name in found.names.items()
        if name in meshes
    }
    for muscle in found.model.muscles:
        name = _clean_name(muscle.name, [other.name for other in scene.muscles])
        try:
            tube = make_tube(muscle, found.places, bones, metre)
            attach: Any = [{"bone": found.names[b], "vertices": v.tolist()} for b, v in tube.held.items()]
            scene.add_muscle(name, (tube.vertices, tube.faces), attach=attach)
        except (SceneError, MeshError) as error:
            found.lost[name] = str(error)
            found.notes.append(f"muscle {name!r} is not taken: {error}")


def _clean_name(name: str, taken: Sequence[str]) -> str:
    """Return a name of letters, digits, ``_`` and ``-`` that is not taken yet."""
    base = re.sub(r"[^A-Za-z0-9_-]+", "_", name).strip("_") or "body"
    made, number = base, 2
    while made in taken:
        made, number = f"{base}_{number}", number + 1
    return made


def _clean_names(names):
    """The clean name of each name."""
    found: dict[str, str] = {}
    for name in names:
        found[name] = _clean_name(name, list(found.values()))
    return found


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


def _add_joints(found, metre):
    """The joints and couplings of the tree, in the scene's units and under clean names."""
    scene, model, names = found.scene, found.model, found.names
    used = list(model.tree())
    titles = _clean_names([joint.name for joint, _ in used])
    factors, full = {}, {}
    for joint, backward in used:
        own = _clean_names(joint.coordinates)
        found.notes += [
            f"coordinate {name!r} is named {own[name]!r} here" for name in own if own[name] != name
        ]
        coordinates = {}
        for name, facts in joint.coordinates.items():
            factors[name] = factor = metre if facts.motion == "translation" else 1.0
            full[name] = f"{titles[joint.name]}.{own[name]}"
            limits = None if facts.range is None else tuple(factor * end for end in facts.range)
            coordinates[own[name]] = replace(facts, rest=facts.rest * factor, range=limits)
        axes = [
            tuple(
                TransformAxis(
                    axis.direction,
                    tuple(own[name] for name in axis.coordinates),
                    _rescaled(axis.function, axis.coordinates, factors, output),
                )
                for axis in group
            )
            for group, output in ((joint.rotations, 1.0), (joint.translations, metre))
        ]
        ends = [names[joint.parent], names[joint.child]]
        frame = found.places[joint.parent] @ scaled(joint.parent_frame, metre)
        parent, child = reversed(ends) if backward else ends
        scene.place_joint(
            Joint(titles[joint.name], parent, child, frame, coordinates, *axes, joint.kind, backward)
        )
    for coupling in model.couplings:
        if all(name in full for name in (coupling.coordinate, *coupling.of)):
            function = _rescaled(coupling.function, coupling.of, factors, factors[coupling.coordinate])
            of = tuple(full[name] for name in coupling.of)
            scene.place_coupling(Coupling(full[coupling.coordinate], of, function))


def _rescaled(function: Function, of: Sequence[str], factors: dict[str, float], output: float) -> Function:
    inputs = [factors[name] for name in of]
    return function if {output, *inputs} == {1.0} else function.rescaled(inputs, output)
