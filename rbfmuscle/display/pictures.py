"""Pictures and animations of runs, and pictures of scenes at rest, drawn without a display."""

import base64
import html
import io
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from PIL import Image, ImageDraw, ImageFont, ImageOps

from rbfmuscle.folders import write_whole
from rbfmuscle.geometry.arrays import Floats, Integers, to_world
from rbfmuscle.geometry.surfaces import vertex_normals
from rbfmuscle.geometry.threads import each
from rbfmuscle.loops import loop
from rbfmuscle.run import appearance as look
from rbfmuscle.run.data import RunData, frame_caption, open_run
from rbfmuscle.scene.objects import Muscle, body_axes
from rbfmuscle.scene.scene import Scene, doubtful
from rbfmuscle.scene.tendons import AT_REST
from rbfmuscle.validation import SolveError, UsageError

# Views where none are asked for; muscles that are named, more are named by their groups; pixels of
# a view.
USUAL_VIEWS = ("front", "right", "back")
_LONGEST = 3600.0  # seconds of an animation
_MOST_CHIPS = 8
_AREA = 220_000
_SMALL = 900, 600  # pixels of a picture in a notebook, at most
# Each pixel is the mean of so many by so many.
_FINER = 2
_MARGIN = 0.05
# Tag of EXIF for the program that made a picture, and what pictures of ours have there.
_SOFTWARE_TAG, _SOFTWARE = 305, "rbfmuscle"
# Height of a row of labels, and width of a colour before one [pixel].
_LINE, _CHIP = 22, 17


class Solid(NamedTuple):
    """What is drawn: vertices (n, 3), faces (m, 3), colour "#rrggbb", and opacity from 0 to 1."""

    vertices: Floats
    faces: Integers
    colour: str
    opacity: float = 1.0


class Camera(NamedTuple):
    """A parallel projection: ``axes`` (3, 3) are right, up and towards the camera; ``scale`` is
    pixels per unit.
    """

    axes: Floats
    centre: Floats
    scale: float
    size: tuple[int, int]

    def project(self, points: Floats) -> Floats:
        """Pixel to the right, pixel downwards and distance towards the camera of points (n, 3)."""
        found = (points - self.centre) @ self.axes.T
        found[:, 0] = 0.5 * self.size[0] + self.scale * found[:, 0]
        found[:, 1] = 0.5 * self.size[1] - self.scale * found[:, 1]
        return found


def aim(axes: Floats, points: Floats, size: tuple[int, int]) -> Camera:
    """A camera of these axes that sees all points (n, 3), as large as a picture of ``size`` holds
    them.
    """
    seen = points @ axes.T
    low, high = seen.min(axis=0), seen.max(axis=0)
    wide, tall, _ = np.maximum(high - low, 1e-9)
    scale = (1.0 - 2.0 * _MARGIN) * min(size[0] / wide, size[1] / tall)
    return Camera(axes, 0.5 * (low + high) @ axes, float(scale), size)


def fitted_size(axes: Floats, points: Floats, area: float) -> tuple[int, int]:
    """Width and height of so many pixels, in the proportions of what is seen; even numbers, as
    films ask for.
    """
    wide, tall, _ = np.maximum(np.ptp(points @ axes.T, axis=0), 1e-9)
    shape = float(np.clip(tall / wide, 0.6, 2.2))
    return 2 * round(0.5 * (area / shape) ** 0.5), 2 * round(0.5 * (area * shape) ** 0.5)


def draw_solids(solids: Sequence[Solid], camera: Camera) -> Integers:
    """Picture (h, w, 3) of uint8; what is not opaque is laid over all that is."""
    width, height = camera.size
    fine = camera._replace(scale=camera.scale * _FINER, size=(_FINER * width, _FINER * height))
    depth = np.full(fine.size[::-1], -np.inf, dtype=np.float32)
    image = np.ones((*depth.shape, 3), dtype=np.float32)
    for solid in sorted(solids, key=lambda solid: -solid.opacity):
        points = fine.project(np.asarray(solid.vertices, dtype=float))
        shades = _shaded(solid, camera.axes)
        _raster_loop(
            points, np.asarray(solid.faces, dtype=np.int64), shades, solid.opacity, depth, image
        )
    # One array after another, which takes a tenth of the time of a mean over two axes.
    parts = [image[a::_FINER, b::_FINER] for a in range(_FINER) for b in range(_FINER)]
    mean = sum(parts[1:], start=parts[0]) / len(parts)
    return np.round(255.0 * np.clip(mean, 0.0, 1.0)).astype(np.uint8)


def _shaded(solid: Solid, axes: Floats) -> Floats:
    """Colours (n, 3) in the light of a lamp up and left of the camera."""
    normals = vertex_normals(solid.vertices, solid.faces)
    lamp = np.array([-0.35, 0.45, 1.0]) @ axes
    lamp /= np.linalg.norm(lamp)
    half = lamp + axes[2]
    facing = np.clip(normals @ lamp, 0.0, 1.0)[:, None]
    gloss = np.clip(normals @ (half / np.linalg.norm(half)), 0.0, 1.0)[:, None] ** 24
    return look.rgb(solid.colour) * (0.42 + 0.62 * facing) + 0.1 * gloss


def labelled(
    image: Integers, text: str, titles: Sequence[str], chips: Mapping[str, str]
) -> Image.Image:
    """Image (h, w, 3) with a strip above that has a title for each column, and one below: text and
    colours.
    """
    font = ImageFont.load_default(13)
    height, width = image.shape[:2]
    x = 8
    y = height + _LINE + 5
    places = []
    for name, colour in [*((part, "") for part in text.split(", ")), *chips.items()]:
        wide = int(font.getlength(name)) + (_CHIP if colour else 0)
        if places and x + wide > width:
            x, y = 8, y + _LINE
        places.append((x, y, name, colour))
        x += wide + 20
    sheet = Image.new("RGB", (width, y + _LINE + 3), "white")
    sheet.paste(Image.fromarray(image), (0, _LINE))
    pen = ImageDraw.Draw(sheet)
    for k, title in enumerate(titles):
        pen.text((k * width // len(titles) + 8, 4), title, fill="#5f646b", font=font)
    for x, y, name, colour in places:
        if colour:
            pen.rectangle((x, y + 2, x + 12, y + 14), fill=colour)
        pen.text((x + (_CHIP if colour else 0), y), name, fill="#26282b", font=font)
    return sheet


@loop
def _raster_loop(points, faces, shades, opacity, depth, image):
    height, width = depth.shape
    for f in range(len(faces)):
        i, j, k = faces[f]
        a = points[i]
        b = points[j]
        c = points[k]
        area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
        if area == 0.0:
            continue
        inverse = 1.0 / area
        left, right = max(0.0, min(a[0], b[0], c[0])), min(width - 1.0, max(a[0], b[0], c[0]))
        top, bottom = max(0.0, min(a[1], b[1], c[1])), min(height - 1.0, max(a[1], b[1], c[1]))
        for y in range(int(np.ceil(top)), int(np.floor(bottom)) + 1):
            for x in range(int(np.ceil(left)), int(np.floor(right)) + 1):
                u = ((b[0] - x) * (c[1] - y) - (b[1] - y) * (c[0] - x)) * inverse
                v = ((c[0] - x) * (a[1] - y) - (c[1] - y) * (a[0] - x)) * inverse
                w = 1.0 - u - v
                z = u * a[2] + v * b[2] + w * c[2]
                if u < 0.0 or v < 0.0 or w < 0.0 or z <= depth[y, x]:
                    continue
                if opacity >= 1.0:
                    depth[y, x] = z
                for m in range(3):
                    shade = u * shades[i, m] + v * shades[j, m] + w * shades[k, m]
                    image[y, x, m] += opacity * (shade - image[y, x, m])


def render_run(
    run: RunData | str | Path | Mapping[str, RunData],
    output: str | Path,
    *,
    frame: int | None = None,
    views: Sequence[str] | None = None,
    area: int = _AREA,
    most: int | None = None,
    seconds: float | None = None,
) -> None:
    """Draw a run, or the one in a folder, or runs of one motion by their titles, to a picture
    (``.png``, one frame) or an animation (``.gif`` or ``.webp``, all of them).

    ``frame`` is that of a picture: its number, or from the end of those that were written if it is
    negative; by default the last. ``views``, side by side, are of `VIEWS`, or
    "motion" for the plane of the motion; `USUAL_VIEWS` where not given. A view has ``area`` pixels.
    An animation of so many ``seconds``, 5 by default, has at ``most`` so many frames, chosen
    evenly. UsageError if the folder holds nothing to draw, the suffix, frame or view is unknown,
    or another file is in the way.
    """
    runs = run if isinstance(run, Mapping) else {"": open_run(run)}
    run = next(iter(runs.values()))
    output = Path(output)
    if output.suffix not in (".png", ".gif", ".webp"):
        raise UsageError(f"{output}: the suffix must be .png, .gif or .webp")
    check_picture(output)
    for drawn in runs.values():
        if not drawn.has_surfaces:
            raise UsageError(f"{drawn.directory or 'the run'} has no surfaces to draw")
    if output.suffix == ".png" and seconds is not None:
        raise UsageError(f"{output}: seconds are of an animation (.gif, .webp), not of a picture")
    if output.suffix != ".png" and frame is not None:
        raise UsageError(f"{output}: a frame is of a picture (.png), an animation shows them all")
    seconds = 5.0 if seconds is None else seconds
    if not 0.0 < seconds <= _LONGEST:
        raise UsageError(f"an animation of {seconds:g} seconds; give up to 3600")
    frame = run.frame(-1 if frame is None else frame).index
    motion = look.motion_direction([shown.poses for shown in run.frames], run.body)
    directions: dict[str, Sequence[float] | Floats] = {**look.VIEWS, "motion": motion}
    for view in views or ():
        if view not in directions:
            raise UsageError(f"unknown view {view!r}; known: {', '.join(directions)}")
    axes = {view: look.view_axes(directions[view], run.body) for view in views or USUAL_VIEWS}
    frames = (
        [frame] if output.suffix == ".png" else chosen_frames(run.frame_numbers, most or len(run))
    )
    save_images(_draw_views(runs, axes, frames, area), output, seconds)


def _draw_views(
    runs: Mapping[str, RunData], axes: Mapping[str, Floats], frames: Sequence[int], area: float
) -> list[Image.Image]:
    """A picture of each frame: views of so many pixels of each run side by side, with titles,
    caption and colours.
    """
    run = next(iter(runs.values()))
    titles = [f"{title}: {view}" if title else view for title in runs for view in axes]
    some = {run.frames[k].index for k in (0, len(run) // 2, -1)}
    seen = np.concatenate(
        [run.mesh(name, k)[0][::3] for name in (*run.muscles, *run.tendons) for k in some]
    )
    size = fitted_size(next(iter(axes.values())), seen, area)
    cameras, chips = [aim(view, seen, size) for view in axes.values()], run.colours
    if len(chips) > _MOST_CHIPS:
        chips = {run.groups[name]: chips[name] for name in reversed(run.muscles)}

    def draw(frame: int) -> Image.Image:
        drawn = [_draw_frame(one, camera, frame) for one in runs.values() for camera in cameras]
        return labelled(np.concatenate(drawn, axis=1), frame_caption(run, frame), titles, chips)

    return each(draw, frames)


def _draw_frame(run: RunData, camera: Camera, frame: int) -> Integers:
    """Picture (h, w, 3) of a frame of a run."""
    colours = run.colours | dict.fromkeys(run.tendons, look.TENDON_COLOUR)
    solids = [Solid(*run.mesh(name, frame), colour) for name, colour in colours.items()]
    poses = run.frame(frame).poses
    for name in run.bones:
        (vertices, faces), pose = run.meshes.bone(name), poses[name]
        solids.append(Solid(to_world(vertices, pose), faces, look.BONE_COLOUR))
    return draw_solids(solids, camera)


def chosen_frames(frames: Sequence[int], most: int) -> list[int]:
    """At most so many of the frames of a motion, evenly, the last one included."""
    stride = -(-len(frames) // most)
    return list(frames[(len(frames) - 1) % stride :: stride])


def save_images(images: Sequence[Image.Image], path: Path, seconds: float) -> None:
    """Save one picture, or several of one width as an animation of so many seconds; raises
    SolveError if it fails.
    """
    size = images[0].width, max(image.height for image in images)
    sheets = [ImageOps.pad(image, size, color="white", centering=(0, 0)) for image in images]
    kind: dict[str, object] = {"quality": 82, "method": 2} if path.suffix == ".webp" else {}
    if len(sheets) > 1:
        pauses = [max(20, int(1000 * seconds / len(sheets)))] * (len(sheets) - 1) + [900]
        kind |= {"save_all": True, "append_images": sheets[1:], "duration": pauses, "loop": 0}
    save_picture(sheets[0], path, **kind)


def check_picture(path: Path) -> None:
    """Raise UsageError if a file is there that is no picture of ours."""
    if not path.exists():
        return
    try:
        with Image.open(path) as image:
            comment = image.info.get("comment", b"")
            if isinstance(comment, bytes):
                comment = comment.decode("utf-8", "replace")
            ours = _SOFTWARE in (image.getexif().get(_SOFTWARE_TAG), comment)
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError):
        ours = False
    if not ours:
        raise UsageError(f"{path} is in the way, and no picture of rbfmuscle; give another file")


def save_picture(image: Image.Image, path: Path, **options: object) -> None:
    """Write a picture, marked as ours, in one move; raises SolveError if it fails."""
    check_picture(path)
    content, kind = io.BytesIO(), path.suffix[1:]
    exif = Image.Exif()
    exif[_SOFTWARE_TAG] = _SOFTWARE
    mark: dict[str, object] = {"comment": _SOFTWARE} if kind == "gif" else {"exif": exif}
    image.save(content, format=kind, **mark, **options)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        write_whole(path, content.getvalue())
    except OSError as error:
        raise SolveError(f"cannot write {path}: {error.strerror}") from None


def figure_html(draw: Callable[[Path], None], caption: str) -> str:
    """HTML of a picture that a function writes to a PNG file, made small, and its caption."""
    with tempfile.TemporaryDirectory() as folder:
        file, small = Path(folder) / "picture.png", Path(folder) / "picture.webp"
        draw(file)
        with Image.open(file) as image:
            image.thumbnail(_SMALL)
            image.save(small, quality=80)
        data = base64.b64encode(small.read_bytes()).decode()
    text = html.escape(caption)
    return (
        f'<figure><img alt="{text}" '
        f'src="data:image/webp;base64,{data}"><figcaption>{text}</figcaption></figure>'
    )


# Of pictures of scenes: pixels of a view, the views, how pale bones are.
_SCENE_SIZE = (640, 1000)
_SCENE_SIDES = ("front", "right", "back", "left")
_PALE = 0.72
# Width that is kept free at both sides of a view for names, their heights [pixel], their colours.
_NAMES, _STEP = 130, 14
_MUSCLE_NAME = "#26282b"
_BONE_NAME = "#7a756c"
_DOUBTED = "#a3281f"
_MUSCLE = "#9a8f8f"
_OPACITY = 0.12
_AXIS = "#0057d9"


def draw_scene(scene: Scene, path: str | Path) -> None:
    """Draw a scene in its rest pose to a PNG file, from four sides of the body."""
    names = [bone.name for bone in scene.bones]
    colours = look.muscle_colours(names, {name: str(k % 8) for k, name in enumerate(names)})
    pale = {name: look.mixed_colour(colour, _PALE) for name, colour in colours.items()}
    solids = [Solid(np.asarray(b.mesh.vertices), b.mesh.faces, pale[b.name]) for b in scene.bones]
    solids += [solid for muscle in scene.muscles for solid in _muscle_solids(muscle, colours)]
    points, images = np.concatenate([solid.vertices for solid in solids]), []
    inner = _SCENE_SIZE[0] - 2 * _NAMES, _SCENE_SIZE[1]
    body = body_axes(scene.superior, scene.anterior)
    for side in _SCENE_SIDES:
        camera = aim(look.view_axes(look.VIEWS[side], body), points, inner)
        camera = camera._replace(size=_SCENE_SIZE)
        image = Image.fromarray(draw_solids(solids, camera))
        pen = ImageDraw.Draw(image)
        _draw_joints(pen, camera, scene)
        _draw_names(pen, camera, scene)
        images.append(np.asarray(image))
    text = f"{scene.name}: attachments in the colour of their bone"
    chips = {**colours, "joint centres and axes": _AXIS, "muscles with doubtful guesses": _DOUBTED}
    save_picture(labelled(np.concatenate(images, axis=1), text, _SCENE_SIDES, chips), Path(path))


def _muscle_solids(muscle: Muscle, colours: dict[str, str]) -> list[Solid]:
    """A muscle as a veil, its held patches in the colours of their bones, and its tendons."""
    vertices, faces = np.asarray(muscle.mesh.vertices), np.asarray(muscle.mesh.faces)
    free, solids = np.ones(len(faces), dtype=bool), []
    for attachment in muscle.attachments:
        held = np.isin(faces, attachment.vertices).all(axis=1)
        solids.append(Solid(vertices, faces[held], colours[attachment.bone]))
        free &= ~held
    tendons = look.tendon_mesh(muscle, {end.name: end.place(AT_REST)[0] for end in muscle.tendons})
    if tendons is not None:
        solids.append(Solid(*tendons, look.TENDON_COLOUR))
    return [Solid(vertices, faces[free], _MUSCLE, _OPACITY), *solids]


def _draw_names(pen: ImageDraw.ImageDraw, camera: Camera, scene: Scene) -> None:
    """Names of the muscles at the left, of the bones at the right, each with a line to its
    middle.
    """
    font = ImageFont.load_default(12)
    for items, left in ((scene.muscles, True), (scene.bones, False)):
        middles = [np.asarray(item.mesh.vertices).mean(axis=0) for item in items]
        places = camera.project(np.reshape(middles, (-1, 3)))
        row = 2.0
        for k in np.argsort(places[:, 1], kind="stable"):
            x, y, _ = places[k]
            rest = int((places[:, 1] > y).sum()) * _STEP
            row = max(row, min(y - 0.5 * _STEP, camera.size[1] - rest - _STEP - 2.0))
            name, wide = items[k].name, pen.textlength(items[k].name, font=font)
            colour = _MUSCLE_NAME if left else _BONE_NAME
            if left and doubtful(scene.guesses, "muscle", name):
                colour = _DOUBTED
            start = 4.0 if left else camera.size[0] - wide - 4.0
            end = start + wide + 2.0 if left else start - 2.0
            pen.line([(end, row + 0.5 * _STEP), (x, y)], fill=colour, width=1)
            pen.text((start, row), name, fill=colour, font=font)
            row += _STEP


def _draw_joints(pen: ImageDraw.ImageDraw, camera: Camera, scene: Scene) -> None:
    """Centres, axes and names of the joints, each name below the one before."""
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
