"""Pictures and animations of saved runs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.geometry.threads import each
from rbfmuscle.output.appearance import BONE_COLOUR, TENDON_COLOUR, VIEWS, motion_direction, view_axes
from rbfmuscle.output.saved import SavedRun
from rbfmuscle.report.raster import Camera, Solid, aim, draw_solids, fitted_size, labelled
from rbfmuscle.validation import SolveError, UsageError

if TYPE_CHECKING:
    from PIL.Image import Image

# Views where none are asked for; muscles that are named, more are named by their groups; pixels of a view.
USUAL_VIEWS, _MOST_CHIPS, _AREA = ("front", "right", "back"), 8, 220_000


def render_run(
    directory: str | Path,
    output: str | Path,
    *,
    frame: int | None = None,
    views: Sequence[str] | None = None,
    area: int = _AREA,
    most: int | None = None,
    seconds: float = 5.0,
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
        Of `VIEWS`, or "motion" for its plane, side by side; `USUAL_VIEWS` where not given.
    area : int
        Pixels of one view.
    most : int, optional
        Frames of an animation, chosen evenly; all where not given.
    seconds : float
        Length of an animation.

    Raises
    ------
    UsageError
        If the folder holds nothing to draw, or the suffix, frame or view is unknown.
    """
    saved, output = SavedRun(directory), Path(output)
    if output.suffix not in (".png", ".gif", ".webp"):
        raise UsageError(f"{output}: the suffix must be .png, .gif or .webp")
    if not saved.has_surfaces():
        raise UsageError(f"{directory} has no surfaces to draw")
    frame = saved.frames[-1] if frame is None else frame
    if frame not in saved.frames:
        raise UsageError(
            f"frame {frame} was not written; the run has {saved.frames[0]} to {saved.frames[-1]}"
        )
    poses = [saved.poses[k] for k in saved.frames]
    directions: dict[str, Sequence[float] | Floats] = {**VIEWS, "motion": motion_direction(poses, saved.body)}
    for view in views or ():
        if view not in directions:
            raise UsageError(f"unknown view {view!r}; known: {', '.join(directions)}")
    axes = {view: view_axes(directions[view], saved.body) for view in views or USUAL_VIEWS}
    frames = [frame] if output.suffix == ".png" else chosen_frames(saved.frames, most or len(saved.frames))
    save_images(_draw_views(saved, axes, frames, area), output, seconds)


def _draw_views(run: SavedRun, axes: Mapping[str, Floats], frames: Sequence[int], area: float) -> list[Image]:
    """A picture of each frame: views of so many pixels side by side, with titles, caption and colours."""
    some = {run.frames[0], run.frames[len(run.frames) // 2], run.frames[-1]}
    names = [*run.muscles, *run.tendons]
    seen = np.concatenate([run.surface(name, k)[0][::3] for name in names for k in some])
    size = fitted_size(next(iter(axes.values())), seen, area)
    cameras, chips = [aim(view, seen, size) for view in axes.values()], run.colours
    if len(chips) > _MOST_CHIPS:
        chips = {run.groups[name]: chips[name] for name in reversed(run.muscles)}

    def draw(frame: int) -> Image:
        image = np.concatenate([_draw_frame(run, camera, frame) for camera in cameras], axis=1)
        return labelled(image, run.caption(frame), list(axes), chips)

    return each(draw, frames)


def _draw_frame(run: SavedRun, camera: Camera, frame: int) -> Integers:
    """Picture (h, w, 3) of a frame of a run."""
    colours = run.colours | dict.fromkeys(run.tendons, TENDON_COLOUR)
    solids = [Solid(*run.surface(name, frame), colour) for name, colour in colours.items()]
    for name, pose in run.poses[frame].items():
        vertices, faces = run.bone(name)
        solids.append(Solid(vertices @ pose[:3, :3].T + pose[:3, 3], faces, BONE_COLOUR))
    return draw_solids(solids, camera)


def chosen_frames(frames: Sequence[int], most: int) -> list[int]:
    """At most so many of the frames of a motion, evenly, the last one included."""
    stride = -(-len(frames) // most)
    return list(frames[(len(frames) - 1) % stride :: stride])


def save_images(images: Sequence[Image], path: Path, seconds: float) -> None:
    """Save one picture, or several of one width as an animation of so many seconds; raises SolveError if it fails."""
    from PIL import ImageOps

    size = images[0].width, max(image.height for image in images)
    sheets = [ImageOps.pad(image, size, color="white", centering=(0, 0)) for image in images]
    kind: dict[str, Any] = {"quality": 82, "method": 2} if path.suffix == ".webp" else {}
    if len(sheets) > 1:
        pauses = [max(20, int(1000 * seconds / len(sheets)))] * (len(sheets) - 1) + [900]
        kind |= {"save_all": True, "append_images": sheets[1:], "duration": pauses, "loop": 0}
    try:
        sheets[0].save(path, **kind)
    except OSError as error:
        raise SolveError(f"cannot write {path}: {error.strerror}") from None
