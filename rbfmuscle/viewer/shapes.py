"""Bones and muscles in the browser's scene, their colours, and what these mean."""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.geometry.coarse import clustered
from rbfmuscle.geometry.surfaces import edge_lengths, mesh_volume, unique_edges
from rbfmuscle.metrics.penetration import BoneProbe, surface_depth
from rbfmuscle.output.appearance import BONE_COLOUR, TENDON_COLOUR, linear_rgb
from rbfmuscle.output.tubes import tendon_name
from rbfmuscle.viewer.sources import LiveSource, Mesh, Picture, SavedSource

BONE_TRIANGLES = 6000  # Software drawing pays for each of them in every picture.
Cut = tuple[int, float] | None  # An axis and the place on it [scene unit] beyond which nothing is shown.


class Colouring(NamedTuple):
    """A quantity's title, the limits of its scale (of lengths in mm), and its colour map."""

    title: str
    low: float
    high: float
    colours: str
    length: bool = False


COLOURINGS = {
    "group": None,
    "activation": Colouring("Activation", 0.0, 1.0, "viridis"),
    "stretch": Colouring("Stretch of the edges", -0.5, 0.5, "coolwarm"),
    "penetration": Colouring("Depth in a bone", 0.0, 2.0, "inferno", length=True),
}


class Shapes:
    """Meshes of a viser server; in metres, as the browser shows nothing far away.

    ``numbers`` are volume error [%], depth in bones and mean of the coloured quantity of each muscle, NaN if unknown.
    """

    def __init__(self, server: Any, source: LiveSource | SavedSource) -> None:
        import trimesh

        self.server, self.source, self.scale = server, source, 0.001 / source.millimetre
        self.numbers: dict[str, dict[str, float]] = {}
        self._probes = [BoneProbe(n, trimesh.Trimesh(*m, process=False)) for n, m in source.bones.items()]
        self._bones = {name: clustered(v, f, BONE_TRIANGLES) for name, (v, f) in source.bones.items()}
        self._volumes = {name: mesh_volume(*mesh) for name, mesh in source.muscles.items()}
        self._nodes: dict[str, Any] = {}
        self._painted: list[Any] = []

    def draw(self, picture: Picture, rest: Picture, colour: str, hidden: frozenset[str], cut: Cut) -> None:
        """Show a picture, coloured by one of `COLOURINGS`; ``rest`` is the one before anything moved."""
        from viser.transforms import SO3

        for name, (vertices, faces) in self._bones.items():
            pose = picture.poses[name]
            _, kept = self._part((vertices @ pose[:3, :3].T + pose[:3, 3], faces), cut)
            self._show(name, (self.scale * vertices, kept), BONE_COLOUR, visible=name not in hidden)
            node = self._nodes[name]
            node.position, node.wxyz = self.scale * pose[:3, 3], SO3.from_matrix(pose[:3, :3]).wxyz
        painted, colouring = [], COLOURINGS[colour]
        for name, mesh in picture.surfaces.items():
            values = vertex_values(colour, name, picture, rest, self._probes)
            error = 100.0 * (mesh_volume(*mesh) / self._volumes[name] - 1.0)
            depth = picture.depth.get(name, math.nan)
            self.numbers[name] = {"volume": error, "depth": depth, "mean": float(values.mean())}
            part, shown = self._part(mesh, cut), name not in hidden
            self._show(name, part, self.source.colours[name], visible=shown and colouring is None)
            if shown and colouring is not None:
                painted.append((*part, linear_rgb(shades(colouring, values, self.source.millimetre))))
        for name, mesh in picture.tendons.items():
            part = self._part(mesh, cut)
            self._show(tendon_name(name), part, TENDON_COLOUR, visible=name not in hidden)
        self._paint(painted)

    def _part(self, mesh: Mesh, cut: Cut) -> Mesh:
        """The part of a mesh that is shown, in metres."""
        vertices, faces = mesh
        if cut is not None:
            faces = faces[(vertices[:, cut[0]] <= cut[1])[faces].all(axis=1)]
        return self.scale * vertices, faces

    def _show(self, name: str, mesh: Mesh, colour: str, *, visible: bool) -> None:
        """Show a mesh in one colour."""
        if name not in self._nodes:
            look: dict[str, Any] = {"color": tuple(bytes.fromhex(colour[1:])), "side": "double"}
            self._nodes[name] = self.server.scene.add_mesh_simple(name, *mesh, **look)
        node = self._nodes[name]
        node.visible = visible
        if visible:
            node.vertices, node.faces = mesh

    def _paint(self, painted: list[Any]) -> None:
        """Show meshes (vertices, faces, colours) as glTF, the only form in which viser takes vertices' colours.

        The browser needs a moment to read it, so what was shown before stays until the next picture.
        """
        import trimesh

        while len(self._painted) > bool(painted):
            self._painted.pop(0).remove()
        if painted:
            meshes = [
                trimesh.Trimesh(v, f, vertex_colors=colours, process=False) for v, f, colours in painted
            ]
            free = "a" if self._painted and self._painted[0].name.endswith("b") else "b"
            glb = trimesh.util.concatenate(meshes).export(file_type="glb")
            self._painted.append(self.server.scene.add_glb(f"painted_{free}", glb))

    def points(self, picture: Picture | None) -> Floats:
        """Vertices (n, 3) of bones and muscles, in metres; at rest without a picture."""
        if picture is None:
            parts = [vertices for vertices, _ in (self.source.bones | self.source.muscles).values()]
        else:
            poses = [(vertices, picture.poses[name]) for name, (vertices, _) in self._bones.items()]
            parts = [vertices @ pose[:3, :3].T + pose[:3, 3] for vertices, pose in poses]
            parts += [vertices for vertices, _ in picture.surfaces.values()]
        return self.scale * np.concatenate(parts)


def vertex_values(
    colouring: str, name: str, picture: Picture, rest: Picture, probes: list[BoneProbe]
) -> Floats:
    """One number for each vertex of a muscle, NaN where it is not known."""
    vertices, faces = picture.surfaces[name]
    if colouring == "activation":
        return np.full(len(vertices), picture.activation.get(name, np.nan))
    if colouring == "stretch" and np.array_equal(faces, rest.surfaces[name][1]):
        return _stretch(vertices, *rest.surfaces[name])
    if colouring == "penetration":
        return surface_depth(vertices, probes, picture.poses)
    return np.full(len(vertices), np.nan)


def _stretch(now: Floats, rest: Floats, faces: Integers) -> Floats:
    """Mean change of length of the edges about each vertex, relative to rest."""
    edges = unique_edges(faces)
    change = edge_lengths(now, edges) / edge_lengths(rest, edges) - 1.0
    total, count = (np.bincount(edges.T.ravel(), x, len(now)) for x in (np.tile(change, 2), None))
    return total / np.maximum(count, 1)


def shades(colouring: Colouring, values: Floats, millimetre: float) -> Floats:
    """Colours (n, 3) from 0 to 1 of values (n,); grey for NaN."""
    from matplotlib import colormaps

    low, high = _limits(colouring, millimetre)
    return colormaps[colouring.colours].with_extremes(bad="#b3b3b3")((values - low) / (high - low))[:, :3]


def legend(colouring: Colouring, units: str, millimetre: float) -> str:
    """The scale of a colouring as HTML."""
    from matplotlib import colormaps
    from matplotlib.colors import to_hex

    low, high = _limits(colouring, millimetre)
    stops = ",".join(to_hex(colormaps[colouring.colours](share)) for share in np.linspace(0, 1, 9))
    ends = "".join(f"<span>{value:.3g}</span>" for value in (low, (low + high) / 2, high))
    return (
        f"<b>{colouring.title}{f' [{units}]' if colouring.length else ''}</b>"
        f"<div style='height:12px;background:linear-gradient(90deg,{stops})'></div>"
        f"<div style='display:flex;justify-content:space-between'>{ends}</div>"
    )


def _limits(colouring: Colouring, millimetre: float) -> Floats:
    return np.array([colouring.low, colouring.high]) * (millimetre if colouring.length else 1.0)
