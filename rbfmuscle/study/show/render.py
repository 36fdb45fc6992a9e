"""Pictures and animations of a saved run, drawn in a process of their own.

VTK may end the process where no graphics exist. So everything is saved first, then this module is run as
``python -m rbfmuscle.study.show.render DIR`` with the job on its standard input.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from rbfmuscle.geometry.arrays import Integers
from rbfmuscle.geometry.surfaces import vertex_normals
from rbfmuscle.study.files.saved import SavedRun
from rbfmuscle.study.show.appearance import (
    BACKGROUND,
    BONE_COLOUR,
    MUSCLE_COLOURS,
    USUAL_VIEWS,
    VIEWS,
    aim_camera,
    fitted_size,
    neighbour_colours,
)
from rbfmuscle.study.show.paint import PAINT_COLOURS, check_colouring, painting
from rbfmuscle.validation import MissingPartError, RBFMuscleError, UsageError

ANIMATIONS = (".webp", ".gif")
_STRIP = 30
_PAINT = "paint"
_BONE_TRIANGLES = 12_000
# Coordinates that a caption names at most.
MOST_SHOWN = 4
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
    colour : {"muscle", "activation", "stretch"}
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
    module: str = "rbfmuscle.study.show.render",
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


class Stage:
    """An off-screen window with several panels, each aimed at the muscles' whole path.

    Parameters
    ----------
    rows : list of list of (SavedRun, str)
        What each panel shows: a run, and the view of it. Runs of several panels are of one scene.
    size : (width, height)
        Of a panel [pixel].
    paint : callable, optional
        ``paint(saved, muscle, frame, vertices)`` gives values (n,) from 0 to 1 to colour a muscle by; plain
        colours where not given.
    """

    def __init__(self, rows: list[Any], size: Any, paint: Callable[..., Any] | None = None) -> None:
        import pyvista

        self.paint = paint
        self.panels = [
            (i, j, saved, view) for i, row in enumerate(rows) for j, (saved, view) in enumerate(row)
        ]
        shape = (len(rows), len(rows[0]))
        window = (size[0] * shape[1], size[1] * shape[0])
        self.plotter = pyvista.Plotter(off_screen=True, shape=shape, border=False, window_size=window)
        self.plotter.set_background(BACKGROUND)
        first = rows[0][0][0]
        self.first, self.colours = first, neighbour_colours(first)
        self.bones = [(name, self._add_bone(first.bone(name))) for name in first.bones]
        # Of each run's muscle: its mesh, shared by the panels, and its actors there.
        self.skins: dict[Any, tuple[Any, list[Any]]] = {}
        bounds = _path_bounds({id(saved): saved for row in rows for saved, _ in row}.values())
        for i, j, _, view in self.panels:
            self.plotter.subplot(i, j)
            aim_camera(self.plotter.camera, VIEWS[view][0], bounds, size)
            self.plotter.enable_anti_aliasing("ssaa")

    def show(self, frame: int) -> Any:
        """Put bones and muscles where they are in a frame, and return the picture (h, w, 3) uint8."""
        for name, actors in self.bones:
            for actor in actors:
                actor.user_matrix = self.first.poses[frame][name]
        for saved in {id(saved): saved for _, _, saved, _ in self.panels}.values():
            for muscle in saved.muscles:
                self._show_skin(saved, muscle, frame)
        for renderer in self.plotter.renderers:
            renderer.ResetCameraClippingRange()
        self.plotter.render()  # a screenshot alone shows what was drawn last
        return self.plotter.screenshot(return_img=True)

    def close(self) -> None:
        """Let the plotter go."""
        self.plotter.close()

    def _add_bone(self, mesh):
        import pyvista

        mesh = pyvista.make_tri_mesh(*mesh)
        if mesh.n_cells > _BONE_TRIANGLES:  # software drawing pays for each of them in every frame
            mesh = mesh.decimate(1.0 - _BONE_TRIANGLES / mesh.n_cells)
        mesh = mesh.compute_normals(split_vertices=False, auto_orient_normals=False)
        return [self._add(i, j, mesh, BONE_COLOUR) for i, j, _, _ in self.panels]

    def _show_skin(self, saved, muscle, frame):
        """A muscle in all panels of its run: moved where its faces are those of the frame before, else made anew."""
        import pyvista

        vertices, faces = saved.surface(muscle, frame)
        mesh, actors = self.skins.get((id(saved), muscle), (None, []))
        known = mesh is not None and np.array_equal(mesh.regular_faces, faces)
        if known:
            mesh.points = vertices
        else:
            mesh = pyvista.make_tri_mesh(vertices, faces)
        # Set and not computed by the plotter, which would do it again for every panel.
        mesh.point_data.active_normals = vertex_normals(vertices, np.asarray(faces)).astype(np.float32)
        if self.paint is not None:
            mesh.point_data[_PAINT] = self.paint(saved, muscle, frame, np.asarray(mesh.points))
        if known:
            return
        for actor in actors:
            self.plotter.remove_actor(actor, render=False)
        panels = [(i, j) for i, j, shown, _ in self.panels if shown is saved]
        actors = [self._add(i, j, mesh, self.colours[muscle]) for i, j in panels]
        self.skins[id(saved), muscle] = mesh, actors

    def _add(self, row, column, mesh, colour):
        self.plotter.subplot(row, column)
        painted = _PAINT in mesh.point_data
        return self.plotter.add_mesh(
            mesh,
            color=None if painted else colour,
            scalars=_PAINT if painted else None,
            cmap=PAINT_COLOURS,
            clim=(0.0, 1.0),
            show_scalar_bar=False,
            smooth_shading=True,
            specular=0.25,
            specular_power=18,
            ambient=0.12,
            render=False,
            reset_camera=False,
        )


def _path_bounds(runs):
    """Box around the muscles of all runs in the first, middle and last frame."""
    boxes = np.array([saved.path_bounds for saved in runs])
    return np.array([boxes[:, 0].min(axis=0), boxes[:, 1].max(axis=0)])


def chosen_frames(frames: list[int], most: int = 24) -> list[int]:
    """At most so many of the frames of a motion for an animation, evenly, the last one included."""
    stride = -(-len(frames) // most)
    return frames[(len(frames) - 1) % stride :: stride]


def caption(saved: Any, frame: int) -> Any:
    """Frame number and joint angles, as text."""
    entry = next(entry for entry in saved.info["frames"] if entry["frame"] == frame)
    clock = [f"{entry['time']:.4g} s"] if "time" in entry else []
    return ", ".join([f"frame {frame}", *clock, *coordinate_texts(saved.info, entry)])


def coordinate_texts(info: dict[str, Any], entry: dict[str, Any]) -> Any:
    """A frame's coordinates as text, each with its unit; of many, those that the motion moves most.

    Parameters
    ----------
    info : dict
        What ``run.json`` holds.
    entry : dict
        Of its ``frames``.
    """
    values = entry["coordinates"]
    if len(values) > MOST_SHOWN:
        tracks = {n: [row["coordinates"].get(n, 0.0) for row in info["frames"]] for n in values}
        spans = {n: max(track) - min(track) for n, track in tracks.items()}
        values = {n: values[n] for n in sorted(values, key=lambda n: -spans[n])[:MOST_SHOWN]}
    units = info["scene"].get("coordinate_units", {})
    return [f"{name} {value:.4g}{units.get(name, '°')}" for name, value in values.items()]


def labelled(image: Integers, text: str, titles: list[Any], chips: dict[str, Any]) -> Any:
    """Image with a title above each column, and below a strip with a caption and what colours mean.

    Parameters
    ----------
    image : (h, w, 3) ndarray of uint8
    text : str
    titles : list of str
    chips : dict of str to colour
    """
    from PIL import Image, ImageDraw, ImageFont

    font = ImageFont.load_default(13)
    height, width = image.shape[:2]
    pen = ImageDraw.Draw(Image.new("RGB", (1, 1)))
    # Where each word begins: side by side, and in another line where there is no room.
    x, y, places = 8, height + 7, []
    parts = [text] if pen.textlength(text, font=font) <= width - 16 else text.split(", ")
    for name in [*parts, *chips]:
        wide = int(pen.textlength(name, font=font)) + (17 if len(places) >= len(parts) else 0)
        if places and x + wide > width:
            x, y = 8, y + _STRIP - 8
        places.append((x, y))
        x += wide + 20
    sheet = Image.new("RGB", (width, y - 7 + _STRIP), BACKGROUND)
    sheet.paste(Image.fromarray(image), (0, 0))
    pen = ImageDraw.Draw(sheet)
    for k, title in enumerate(titles):
        pen.text((k * width // len(titles) + 8, 6), title, fill="#8a8a8a", font=font)
    for place, part in zip(places, parts):
        pen.text(place, part, fill="#333333", font=font)
    for (x, y), (name, colour) in zip(places[len(parts) :], chips.items()):
        pen.rectangle((x, y + 2, x + 12, y + 14), fill=colour)
        pen.text((x + 17, y), name, fill="#333333", font=font)
    return sheet


def _draw_job(saved, job, seconds, stages):
    views, size, colour = tuple(job["views"]), tuple(job["size"]), job.get("colour", "muscle")
    paint, chips = painting(saved, colour, job["frames"])
    if job.get("fit"):
        size = fitted_size(_path_bounds([saved]), views, size)
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
