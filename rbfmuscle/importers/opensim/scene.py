"""A scene from an OpenSim model: bodies as bones where the default pose puts them, joints as they are."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from rbfmuscle.geometry.exact_distance import ExactDistance
from rbfmuscle.importers.opensim.geometry import body_meshes
from rbfmuscle.importers.opensim.model import OsimModel, clean_name
from rbfmuscle.importers.opensim.read import read_osim
from rbfmuscle.importers.opensim.tubes import make_tube, scaled
from rbfmuscle.scene.joints.functions import Function
from rbfmuscle.scene.joints.joint import Coupling, Joint
from rbfmuscle.scene.objects import MM_PER_UNIT
from rbfmuscle.scene.scene import Scene
from rbfmuscle.validation import MeshError, SceneError


@dataclass
class Imported:
    """A scene made from a model.

    Attributes
    ----------
    scene, model : Scene, OsimModel
    places : dict of str to (4, 4) ndarray
        From every body of the model to the scene, rest pose [scene unit], by the model's names.
    names : dict of str to str
        The scene's name of every body.
    notes : list of str
        What was not taken, or taken otherwise than one may expect.
    """

    scene: Scene
    model: OsimModel
    places: dict[str, np.ndarray]
    names: dict[str, str]
    notes: list[str] = field(default_factory=list)


def import_osim(
    path: Path | str,
    *,
    units: str = "m",
    geometry: list[Path] | None = None,
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
    muscles : bool
        Make a tube of each of the model's muscles.

    Raises
    ------
    SceneError
        If the model cannot be read, or has a joint that the table of joints lacks.
    """
    model = read_osim(path)
    scene = Scene(clean_name(model.name or Path(path).stem), units=units)
    metre = 1000.0 / MM_PER_UNIT[units]
    ground = model.transforms()
    names = {body: clean_name(body) for body in model.bodies}
    meshes, notes = body_meshes(model, ground, metre, list(geometry or []))
    notes = [*model.notes, *notes]
    notes += [f"body {body!r} is named {names[body]!r} here" for body in model.bodies if names[body] != body]
    for body in model.bodies:
        if body in meshes:
            scene.add_bone(names[body], meshes[body])
            notes += [f"body {body!r}: {note}" for note in meshes[body].notes]
        else:
            scene.add_link(names[body])
            scene.left_out += [names[body]] if any(mesh.body == body for mesh in model.meshes) else []
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
        name = clean_name(muscle.name)
        try:
            tube = make_tube(muscle, found.places, bones, metre)
            attach: Any = [{"bone": found.names[b], "vertices": v.tolist()} for b, v in tube.held.items()]
            scene.add_muscle(name, (tube.vertices, tube.faces), attach=attach)
        except (SceneError, MeshError) as error:
            found.notes.append(f"muscle {name!r} is not taken: {error}")


def _add_joints(found, metre):
    """The joints and couplings of the tree, in the scene's units and under clean names."""
    factors, full = {}, {}

    def converted(axis, output):
        names = tuple(map(clean_name, axis.coordinates))
        function = _rescaled(axis.function, axis.coordinates, factors, output)
        return replace(axis, coordinates=names, function=function)

    for joint, backward in found.model.tree():
        title, coordinates = clean_name(joint.name), {}
        for name, facts in joint.coordinates.items():
            own = clean_name(name)
            if own != name:
                found.notes.append(f"coordinate {name!r} is named {own!r} here")
            factors[name] = factor = metre if facts.motion == "translation" else 1.0
            full[name] = f"{title}.{own}"
            limits = None if facts.range is None else tuple(factor * end for end in facts.range)
            coordinates[own] = replace(facts, rest=facts.rest * factor, range=limits)
        turns = tuple(converted(axis, 1.0) for axis in joint.rotations)
        shifts = tuple(converted(axis, metre) for axis in joint.translations)
        ends = [found.names[joint.parent], found.names[joint.child]]
        parent, child = reversed(ends) if backward else ends
        frame = found.places[joint.parent] @ scaled(joint.parent_frame, metre)
        made = Joint(title, parent, child, frame, coordinates, turns, shifts, joint.kind, backward)
        found.scene.place_joint(made)
    for coupling in found.model.couplings:
        if all(name in full for name in (coupling.coordinate, *coupling.of)):
            function = _rescaled(coupling.function, coupling.of, factors, factors[coupling.coordinate])
            of = tuple(full[name] for name in coupling.of)
            found.scene.place_coupling(Coupling(full[coupling.coordinate], of, function))


def _rescaled(function: Function, of: Sequence[str], factors: dict[str, float], output: float) -> Function:
    inputs = [factors[name] for name in of]
    return function if {output, *inputs} == {1.0} else function.rescaled(inputs, output)
