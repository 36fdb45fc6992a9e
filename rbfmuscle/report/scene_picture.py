"""A scene before it runs as one picture: held patches in the colour of their bone, tendons, joint axes."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from rbfmuscle.output.appearance import TENDON_COLOUR, VIEWS, mixed_colour, muscle_colours, view_axes
from rbfmuscle.output.tubes import tendon_mesh
from rbfmuscle.report.raster import Camera, Solid, aim, draw_solids, labelled
from rbfmuscle.scene.tendons import AT_REST

if TYPE_CHECKING:
    from PIL.ImageDraw import ImageDraw

    from rbfmuscle.scene.objects import Muscle
    from rbfmuscle.scene.scene import Scene

SIZE, SIDES = (480, 860), ("front", "right", "back", "left")
_MUSCLE, _OPACITY, _AXIS, _PALE = "#9a8f8f", 0.12, "#0057d9", 0.72


def draw_scene(scene: Scene, path: str | Path) -> None:
    """Draw a scene in its rest pose to a PNG file, from four sides of the body."""
    from PIL import Image, ImageDraw

    names = [bone.name for bone in scene.bones]
    colours = muscle_colours(names, {name: str(k % 8) for k, name in enumerate(names)})
    solids = [
        Solid(np.asarray(bone.mesh.vertices), bone.mesh.faces, mixed_colour(colours[bone.name], _PALE))
        for bone in scene.bones
    ]
    solids += [solid for muscle in scene.muscles for solid in _muscle_solids(muscle, colours)]
    points, images = np.concatenate([solid.vertices for solid in solids]), []
    for side in SIDES:
        camera = aim(view_axes(VIEWS[side], scene.body), points, SIZE)
        images.append(Image.fromarray(draw_solids(solids, camera)))
        _draw_joints(ImageDraw.Draw(images[-1]), camera, scene)
    text = f"{scene.name}: held patches in the colour of their bone"
    chips = {**colours, "joint centres and axes": _AXIS}
    labelled(np.concatenate([np.asarray(image) for image in images], axis=1), text, SIDES, chips).save(path)


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
        solids.append(Solid(*tendons, TENDON_COLOUR))
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
