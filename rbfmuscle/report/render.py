"""Pictures and animations of a saved run, drawn in a process of their own.

VTK may end the process where no graphics exist. So everything is saved first, then this module is run as
``python -m rbfmuscle.report.render DIR`` with the job on its standard input.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

from rbfmuscle.output.saved import SavedRun
from rbfmuscle.report.appearance import (
    BACKGROUND,
    MUSCLE_COLOURS,
    USUAL_VIEWS,
    VIEWS,
    fitted_size,
)
from rbfmuscle.report.labels import caption, labelled
from rbfmuscle.report.paint import check_colouring, painting
from rbfmuscle.report.stage import Stage, path_bounds
from rbfmuscle.validation import MissingPartError, RBFMuscleError, UsageError

ANIMATIONS = (".webp", ".gif")
_TIMEOUT = 1800
# Code of a child that could draw and could not save.
_REFUSED = 3


def render_run(
    directory: str | Path,
    output: str | Path,
    *,
    frame: int | None = None,
    views: list[str] | None = None,
    size: tuple[int, int] = (420, 520),
    seconds: float = 5.0,
    colour: str = "muscle",
) -> None:
    """Draw a saved run to a picture or an animation.

    Parameters
    ----------
    directory : path
        Folder of the run.
    output : path
        ``.png`` for one frame, ``.gif`` or ``.webp`` for all.
    frame : int, optional
        Of a picture; the last one where not given.
    views : list of str, optional
        Of `VIEWS`, side by side; `USUAL_VIEWS` where not given.
    size : (width, height)
        Of one view [pixel].
    seconds : float
        Length of an animation.
    colour : {"muscle", "activation"}
        What muscles are coloured by.

    Raises
    ------
    UsageError
        If the folder holds nothing to draw, or the suffix, frame or view is unknown.
    MissingPartError
        If there are no graphics to draw with.
    """
    saved, output = SavedRun(directory), Path(output)
    views = list(views or USUAL_VIEWS)
    for view in views:
        if view not in VIEWS:
            raise UsageError(f"unknown view {view!r}; known: {', '.join(VIEWS)}")
    if output.suffix not in (".png", *ANIMATIONS):
        raise UsageError(f"{output}: the suffix must be .png, .gif or .webp")
    if not saved.has_surfaces():
        raise UsageError(f"{directory} has no surfaces to draw")
    check_colouring(saved, colour)
    frame = saved.frames[-1] if frame is None else frame
    if frame not in saved.frames:
        raise UsageError(
            f"frame {frame} was not written; the run has {saved.frames[0]} to {saved.frames[-1]}"
        )
    frames = [frame] if output.suffix == ".png" else saved.frames
    job = {"file": str(output.resolve()), "frames": frames, "views": views, "size": size, "colour": colour}
    draw(directory, [job], seconds)


def draw(
    directory: str | Path,
    jobs: list[Any],
    seconds: float = 5.0,
    *,
    module: str = "rbfmuscle.report.render",
) -> None:
    """Draw pictures in a child process.

    Parameters
    ----------
    directory : path
    jobs : list of dict
        ``file``, ``frames``, ``views``, ``size``; several frames make an animation.
    seconds : float
        Length of an animation.
    module : str
        What draws them, run with ``-m``.

    Raises
    ------
    MissingPartError
        If the child cannot draw; the message holds its last words.
    """
    command = [sys.executable, "-m", module, str(directory)]
    text = json.dumps({"jobs": jobs, "seconds": seconds})
    try:
        done = subprocess.run(
            command, input=text, capture_output=True, text=True, timeout=_TIMEOUT, check=False
        )
    except subprocess.TimeoutExpired:
        raise MissingPartError(f"drawing took longer than {_TIMEOUT} s and was stopped") from None
    if done.returncode != 0:
        words = [line.strip() for line in done.stderr.splitlines() if line.strip()]
        reason = words[-1][-160:] if words else f"the drawing process ended with code {done.returncode}"
        # What Python itself refuses is no want of graphics.
        blame = (
            ""
            if done.returncode == _REFUSED
            else "; drawing needs OpenGL (a display, or Mesa's libegl1 and libgl1)"
        )
        raise MissingPartError(f"no pictures: {reason}{blame}")


def draw_pictures(directory: str | Path, make_jobs: Callable[..., Any], **how: Any) -> tuple[Any, ...]:
    """Draw pictures to memory.

    Parameters
    ----------
    directory : path
    make_jobs : callable
        ``make_jobs(folder)`` gives the jobs, whose PNG files go to that folder.
    **how
        As for `draw`.

    Returns
    -------
    images : dict of str to bytes
        The PNG files by their stems.
    missing : MissingPartError or None
        Why not all are drawn.
    """
    missing = None
    with tempfile.TemporaryDirectory() as folder:
        jobs = make_jobs(Path(folder))
        if jobs:
            try:
                draw(directory, jobs, **how)
            except MissingPartError as error:
                missing = error
        return {path.stem: path.read_bytes() for path in sorted(Path(folder).glob("*.png"))}, missing


def chosen_frames(frames: list[int], most: int = 24) -> list[int]:
    """At most so many of the frames of a motion for an animation, evenly, the last one included."""
    stride = -(-len(frames) // most)
    return frames[(len(frames) - 1) % stride :: stride]


def _draw_job(saved, job, seconds, stages):
    views, size, colour = tuple(job["views"]), tuple(job["size"]), job.get("colour", "muscle")
    paint, chips = painting(saved, colour, job["frames"])
    if job.get("fit"):
        size = fitted_size(path_bounds([saved]), views, size)
    if (views, *size, colour) not in stages:
        stages[views, *size, colour] = Stage([[(saved, view) for view in views]], size, paint)
    stage = stages[views, *size, colour]
    titles = [f"{view} ({VIEWS[view][1]})" for view in job["views"]]
    if paint is None:
        # A legend of dozens says nothing that the table does not say better.
        chips = stage.colours if len(saved.muscles) <= len(MUSCLE_COLOURS) else {}
    images = [labelled(stage.show(frame), caption(saved, frame), titles, chips) for frame in job["frames"]]
    save_images(images, job["file"], seconds)


def save_images(images: list[Any], path: str, seconds: float) -> None:
    """Save one picture, or several as an animation of so many seconds; all on sheets of one size."""
    from PIL import Image

    width, height = (max(image.size[k] for image in images) for k in range(2))
    for k, image in enumerate(images):
        if image.size != (width, height):
            sheet = Image.new("RGB", (width, height), BACKGROUND)
            sheet.paste(image, (0, 0))
            images[k] = sheet
    if len(images) == 1:
        images[0].save(path)
        return
    pause = max(20, int(1000 * seconds / len(images)))
    pauses = [pause] * (len(images) - 1) + [900]
    kinds: dict[str, dict[str, Any]] = {".webp": {"quality": 82, "method": 2}, ".gif": {"optimize": False}}
    kind = kinds[Path(path).suffix]
    if path.endswith(".gif"):
        images = [image.quantize(128, dither=Image.Dither.NONE) for image in images]
    images[0].save(path, save_all=True, append_images=images[1:], duration=pauses, loop=0, **kind)


def main(arguments: Any, opened: Any = SavedRun, draw_job: Any = _draw_job) -> Any:
    """The child's part: read the jobs, open the folder, draw, leave with 0.

    ``draw_job(found, job, seconds, stages)`` keeps in ``stages`` what later jobs can use again.
    """
    task, stages = json.loads(sys.stdin.read()), {}
    try:
        found = opened(arguments[0])
        for job in task["jobs"]:
            draw_job(found, job, task["seconds"], stages)
        for stage in stages.values():
            stage.close()
    except (RBFMuscleError, OSError, ValueError) as error:
        print(error, file=sys.stderr)
        return _REFUSED
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
