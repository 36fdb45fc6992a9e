"""``rbfmuscle new``: a commented scene file to start from, guessed from a folder of meshes."""

from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from rbfmuscle.validation import UsageError


def new(
    mesh_dir: Path,
    *,
    units: Literal["mm", "cm", "m"],
    output: Annotated[Path | None, Parameter(name=["--output", "-o"])] = None,
    force: Annotated[bool, Parameter(negative="")] = False,
):
    """Write a commented scene file for a folder of meshes.

    Parameters
    ----------
    mesh_dir
        Folder with STL, OBJ, PLY, VTK or VTP files, one bone or muscle each.
    units
        Unit of the meshes.
    output
        Scene file to write, MESH_DIR/scene.toml by default.
    force
        Replace a file that exists.
    """
    from rbfmuscle.sim.guess.guess import guess_scene, write_scene

    output = output or mesh_dir / "scene.toml"
    if output.exists() and not force:
        raise UsageError(f"{output} exists; give another --output, or --force to replace it")
    guess = guess_scene(mesh_dir, units, output.parent)
    scene = write_scene(guess, output)
    print(f"{output} written; every guess in it is marked, look them over")
    for doubt in guess.doubts():
        print(f"doubtful: {doubt}")
    for finding in scene.check():
        print(finding)
    print(f"next: rbfmuscle check {output}, then rbfmuscle run {output} -o out")
