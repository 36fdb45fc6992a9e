"""A triangulation that goes with the material and is brought onto a level set: no grid, one topology.

Marching cubes sees a sheet only where a node of its grid lies inside, so rims come and go with the grid, and sheets
that come within a cell of each other grow together. A triangulation of the rest surface that the muscle carries
along starts next to the level set, keeps its topology, and samples the same material in every frame. Vertices go
onto the zero set of max(f - s, -d) by Newton steps, the level s follows from the volume as for the marched mesh, and
what a fold of the field or the edge of a bone has turned inside out is smoothed.
"""

from dataclasses import dataclass

import numpy as np

from rbfmuscle.compiled.loop import compiled
from rbfmuscle.geometry.arrays import Array, Booleans, Floats, Integers
from rbfmuscle.geometry.fields import Cut, Field
from rbfmuscle.geometry.surfaces import mesh_volume, vertex_normals
from rbfmuscle.implicit.extraction.band import BandGrid
from rbfmuscle.implicit.extraction.material_mesh import MaterialMesh
from rbfmuscle.implicit.extraction.obstacles import CHORD, ObstaclePoints, faces_within, points_near_cells
from rbfmuscle.implicit.extraction.projection import CutBounds, Projector
from rbfmuscle.implicit.extraction.surface import ExtractedSurface
from rbfmuscle.validation import check_finite

# No vertex goes farther than this from where the material carries it, in mean edges; and where the field's slope
# has sunk to these shares of its slope at rest, not at all, or as far as it likes within that.
FARTHEST = 1.0
UNSURE, SURE = 0.3, 0.7
# What is within this many mean edges of the bones may come to lie on them.
NEAR_CUT = 1.5
# Rounds of smoothing for triangles that cross others, and how the smoothed region grows with them; as the way back to
# the volume can make others cross, all of it is done up to so many times.
UNTANGLE, GROWTH, AGAIN = 24, 4, 8
# Rounds before them in which what crosses is taken back to where the material is, by this share of the way.
RETURN, BACK = 12, 0.15
# What the material takes so many mean edges deep into a bone, or a bone sent so
# far away, is drawn as a skin over the place where it goes in: so many sweeps of smoothing first, and in each of some
# rounds after, each followed by the way out of the bone.
SUNK, STRAYED = 1.0, 1.5
FILL_SWEEPS, GATHER, GATHER_SWEEPS = 150, 4, 12
# Mean edges that a bone's vertex may lie within the surface; rounds of smoothing after which bones are looked at again.
PUSHED, CLEAR = 0.01, 2
# A level that moves vertices by less than this share of a mean edge is met, as what is left is of second order.
SETTLED = 0.01
# Rounds in which the volume is met and what that drove into a bone is brought out.
MEET = 4
# Where both sides of a muscle sink into a bone, the far one stays above it by this share of a mean edge.
LAMELLA = 0.02


@dataclass(frozen=True)
class FittedMesh(ExtractedSurface):
    """A material mesh on a level set.

    Attributes
    ----------
    left : int
        Vertices that were kept from a level set far from where the material carries them.
    smoothed : int
        Vertices that were smoothed, as triangles around them crossed others.
    crossing : int
        Triangles that still cross others.
    """

    left: int = 0
    smoothed: int = 0
    crossing: int = 0


def fit_material(
    mesh: MaterialMesh,
    vertices: Floats,
    field: Field,
    *,
    volume: float | None = None,
    level: float = 0.0,
    cut: Cut | None = None,
    obstacles: list[tuple[ObstaclePoints, Floats]] | None = None,
    axes: Floats | None = None,
) -> FittedMesh:
    """Bring a triangulation onto the zero set of max(field - level, -cut).

    Parameters
    ----------
    mesh : MaterialMesh
    vertices : (n, 3) ndarray
        Where the material carries them [scene unit].
    field, cut, volume, level, obstacles, axes
        As for `rbfmuscle.implicit.extraction.surface.extract_surface`.

    Returns
    -------
    FittedMesh

    Raises
    ------
    ValueError
        On NaN in field or cut, and where no level gives the volume.
    """
    fitting = _Fitting(mesh, vertices, field, cut, float(level))
    if volume is None:
        fitting.project()
    else:
        fitting.reach(volume)
    return fitting.finish(volume, obstacles, axes)


def carry_material(
    mesh: MaterialMesh,
    vertices: Floats,
    *,
    volume: float | None = None,
    cut: Cut | None = None,
    obstacles: list[tuple[ObstaclePoints, Floats]] | None = None,
    axes: Floats | None = None,
) -> FittedMesh:
    """A triangulation where the material is, out of the bones and blown up to a volume: for want of a level set.

    Parameters
    ----------
    mesh, vertices, volume, cut, obstacles, axes
        As for `fit_material`.

    Returns
    -------
    FittedMesh
        All of its vertices are ``left``.

    Raises
    ------
    ValueError
        Where so much of it is in the bones that nothing can be blown up to the volume.
    """
    fitting = _Fitting(mesh, vertices, None, cut, 0.0)
    fitting.inflate(volume)
    return fitting.finish(volume, obstacles, axes)


class _Fitting:
    """A material mesh on its way to a level set."""

    def __init__(
        self,
        mesh: MaterialMesh,
        vertices: Floats,
        field: Field | None,
        cut: Cut | None,
        level: float,
    ) -> None:
        self.mesh, self.carried, self.level = mesh, np.ascontiguousarray(vertices, dtype=np.float64), level
        self.field, self.cut = field, cut
        self.edge = mesh.edge(self.carried)
        self.sunk = np.zeros(len(vertices), dtype=np.bool_)
        self.outside = np.ones(len(vertices), dtype=np.bool_)
        self._start(cut)
        self.left, self.pushed = (
            np.zeros(len(vertices), dtype=np.bool_),
            np.zeros(len(vertices), dtype=np.bool_),
        )
        self.evaluations = 0
        self.reach_of = None
        if mesh.slope is not None and field is not None:
            self.projector.known = field.value_and_gradient(self.carried)
            self.projector.least = SURE * mesh.slope
            gradient = self.projector.known[1]
            share = np.sqrt(np.einsum("nd,nd->n", gradient, gradient)) / mesh.slope
            self.reach_of = FARTHEST * self.edge * np.clip((share - UNSURE) / (SURE - UNSURE), 0.0, 1.0)

    def _start(self, cut: Cut | None) -> None:
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

    def project(self) -> None:
        """Newton steps onto the level set, no farther from where the material is than the field is to be trusted."""
        projector = self.projector
        projector.project(self.level)
        self.evaluations += len(projector.vertices)
        if self.reach_of is None:
            return
        # A way to a bone from outside it, which the field asked for, is as long as the field is to be trusted.
        bounded = projector.on_field | (self.outside & (self.reach_of < FARTHEST * self.edge))
        _bound_loop(projector.vertices, self.carried, self.reach_of, bounded, self.left)
        rows = np.flatnonzero(self.left)
        if len(rows):
            self._lift(rows)

    def reach(self, volume: float) -> None:
        """Move the level until the mesh has the volume."""
        for _ in range(20):
            self.project()
            step = self.projector.volume_step(self.mesh.faces, volume)
            largest = np.abs(self.projector.slope).max()
            step = float(np.clip(step, -self.edge / largest, self.edge / largest))
            self.level += step
            self.projector.shift(step)
            if abs(step) * largest < SETTLED * self.edge:
                return
        raise ValueError(f"no level gives a volume of {volume:g}; is it the volume of the surface fitted?")

    def inflate(self, volume: float | None) -> None:
        """Out of the bones, and along the normals to the volume; every vertex counts as left."""
        projector, faces = self.projector, self.mesh.faces
        self.left[:] = True
        projector.lift()
        if volume is None:
            return
        for _ in range(20):
            projector.move_along(vertex_normals(projector.vertices, faces))
            step = float(np.clip(projector.volume_step(faces, volume), -0.5 * self.edge, 0.5 * self.edge))
            projector.shift(step)
            projector.lift()
            if abs(step) < 1e-3 * self.edge:
                break

    def finish(
        self,
        volume: float | None,
        obstacles: list[tuple[ObstaclePoints, Floats]] | None,
        axes: Floats | None,
    ) -> FittedMesh:
        """Bone vertices pushed off, crossings smoothed, the volume met: the mesh."""
        self.gather()
        self.push_off(obstacles, axes)
        smoothed, crossing = self.settle(volume, obstacles, axes)
        vertices, faces = self.projector.vertices, self.mesh.faces
        check_finite(vertices, name="fitted vertices")
        return FittedMesh(
            vertices, faces, self.level, mesh_volume(vertices, faces), 1, 0, self.edge,
            self.evaluations, int(self.left.sum()), smoothed, crossing,
        )  # fmt: skip

    def settle(
        self,
        volume: float | None,
        obstacles: list[tuple[ObstaclePoints, Floats]] | None,
        axes: Floats | None,
    ) -> tuple[int, int]:
        """The volume met and nothing smoothed since; vertices that were, and triangles that cross all the same."""
        smoothed = 0
        for turn in range(AGAIN):
            self.fill(volume)
            touched = self.untangle()
            if touched == 0:
                return smoothed, 0
            smoothed = max(smoothed, touched)
            if turn < CLEAR:
                # What was smoothed may lie over a bone's vertex again.
                self.push_off(obstacles, axes)
        self.fill(volume)
        return smoothed, int(self.mesh.tree.crossing(self.projector.vertices).sum())

    def fill(self, volume: float | None) -> None:
        """The volume, where one is to be met."""
        if volume is None:
            return
        if self.field is None:
            # What was smoothed or filled stays put otherwise, and that may be all of it.
            self.projector.move_along(vertex_normals(self.projector.vertices, self.mesh.faces))
            self.projector.lift()
        self.meet(volume)

    def meet(self, volume: float) -> None:
        """The volume to the last digit; what its last step drove into a bone is brought out and stays there."""
        for turn in range(MEET + 1):
            step = self.projector.volume_step(self.mesh.faces, volume, steps=4)
            self.level += step
            self.projector.shift(step)
            if turn == MEET or not self.projector.lift():
                break

    def gather(self) -> None:
        """Close the surface over what is deep in a bone: a sheet that is folded over it would cross itself."""
        projector = self.projector
        away = projector.vertices - self.carried
        strayed = np.einsum("nd,nd->n", away, away) > (STRAYED * self.edge) ** 2
        lost = np.asarray(self.sunk | strayed, dtype=np.bool_)
        if not lost.any():
            return
        rows = np.flatnonzero(self.mesh.around(lost, 1))
        for turn in range(GATHER):
            self.mesh.smooth(projector.vertices, rows, GATHER_SWEEPS if turn else FILL_SWEEPS)
            if self.field is None:
                self._lift(rows)
                continue
            part = projector.part(rows)
            part.project(self.level)
            projector.take(part, rows)

    def _lift(self, rows: Integers) -> None:
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

    def untangle(self) -> int:
        """Smooth what crosses itself; return how many vertices were moved for it."""
        projector, faces = self.projector, self.mesh.faces
        touched = np.zeros(len(self.carried), dtype=np.bool_)
        among: Booleans | None = None
        for turn in range(0 if self.field is None else -RETURN, UNTANGLE + 1):
            # What was not moved does not begin to cross; where nothing crosses, a quick look is enough.
            if among is None and not self.mesh.tree.crossing(projector.vertices, by_sheets=True).any():
                break
            bad = self.mesh.tree.crossing(projector.vertices, among)
            if turn == UNTANGLE or not bad.any():
                break
            marked = np.zeros(len(self.carried), dtype=np.bool_)
            marked[faces[bad].ravel()] = True
            region = self.mesh.around(marked, 1 + max(turn, 0) // GROWTH)
            among = np.asarray(region[faces].any(axis=1), dtype=np.bool_)
            touched |= region
            if turn < 0:
                self._return(np.flatnonzero(region))
            else:
                self._smooth(np.flatnonzero(region), self.field is not None and turn < UNTANGLE // 2)
        return int(touched.sum())

    def _return(self, rows: Integers) -> None:
        """Take vertices back towards where the material is, which smoothing would shorten; not those on bones."""
        projector = self.projector
        away = projector.vertices[rows] - self.carried[rows]
        strayed = np.einsum("nd,nd->n", away, away) > (STRAYED * self.edge) ** 2
        free = projector.on_field[rows] & ~strayed & ~self.pushed[rows]
        projector.vertices[rows[free]] -= BACK * away[free]
        self._lift(rows[free])

    def _smooth(self, rows: Integers, onto_field: bool) -> None:
        """Move vertices towards their neighbours, then back onto the surface, or out of the bones at least."""
        projector = self.projector
        before = projector.vertices[rows]
        self.mesh.smooth(projector.vertices, rows, 3)
        if not onto_field:
            self._lift(rows)
            return
        part = projector.part(rows)
        part.project(self.level)
        gone = np.einsum("nd,nd->n", part.vertices - before, part.vertices - before) > self.edge**2
        part.vertices[gone] = projector.vertices[rows[gone]]
        projector.take(part, rows)


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


@compiled(error_model="numpy")
def _bound_loop(vertices, carried, reach, bounded, left):
    """Bring back bounded vertices that went beyond their reach, and mark them."""
    for v in range(len(vertices)):
        square = 0.0
        for a in range(3):
            square += (vertices[v, a] - carried[v, a]) ** 2
        # NaN counts as beyond.
        left[v] = bounded[v] and not square <= reach[v] ** 2
        if left[v]:
            share = reach[v] / np.sqrt(square) if square < np.inf else 0.0
            for a in range(3):
                way = share * (vertices[v, a] - carried[v, a]) if share > 0.0 else 0.0
                vertices[v, a] = carried[v, a] + way
