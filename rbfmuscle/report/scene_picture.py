"""A scene before it runs as one picture: patches in the colour of their bone, joint axes, far ends, overlaps.

Drawn in a process of its own, ``python -m rbfmuscle.report.scene_picture FOLDER``, as pictures of runs are.
"""

from __future__ import annotations

import json
import sys
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rbfmuscle.geometry.exact_distance import ExactDistance
from rbfmuscle.report.appearance import BACKGROUND, LINE_COLOURS, VIEWS, aim_camera
from rbfmuscle.report.render import draw, main

if TYPE_CHECKING:
    from rbfmuscle.scene.scene import Scene

# A patch farther than this [mm] from its bone is a far end; a muscle deeper than this in a bone overlaps it.
FAR, DEEP = 6.0, 1.0
SIZE = (560, 1000)
BONE_OPACITY, MUSCLE_OPACITY = 1.0, 0.28
MUSCLE, FAR_END, OVERLAP, AXIS = "#9a8f8f", "#111111", "#e3001b", "#0057d9"
_PALE = 0.72
_STRIP, _LINE, _TEXT = 34, 24, 15


def draw_scene(scene: Scene, path: str | Path) -> dict[str, int]:
    """Draw a scene in its rest pose to a PNG file.

    Parameters
    ----------
    scene : Scene
    path : path

    Returns
    -------
    dict of str to int
        How many ``far_ends`` and ``overlaps`` (pairs of a muscle and a bone) are marked.

    Raises
    ------
    MissingPartError
        If there are no graphics to draw with.
    """
    with tempfile.TemporaryDirectory() as folder:
        facts = write_parts(scene, Path(folder))
        draw(folder, [{"file": str(Path(path).resolve())}], module="rbfmuscle.report.scene_picture")
    return {"far_ends": len(facts["far"]), "overlaps": len(facts["overlaps"])}


def write_parts(scene: Scene, folder: Path) -> dict[str, Any]:
    """Write what is drawn: meshes as arrays, all else as JSON, which is returned."""
    millimetre = scene.length(1.0)
    arrays, far, overlaps = {}, [], []
    for k, bone in enumerate(scene.bones):
        arrays[f"bone{k}"], arrays[f"bone{k}f"] = _mesh(bone)
    distances = {bone.name: ExactDistance(*_mesh(bone)) for bone in scene.bones}
    names = [bone.name for bone in scene.bones]
    for k, muscle in enumerate(scene.muscles):
        vertices, faces = _mesh(muscle)
        arrays[f"muscle{k}"], arrays[f"muscle{k}f"] = vertices, faces
        attached_bone = np.full(len(vertices), -1)
        for held in muscle.attachments:
            attached_bone[held.vertices] = names.index(held.bone)
            gap, end = _gap(
                vertices[held.vertices], distances[held.bone], scene.bones[names.index(held.bone)]
            )
            if gap > FAR * millimetre:
                far.append({"muscle": muscle.name, "bone": held.bone, "gap": gap, "line": end})
        arrays[f"muscle{k}h"] = attached_bone
        deep = _inside(vertices, attached_bone, scene, distances, DEEP * millimetre)
        if len(deep["points"]):
            arrays[f"deep{k}"] = deep.pop("points")
            overlaps += [{"muscle": muscle.name, **one} for one in deep["bones"]]
    facts = {
        "name": scene.name,
        "units": scene.units,
        "bones": names,
        "muscles": [muscle.name for muscle in scene.muscles],
        "joints": [_joint(joint) for joint in scene.joints if joint.coordinates],
        "far": far,
        "overlaps": overlaps,
    }
    np.savez(folder / "parts.npz", **arrays)
    (folder / "facts.json").write_text(json.dumps(facts), encoding="utf-8")
    return facts


def _mesh(item):
    return np.asarray(item.mesh.vertices, dtype=float), np.asarray(item.mesh.faces)


def _gap(points, distance, bone):
    """Least distance of a patch from its bone, and the line from its middle to the nearest place there."""
    gap = float(distance.signed_distance(points).min())
    vertices = np.asarray(bone.mesh.vertices, dtype=float)
    middle = points.mean(axis=0)
    nearest = vertices[np.argmin(((vertices - middle) ** 2).sum(axis=1))]
    return gap, [middle.tolist(), nearest.tolist()]


def _inside(vertices, attached_bone, scene, distances, deep):
    """Vertices deeper in a bone than allowed, of those that no bone holds, and which bones these are."""
    marked, bones = np.zeros(len(vertices), dtype=bool), []
    for bone in scene.bones:
        low, high = bone.mesh.bounds
        near = np.flatnonzero(((vertices > low) & (vertices < high)).all(axis=1) & (attached_bone < 0))
        if len(near) == 0:
            continue
        depth = -distances[bone.name].signed_distance(vertices[near])
        if depth.max() > deep:
            marked[near[depth > deep]] = True
            bones.append({"bone": bone.name, "depth": float(depth.max())})
    return {"points": vertices[marked], "bones": bones}


def _joint(joint):
    """Place and axes of a joint for the picture."""
    moving = [axis.direction for axis in (*joint.rotations, *joint.translations) if axis.coordinates]
    axes = [(joint.frame[:3, :3] @ np.asarray(direction, dtype=float)).tolist() for direction in moving]
    return {"name": joint.name, "centre": np.asarray(joint.centre, dtype=float).tolist(), "axes": axes}


class ScenePicture:
    """The child's window: three views of one scene.

    Parameters
    ----------
    folder : Path
        From `write_parts`.
    """

    def __init__(self, folder: Path) -> None:
        import pyvista

        self.facts = json.loads((folder / "facts.json").read_text(encoding="utf-8"))
        with np.load(folder / "parts.npz") as found:
            self.parts = dict(found)
        self.colours = [_bone_colour(k) for k in range(len(self.facts["bones"]))]
        window = (SIZE[0] * len(VIEWS), SIZE[1])
        self.plotter = pyvista.Plotter(
            off_screen=True, shape=(1, len(VIEWS)), border=False, window_size=window
        )
        self.plotter.set_background(BACKGROUND)
        points = np.vstack([part for name, part in self.parts.items() if name[-1].isdigit()])
        bounds = np.array([points.min(axis=0), points.max(axis=0)])
        self.size = float(np.linalg.norm(np.ptp(points, axis=0)))
        for column, (direction, _) in enumerate(VIEWS.values()):
            self.plotter.subplot(0, column)
            self._add_all()
            aim_camera(self.plotter.camera, direction, bounds, SIZE)
            self.plotter.enable_anti_aliasing("ssaa")

    def picture(self) -> Any:
        """The views side by side, (h, w, 3) uint8."""
        self.plotter.render()
        return self.plotter.screenshot(return_img=True)

    def close(self) -> None:
        """Let the plotter go."""
        self.plotter.close()

    def _add_all(self):
        import pyvista

        look = {"smooth_shading": True, "ambient": 0.2, "render": False, "reset_camera": False}
        for k, colour in enumerate(self.colours):
            mesh = pyvista.make_tri_mesh(self.parts[f"bone{k}"], self.parts[f"bone{k}f"])
            self.plotter.add_mesh(mesh, color=_paler(colour), opacity=BONE_OPACITY, **look)
        for k in range(len(self.facts["muscles"])):
            self._add_muscle(k, look)
        for joint in self.facts["joints"]:
            self._add_joint(joint, look)
        self._add_names()
        for far in self.facts["far"]:
            line = pyvista.Line(*far["line"]).tube(radius=0.0022 * self.size)
            self.plotter.add_mesh(line, color=FAR_END, **look)

    def _add_muscle(self, k, look):
        import pyvista

        points, faces = self.parts[f"muscle{k}"], self.parts[f"muscle{k}f"]
        attached_bone = self.parts[f"muscle{k}h"][faces]
        held = np.where((attached_bone == attached_bone[:, :1]).all(axis=1), attached_bone[:, 0], -1)
        self.plotter.add_mesh(
            pyvista.make_tri_mesh(points, faces[held < 0]), color=MUSCLE, opacity=MUSCLE_OPACITY, **look
        )
        for bone in np.unique(held[held >= 0]):
            patch = pyvista.make_tri_mesh(points, faces[held == bone])
            self.plotter.add_mesh(patch, color=self.colours[bone], **look)
        if f"deep{k}" in self.parts:
            self.plotter.add_mesh(
                pyvista.PolyData(self.parts[f"deep{k}"]), color=OVERLAP, point_size=6,
                render_points_as_spheres=True, render=False, reset_camera=False,
            )  # fmt: skip

    def _add_joint(self, joint, look):
        import pyvista

        centre = np.array(joint["centre"])
        reach = 0.07 * self.size if len(joint["axes"]) > 1 else 0.09 * self.size
        for axis in joint["axes"]:
            way = reach * np.array(axis) / np.linalg.norm(axis)
            line = pyvista.Line(centre - way, centre + way).tube(radius=0.002 * self.size)
            self.plotter.add_mesh(line, color=AXIS, **look)
        self.plotter.add_mesh(pyvista.Sphere(0.006 * self.size, centre), color=AXIS, **look)

    def _add_names(self):
        """Names of the joints, one below the other where they share a place."""
        groups: list[tuple[Any, list[str]]] = []
        for joint in self.facts["joints"]:
            centre = np.array(joint["centre"])
            near = [names for place, names in groups if np.linalg.norm(place - centre) < 0.04 * self.size]
            if near:
                near[0].append(joint["name"])
            else:
                groups.append((centre, [joint["name"]]))
        if groups:
            self.plotter.add_point_labels(
                [place for place, _ in groups], ["\n".join(names) for _, names in groups], font_size=13,
                text_color=AXIS, shape=None, always_visible=True, show_points=False, render=False, reset_camera=False,
            )  # fmt: skip


def _bone_colour(k):
    """A colour for the k-th bone; darker ones where there are more bones than colours."""
    colour = LINE_COLOURS[k % len(LINE_COLOURS)]
    return _mixed(colour, 0, min(0.45 * (k // len(LINE_COLOURS)), 0.8))


def _paler(colour):
    return _mixed(colour, 255, _PALE)


def _mixed(colour, other, share):
    """A colour brought nearer to a grey (0 black, 255 white)."""
    values = [int(colour[k : k + 2], 16) for k in (1, 3, 5)]
    return "#" + "".join(f"{round(value + share * (other - value)):02x}" for value in values)


def _legend(facts, colours, width):
    """A strip under the views: colours of the bones, then what the marks mean and what they found."""
    from PIL import Image, ImageDraw, ImageFont

    font = ImageFont.load_default(_TEXT)
    chips = list(zip(facts["bones"], colours))
    units = facts["units"]
    marks = [("joint centres and axes", AXIS)]
    if facts["far"]:
        marks.append((f"ends far from their bone ({len(facts['far'])})", FAR_END))
    if facts["overlaps"]:
        marks.append((f"muscle inside a bone ({len(facts['overlaps'])} pairs)", OVERLAP))
    worst = sorted(facts["far"], key=lambda one: -one["gap"])[:6]
    notes = [f"{one['muscle']} ends {one['gap']:.3g} {units} from {one['bone']}" for one in worst]
    deepest = sorted(facts["overlaps"], key=lambda one: -one["depth"])[:6]
    notes += [f"{one['muscle']} is {one['depth']:.3g} {units} deep in {one['bone']}" for one in deepest]
    image = Image.new("RGB", (width, 4000), BACKGROUND)
    pen = ImageDraw.Draw(image)
    y = 8
    for entries, boxed in ((chips, True), (marks, True), ([(note, None) for note in notes], False)):
        x = 14
        for text, colour in entries:
            wide = pen.textlength(text, font=font) + (26 if boxed else 0) + 22
            if x + wide > width and x > 14:
                x, y = 14, y + _LINE
            if boxed:
                pen.rectangle((x, y + 3, x + 16, y + 15), fill=colour)
            pen.text((x + (24 if boxed else 0), y), text, fill="#26282b", font=font)
            x += wide
        y += _LINE if entries else 0
    return image.crop((0, 0, width, y + 6))


def _draw_job(found, job, seconds, stages):
    from PIL import Image, ImageDraw, ImageFont

    stage = ScenePicture(found)
    stages[id(stage)] = stage
    image = Image.fromarray(stage.picture())
    legend = _legend(stage.facts, stage.colours, image.width)
    whole = Image.new("RGB", (image.width, _STRIP + image.height + legend.height), BACKGROUND)
    pen, font = ImageDraw.Draw(whole), ImageFont.load_default(_TEXT + 2)
    pen.text(
        (14, 8), f"{stage.facts['name']}: held patches in the colour of their bone", fill="#26282b", font=font
    )
    for column, (_, title) in enumerate(VIEWS.values()):
        pen.text(
            (SIZE[0] * (column + 1) - 70, 10), title, fill="#6a6f76", font=ImageFont.load_default(_TEXT - 2)
        )
    whole.paste(image, (0, _STRIP))
    whole.paste(legend, (0, _STRIP + image.height))
    whole.save(job["file"])


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:], Path, _draw_job))
