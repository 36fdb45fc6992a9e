"""Pictures and animations of saved runs."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.geometry.threads import each
from rbfmuscle.output.appearance import (
    BACKGROUND,
    BONE_COLOUR,
    MUSCLE_COLOURS,
    TENDON_COLOUR,
    USUAL_VIEWS,
    VIEWS,
    motion_direction,
    muscle_colours,
    muscle_groups,
    rgb,
    view_axes,
)
from rbfmuscle.output.saved import SavedRun
from rbfmuscle.report.page import embedded_image
from rbfmuscle.report.raster import Solid, aim, draw_layer, draw_solids, fitted_size, labelled
from rbfmuscle.validation import SolveError, UsageError

if TYPE_CHECKING:
    from PIL.Image import Image

ANIMATIONS = (".webp", ".gif")
Meshes = Mapping[str, tuple[Floats, Integers]]
# Pixels of a figure in a notebook, and from where it is seen.
_FIGURE, _DIRECTION = (300, 340), (1.4, -1.6, 0.5)
# Pixels of a panel, and of one of a preview; frames of a preview, and how many a second.
_AREA, _PREVIEW_AREA, _PREVIEW_FRAMES, _PREVIEW_SECONDS = 220_000, 110_000, 12, 4.0


class Panel:
    """A run seen from one direction, as large in all frames.

    Parameters
    ----------
    saved : SavedRun
    axes : (3, 3) ndarray
        Right, up and towards the camera.
    size : (width, height)
        Pixels.
    seen : (n, 3) ndarray
        What is to be seen.
    """

    def __init__(self, saved: SavedRun, axes: Floats, size: tuple[int, int], seen: Floats) -> None:
        self.saved = saved
        self.colours = muscle_colours(saved.muscles, muscle_groups(saved.info))
        self.camera = aim(axes, seen, size)
        bones, first = {name: saved.bone(name) for name in saved.bones}, saved.poses[saved.frames[0]]
        moving = {
            name
            for name in bones
            if any(not np.array_equal(saved.poses[k][name], first[name]) for k in saved.frames)
        }
        self.moving = {name: bones[name] for name in moving}
        still = [_posed(*bones[name], first[name]) for name in bones if name not in moving]
        self._behind = draw_layer(still, self.camera, rgb(BACKGROUND))

    def draw(self, frame: int) -> Integers:
        """Picture (h, w, 3) of a frame."""
        solids = [_posed(*mesh, self.saved.poses[frame][name]) for name, mesh in self.moving.items()]
        for name, colour in self.colours.items():
            solids.append(Solid(*self.saved.surface(name, frame), rgb(colour)))
        tendons = (self.saved.surface(name, frame) for name in self.saved.tendons)
        solids += [Solid(vertices, faces, rgb(TENDON_COLOUR)) for vertices, faces in tendons]
        return draw_solids(solids, self.camera, rgb(BACKGROUND), behind=self._behind)


def _posed(vertices: Floats, faces: Integers, pose: Floats) -> Solid:
    return Solid(vertices @ pose[:3, :3].T + pose[:3, 3], faces, rgb(BONE_COLOUR))


def muscle_points(runs: Sequence[SavedRun], frames: Sequence[int]) -> Floats:
    """Points (n, 3) of all muscles and tendons in the first, middle and last of some frames."""
    some = sorted({frames[0], frames[len(frames) // 2], frames[-1]})
    names = [(run, name) for run in runs for name in (*run.muscles, *run.tendons)]
    return np.concatenate([run.surface(name, k)[0][::3] for run, name in names for k in some])


def draw_panels(
    panels: Sequence[Panel], frames: Sequence[int], titles: Sequence[str], chips: Mapping[str, str]
) -> list[Image]:
    """Panels beside each other, a picture for each frame, with titles above and caption and colours below."""
    images = each(lambda frame: np.concatenate([panel.draw(frame) for panel in panels], axis=1), frames)
    saved = panels[0].saved
    return [labelled(image, saved.caption(k), titles, chips) for image, k in zip(images, frames)]


def draw_preview(runs: Mapping[str, SavedRun], path: Path, *, area: float = _PREVIEW_AREA) -> None:
    """Write the whole motion of runs beside each other, seen in its plane; one run is seen from the front as well."""
    first = next(iter(runs.values()))
    frames = chosen_frames(first.frames, _PREVIEW_FRAMES)
    seen = muscle_points(list(runs.values()), frames)
    side = view_axes(motion_direction([first.poses[frame] for frame in frames], first.body), first.body)
    size = fitted_size(side, seen, area)
    panels, titles = [Panel(run, side, size, seen) for run in runs.values()], list(runs)
    if len(runs) == 1:
        panels.append(Panel(first, view_axes(VIEWS["front"], first.body), size, seen))
        titles = ["plane of the motion", "front"]
    chips = _chips(first) if len(runs) == 1 else {}
    save_images(draw_panels(panels, frames, titles, chips), path, _PREVIEW_SECONDS)


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
    views = list(views or USUAL_VIEWS)
    for view in views:
        if view not in VIEWS:
            raise UsageError(f"unknown view {view!r}; known: {', '.join(VIEWS)}")
    if output.suffix not in (".png", *ANIMATIONS):
        raise UsageError(f"{output}: the suffix must be .png, .gif or .webp")
    if not saved.has_surfaces():
        raise UsageError(f"{directory} has no surfaces to draw")
    frame = saved.frames[-1] if frame is None else frame
    if frame not in saved.frames:
        raise UsageError(
            f"frame {frame} was not written; the run has {saved.frames[0]} to {saved.frames[-1]}"
        )
    seen = muscle_points([saved], saved.frames)
    axes = [view_axes(VIEWS[view], saved.body) for view in views]
    size = fitted_size(axes[0], seen, area)
    panels = [Panel(saved, one, size, seen) for one in axes]
    frames = [frame] if output.suffix == ".png" else saved.frames
    images = draw_panels(panels, frames, views, _chips(saved))
    save_images(images, output, seconds)


def _chips(saved: SavedRun) -> dict[str, str]:
    """Names of the muscles with their colours; of many, those of the groups."""
    groups = muscle_groups(saved.info)
    colours = muscle_colours(saved.muscles, groups)
    if len(colours) <= len(MUSCLE_COLOURS):
        return colours
    return {groups[name]: colours[name] for name in reversed(saved.muscles)}


def chosen_frames(frames: Sequence[int], most: int) -> list[int]:
    """At most so many of the frames of a motion, evenly, the last one included."""
    stride = -(-len(frames) // most)
    return list(frames[(len(frames) - 1) % stride :: stride])


def save_images(images: Sequence[Image], path: Path, seconds: float) -> None:
    """Save one picture, or several of one width as an animation of so many seconds; raises SolveError if it fails."""
    from PIL import Image

    width, height = (max(image.size[k] for image in images) for k in range(2))
    sheets = []
    for image in images:
        sheets.append(Image.new("RGB", (width, height), BACKGROUND))
        sheets[-1].paste(image, (0, 0))
    kind: dict[str, Any] = {}
    if len(sheets) > 1:
        pause = max(20, int(1000 * seconds / len(sheets)))
        pauses = [pause] * (len(sheets) - 1) + [900]
        kind = {"save_all": True, "append_images": sheets[1:], "duration": pauses, "loop": 0}
        kind |= {"quality": 82, "method": 2} if path.suffix == ".webp" else {}
    try:
        sheets[0].save(path, **kind)
    except OSError as error:
        raise SolveError(f"cannot write {path}: {error.strerror}") from None


def figure_html(bones: Meshes, muscles: Meshes, caption: str, body: Floats) -> str:
    """HTML of a picture.

    Parameters
    ----------
    bones, muscles : mapping of str to (vertices, faces)
        Where they are drawn.
    caption : str
    body : (3, 3) ndarray
        Left, posterior and superior.
    """
    from PIL import Image

    colours = muscle_colours(list(muscles))
    solids = [Solid(np.asarray(v), np.asarray(f), rgb(BONE_COLOUR)) for v, f in bones.values()]
    solids += [Solid(np.asarray(v), np.asarray(f), rgb(colours[name])) for name, (v, f) in muscles.items()]
    picture = ""
    if solids:
        camera = aim(view_axes(_DIRECTION, body), np.concatenate([s.vertices for s in solids]), _FIGURE)
        file = io.BytesIO()
        Image.fromarray(draw_solids(solids, camera, rgb(BACKGROUND))).save(file, format="PNG")
        picture = embedded_image(file.getvalue(), "png", caption)
    return f"<figure>{picture}<figcaption>{escape(caption)}</figcaption></figure>"
