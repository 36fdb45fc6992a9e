"""``rbfmuscle check``: a scene file and its meshes, nothing solved."""

from __future__ import annotations

import json
import logging
import sys
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from rbfmuscle.cli.scenes import load_scene
from rbfmuscle.progress import Progress, stage
from rbfmuscle.validation import SceneError


def check(
    scene: Path,
    *,
    picture: Annotated[bool, Parameter(negative="")] = False,
    fields: Annotated[bool, Parameter(negative="")] = False,
    as_json: Annotated[bool, Parameter(name="--json", negative="")] = False,
) -> int:
    """Check a scene file and its meshes; nothing is solved.

    Parameters
    ----------
    scene
        Scene file (TOML), or "phantom" for the embedded hip.
    picture
        Draw patches, joint axes, far ends and overlaps to a PNG beside the scene file.
    fields
        Measure the bones' distance fields against exact distances.
    as_json
        Print JSON and nothing else.
    """
    with Progress(f"check {scene.name}"):
        loaded, findings = _findings(scene)
        errors_of = _measure_fields(loaded) if fields else {}
    drawn = _draw(loaded, scene) if picture else None
    errors = [finding for finding in findings if finding.level == "error"]
    if as_json:
        shown = [{"level": f.level, "place": f.place, "message": f.message} for f in findings]
        facts = {"scene": loaded.resolved(), "findings": shown}
        more = {"picture": drawn, "fields": errors_of}
        print(json.dumps({**facts, **{key: value for key, value in more.items() if value}}, indent=1))
    else:
        _print_scene(loaded)
        for name, found in errors_of.items():
            print(_describe_field(name, found, loaded.units))
        for finding in findings:
            print(finding)
        if drawn is not None:
            print(
                f"{drawn['file']}: {drawn['far_ends']} ends far from their bone, {drawn['overlaps']} overlaps"
            )
        print("not usable" if errors else "usable", file=sys.stderr)
    return SceneError.exit_code if errors else 0


def _draw(scene, path):
    """Draw a scene beside its file; return the file and what is marked."""
    from rbfmuscle.report.scene_picture import draw_scene

    file = path.with_suffix(".png")
    with Progress(f"picture of {path.name}"):
        return {"file": str(file), **draw_scene(scene, file)}


def _findings(path):
    from rbfmuscle.importers.guess.orientation import orient_scene
    from rbfmuscle.models import check_models
    from rbfmuscle.scene.attachments import ExactMeshes
    from rbfmuscle.scene.check import Finding, check_scene
    from rbfmuscle.simulation.plan.motion_check import motion_findings
    from rbfmuscle.simulation.substeps import check_substeps

    loaded = load_scene(path, skeleton=True)
    orient_scene(loaded)
    check_models(loaded)
    exact = ExactMeshes()
    with stage("fields of the bones"):
        findings = [*check_scene(loaded, exact), *_field_notes(loaded)]
    try:
        check_substeps(loaded)
    except SceneError as error:
        findings.append(Finding("error", loaded.name, str(error)))
    if not any(finding.level == "error" for finding in findings):
        with stage("checking the motion"):
            findings += motion_findings(loaded, exact)
    order = {"error": 0, "warning": 1, "note": 2}
    return loaded, sorted(findings, key=lambda finding: order[finding.level])


def _field_notes(scene):
    """Notes of the bones' distance fields: open meshes, meshes that intersect themselves."""
    from rbfmuscle.bones.sdf import BoneSDF
    from rbfmuscle.scene.check import Finding

    logger = logging.getLogger("rbfmuscle.bones.sdf")
    level, found = logger.level, []
    logger.setLevel(logging.ERROR)  # what it would say is said by the findings
    try:
        for bone in scene.bones:
            notes = BoneSDF.from_mesh(bone.mesh, name=bone.name).notes
            found += [Finding("note", f"bone {bone.name!r}", note) for note in notes]
    finally:
        logger.setLevel(level)
    return found


def _measure_fields(scene):
    """Errors of the distance field of each bone, by name."""
    from rbfmuscle.bones.errors import measure_field
    from rbfmuscle.bones.sdf import BoneSDF

    with stage("errors of the bones' fields"):
        return {b.name: measure_field(BoneSDF.from_mesh(b.mesh, name=b.name)) for b in scene.bones}


def _describe_field(name, found, units):
    return (
        f"  field of {name}: within {found['width']:.3g} {units} of the surface {found['error_rms']:.2g} {units} RMS, "
        f"{found['error_max']:.2g} at most; sign wrong for {100 * found['sign_wrong']:.4f} %; direction off by "
        f"{found['angle_median']:.2g} degrees in the median"
    )


def _print_scene(scene):
    print(f"{scene.name}: {len(scene.motion)} frames, lengths in {scene.units}")
    if scene.superior is not None:
        up, front = (", ".join(f"{x:.3g}" for x in v) for v in (scene.superior, scene.anterior))
        print(f"  superior is ({up}), anterior ({front})")
    for bone in scene.bones:
        print(f"  bone {bone.name}: {len(bone.mesh.vertices)} vertices, {len(bone.mesh.faces)} triangles")
    for joint in scene.joints:
        print(
            f"  joint {joint.name}: {joint.parent} to {joint.child}, {', '.join(joint.coordinates) or joint.kind}"
        )
    for muscle in scene.muscles:
        held = ", ".join(f"{len(a.vertices)} on {a.bone}" for a in muscle.attachments)
        volume = muscle.mesh.volume / scene.length(10.0) ** 3
        print(
            f"  muscle {muscle.name}: model {muscle.model}, {len(muscle.mesh.vertices)} vertices, "
            f"{volume:.4g} cm3, attached: {held}"
        )
