"""Pictures and animations of saved runs; a scene before it runs as one picture."""

from __future__ import annotations

import base64
import html
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.geometry.threads import each
from rbfmuscle.output import appearance as look
from rbfmuscle.output.saved import SavedRun
from rbfmuscle.output.tubes import tendon_mesh
from rbfmuscle.report.raster import Camera, Solid, aim, draw_solids, fitted_size, labelled
from rbfmuscle.scene.objects import Muscle
from rbfmuscle.scene.scene import Scene
from rbfmuscle.scene.tendons import AT_REST
from rbfmuscle.validation import SolveError, UsageError

if TYPE_CHECKING:
    from PIL.Image import Image
    from PIL.ImageDraw import ImageDraw


# Views where none are asked for; muscles that are named, more are named by their groups; pixels of a view.
USUAL_VIEWS, _MOST_CHIPS, _AREA = ("front", "right", "back"), 8, 220_000
# Of pictures of scenes: pixels of a view, the views, how pale bones are.
_SCENE_SIZE, _SCENE_SIDES, _PALE = (480, 860), ("front", "right", "back", "left"), 0.72
_SMALL = 900, 600  # pixels of a picture in a notebook, at most
_MUSCLE, _OPACITY, _AXIS = "#9a8f8f", 0.12, "#0057d9"


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
        ends = f"{saved.frames[0]} to {saved.frames[-1]}"
        raise UsageError(f"frame {frame} was not written; the run has {ends}")
    poses = [saved.poses[k] for k in saved.frames]
    directions: dict[str, Sequence[float] | Floats] = {
        **look.VIEWS,
        "motion": look.motion_direction(poses, saved.body),
    }
    for view in views or ():
        if view not in directions:
            raise UsageError(f"unknown view {view!r}; known: {', '.join(directions)}")
    axes = {view: look.view_axes(directions[view], saved.body) for view in views or USUAL_VIEWS}
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
    colours = run.colours | dict.fromkeys(run.tendons, look.TENDON_COLOUR)
    solids = [Solid(*run.surface(name, frame), colour) for name, colour in colours.items()]
    for name, pose in run.poses[frame].items():
        vertices, faces = run.bone(name)
        solids.append(Solid(vertices @ pose[:3, :3].T + pose[:3, 3], faces, look.BONE_COLOUR))
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


def draw_scene(scene: Scene, path: str | Path) -> None:
    """Draw a scene in its rest pose to a PNG file, from four sides of the body."""
    from PIL import Image, ImageDraw

    names = [bone.name for bone in scene.bones]
    colours = look.muscle_colours(names, {name: str(k % 8) for k, name in enumerate(names)})
    solids = [
        Solid(np.asarray(bone.mesh.vertices), bone.mesh.faces, look.mixed_colour(colours[bone.name], _PALE))
        for bone in scene.bones
    ]
    solids += [solid for muscle in scene.muscles for solid in _muscle_solids(muscle, colours)]
    points, images = np.concatenate([solid.vertices for solid in solids]), []
    for side in _SCENE_SIDES:
        camera = aim(look.view_axes(look.VIEWS[side], scene.body), points, _SCENE_SIZE)
        images.append(Image.fromarray(draw_solids(solids, camera)))
        _draw_joints(ImageDraw.Draw(images[-1]), camera, scene)
    text = f"{scene.name}: held patches in the colour of their bone"
    chips = {**colours, "joint centres and axes": _AXIS}
    labelled(np.concatenate([np.asarray(image) for image in images], axis=1), text, _SCENE_SIDES, chips).save(
        path
    )


def figure_html(draw: Callable[[Path], None], caption: str) -> str:
    """HTML of a picture that a function writes to a PNG file, made small, and its caption."""
    from PIL import Image

    with tempfile.TemporaryDirectory() as folder:
        file, small = Path(folder) / "picture.png", Path(folder) / "picture.webp"
        draw(file)
        with Image.open(file) as image:
            image.thumbnail(_SMALL)
            image.save(small, quality=80)
        data = base64.b64encode(small.read_bytes()).decode()
    text = html.escape(caption)
    return f'<figure><img alt="{text}" src="data:image/webp;base64,{data}"><figcaption>{text}</figcaption></figure>'


def _muscle_solids(muscle: Muscle, colours: dict[str, str]) -> list[Solid]:
    """A muscle as a veil, its held patches in the colours of their bones, and its tendons."""
    vertices, faces = np.asarray(muscle.mesh.vertices), np.asarray(muscle.mesh.faces)
    free, solids = np.ones(len(faces), dtype=bool), []
    for attachment in muscle.attachments:
        held = np.isin(faces, attachment.vertices).all(axis=1)
        solids.append(Solid(vertices, faces[held], colours[attachment.bone]))
        free &= ~held
    tendons = tendon_mesh(muscle, {end.name: end.place(AT_REST)[0] for end in muscle.tendons})
    if tendons is not None:
        solids.append(Solid(*tendons, look.TENDON_COLOUR))
    return [Solid(vertices, faces[free], _MUSCLE, _OPACITY), *solids]


def _draw_joints(pen: ImageDraw, camera: Camera, scene: Scene) -> None:
    """Centres, axes and names of the joints, each name below the one before."""
    from PIL import ImageFont

    font, row = ImageFont.load_default(13), -np.inf
    for joint in sorted(scene.joints, key=lambda joint: -float(camera.axes[1] @ joint.centre)):
        if not joint.coordinates:
            continue
        centre = np.asarray(joint.centre, dtype=float)
        x, y, _ = camera.project(centre[None])[0]
        for axis in (*joint.rotations, *joint.translations):
            if axis.coordinates:
                along = np.asarray(axis.direction, dtype=float)
                reach = 26.0 / camera.scale / np.linalg.norm(along)
                ends = camera.project(np.array([centre - reach * along, centre + reach * along]))
                pen.line([tuple(end[:2]) for end in ends], fill=_AXIS, width=2)
        pen.ellipse((x - 4, y - 4, x + 4, y + 4), fill=_AXIS)
        left = min(x + 8, camera.size[0] - pen.textlength(joint.name, font=font) - 4)
        row = max(y - 7, row + 13)
        pen.text((left, row), joint.name, fill=_AXIS, font=font)
