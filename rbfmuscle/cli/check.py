"""``rbfmuscle check``: a scene file, and how long a run of it would take."""

import logging
import sys
from dataclasses import asdict
from time import perf_counter
from typing import TYPE_CHECKING

from rbfmuscle.cli.options import USUAL_WORK, Flag, SceneName, Work, print_result
from rbfmuscle.progress import Progress, stage
from rbfmuscle.validation import SceneError

if TYPE_CHECKING:
    from rbfmuscle.studies.accuracy import LatticeError


def check(
    scene: SceneName,
    *,
    picture: Flag = False,
    time: Flag = False,
    accuracy: Flag = False,
    work: Work = USUAL_WORK,
) -> int:
    """Check a scene file and its meshes; nothing is solved but what --time and --accuracy ask for.

    Parameters
    ----------
    picture
        Draw attachments, tendons and joint axes to a PNG beside the scene file.
    time
        Build the muscles, solve two frames after the first, and extrapolate to the whole motion;
        compiling is left out. Also list what was solved: unknowns, bones within reach, sub-steps.
    accuracy
        Run the motion on lattices with the nodes given and twice as many, and tell how far RBF
        muscles are apart.
    """
    facts: dict[str, object] = {}
    errors: list[LatticeError] = []
    path = scene.with_suffix(".png")
    with Progress(f"check {scene.name}"), work.threads():
        if picture:
            from rbfmuscle.display.pictures import check_picture, draw_scene

            check_picture(path)
        loaded, findings = _findings(scene)
        usable = bool(loaded.bones) and not any(f.level == "error" for f in findings)
        from rbfmuscle.simulation.neighbours import find_links

        names = [muscle.name for muscle in loaded.muscles]
        # Of the muscles that may touch in the motion.
        pairs = [[names[k] for k in pair] for pair in find_links(loaded, names)] if usable else []
        if time and usable:
            with stage("solving two frames"):
                facts["time"] = _measure_time(loaded)
        if accuracy and usable:
            from rbfmuscle.studies.accuracy import discretisation_error

            with stage("two lattices"):
                errors = discretisation_error(loaded)
            facts["accuracy"] = [asdict(error) for error in errors]
        if picture:
            with stage("drawing the picture"):
                draw_scene(loaded, path)
            facts["picture"] = str(path)
    from rbfmuscle.run.info import record_scene
    from rbfmuscle.scene.check import attachment_facts

    attached = attachment_facts(loaded)
    lines = [*_scene_lines(loaded, pairs, attached), *map(str, findings)]
    lines += _time_lines(facts["time"]) if "time" in facts else ()
    for error in errors:
        rms, greatest = (f"{value:.2g} {loaded.units}" for value in (error.rms, error.greatest))
        lines.append(
            f"muscle {error.muscle}: {error.nodes} nodes are {rms} RMS ({greatest} at most) "
            f"from twice as many, in frame {error.frame}"
        )
    lines += [str(path)] if picture else ()
    facts |= {
        "scene": record_scene(loaded),
        "findings": [vars(finding) for finding in findings],
        "neighbours": pairs,
        "attachments": [held._asdict() for held in attached],
    }
    print_result(work, facts, lines)
    if not work.as_json:
        last = f"usable; next: rbfmuscle run {scene} -o results" if usable else "not usable"
        print(last, file=sys.stderr)
    return 0 if usable else SceneError.exit_code


def _findings(path):
    from rbfmuscle.anatomy.bones import orient_scene
    from rbfmuscle.models import check_models
    from rbfmuscle.scene.check import Finding, check_scene, sort_findings
    from rbfmuscle.scene.phantom import open_scene
    from rbfmuscle.simulation.motion_check import motion_findings
    from rbfmuscle.simulation.substeps import check_substeps

    loaded = open_scene(path, skeleton=True)
    orient_scene(loaded)
    check_models(loaded)
    with stage("meshes of the bones"):
        findings = [*check_scene(loaded), *_field_notes(loaded)]
    try:
        check_substeps(loaded)
    except SceneError as error:
        findings.append(Finding("error", loaded.name, str(error)))
    if loaded.bones and not any(finding.level == "error" for finding in findings):
        with stage("checking the motion"):
            findings += motion_findings(loaded)
    return loaded, sort_findings(findings)


def _field_notes(scene):
    """Notes of the bones' distance fields: open meshes, meshes that intersect themselves."""
    from rbfmuscle.bones.sdf import BoneSDF
    from rbfmuscle.scene.check import Finding

    logger = logging.getLogger("rbfmuscle.bones.sdf")
    level = logger.level
    logger.setLevel(logging.ERROR)  # what it would say is said by the findings
    try:
        return [
            Finding("note", f"bone {bone.name!r}", note)
            for bone in scene.bones
            for note in BoneSDF.from_mesh(bone.mesh, name=bone.name).notes
        ]
    finally:
        logger.setLevel(level)


def _scene_lines(scene, pairs, attached):
    from rbfmuscle.scene.objects import body_axes, from_mm

    yield f"{scene.name}: {len(scene.motion)} frames, lengths in {scene.units}"
    body = body_axes(scene.superior, scene.anterior)
    up, front = (", ".join(f"{x:.3g}" for x in v + 0.0) for v in (body[2], -body[1]))
    unknown = " (assumed, as no femur or tibia shows them; set superior and anterior in [scene])"
    yield f"  superior is ({up}), anterior ({front}){unknown if scene.superior is None else ''}"
    for bone in scene.bones:
        yield (
            f"  bone {bone.name}: {len(bone.mesh.vertices)} vertices, {len(bone.mesh.faces)} "
            "triangles"
        )
    for joint in scene.joints:
        yield (
            f"  joint {joint.name}: {joint.parent} to {joint.child}, "
            f"{', '.join(joint.coordinates) or joint.kind}"
        )
    for muscle in scene.muscles:
        volume = muscle.mesh.volume / from_mm(10.0, scene.units) ** 3
        yield (
            f"  muscle {muscle.name}: model {muscle.model}, {len(muscle.mesh.vertices)} vertices, "
            f"{volume:.4g} cm3"
        )
        for held in (one for one in attached if one.muscle == muscle.name):
            yield (
                f"    {held.end}: {held.vertices} vertices {held.how} {held.bone}, "
                f"{held.area:.3g} cm2, {100 * held.share:.2g} % of the surface"
            )
        touching = [pair for pair in pairs if muscle.name in pair]
        others = [name for pair in touching for name in pair if name != muscle.name]
        if others:
            yield f"    can touch {', '.join(others)}"


def _measure_time(scene):
    """Wall time of a run without report, pictures and files [s], extrapolated from its first three
    frames once all is compiled, and what these frames solved.
    """
    from rbfmuscle.models import solved_points
    from rbfmuscle.recording import simulate

    simulate(scene, frames=slice(0, 2))  # compiles what the frames need
    start = perf_counter()
    frames = simulate(scene, frames=slice(0, 3)).frames
    spent, count = perf_counter() - start, len(scene.motion)
    frame = (
        spent / count if len(frames) < 2 else sum(f.wall for f in frames[1:]) / (len(frames) - 1)
    )
    build = max(0.0, spent - frame * (len(frames) - 1))
    muscles = [
        {
            "name": muscle.name,
            "points": solved_points(muscle, scene),
            "bones": frames[0].bones[muscle.name].names,
            "substeps": sum(frame.work[muscle.name].substeps for frame in frames),
        }
        for muscle in scene.muscles
    ]
    return {
        "build": build,
        "frame": frame,
        "total": build + frame * (count - 1),
        "frames": len(frames),
        "muscles": muscles,
    }


def _time_lines(spent):
    for muscle in spent["muscles"]:
        yield (
            f"muscle {muscle['name']}: {muscle['points']}; {spent['frames']} frames take "
            f"{muscle['substeps']} sub-steps, within reach of "
            f"{', '.join(muscle['bones']) or 'no bone'}"
        )
    yield (
        f"expected time: {spent['total']:.3g} s without report, pictures and files; build and "
        "first frame "
        f"{spent['build']:.2g} s, {1e3 * spent['frame']:.3g} ms per frame"
    )
