"""``rbfmuscle import``: a scene from an OpenSim model."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from rbfmuscle.cli.options import Flag, Output
from rbfmuscle.validation import UsageError


def import_(
    model: Path,
    *,
    output: Output,
    geometry: Annotated[list[Path] | None, Parameter(negative="")] = None,
    muscles: Annotated[bool, Parameter(negative="--no-muscles")] = True,
    force: Flag = False,
) -> None:
    """Write a scene file and its meshes from an OpenSim model (.osim), in metres.

    Parameters
    ----------
    model
        The model, of version 2 to 4; OpenSim itself is not needed.
    geometry
        Folder with meshes, besides the model's own and its Geometry; repeatable.
    muscles
        Make a tube of each muscle of the model, along its path.
    force
        Replace a scene file that exists.
    """
    from rbfmuscle.importers.opensim.scene import import_osim
    from rbfmuscle.importers.opensim.write import write_scene

    target = output / "scene.toml"
    if target.exists() and not force:
        raise UsageError(f"{target} exists; give another --output, or --force to replace it")
    for folder in geometry or []:
        if not folder.is_dir():
            raise UsageError(f"--geometry {folder}: no such folder")
    found = import_osim(model, geometry=geometry, muscles=muscles)
    written = write_scene(found, output)
    for note in found.notes:
        print(f"note: {note}")
    scene = found.scene
    counts = f"{len(scene.bones)} bones, {len(scene.links)} without a mesh, {len(scene.joints)} joints"
    print(f"{written}: {counts}, {len(scene.couplings)} couplings, {len(scene.muscles)} muscles as tubes")
    print(f"next: rbfmuscle check {written}, then rbfmuscle run {written} -o out")
