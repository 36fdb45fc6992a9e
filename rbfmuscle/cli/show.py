"""``rbfmuscle export`` and ``rbfmuscle render``: other formats and pictures of a run."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from rbfmuscle.progress import Progress, stage


def export(
    directory: Path,
    *,
    formats: Annotated[list[str], Parameter(name="--format", negative="", consume_multiple=True)],
    output: Annotated[Path | None, Parameter(name=["--output", "-o"])] = None,
    units: str | None = None,
    frames: str | None = None,
) -> None:
    """Write the surfaces of a run in other formats and units.

    Parameters
    ----------
    directory
        Folder of the run.
    formats
        pvd, vtp, ply, stl, obj or glb: files for each frame; usd or animated-glb: all frames as an animation.
        Several may be given.
    output
        Folder to write to, DIR/export by default.
    units
        m, cm or mm; the scene's by default (glb, animated-glb: m).
    frames
        Of the written frames, as A:B:S.
    """
    with Progress(f"export {directory}"):
        from rbfmuscle.output.export import export_run
        from rbfmuscle.scene.settings import parse_slice

        chosen = parse_slice(frames) if frames is not None else None
        written = export_run(directory, formats, output=output, units=units, frames=chosen)
    folders = sorted({str(path.parent) for path in written})
    print(f"{len(written)} files in {', '.join(folders)}" if len(written) > 1 else written[0])


def render(
    directory: Path,
    *,
    output: Annotated[Path, Parameter(name=["--output", "-o"])],
    frame: int | None = None,
    view: Annotated[list[str] | None, Parameter(negative="")] = None,
    seconds: float = 5.0,
) -> None:
    """Draw a run: a picture (.png) or an animation (.gif, .webp).

    Parameters
    ----------
    directory
        Folder of the run.
    output
        File to draw.
    frame
        Of a picture; the last one by default.
    view
        front, back, left, right, top, bottom or motion (in its plane); may be repeated; front, right and back
        by default.
    seconds
        Length of an animation.
    """
    with Progress(f"render {directory}"):
        from rbfmuscle.report.render import render_run

        with stage("drawing pictures"):
            render_run(directory, output, frame=frame, views=view, seconds=seconds)
    print(output)
