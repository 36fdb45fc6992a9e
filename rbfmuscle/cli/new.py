"""``rbfmuscle new``: a scene file to start from, of meshes or of a segmentation."""

from pathlib import Path
from typing import Literal

from rbfmuscle.cli.options import USUAL, Force, OwnFolder, Printing, print_result
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
    from rbfmuscle.importers.scenes import guess_volume
    from rbfmuscle.importers.volumes import read_labels
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
    return print_result(printing, facts, _new_lines(output, facts["doubts"], findings, scene))


def _new_lines(output, doubts, findings, scene):
    yield f"{output} written; check what has the key guess"
    yield from (f"doubtful: {doubt}" for doubt in doubts)
    yield from map(str, findings)
    if scene.guesses:
        yield "how to correct guesses: docs/new.md; removing a key guess confirms it"
    yield f"next: rbfmuscle check {output}, then rbfmuscle run {output} -o out"


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
