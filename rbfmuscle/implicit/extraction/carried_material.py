"""A triangulation where the material takes it: how far the bones are there, and its ways out of them."""

import numpy as np

from rbfmuscle.geometry.arrays import Booleans, Floats, Integers
from rbfmuscle.geometry.fields import ClipDistance, Field
from rbfmuscle.geometry.surfaces import vertex_normals
from rbfmuscle.implicit.extraction.material_mesh import MaterialMesh
from rbfmuscle.implicit.extraction.obstacles import Obstacles
from rbfmuscle.implicit.extraction.projection import CutBounds, Projector

# What is within this many mean edges of the bones may come to lie on them.
NEAR_CUT = 1.5
# Greatest bound of the distance from them that is kept, in mean edges.
FAR = 100.0
# A triangle none of whose corners is so many spacings near a bone has no bone vertex behind it by a chord: no point
# of it is farther from a corner than its longest side over the root of three.
NEAR_BONE = 1.5
# What the material takes so many mean edges deep into a bone is sunk.
SUNK = 1.0
# Mean edges that a bone's vertex may lie within the surface.
PUSHED = 0.01
# Where both sides of a muscle sink into a bone, the far one stays above it by this share of a mean edge.
LAMELLA = 0.02


class CarriedMaterial:
    """A material mesh on its way from where the material takes it.

    Parameters
    ----------
    mesh : MaterialMesh
    vertices : (n, 3) ndarray
        Where the material carries them [scene unit].
    field : Field or None
    cut : ClipDistance or None
    level : float

    Attributes
    ----------
    carried : (n, 3) ndarray
        The vertices as given.
    projector : Projector
        Holds the vertices where they are now.
    edge : float
        Mean length of an edge [scene unit].
    sunk, outside, pushed, left : (n,) ndarray of bool
        What the material takes deep into a bone, what it leaves outside all bones, what a bone's vertex pushed off, and
        what was kept from a level set far from where the material takes it.
    """

    def __init__(
        self,
        mesh: MaterialMesh,
        vertices: Floats,
        field: Field | None,
        cut: ClipDistance | None,
        level: float,
    ) -> None:
        self.mesh, self.carried, self.level = mesh, np.ascontiguousarray(vertices, dtype=np.float64), level
        self.field, self.cut = field, cut
        self.edge = mesh.edge(self.carried)
        self.sunk, self.pushed, self.left = np.zeros((3, len(vertices)), dtype=np.bool_)
        self.outside = np.ones(len(vertices), dtype=np.bool_)
        self._start(cut)

    def _start(self, cut: ClipDistance | None) -> None:
        """A projector of the vertices where the material takes them, that knows how far the bones are there."""
        near, vertices = np.zeros(len(self.carried), dtype=np.bool_), self.carried.copy()
        if cut is None:
            self.projector = Projector(self.field, None, vertices, self.edge, near)
            return
        limit = np.full(len(vertices), NEAR_CUT * self.edge)
        distance, outward = cut.value_and_gradient_below(self.carried, limit)
        near, self.outside = distance < limit, distance >= 0.0
        self.projector = Projector(self.field, cut if near.any() else None, vertices, self.edge, near)
        if np.isfinite(cut.steepest):
            self.projector.bounds = CutBounds(
                self.carried, np.minimum(distance, FAR * self.edge), cut.steepest
            )
        if near.any():
            self.projector.clearance = self._clearance(near, distance, outward)

    def _clearance(self, near: Booleans, distance: Floats, outward: Floats) -> Floats:
        """How far from the bones vertices that sink into them end: those that look away keep off the others."""
        normals, clearance = vertex_normals(self.carried, self.mesh.faces), np.zeros(len(self.carried))
        away = near & (np.einsum("nd,nd->n", normals, outward) > 0.0)
        clearance[away] = LAMELLA * self.edge
        self.sunk = near & (distance < -SUNK * self.edge)
        return clearance

    def lift(self, rows: Integers) -> None:
        """Bring vertices out of the bones, where they stay."""
        part = self.projector.part(rows)
        part.lift()
        part.hold(slice(None))
        self.projector.take(part, rows)

    def push_off(self, obstacles: Obstacles | None) -> None:
        """Move the corners of triangles that a bone's vertices came through."""
        if not obstacles:
            return
        vertices, faces = self.projector.vertices, self.mesh.faces
        # So large that no corner is farther than 1.3 of it from its triangle's middle.
        spacing = max(self.edge, 0.52 * self.mesh.longest(vertices))
        if self.projector.bounds is not None:
            near = self.projector.bounds.distance(vertices) < NEAR_BONE * spacing
            faces = faces[near[faces].any(axis=1)]
        if len(faces):
            self.pushed |= self.projector.push_off(faces, obstacles, self.level, spacing, PUSHED * self.edge)
