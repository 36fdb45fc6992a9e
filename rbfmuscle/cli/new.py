"""``rbfmuscle new`` and ``import``: a scene file to start from, of meshes, of a segmentation or of
an OpenSim model.
"""

from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from rbfmuscle.cli.options import USUAL, Force, Output, OwnFolder, Printing, print_result
from rbfmuscle.folders import OutputFolder
from rbfmuscle.progress import Progress
from rbfmuscle.validation import UsageError


def new(
    source: Path,
    *,
    units: Literal["mm", "cm", "m"] | None = None,
    labels: Path | None = None,
    output: OwnFolder = None,
    force: Force = False,
    printing: Printing = USUAL,
) -> int:
    """Write a commented scene file for a folder of meshes or a volume of labels.

    Parameters
    ----------
    source
        Folder with STL, OBJ, PLY, VTK or VTP files, one bone or muscle each (or in folders bones
        and muscles); or a segmentation: .nii, .nii.gz, .nrrd, .nhdr, or a folder with one file for
        each mask.
    units
        Unit of the meshes; by default chosen from the size of the bones. Label volumes are always
        in mm.
    labels
        Names of a segmentation's labels: JSON, CSV, TSV or ITK-SNAP's descriptions, or a known
        table, as totalsegmentator, musclemap-thigh.
    output
        Folder for scene.toml; the folder of the meshes by default.
    """
    from rbfmuscle.importers.guess.guess import SceneGuess, guess_scene, write_scene
    from rbfmuscle.importers.volumes import guess_volume, read_labels
    from rbfmuscle.scene.check import check_scene

    volume = _is_segmentation(source)
    if volume and units not in (None, "mm"):
        raise UsageError(
            f"{source}: a segmentation says its unit, its scene is in mm; leave --units out"
        )
    if labels is not None and not volume:
        raise UsageError(
            f"--labels names the labels of a segmentation, {source} is a folder of meshes"
        )
    if output is not None and output.suffix.lower() == ".toml":
        raise UsageError(f"--output {output}: give a folder, scene.toml is written to it")
    output = (output or (_beside(source) if volume else source)) / "scene.toml"
    if output.exists() and not force:
        raise UsageError(f"{output} exists; give another --output, or --force to replace it")
    out = OutputFolder(output.parent, "new", beside=True, replace=force, forced=[output.name])
    base = output.parent
    read = read_labels(source, names=labels) if volume else guess_scene(source, units, base)
    with out.staged(replaces=()) as stage:
        if isinstance(read, SceneGuess):
            guess = read
        else:
            with Progress("surfaces", "label") as progress:
                guess = guess_volume(read, stage, base, progress=progress)
        scene = write_scene(guess, output, stage)
    findings = check_scene(scene)
    facts = {
        "file": str(output),
        "doubts": guess.doubts(),
        "guesses": [one._asdict() for one in scene.guesses],
        "findings": [vars(finding) for finding in findings],
    }
    remedy = "how to correct guesses: docs/new.md; removing a key guess confirms it"
    lines = [
        f"{output} written; check what has the key guess",
        *(f"doubtful: {doubt}" for doubt in guess.doubts()),
        *map(str, findings),
        *([remedy] if scene.guesses else []),
        f"next: rbfmuscle check {output}, then rbfmuscle run {output} -o out",
    ]
    return print_result(printing, facts, lines)


def _is_segmentation(source):
    from rbfmuscle.importers.volumes import VOLUME_SUFFIXES, is_volume
    from rbfmuscle.scene.meshes.read import MESH_SUFFIXES

    if source.is_file() and not is_volume(source):
        raise UsageError(
            f"{source}: give a folder of meshes or of masks, or a label volume "
            f"({', '.join(VOLUME_SUFFIXES)}); 3D Slicer and ITK-SNAP write these"
        )
    if not source.is_dir():
        return is_volume(source)
    files = [path for path in source.iterdir() if path.is_file()]
    meshes = any(path.suffix.lower() in MESH_SUFFIXES for path in files)
    return not meshes and any(is_volume(path) for path in files)


def _beside(source):
    """Folder of the scene of a segmentation, where none is given."""
    name = source.name.split(".")[0] or "scene"
    return source / "scene" if source.is_dir() else source.parent / f"{name}_scene"


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
    lines = [
        *(f"note: {note}" for note in found.notes),
        *(f"doubtful: {doubt}" for doubt in scene.doubts),
        f"{written}: {len(scene.bones)} bones, {len(scene.meshless_bones)} without a mesh, "
        f"{len(scene.joints)} joints, {len(scene.couplings)} couplings, {len(scene.muscles)} "
        "muscles as tubes",
        f"next: rbfmuscle check {written}, then rbfmuscle run {written} -o out",
    ]
    return print_result(printing, facts, lines)
