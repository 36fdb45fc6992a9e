"""``rbfmuscle export`` and ``render``: a run in other formats, and as pictures."""

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from rbfmuscle.cli.options import (
    USUAL,
    Muscles,
    OwnFolder,
    Printing,
    RunFolder,
    print_result,
    split_list,
)
from rbfmuscle.progress import Progress, stage
from rbfmuscle.validation import (
    MissingDependencyError,
)


def export(
    directory: RunFolder,
    *,
    formats: Annotated[str, Parameter(name="--format")],
    output: OwnFolder = None,
    units: str | None = None,
    muscles: Muscles = None,
    frames: str | None = None,
    fps: float | None = None,
    printing: Printing = USUAL,
) -> int:
    """Write the surfaces of a run in other formats and units.

    Parameters
    ----------
    formats
        Formats, separated by commas. pvd, vtp, ply, stl, obj or glb: files for each frame;
        animated-glb (Blender) or usd: all frames in one animated file.
    output
        Folder to write to, DIR/export by default.
    units
        m, cm or mm; the scene's by default (glb, animated-glb: m).
    muscles
        Muscles of the run, separated by commas; all by default. Bones are always written.
    frames
        Some of the written frames, FIRST:END:STEP as a Python slice.
    fps
        Frames per second of animated-glb and usd; by default the times of the motion's file, or 24.
    """
    with Progress(f"export {directory}"):
        from rbfmuscle.display.export import export_run
        from rbfmuscle.scene.frames import parse_slice

        chosen = parse_slice(frames) if frames is not None else None
        names, failed = split_list(formats), None
        try:
            written = export_run(
                directory,
                names,
                output=output,
                units=units,
                muscles=None if muscles is None else split_list(muscles),
                frames=chosen,
                fps=fps,
            )
        except MissingDependencyError as error:
            written, failed = error.written, error
            if not written:
                raise
    folders = sorted({str(path.parent) for path in written})
    several = f"{len(written)} files in {', '.join(folders)}"
    facts = {"files": [str(path) for path in written]}
    lines = [several if len(written) > 1 else str(written[0])]
    return print_result(printing, facts, lines, error=failed)


def render(
    directory: RunFolder,
    *,
    output: Annotated[Path, Parameter(name=["--output", "-o"])],
    frame: int | None = None,
    view: str | None = None,
    seconds: float | None = None,
    printing: Printing = USUAL,
) -> int:
    """Draw a run: a picture (.png) or an animation (.gif, .webp).

    Parameters
    ----------
    output
        File to draw.
    frame
        Frame of a picture; -1, the last one, by default.
    view
        Views, separated by commas: front, back, left, right, top, bottom or motion (in its plane);
        front, right and back by default.
    seconds
        Length of an animation; 5 by default.
    """
    with Progress(f"render {directory}"):
        from rbfmuscle.display.pictures import render_run

        views = split_list(view) or None
        with stage("drawing pictures"):
            render_run(directory, output, frame=frame, views=views, seconds=seconds)
    return print_result(printing, {"file": str(output)}, [str(output)])
