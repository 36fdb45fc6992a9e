"""Pictures and animations of saved runs."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.output.colours import BONE_COLOUR, MUSCLE_COLOURS, muscle_colours, rgb
from rbfmuscle.output.saved import SavedRun
from rbfmuscle.report.appearance import BACKGROUND, USUAL_VIEWS, VIEWS, motion_direction, muscle_groups
from rbfmuscle.report.labels import labelled
from rbfmuscle.report.paint import activations, check_colouring, scale_chips, scale_colours
from rbfmuscle.report.raster import Solid, aim, draw_solids, fitted_size
from rbfmuscle.validation import SolveError, UsageError

if TYPE_CHECKING:
    from PIL.Image import Image

ANIMATIONS = (".webp", ".gif")
# Pixels of a panel, and of one of the preview; frames of the preview.
_AREA, _PREVIEW_AREA, _PREVIEW_FRAMES = 220_000, 110_000, 12
# Colours (n, 3) of a muscle's vertices in a frame.
Paint = Callable[[SavedRun, str, int, Floats], Floats]


class Panel:
    """A run seen from one direction, as large in all frames.

    Parameters
    ----------
    saved : SavedRun
    direction : (3,) sequence of float
        From the subject to the camera.
    size : (width, height)
        Pixels.
    path : (n, 3) ndarray
        What is to be seen.
    paint : callable, optional
        ``paint(saved, muscle, frame, vertices)`` gives colours (n, 3); the muscles' own where not given.
    """

    def __init__(
        self,
        saved: SavedRun,
        direction: Sequence[float] | Floats,
        size: tuple[int, int],
        path: Floats,
        paint: Paint | None = None,
    ) -> None:
        self.saved, self.paint = saved, paint
        self.colours = muscle_colours(saved.muscles, muscle_groups(saved.info))
        self.bones = {name: saved.bone(name) for name in saved.bones}
        self.camera = aim(direction, path, size)

    def draw(self, frame: int) -> Integers:
        """Picture (h, w, 3) of a frame."""
        solids = []
        for name, (vertices, faces) in self.bones.items():
            pose = self.saved.poses[frame][name]
            solids.append(Solid(vertices @ pose[:3, :3].T + pose[:3, 3], faces, rgb(BONE_COLOUR)))
        for name, colour in self.colours.items():
            vertices, faces = self.saved.surface(name, frame)
            shade = rgb(colour) if self.paint is None else self.paint(self.saved, name, frame, vertices)
            solids.append(Solid(vertices, faces, shade))
        return draw_solids(solids, self.camera, rgb(BACKGROUND))


def muscle_path(runs: Sequence[SavedRun], frames: Sequence[int]) -> Floats:
    """Points (n, 3) of all muscles in some frames."""
    return np.concatenate(
        [run.surface(name, frame)[0][::3] for run in runs for name in run.muscles for frame in frames]
    )


def draw_panels(
    panels: Sequence[Panel], frames: Sequence[int], titles: Sequence[str], chips: Mapping[str, str]
) -> list[Image]:
    """Panels beside each other, a picture for each frame, with titles above and caption and colours below."""
    return [
        labelled(
            np.concatenate([panel.draw(frame) for panel in panels], axis=1),
            panels[0].saved.caption(frame),
            titles,
            chips,
        )
        for frame in frames
    ]


def draw_preview(saved: SavedRun, path: Path) -> None:
    """Write the whole motion, seen in its plane and from the front, as an animation."""
    frames = chosen_frames(saved.frames, _PREVIEW_FRAMES)
    seen = muscle_path([saved], frames[:: max(1, len(frames) // 4)] + frames[-1:])
    directions = [motion_direction([saved.poses[frame] for frame in frames]), np.array(VIEWS["front"][0])]
    size = fitted_size(directions[0], seen, _PREVIEW_AREA)
    panels = [Panel(saved, direction, size, seen) for direction in directions]
    save_images(draw_panels(panels, frames, ["plane of the motion", "front"], _chips(saved)), path, 4.0)


def render_run(
    directory: str | Path,
    output: str | Path,
    *,
    frame: int | None = None,
    views: Sequence[str] | None = None,
    area: int = _AREA,
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
    area : int
        Pixels of one view.
    seconds : float
        Length of an animation.
    colour : {"muscle", "activation"}
        What muscles are coloured by.

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
    check_colouring(saved, colour)
    frame = saved.frames[-1] if frame is None else frame
    if frame not in saved.frames:
        raise UsageError(
            f"frame {frame} was not written; the run has {saved.frames[0]} to {saved.frames[-1]}"
        )
    seen = muscle_path(
        [saved], sorted({saved.frames[0], saved.frames[len(saved.frames) // 2], saved.frames[-1]})
    )
    paint, chips = (
        (activation_paint(saved), _activation_chips()) if colour == "activation" else (None, _chips(saved))
    )
    panels = [
        Panel(saved, VIEWS[view][0], fitted_size(VIEWS[views[0]][0], seen, area), seen, paint)
        for view in views
    ]
    frames = [frame] if output.suffix == ".png" else saved.frames
    images = draw_panels(panels, frames, [f"{view} ({VIEWS[view][1]})" for view in views], chips)
    save_images(images, output, seconds)


def _chips(saved: SavedRun) -> dict[str, str]:
    """Names of the muscles with their colours; of many, those of the groups."""
    groups = muscle_groups(saved.info)
    colours = muscle_colours(saved.muscles, groups)
    if len(colours) <= len(MUSCLE_COLOURS):
        return colours
    return {groups[name]: colours[name] for name in reversed(saved.muscles)}


def _activation_chips() -> dict[str, str]:
    return scale_chips([f"activation {share:g}" for share in np.linspace(0, 1, 5)])


def activation_paint(saved: SavedRun) -> Paint:
    """Each muscle by its activation, 0 where it does not contract."""
    known = activations(saved)
    return lambda _, muscle, frame, vertices: scale_colours(
        np.full(len(vertices), known.get((muscle, frame), 0.0))
    )


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
