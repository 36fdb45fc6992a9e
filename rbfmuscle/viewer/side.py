"""One of the models that stand beside each other: its bones, muscles, attachments and joints in the
browser's scene, and their colours.
"""

import math
from collections.abc import Collection, Mapping
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import trimesh

from rbfmuscle.geometry.arrays import Floats, Integers, to_world
from rbfmuscle.geometry.mesh_distance import MeshDistance
from rbfmuscle.geometry.surfaces import EdgeLengths, clustered, joined_meshes, mesh_volume
from rbfmuscle.metrics.rows import surface_depth
from rbfmuscle.run.appearance import (
    BONE_COLOUR,
    LONG,
    SHORT,
    TENDON_COLOUR,
    fibres_name,
    linear_rgb,
    stretch_colours,
)
from rbfmuscle.scene.bone import BoneDistance
from rbfmuscle.scene.tendons import tendon_name
from rbfmuscle.simulation.frame import Mesh
from rbfmuscle.viewer.sources import (
    LiveFigure,
    LiveSource,
    Marks,
    Picture,
    SavedFigure,
    SavedSource,
)

if TYPE_CHECKING:
    from viser import (
        GlbHandle,
        LabelHandle,
        LineSegmentsHandle,
        MeshHandle,
        PointCloudHandle,
        ViserServer,
    )


KINDS = ("Attachments", "Joint axes", "Names")
AXIS_COLOUR = (0.86, 0.20, 0.18)  # red, green, blue
HELD_COLOUR = (0.05, 0.35, 0.75)  # of vertices that bones hold
POINT = 0.0012  # size of a vertex that a bone holds [m]


class MarkView:
    """Marks under a node of a viser server, in metres; ``factor`` is from the scene's unit."""

    def __init__(self, server: "ViserServer", root: str, marks: Marks, factor: float) -> None:
        self._server = server
        self._root = root
        self._marks = marks
        self._factor = factor
        self._nodes: dict[str, LabelHandle | LineSegmentsHandle | PointCloudHandle] = {}

    def draw(
        self,
        shown: Collection[str],
        hidden: Collection[str],
        poses: Mapping[str, Floats],
        surfaces: Mapping[str, Mesh],
    ) -> None:
        """Show the marks of some `KINDS`, but for hidden muscles, with bones in these poses."""
        for node in self._nodes.values():
            node.visible = False
        middles = {}
        if "Joint axes" in shown:
            for name, bone, points in self._marks.axes:
                if bone in poses:
                    lines = to_world(points, poses[bone])
                    self._show(f"axes/{name}", lines)
                    middles[name] = lines[0].mean(axis=0)
        if "Attachments" in shown:
            for number, (muscle, bone, points) in enumerate(self._marks.held):
                if muscle not in hidden:
                    self._show(f"held/{number}", to_world(points, poses[bone]))
        if "Names" in shown:
            for name, (vertices, _) in surfaces.items():
                if name not in hidden:
                    middles[name] = vertices.mean(axis=0)
        for name, middle in middles.items():
            place = f"{self._root}/names/{name}"
            if place not in self._nodes:
                self._nodes[place] = self._server.scene.add_label(place, name)
            self._nodes[place].position = middle * self._factor
            self._nodes[place].visible = True

    def _show(self, name: str, points: Floats) -> None:
        """Show lines (k, 2, 3), or points (n, 3)."""
        place = f"{self._root}/{name}"
        points = points * self._factor
        if place not in self._nodes and points.ndim == 3:
            colours = np.broadcast_to(np.array(AXIS_COLOUR), points.shape)
            self._nodes[place] = self._server.scene.add_line_segments(
                place, points, colours, thickness=3.0, thickness_units="screen"
            )
        elif place not in self._nodes:
            self._nodes[place] = self._server.scene.add_point_cloud(
                place, points, HELD_COLOUR, point_size=POINT
            )
        self._nodes[place].points = points
        self._nodes[place].visible = True


CAPTION = 0.02  # height of a model's name above it [m]
LINE = 2.0  # thickness of a fibre [pixel]
BONE_TRIANGLES = 6000  # Software drawing pays for each of them in every picture.


class Colouring(NamedTuple):
    """A quantity's title, the limits of its scale (of lengths in mm), and its colour map."""

    title: str
    low: float
    high: float
    colours: str
    length: bool = False


COLOURINGS = {
    "group": None,
    "fibres": Colouring("Stretch of the fibres", SHORT, LONG, "RdBu_r"),
    "activation": Colouring("Activation", 0.0, 1.0, "viridis"),
    "stretch": Colouring("Stretch of the edges", -0.5, 0.5, "coolwarm"),
    "penetration": Colouring("Depth in a bone", 0.0, 2.0, "inferno", length=True),
    "distance": Colouring("Distance to the other model", 0.0, 5.0, "viridis", length=True),
}


class ViewSettings(NamedTuple):
    """Colouring, hidden muscles and bones, axis and place [scene unit] of a cut, choices that ask
    for a new picture, and what is marked.
    """

    colour: str
    hidden: frozenset[str]
    cut: tuple[int, float] | None
    others: tuple[str, ...]
    marks: frozenset[str] = frozenset()


def vertex_values(
    colouring: str,
    name: str,
    picture: Picture,
    rest: Picture,
    probes: list[BoneDistance],
    other: Picture | None,
) -> Floats:
    """One number for each vertex of a muscle, NaN where it is not known; ``other`` is the model
    beside it.
    """
    vertices, faces = picture.surfaces[name]
    if colouring == "activation":
        return np.full(len(vertices), picture.activation.get(name, np.nan))
    if colouring == "stretch" and np.array_equal(faces, rest.surfaces[name][1]):
        return EdgeLengths(*rest.surfaces[name]).stretch(vertices)
    if colouring == "penetration":
        return surface_depth(vertices, probes, picture.poses)
    if colouring == "distance" and other is not None:
        return MeshDistance(*other.surfaces[name]).unsigned(vertices)
    return np.full(len(vertices), np.nan)


def shades(colouring: Colouring, values: Floats, millimetre: float) -> Floats:
    """Colours (n, 3) from 0 to 1 of values (n,); grey for NaN."""
    from matplotlib import colormaps

    low, high = _limits(colouring, millimetre)
    return colormaps[colouring.colours].with_extremes(bad="#b3b3b3")((values - low) / (high - low))[
        :, :3
    ]


def legend(colouring: Colouring, units: str, millimetre: float) -> str:
    """The scale of a colouring as HTML."""
    from matplotlib import colormaps
    from matplotlib.colors import to_hex

    low, high = _limits(colouring, millimetre)
    stops = ",".join(to_hex(colormaps[colouring.colours](share)) for share in np.linspace(0, 1, 9))
    ends = "".join(f"<span>{value:.3g}</span>" for value in (low, (low + high) / 2, high))
    return (
        f"<b>{colouring.title}{f' [{units}]' if colouring.length else ''}</b><div "
        f"style='height:12px;background:linear-gradient(90deg,{stops})'></div><div "
        f"style='display:flex;justify-content:space-between'>{ends}</div>"
    )


def _limits(colouring: Colouring, millimetre: float) -> Floats:
    return np.array([colouring.low, colouring.high]) * (millimetre if colouring.length else 1.0)


def _make_matt(tree: dict) -> None:
    """Give a glTF its material: one without is a metal, which is dark under plain lights."""
    tree["materials"] = [{"pbrMetallicRoughness": {"metallicFactor": 0.0}}]
    tree["meshes"][0]["primitives"][0]["material"] = 0


class ModelView:
    """A model, or a run, under a node of a viser server; in metres, as the browser shows nothing
    far away.

    ``choice`` is which of the source's models or runs, "none" for none, ``figure`` the one chosen;
    ``picture`` is what is shown of it, ``rest`` what it began with. ``numbers`` are by muscle
    volume error [%], depth in bones, moment arm and mean of the coloured quantity, NaN where not
    known.
    """

    def __init__(self, server: "ViserServer", root: str, source: LiveSource | SavedSource) -> None:
        self.server = server
        self.root = root
        self.source = source
        self.choice = "none"
        self.figure: LiveFigure | SavedFigure | None = None
        self.picture = source.rest
        self.rest = source.rest
        self.numbers: dict[str, dict[str, float]] = {}
        self.frame = server.scene.add_frame(root, show_axes=False)
        self._bones = {
            name: clustered(v, f, BONE_TRIANGLES) for name, (v, f) in source.bones.items()
        }
        self._volumes = {name: mesh_volume(*mesh) for name, mesh in source.muscles.items()}
        self._nodes: dict[str, MeshHandle] = {}
        self._painted: list[GlbHandle] = []
        self._lines: dict[str, LineSegmentsHandle] = {}
        self._marks = MarkView(server, f"{root}/.marks", source.marks, 0.001 / source.millimetre)
        points = (0.001 / source.millimetre) * np.concatenate(self.points())
        up = source.body[2]
        middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
        above = middle + (np.max((points - middle) @ up) + CAPTION) * up
        self.caption = server.scene.add_label(f"{root}/.caption", "", position=above, visible=False)

    def choose(self, choice: str) -> bool:
        """Show another model or run, or none; returns whether it is another."""
        if choice == self.choice:
            return False
        self.figure = None if choice == "none" else self.source.figure(choice)
        self.choice = self.caption.text = choice
        self.picture = self.source.rest if self.figure is None else self.figure.advance()
        self.rest = self.picture
        self.frame.visible = self.figure is not None
        return True

    def draw(self, look: ViewSettings, probes: list[BoneDistance], other: Picture | None) -> None:
        """Show the picture; ``other`` is that of the model beside this one."""
        from viser.transforms import SO3

        for name, (vertices, faces) in self._bones.items():
            pose = self.picture.poses[name]
            _, kept = self._part((to_world(vertices, pose), faces), look.cut)
            part = self._part((vertices, kept), None)
            place = f"bones/{name}"  # a muscle may have its name
            self._show(place, part, BONE_COLOUR, visible=name not in look.hidden)
            node = self._nodes[place]
            node.position = pose[:3, 3] * (0.001 / self.source.millimetre)
            node.wxyz = SO3.from_matrix(pose[:3, :3]).wxyz
        painted, colouring = [], COLOURINGS[look.colour]
        for name, mesh in self.picture.surfaces.items():
            values = vertex_values(look.colour, name, self.picture, self.rest, probes, other)
            self.numbers[name] = {
                "volume": 100.0 * (mesh_volume(*mesh) / self._volumes[name] - 1),
                "depth": self.picture.depth.get(name, math.nan),
                "moment": self.picture.moment_arms.get(name, math.nan),
                "mean": float(values.mean()),
            }
            part, shown = self._part(mesh, look.cut), name not in look.hidden
            if look.colour == "fibres" and name in self.picture.fibres:
                shown = False  # the surface would hide them
            self._show(name, part, self.source.colours[name], visible=shown and colouring is None)
            if shown and colouring is not None:
                painted.append(
                    (*part, linear_rgb(shades(colouring, values, self.source.millimetre)))
                )
        for name, mesh in self.picture.tendons.items():
            part = self._part(mesh, look.cut)
            self._show(tendon_name(name), part, TENDON_COLOUR, visible=name not in look.hidden)
        self._paint(painted)
        self._draw_fibres(look)
        self._marks.draw(look.marks, look.hidden, self.picture.poses, self.picture.surfaces)
        for node in self._nodes.values():
            # The inside is seen in a cut alone, and software drawing pays for it.
            node.side = "front" if look.cut is None else "double"

    def _draw_fibres(self, look: ViewSettings) -> None:
        """Show fibres as lines where they are asked for, coloured by their stretch."""
        for name, fibres in self.picture.fibres.items():
            if look.colour == "fibres" and name not in look.hidden:
                points = fibres.points * (0.001 / self.source.millimetre)
                colours = np.rint(255.0 * stretch_colours(fibres.local_stretch)).astype(np.uint8)
                ends = [
                    np.stack([x[:, :-1], x[:, 1:]], axis=2).reshape(-1, 2, 3)
                    for x in (points, colours)
                ]
                place = f"{self.root}/{fibres_name(name)}"
                self._lines[name] = self.server.scene.add_line_segments(
                    place, *ends, thickness=LINE, thickness_units="screen"
                )
            elif name in self._lines:
                self._lines[name].visible = False

    def _part(self, mesh: Mesh, cut: tuple[int, float] | None) -> Mesh:
        """The part of a mesh that is shown, in metres."""
        vertices, faces = mesh
        if cut is not None:
            faces = faces[(vertices[:, cut[0]] <= cut[1])[faces].all(axis=1)]
        return vertices * (0.001 / self.source.millimetre), faces

    def _show(self, name: str, mesh: Mesh, colour: str, *, visible: bool) -> None:
        """Show a mesh in one colour."""
        if name not in self._nodes:
            shade = tuple(bytes.fromhex(colour[1:]))
            self._nodes[name] = self.server.scene.add_mesh_simple(
                f"{self.root}/{name}", *mesh, color=shade
            )
        node = self._nodes[name]
        node.visible = visible
        if visible:
            node.vertices, node.faces = mesh

    def _paint(self, painted: list[tuple[Floats, Integers, Floats]]) -> None:
        """Show coloured meshes as glTF, which the browser needs a moment to read: the last stays
        until the next.
        """
        self.forget(bool(painted))
        if painted:
            vertices, faces, shades = zip(*painted)
            whole, colours = joined_meshes(vertices, faces), np.concatenate(shades)
            mesh = trimesh.Trimesh(*whole, vertex_colors=colours, process=False)
            free = "a" if self._painted and self._painted[0].name.endswith("b") else "b"
            glb = mesh.export(file_type="glb", tree_postprocessor=_make_matt)
            self._painted.append(self.server.scene.add_glb(f"{self.root}/painted_{free}", glb))

    def forget(self, kept: int = 1) -> None:
        """Remove all coloured meshes but the last ones."""
        while len(self._painted) > kept:
            self._painted.pop(0).remove()

    def points(self) -> list[Floats]:
        """Vertices (n, 3) of bones and muscles, where they are shown."""
        bones = [
            to_world(vertices, self.picture.poses[name])
            for name, (vertices, _) in self._bones.items()
        ]
        return bones + [vertices for vertices, _ in self.picture.surfaces.values()]
