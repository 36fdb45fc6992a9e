"""What a window shows of a scene or a saved run, and what its switches do; no graphics here."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial import cKDTree

from rbfmuscle.geometry.surfaces import edge_lengths
from rbfmuscle.metrics.mesh_distance import MeshDistance
from rbfmuscle.metrics.penetration import BoneProbe, bone_coordinates, surface_depth
from rbfmuscle.output.meshfiles import write_mesh
from rbfmuscle.validation import UsageError

if TYPE_CHECKING:
    pass


# Colouring: name, what the bar says, limits ("length" ones in mm), colour map.
COLOURINGS = {
    "nothing": ("", (0.0, 1.0), ""),
    "penetration": ("depth in a bone", (0.0, 2.0), "inferno"),
    "distance": ("distance to bone", (0.0, 20.0), "viridis"),
    "stretch": ("stretch of edges", (-0.5, 0.5), "coolwarm"),
    "volume": ("volume error", (-0.01, 0.01), "coolwarm"),
    "activation": ("activation", (0.0, 1.0), "Reds"),
}
LENGTHS = ("penetration", "distance")


@dataclass
class View:
    """One picture's content.

    Attributes
    ----------
    poses : dict of str to (4, 4) ndarray
    surfaces : dict of str to (vertices, faces)
    values : dict of str to (n,) ndarray
        One number a vertex where the colouring asks for it, else empty.
    lines : list of str
        Metrics of the moment.
    """

    poses: dict
    surfaces: dict
    values: dict = field(default_factory=dict)
    lines: list = field(default_factory=list)


class Viewer:
    """State shared by live scenes and saved runs: colouring, export, the names of things.

    Parameters
    ----------
    units : str
    length : float
        A millimetre in these units.
    bones : dict of str to (vertices, faces)
        At rest.
    muscles : list of str
    """

    live = False

    def __init__(self, units: str, length: float, bones: dict[str, Any], muscles: list[str]) -> None:
        self.units, self.length = units, length
        self.bones, self.muscles = bones, list(muscles)
        self.colouring = "nothing"
        self.message = ""
        self._shots = 0

    @cached_property
    def probes(self) -> list[BoneProbe]:
        """The bones, prepared for exact distances."""
        import trimesh

        return [BoneProbe(name, trimesh.Trimesh(*mesh, process=False)) for name, mesh in self.bones.items()]

    @cached_property
    def _trees(self):
        return {name: MeshDistance(*mesh) for name, mesh in self.bones.items()}

    def colour_by(self, name: str) -> None:
        """Choose a colouring.

        Raises
        ------
        UsageError
            If it is unknown.
        """
        if name not in COLOURINGS:
            raise UsageError(f"unknown colouring {name!r}; known: {', '.join(COLOURINGS)}")
        self.colouring = name

    def scale(self) -> tuple[str, tuple[float, ...], str] | None:
        """Title, limits and colour map of the present colouring, or None."""
        if self.colouring == "nothing":
            return None
        title, limits, colours = COLOURINGS[self.colouring]
        if self.colouring in LENGTHS:
            return f"{title} [{self.units}]", tuple(v * self.length for v in limits), colours
        return title, limits, colours

    def export(self, view: View, folder: Path, label: str) -> list[Path]:
        """Write every surface of a view as PLY; returns the paths."""
        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        paths = [folder / f"{name}_{label}.ply" for name in view.surfaces]
        for path, (vertices, faces) in zip(paths, view.surfaces.values()):
            write_mesh(path, vertices, faces)
        return paths

    def next_name(self, folder: Any, suffix: Any) -> Any:
        """A file name in the folder that is not taken."""
        folder = Path(folder)
        folder.mkdir(parents=True, exist_ok=True)
        while True:
            path = folder / f"view_{self._shots:04d}{suffix}"
            if not path.exists():
                return path
            self._shots += 1

    def _distances(self, vertices, poses):
        found = np.full(len(vertices), np.inf)
        for name, tree in self._trees.items():
            np.minimum(found, tree.unsigned(bone_coordinates(vertices, poses[name])), out=found)
        return found

    def _values(self, name, vertices, faces, poses, carried, volume_error):
        """One number a vertex for the present colouring, or None where it cannot be known."""
        if self.colouring == "penetration":
            return surface_depth(vertices, self.probes, poses)
        if self.colouring == "distance":
            return self._distances(vertices, poses)
        if self.colouring == "stretch" and carried is not None:
            return self._stretch(name, vertices, *carried)
        if self.colouring == "volume":
            return np.full(len(vertices), volume_error)
        return None

    def _stretch(self, name, vertices, carried, faces):
        edges, rest = self._rest_edges(name, carried, faces)
        change = edge_lengths(carried, edges) / rest - 1.0
        total, count = np.zeros(len(carried)), np.zeros(len(carried))
        for end in edges.T:
            np.add.at(total, end, change)
            np.add.at(count, end, 1.0)
        mean = total / np.maximum(count, 1.0)
        return mean[cKDTree(carried).query(vertices)[1]]

    def _rest_edges(self, name, carried, faces):
        raise NotImplementedError
