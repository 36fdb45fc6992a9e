"""``rbfmuscle import``: a scene of an OpenSim model."""

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from rbfmuscle.cli.options import USUAL, Force, Output, Printing, print_result
from rbfmuscle.validation import UsageError


def import_(
    model: Path,
    *,
    output: Output,
    geometry: Annotated[list[Path] | None, Parameter(negative="")] = None,
    muscles: Annotated[bool, Parameter(negative="--no-muscles")] = True,
    force: Force = False,
    printing: Printing = USUAL,
) -> int:
    """Write a scene file and its meshes from an OpenSim model (.osim), in metres.

    Parameters
    ----------
    model
        The model, of version 2 to 4; OpenSim itself is not needed.
    geometry
        Folder with meshes, besides the model's own and its Geometry; repeatable.
    muscles
        Make a tube of each muscle of the model, along its path.
    """
    from rbfmuscle.importers.opensim.scene import import_osim, scene_folder, write_imported
    from rbfmuscle.run.info import record_scene

    scene_folder(output, force=force)
    for folder in geometry or []:
        if not folder.is_dir():
            raise UsageError(f"--geometry {folder}: no such folder")
    found = import_osim(model, geometry=geometry, muscles=muscles)
    written = write_imported(found, output, force=force)
    scene = found.scene
    facts = {"file": str(written), "notes": found.notes, "scene": record_scene(scene)}
    return print_result(printing, facts, _import_lines(written, found.notes, scene))


def _import_lines(written, notes, scene):
    yield from (f"note: {note}" for note in notes)
    yield from (f"doubtful: {doubt}" for doubt in scene.doubts)
    yield (
        f"{written}: {len(scene.bones)} bones, {len(scene.meshless_bones)} without a mesh, "
        f"{len(scene.joints)} joints, {len(scene.couplings)} couplings, {len(scene.muscles)} "
        "muscles as tubes"
    )
    yield f"next: rbfmuscle check {written}, then rbfmuscle run {written} -o out"
