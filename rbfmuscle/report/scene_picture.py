"""A scene before it runs as one picture: patches in the colour of their bone, joint axes, far ends, overlaps."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.geometry.exact_distance import ExactDistance
from rbfmuscle.output.colours import MUSCLE_COLOURS, TENDON_COLOUR, mixed_colour, rgb
from rbfmuscle.output.tubes import tendon_mesh
from rbfmuscle.report.appearance import BACKGROUND, VIEWS, body_axes
from rbfmuscle.report.labels import labelled
from rbfmuscle.report.raster import Camera, Solid, aim, draw_solids
from rbfmuscle.scene.tendons import AT_REST

if TYPE_CHECKING:
    from PIL.ImageDraw import ImageDraw

    from rbfmuscle.scene.objects import Bone, Muscle
    from rbfmuscle.scene.scene import Scene

# A patch farther than this [mm] from its bone is a far end; a muscle deeper than this in a bone overlaps it.
FAR, DEEP = 6.0, 1.0
SIZE = (480, 860)
# What `VIEWS` are where the body's directions are known.
_SIDES = {"front": "from the front", "side": "from the right", "back": "from behind", "far": "from the left"}
_MUSCLE, _OPACITY, _FAR_END, _OVERLAP, _AXIS = "#9a8f8f", 0.4, "#111111", "#e3001b", "#0057d9"
_PALE, _MOST_NAMED = 0.72, 6


class Fault(NamedTuple):
    """An end of a muscle away from its bone, or a muscle inside one: how far or deep, and the places (n, 3) of it."""

    muscle: str
    bone: str
    size: float
    points: Floats


def draw_scene(scene: Scene, path: str | Path) -> dict[str, int]:
    """Draw a scene in its rest pose to a PNG file, from the body's sides where its directions are known.

    Parameters
    ----------
    scene : Scene
    path : path

    Returns
    -------
    dict of str to int
        How many ``far_ends`` and ``overlaps`` (pairs of a muscle and a bone) are marked.
    """
    far, overlaps = find_faults(scene)
    colours = {bone.name: _bone_colour(k) for k, bone in enumerate(scene.bones)}
    solids = [Solid(*_mesh(bone), rgb(mixed_colour(colours[bone.name], _PALE))) for bone in scene.bones]
    solids += [solid for muscle in scene.muscles for solid in _muscle_solids(muscle, colours)]
    points = np.concatenate([solid.vertices for solid in solids])
    images, body, titles = [], None, {view: title for view, (_, title) in VIEWS.items()}
    if scene.superior is not None and scene.anterior is not None:
        body, titles = body_axes(scene.superior, scene.anterior), _SIDES
    for direction, _ in VIEWS.values():
        camera = aim(direction, points, SIZE, body)
        images.append(_marked(draw_solids(solids, camera, rgb(BACKGROUND)), camera, scene, far, overlaps))
    chips = {**colours, "joint centres and axes": _AXIS}
    if far:
        chips[f"ends far from their bone ({len(far)})"] = _FAR_END
    if overlaps:
        chips[f"muscle inside a bone ({len(overlaps)} pairs)"] = _OVERLAP
    text = ", ".join(
        [f"{scene.name}: held patches in the colour of their bone", *_notes(scene, far, overlaps)]
    )
    labelled(np.concatenate(images, axis=1), text, list(titles.values()), chips).save(path)
    return {"far_ends": len(far), "overlaps": len(overlaps)}


def find_faults(scene: Scene) -> tuple[list[Fault], list[Fault]]:
    """Ends of muscles away from their bones, and muscles that start inside bones."""
    millimetre = scene.length(1.0)
    distances = {bone.name: ExactDistance(*_mesh(bone)) for bone in scene.bones}
    bones = {bone.name: bone for bone in scene.bones}
    far, overlaps = [], []
    for muscle in scene.muscles:
        vertices, _ = _mesh(muscle)
        free = np.ones(len(vertices), dtype=bool)
        for held in muscle.attachments:
            patch = vertices[held.vertices]
            free[held.vertices] = False
            gap = float(distances[held.bone].signed_distance(patch).min())
            if held.tendon is None and gap > FAR * millimetre:
                middle, places = patch.mean(axis=0), _mesh(bones[held.bone])[0]
                nearest = places[np.argmin(((places - middle) ** 2).sum(axis=1))]
                far.append(Fault(muscle.name, held.bone, gap, np.array([middle, nearest])))
        for bone in scene.bones:
            low, high = bone.mesh.bounds
            near = vertices[((vertices > low) & (vertices < high)).all(axis=1) & free]
            depth = -distances[bone.name].signed_distance(near) if len(near) else np.zeros(0)
            deep = depth > DEEP * millimetre
            if deep.any():
                overlaps.append(Fault(muscle.name, bone.name, float(depth.max()), near[deep]))
    return far, overlaps


def _mesh(item: Bone | Muscle) -> tuple[Floats, Integers]:
    return np.asarray(item.mesh.vertices, dtype=float), np.asarray(item.mesh.faces)


def _muscle_solids(muscle: Muscle, colours: dict[str, str]) -> list[Solid]:
    """A muscle as a veil, its held patches in the colours of their bones, and its tendons."""
    vertices, faces = _mesh(muscle)
    held = np.zeros(len(vertices), dtype=bool)
    solids = []
    for attachment in muscle.attachments:
        mine = np.zeros(len(vertices), dtype=bool)
        mine[attachment.vertices] = True
        solids.append(Solid(vertices, faces[mine[faces].all(axis=1)], rgb(colours[attachment.bone])))
        held |= mine
    veil = Solid(vertices, faces[~held[faces].all(axis=1)], rgb(_MUSCLE), _OPACITY)
    tendons = tendon_mesh(muscle, {end.name: end.place(AT_REST)[0] for end in muscle.tendons})
    if tendons is not None:
        solids.append(Solid(*tendons, rgb(TENDON_COLOUR)))
    return [veil, *(solid for solid in solids if len(solid.faces))]


def _marked(
    image: Integers, camera: Camera, scene: Scene, far: list[Fault], overlaps: list[Fault]
) -> Integers:
    """The picture with joints, far ends and overlaps drawn over it."""
    from PIL import Image, ImageDraw

    sheet = Image.fromarray(image)
    pen = ImageDraw.Draw(sheet)
    for overlap in overlaps:
        for x, y, _ in camera.project(overlap.points):
            pen.ellipse((x - 2, y - 2, x + 2, y + 2), fill=_OVERLAP)
    for end in far:
        pen.line([tuple(place[:2]) for place in camera.project(end.points)], fill=_FAR_END, width=3)
    _draw_joints(pen, camera, scene)
    return np.asarray(sheet)


def _draw_joints(pen: ImageDraw, camera: Camera, scene: Scene) -> None:
    """Centres, axes and names of the joints; names of those at one place below each other."""
    from PIL import ImageFont

    font, rows = ImageFont.load_default(13), []
    for joint in scene.joints:
        if not joint.coordinates:
            continue
        centre = np.asarray(joint.centre, dtype=float)
        x, y, _ = camera.project(centre[None])[0]
        for axis in (*joint.rotations, *joint.translations):
            if axis.coordinates:
                along = joint.frame[:3, :3] @ np.asarray(axis.direction, dtype=float)
                reach = 26.0 / camera.scale / np.linalg.norm(along)
                ends = camera.project(np.array([centre - reach * along, centre + reach * along]))
                pen.line([tuple(end[:2]) for end in ends], fill=_AXIS, width=2)
        pen.ellipse((x - 4, y - 4, x + 4, y + 4), fill=_AXIS)
        row, wide = y - 7, pen.textlength(joint.name, font=font)
        left = min(x + 8, camera.size[0] - wide - 4)
        while any(abs(row - other) < 14 and left < end and start < left + wide for other, start, end in rows):
            row += 14
        rows.append((row, left, left + wide))
        pen.text((left, row), joint.name, fill=_AXIS, font=font)


def _bone_colour(k: int) -> str:
    """A colour for the k-th bone; darker ones where there are more bones than colours."""
    return mixed_colour(MUSCLE_COLOURS[k % len(MUSCLE_COLOURS)], -min(0.45 * (k // len(MUSCLE_COLOURS)), 0.8))


def _notes(scene: Scene, far: list[Fault], overlaps: list[Fault]) -> list[str]:
    """The worst of what is marked, in words."""
    words = []
    for faults, verb, place in ((far, "ends", "from"), (overlaps, "is", "deep in")):
        for one in sorted(faults, key=lambda fault: -fault.size)[:_MOST_NAMED]:
            words.append(f"{one.muscle} {verb} {one.size:.3g} {scene.units} {place} {one.bone}")
    return words
