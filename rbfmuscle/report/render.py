"""Pictures and animations of saved runs."""

from __future__ import annotations

import base64
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

# Views where none are asked for; muscles that are named, more are named by their groups.
USUAL_VIEWS, _MOST_CHIPS = ("front", "right", "back"), 8
# Pixels of a panel, and of one of a preview; frames of a preview, and its length [s].
_AREA, _PREVIEW_AREA, _PREVIEW_FRAMES, _PREVIEW_SECONDS = 220_000, 110_000, 12, 4.0


def draw_preview(runs: Mapping[str, SavedRun], path: Path, *, area: float = _PREVIEW_AREA) -> str:
    """Draw a WebP animation of runs of one scene, by title, in the motion's plane; return it as an image's address.

    ``area`` is pixels of each run.
    """
    first = next(iter(runs.values()))
    frames = chosen_frames(first.frames, _PREVIEW_FRAMES)
    side = view_axes(motion_direction([first.poses[frame] for frame in frames], first.body), first.body)
    panels = [(title, run, side) for title, run in runs.items()]
    save_images(_draw_panels(panels, frames, area), path, _PREVIEW_SECONDS)
    return f"data:image/webp;base64,{base64.b64encode(path.read_bytes()).decode()}"


def render_run(
    directory: str | Path,
    output: str | Path,
    *,
    frame: int | None = None,
    views: Sequence[str] | None = None,
    area: int = _AREA,
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
        Of `VIEWS`, side by side; `USUAL_VIEWS` where not given.
    area : int
        Pixels of one view.
    seconds : float
        Length of an animation.

    Raises
    ------
    UsageError
        If the folder holds nothing to draw, or the suffix, frame or view is unknown.
    """
    saved, output = SavedRun(directory), Path(output)
    for view in views or ():
        if view not in VIEWS:
            raise UsageError(f"unknown view {view!r}; known: {', '.join(VIEWS)}")
    if output.suffix not in (".png", ".gif", ".webp"):
        raise UsageError(f"{output}: the suffix must be .png, .gif or .webp")
    if not saved.has_surfaces():
        raise UsageError(f"{directory} has no surfaces to draw")
    frame = saved.frames[-1] if frame is None else frame
    if frame not in saved.frames:
        raise UsageError(
            f"frame {frame} was not written; the run has {saved.frames[0]} to {saved.frames[-1]}"
        )
    panels = [(view, saved, view_axes(VIEWS[view], saved.body)) for view in views or USUAL_VIEWS]
    frames = [frame] if output.suffix == ".png" else saved.frames
    save_images(_draw_panels(panels, frames, area), output, seconds)


def _draw_panels(
    panels: Sequence[tuple[str, SavedRun, Floats]], frames: Sequence[int], area: float
) -> list[Image]:
    """A picture of each frame: panels (title, run, axes) of so many pixels, with captions and colours below."""
    _, first, axes = panels[0]
    some = {first.frames[0], first.frames[len(first.frames) // 2], first.frames[-1]}
    names = [(run, name) for _, run, _ in panels for name in (*run.muscles, *run.tendons)]
    seen = np.concatenate([run.surface(name, k)[0][::3] for run, name in names for k in some])
    size = fitted_size(axes, seen, area)
    cameras = [(run, aim(axes, seen, size)) for _, run, axes in panels]
    titles, chips = [title for title, *_ in panels], first.colours
    if len(chips) > _MOST_CHIPS:
        chips = {first.groups[name]: chips[name] for name in reversed(first.muscles)}

    def draw(frame: int) -> Image:
        image = np.concatenate([_draw_frame(run, camera, frame) for run, camera in cameras], axis=1)
        return labelled(image, first.caption(frame), titles, chips)

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
