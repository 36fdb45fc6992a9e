"""A bone: a rigid body with a mesh, its distances and points on it."""

from dataclasses import dataclass, field, fields
from functools import cached_property

import numpy as np
import trimesh

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.geometry.solids import SolidDistance
from rbfmuscle.scene.content import Compared
from rbfmuscle.validation import check_mesh

SURFACE_POINTS = 2000  # about how many points cover a bone: 4.5 mm apart on a femur


class BoneDistance(SolidDistance):
    """One bone, prepared once in its own coordinates; it may have holes and several shells."""

    def __init__(self, name: str, mesh: trimesh.Trimesh) -> None:
        super().__init__(*check_mesh(mesh.vertices, mesh.faces, name=name))
        self.name = name
        self.bounds = np.array([self.vertices.min(axis=0), self.vertices.max(axis=0)])


@dataclass(eq=False)
class Bone(Compared):
    """A rigid body: its mesh (outward, rest pose), where it came from, what was mended."""

    not_compared = ("source",)

    name: str
    mesh: trimesh.Trimesh = field(repr=False)
    source: str = ""
    closed: bool = True
    notes: list[str] = field(default_factory=list)
    doubt: str = ""  # why it is not known what is inside

    def __getstate__(self) -> dict[str, object]:
        """What is computed on demand is not copied, nor sent to other processes."""
        return {each.name: getattr(self, each.name) for each in fields(self)}

    @cached_property
    def bounds(self) -> Floats:
        """Box (2, 3) about the mesh."""
        return np.array(self.mesh.bounds)

    @cached_property
    def exact(self) -> BoneDistance:
        """Exact distances to the bone at rest, for checks and metrics alike."""
        return BoneDistance(self.name, self.mesh)

    def distances(self, points: Floats) -> Floats:
        """Distances (n,) of points (n, 3) to the outer surface, negative inside."""
        return self.exact.signed(points)

    def nearest(self, points: Floats) -> tuple[Floats, Floats]:
        """Distances (n,) to the outer surface, negative inside, and the nearest places (n, 3) on
        it, of points (n, 3).
        """
        distances, places, _ = self.exact.nearest(points)
        return np.where(self.exact.inside(points), -1.0, 1.0) * np.abs(distances), places

    @cached_property
    def surface_points(self) -> Floats:
        """Points (n, 3) that cover the mesh evenly, one in each cell of a grid."""
        from trimesh.remesh import subdivide_to_size

        cell = float(np.sqrt(self.mesh.area / SURFACE_POINTS))
        points, _ = subdivide_to_size(self.mesh.vertices, self.mesh.faces, cell, max_iter=30)
        kept = np.unique(np.floor(points / cell), axis=0, return_index=True)[1]
        return np.ascontiguousarray(points[kept], dtype=float)
