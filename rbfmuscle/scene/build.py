"""The motion of a scene, and whether it can be run."""

from __future__ import annotations

from rbfmuscle.scene.activation.contraction import check_activation, make_contraction
from rbfmuscle.scene.contents import SceneContents
from rbfmuscle.scene.frames import make_motion
from rbfmuscle.scene.joints.joint import all_coordinates
from rbfmuscle.scene.objects import Motion, check_file_names
from rbfmuscle.scene.options import MotionOptions
from rbfmuscle.validation import SceneError, did_you_mean


def made_motion(scene: SceneContents, options: MotionOptions) -> Motion:
    """The motion that ``[motion]`` asks of a scene."""
    return make_motion(options, scene.joints, scene.couplings, metre=scene.length(1000.0))


def check_runnable(scene: SceneContents) -> None:
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
            make_contraction(muscle)
            check_activation(muscle, scene.motion)
