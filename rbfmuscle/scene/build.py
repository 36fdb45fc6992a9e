"""A scene from the checked tables of its file."""

from __future__ import annotations

from typing import TYPE_CHECKING

from rbfmuscle.scene.activation.contraction import check_activation, resolve_contraction
from rbfmuscle.scene.extents import check_centre, check_place, check_size
from rbfmuscle.scene.file import SceneFile, given_muscle
from rbfmuscle.scene.frames import make_motion
from rbfmuscle.scene.joints.joint import all_coordinates
from rbfmuscle.scene.joints.tables import make_coupling
from rbfmuscle.scene.meshes.read import read_mesh
from rbfmuscle.scene.meshes.transform import MeshTransform
from rbfmuscle.scene.objects import Motion, check_file_names
from rbfmuscle.scene.options import MotionOptions
from rbfmuscle.validation import SceneError, did_you_mean

if TYPE_CHECKING:
    from rbfmuscle.scene.scene import Scene


def made_motion(scene: Scene, options: MotionOptions) -> Motion:
    """The motion that ``[motion]`` asks of a scene."""
    return make_motion(options, scene.joints, scene.couplings, metre=scene.length(1000.0))


def fill_scene(scene: Scene, tables: SceneFile) -> None:
    """Give a new scene what a file holds, in place."""
    about = tables.scene
    scene.missing_bones = about.missing_bones
    scene.doubts = about.doubts
    scene.notes = about.notes
    scene.superior = about.superior
    scene.anterior = about.anterior
    for bone in tables.bone:
        scene.add_bone(**{key: getattr(bone, key) for key in bone.model_fields_set})
        if bone.mesh is not None:
            check_size("bone", bone.name, scene.bones[-1], scene.units)
    for joint in tables.joint:
        scene.add_joint(joint.joint())
        check_centre(joint.name, scene.joints[-1].centre, scene.bones, scene.units)
    for coupling in tables.coupling:
        scene.add_coupling(make_coupling(coupling, scene.joints))
    for muscle in tables.muscle:
        given = given_muscle(muscle, tables.classes)
        lies = MeshTransform(**{k: given[k] for k in MeshTransform.model_fields if k in given})
        read = read_mesh(muscle.mesh, name=muscle.name, transform=lies)
        check_size("muscle", muscle.name, read, scene.units)
        check_place(muscle.name, read, scene.bones, scene.units)
        scene.add_muscle(**given | {"mesh": read})
    scene.motion = made_motion(scene, tables.motion)
    scene.contact = tables.contact
    scene.sliding = tables.sliding
    scene.detect = tables.detect
    scene.output = tables.output


def check_runnable(scene: Scene) -> None:
    """Raise SceneError if a scene cannot be simulated: no bones, no muscles, loose muscles."""
    for what in ("bones", "muscles"):
        if not getattr(scene, what):
            raise SceneError(f"scene {scene.name!r} has no {what}, add a [[{what[:-1]}]]")
    check_file_names(scene.bones, scene.muscles)
    known = all_coordinates(scene.joints)
    for name in (name for frame in scene.motion.frames for name in frame):
        if name not in known:
            hint = did_you_mean(name, sorted(known))
            raise SceneError(f"[motion]: unknown coordinate {name!r}, {hint}")
    for muscle in scene.muscles:
        place = f"muscle {muscle.name!r}"
        bones = sorted({a.bone for a in muscle.attachments})
        if not bones:
            raise SceneError(f"{place} has no attachment, give attach a place on two bones")
        if len(bones) == 1:
            words = f"is attached to {bones[0]!r} only, give attach a second bone"
            raise SceneError(f"{place} {words}")
        if muscle.contraction is not None:
            resolve_contraction(muscle)
            check_activation(muscle, scene.motion)
