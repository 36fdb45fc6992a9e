"""``rbfmuscle render``: pictures and animations of a run."""

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from rbfmuscle.cli.options import (
    USUAL,
    Printing,
    RunFolder,
    print_result,
    split_list,
)
from rbfmuscle.progress import Progress, stage


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
