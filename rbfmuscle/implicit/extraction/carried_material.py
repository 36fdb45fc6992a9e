"""A triangulation where the material takes it: how far the bones are there, and its ways out of them."""

import numpy as np

from rbfmuscle.geometry.arrays import Array, Booleans, Floats, Integers
from rbfmuscle.geometry.fields import ClipDistance, Field
from rbfmuscle.geometry.surfaces import vertex_normals
from rbfmuscle.implicit.extraction.band import BandGrid
from rbfmuscle.implicit.extraction.material_mesh import MaterialMesh
from rbfmuscle.implicit.extraction.obstacles import CHORD, ObstaclePoints, faces_within, points_near_cells
from rbfmuscle.implicit.extraction.projection import CutBounds, Projector
from rbfmuscle.jit import compiled

# What is within this many mean edges of the bones may come to lie on them.
NEAR_CUT = 1.5
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
    cut : Cut or None
    level : float

    Attributes
    ----------
    carried : (n, 3) ndarray
        The vertices as given.
    projector : Projector
        Holds the vertices where they are now.
    edge : float
        Mean length of an edge [scene unit].
    sunk, outside, pushed : (n,) ndarray of bool
        What the material takes deep into a bone, what it leaves outside all bones, what a bone's vertex pushed off.
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
        self.sunk, self.pushed = np.zeros((2, len(vertices)), dtype=np.bool_)
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
            self.projector.bounds = CutBounds(self.carried, np.minimum(distance, limit), cut.steepest)
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

    def push_off(self, obstacles: list[tuple[ObstaclePoints, Floats]] | None, axes: Floats | None) -> None:
        """Move the corners of triangles that a bone's vertices came through."""
        if not obstacles:
            return
        vertices, faces = self.projector.vertices, self.mesh.faces
        # So large that no corner is farther than 1.3 cells from its triangle's middle.
        spacing = max(self.edge, 0.52 * self.mesh.longest(vertices))
        size = float(np.ptp(vertices, axis=0).max())
        grid = BandGrid.around(vertices, resolution=max(int(size / spacing), 4), padding=2, axes=axes)
        if self.projector.bounds is not None:
            distance = self.projector.bounds.distance(vertices)
            faces = faces[faces_within(vertices, faces, distance, 1.1 * CHORD * grid.spacing)]
            if len(faces) == 0:
                return
        state = np.zeros(int(np.prod(grid.shape)), dtype=np.uint8)
        cells = _touched_cells(grid, vertices, faces, state)
        points = points_near_cells(obstacles, grid, state, cells)
        if self.field is not None:
            points = points[self.field(points) - self.level < CHORD * grid.spacing]
        before = vertices.copy()
        self.projector.push_off(faces, points, grid, PUSHED * self.edge)
        self.pushed |= (self.projector.vertices != before).any(axis=1)


def _touched_cells(grid: BandGrid, vertices: Floats, faces: Integers, state: Array) -> Integers:
    """Mark the cells that hold vertices or middles of triangles, and those beside them; their flat numbers."""
    corners = vertices[faces]
    holders = grid.cells(np.concatenate([corners.reshape(-1, 3), corners.mean(axis=1)]))
    cells = np.empty(len(state), dtype=np.int64)
    return cells[: _touch_loop(np.unique(holders), grid.strides, state, cells)]


@compiled(error_model="numpy")
def _touch_loop(holders, strides, state, cells):
    """Mark cells and their neighbours, each once; returns how many."""
    count = 0
    for cell in holders:
        for i in range(-1, 2):
            for j in range(-1, 2):
                for k in range(-1, 2):
                    near = cell + i * strides[0] + j * strides[1] + k * strides[2]
                    if 0 <= near < len(state) and state[near] == 0:
                        state[near] = 1
                        cells[count] = near
                        count += 1
    return count
