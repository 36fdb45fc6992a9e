"""The picture of a scene in its rest pose: attachments, tendons, joints and names."""

from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from rbfmuscle.output import appearance as look
from rbfmuscle.output.appearance import tendon_mesh
from rbfmuscle.report.render import Camera, Solid, aim, draw_solids, labelled, save_picture
from rbfmuscle.scene.guesses import doubtful
from rbfmuscle.scene.objects import Muscle, body_axes
from rbfmuscle.scene.scene import Scene
from rbfmuscle.scene.tendons import AT_REST

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
    tendons = tendon_mesh(muscle, {end.name: end.place(AT_REST)[0] for end in muscle.tendons})
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
