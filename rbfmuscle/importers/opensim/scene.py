"""A scene from an OpenSim model: bodies as bones where the default pose puts them, joints as they are."""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from rbfmuscle.geometry.exact_distance import ExactDistance
from rbfmuscle.importers.opensim.geometry import body_meshes
from rbfmuscle.importers.opensim.model import OsimModel
from rbfmuscle.importers.opensim.read import read_osim
from rbfmuscle.importers.opensim.tubes import make_tube
from rbfmuscle.scene.scene import Scene
from rbfmuscle.validation import MeshError, SceneError


@dataclass
class Imported:
    """A scene made from a model.

    Attributes
    ----------
    scene, model : Scene, OsimModel
    places : dict of str to (4, 4) ndarray
        From every body of the model to the scene, rest pose [metre].
    notes : list of str
        What was not taken, or taken otherwise than one may expect.
    """

    scene: Scene
    model: OsimModel
    places: dict[str, np.ndarray]
    notes: list[str] = field(default_factory=list)


def import_osim(path: Path | str, *, geometry: list[Path] | None = None, muscles: bool = True) -> Imported:
    """Make a scene of an OpenSim model, in metres as the model is.

    Meshes stand where the model's default pose puts them, which is then the rest pose of the scene. A body without a
    mesh becomes a bone without one.

    Parameters
    ----------
    path : path
        An ``.osim`` file.
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
    scene, places = Scene(model.name, units="m"), model.transforms()
    meshes, notes = body_meshes(model, places, list(geometry or []))
    notes = [*model.notes, *notes]
    for body in model.bodies:
        if body in meshes:
            scene.add_bone(body, meshes[body])
            notes += [f"body {body!r}: {note}" for note in meshes[body].notes]
        else:
            scene.add_bone(body)
            scene.left_out += [body] if any(mesh.body == body for mesh in model.meshes) else []
    full = {}
    for joint, backward in model.tree():
        full |= {name: f"{joint.name}.{name}" for name in joint.coordinates}
        parent, child = (joint.child, joint.parent) if backward else (joint.parent, joint.child)
        placed = joint.moved(places[joint.parent] @ joint.parent_frame)
        scene.place_joint(replace(placed, parent=parent, child=child, backward=backward))
    for coupling in model.couplings:
        if all(name in full for name in (coupling.coordinate, *coupling.of)):
            of = tuple(full[name] for name in coupling.of)
            scene.place_coupling(replace(coupling, coordinate=full[coupling.coordinate], of=of))
    scene.superior, scene.anterior = [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]
    found = Imported(scene, model, places, notes)
    if muscles:
        _add_muscles(found)
    return found


def _add_muscles(found):
    """A tube for each muscle of the model."""
    scene = found.scene
    bones = {bone.name: ExactDistance(bone.mesh.vertices, bone.mesh.faces) for bone in scene.bones}
    for muscle in found.model.muscles:
        try:
            tube = make_tube(muscle, found.places, bones)
            attach: Any = [{"bone": body, "vertices": held.tolist()} for body, held in tube.held.items()]
            scene.add_muscle(muscle.name, (tube.vertices, tube.faces), attach=attach)
        except (SceneError, MeshError) as error:
            found.notes.append(f"muscle {muscle.name!r} is not taken: {error}")
