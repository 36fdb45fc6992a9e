"""From a field to a closed triangle mesh of wanted volume, cut by bones.

The surface is the zero set of F = max(f - s, -d): f the field (negative inside), s the level, d the
distance to the bones (negative inside them). Marching cubes give its topology, and Newton steps put
each vertex onto the zero set.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from rbfmuscle.geometry.arrays import Booleans, Floats, Integers
from rbfmuscle.geometry.mesh_distance import Cut, Field
from rbfmuscle.geometry.point_grid import Obstacles, push_off
from rbfmuscle.geometry.surfaces import change_to_volume, label_sheets, mesh_volume
from rbfmuscle.validation import check_finite, check_points, check_positive

# More nodes than this are refused; so many are evaluated at a time.
MAX_NODES, SLAB = 50_000_000, 500_000
# Values nearer to zero than this share of their mean are moved away from it: no vertex then lies on
# a node.
LEAST_VALUE = 1e-6
# Cells along the longest side of the points when stray sheets are looked for, and the share of it
# added on every side.
SEARCHED, MARGIN = 64, 0.075
# Newton steps towards the zero set, at most.
NEWTON = 6
# A vertex farther than this from the cut, in cells, stays clear of it.
NEAR_CUT = 1.2
# Cells beyond which a lower bound of the distance to the cut will do: no vertex gets there.
REACH = 1.25


@dataclass(frozen=True)
class Grid:
    """A regular grid of cubic cells.

    ``origin`` (3,) is the position of node (0, 0, 0), ``spacing`` the edge of a cell [scene unit],
    ``shape`` the number of nodes along each axis. Rows of ``axes`` (3, 3) are the grid's unit axes
    in world coordinates.
    """

    origin: np.ndarray
    spacing: float
    shape: tuple[int, ...]
    axes: np.ndarray

    @classmethod
    def around(
        cls,
        points: ArrayLike,
        *,
        resolution: int = 48,
        padding: int = 3,
        axes: ArrayLike | None = None,
    ) -> "Grid":
        """Grid around points (n, 3), with so many cells (at least 4) along their longest side.

        ``padding`` cells, at least 1, are added on each side. Rows of ``axes`` (3, 3), a rotation,
        are the grid's axes; those of the world by default. ValueError on no or coinciding points,
        numbers out of range, or too many nodes.
        """
        points = check_points(points)
        axes = np.eye(3) if axes is None else np.asarray(axes, dtype=np.float64)
        if axes.shape != (3, 3) or not np.abs(axes @ axes.T - np.eye(3)).max() < 1e-5:
            raise ValueError("axes must be a (3, 3) rotation")
        if int(resolution) < 4 or int(padding) < 1:
            raise ValueError(
                f"resolution must be >= 4 and padding >= 1, got {resolution} and {padding}"
            )
        if len(points) == 0:
            raise ValueError("points must hold at least one point on the surface")
        along = points @ axes.T
        low, high = along.min(axis=0), along.max(axis=0)
        spacing = float((high - low).max()) / int(resolution)
        if not spacing > 0:
            raise ValueError("points must not all coincide: the grid's size is taken from them")
        cells = np.maximum(np.ceil((high - low) / spacing - 1e-9).astype(int), 1) + 2 * int(padding)
        if np.prod(cells + 1.0) > MAX_NODES:
            raise ValueError(f"a grid of {cells} cells is too large; lower the resolution")
        corner = 0.5 * (low + high) - 0.5 * spacing * cells
        return cls(corner @ axes, spacing, tuple(int(n) + 1 for n in cells), axes)

    def positions(self, coordinates: Floats) -> Floats:
        """World positions (n, 3) of grid coordinates, in cells from the origin."""
        return coordinates @ (self.spacing * self.axes) + self.origin

    def evaluate(self, function: Callable[[Floats], Floats]) -> NDArray[np.float32]:
        """Values of a function of points (n, 3) at the nodes, in single precision as marching cubes
        has them.
        """
        values = np.empty(int(np.prod(self.shape)), dtype=np.float32)
        for low in range(0, len(values), SLAB):
            nodes = np.arange(low, min(low + SLAB, len(values)))
            points = self.positions(np.stack(np.unravel_index(nodes, self.shape), 1))
            values[nodes] = function(points)
            if np.isnan(values[nodes]).any():
                where = points[np.argmax(np.isnan(values[nodes]))]
                raise ValueError(
                    f"field or cut is NaN at {where}; check the fit and the bone fields"
                )
        return values.reshape(self.shape)


class LevelSet:
    """Triangles of the zero set of max(field - level, -cut) on a grid; the field is negative
    inside.
    """

    def __init__(self, grid: Grid, field: Field, cut: Cut | None = None) -> None:
        self.grid = grid
        self.field = field
        self.cut = cut
        self._f = grid.evaluate(field)
        self._c = None
        if cut is not None:
            self._c = grid.evaluate(lambda points: cut(points, REACH * grid.spacing)[0])

    def march(self, level: float) -> tuple[Floats, Integers]:
        """Vertices (n, 3) in grid coordinates and outward triangles (m, 3), if any, closed but on
        the grid's border.
        """
        from skimage.measure import marching_cubes

        value = self._f - np.float32(level)
        if self._c is not None:
            value = np.maximum(value, -self._c)
        inside = value < 0.0
        if inside.all() or not inside.any():
            return np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64)
        least = LEAST_VALUE * np.abs(value[np.isfinite(value)]).mean()
        value = np.where(inside, np.minimum(value, -least), np.maximum(value, least))
        vertices, faces, _, _ = marching_cubes(value, 0.0)
        return vertices.astype(np.float64), faces.astype(np.int64)

    def on_border(self, coordinates: Floats) -> Booleans:
        """Mask (n,) of the vertices on the border of the grid, where a surface leaves it."""
        return np.any(
            (coordinates <= 0.0) | (coordinates >= np.array(self.grid.shape) - 1.0), axis=1
        )


class Sheets(NamedTuple):
    """Sheets of a level set beside a surface.

    ``stray`` counts those, beside the one nearest to most points, that stand off the surface by
    more than a cell; ``is_open`` says whether a sheet leaves the box, ``found`` whether there is
    any.
    """

    stray: int
    is_open: bool
    found: bool

    def sound(self) -> bool:
        """Whether there are sheets, all of them closed and on the surface."""
        return self.found and not self.is_open and self.stray == 0


def find_sheets(field: Field, points: Floats, distance: Callable[[Floats], Floats]) -> Sheets:
    """Sheets of a field's zero set (negative inside) in a box around a surface, 7.5 % larger than
    it on every side.

    Points (n, 3) of the surface give the box [length]; ``distance`` maps points (n, 3) to their
    distances (n,) from the surface, signed or not. Where a muscle is thinner than a cell, its own
    sheet falls into pieces on the grid: these lie within a cell of it and do not count.
    """
    axes = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2]
    grid = Grid.around(points, resolution=SEARCHED, padding=round(MARGIN * SEARCHED), axes=axes)
    level_set = LevelSet(grid, field)
    coordinates, faces = level_set.march(0.0)
    if len(faces) == 0:
        return Sheets(0, False, False)
    vertices = grid.positions(coordinates)
    number, label, own = nearest_sheet(vertices, faces, points)
    off = np.zeros(number)
    np.maximum.at(off, label, np.abs(distance(vertices)))
    stray = int((off > grid.spacing).sum() - (off[own] > grid.spacing))
    return Sheets(stray, bool(level_set.on_border(coordinates).any()), True)


def nearest_sheet(vertices: Floats, faces: Integers, points: Floats) -> tuple[int, Integers, int]:
    """Number of connected sheets, the sheet (n,) of each vertex, and the sheet that lies nearest to
    most points.
    """
    number, label = label_sheets(faces, len(vertices))
    return number, label, int(np.bincount(label[cKDTree(vertices).query(points)[1]]).argmax())


@dataclass(frozen=True)
class ExtractedSurface:
    """A closed outward mesh: vertices (n, 3) in the world [scene unit], faces (m, 3), and the
    volume that it holds.

    ``level`` is that of the field that was extracted, ``components`` the number of sheets in the
    box, of which all but the one nearest to the points are left out.
    """

    vertices: np.ndarray
    faces: np.ndarray
    level: float
    volume: float
    components: int


def extract_surface(
    field: Field,
    *,
    points: ArrayLike,
    resolution: int = 48,
    cut: Cut | None = None,
    volume: float | None = None,
    level: float = 0.0,
    axes: ArrayLike | None = None,
    obstacles: Obstacles | None = None,
) -> ExtractedSurface:
    """Extract the zero set of max(field - level, -cut) as a closed mesh; the field is negative
    inside.

    Predicted surface ``points`` (n, 3) [scene unit] give the grid, with ``resolution`` cells along
    the longest side of their box, and which sheet is the surface's. ``cut`` gives distances,
    negative inside what is to be cut away. The level is moved from ``level`` until the mesh has the
    ``volume``, if one is wanted, to 1e-9. Rows of ``axes`` (3, 3), a rotation, are the grid's axes:
    in a frame that moves with the scene the mesh does too. ``obstacles`` are vertices of the bones
    behind ``cut``, each in its own coordinates with its pose: triangles whose chords cut across a
    convex bone are moved until no vertex is inside the mesh by more than 1 % of a cell.

    ValueError on bad arguments, NaN in field or cut, an empty level set, or one that is not closed
    within twice the box of the points; on a volume that no level reaches.
    """
    points = check_points(points)
    level = float(level)
    check_finite(np.array([level]), name="level")
    target = None if volume is None else check_positive(volume, name="volume")
    padding, most = 3, int(resolution) // 2
    while True:
        grid = Grid.around(points, resolution=resolution, padding=padding, axes=axes)
        surface = _reach_volume(LevelSet(grid, field, cut), points, target, level, obstacles or [])
        if surface is not None:
            return surface
        if padding >= most:
            raise ValueError(
                "the level set is open: it leaves twice the box of the points; "
                "check normals (all outward?), or fit with more centres"
            )
        padding = min(4 * padding, most)


class Projector:
    """Vertices (n, 3) on their way to the zero set of max(f - level, -d).

    ``spacing`` is the length of cells. ``slope`` (n,) is 1 / |grad f|, 0 for vertices that stay
    when the level changes.
    """

    def __init__(self, level_set: LevelSet, vertices: Floats) -> None:
        self.vertices = vertices
        self.spacing = level_set.grid.spacing
        self._field = level_set.field
        self._cut = level_set.cut
        # Which vertices lie on the cut, or may come there by a shift by a cell.
        self._near_cut = np.zeros(len(vertices), dtype=np.bool_)
        if self._cut is not None:
            distance, _ = self._cut(vertices, REACH * self.spacing)
            self._near_cut = distance < NEAR_CUT * self.spacing
        self.slope = np.zeros(len(vertices))
        self._direction = np.zeros_like(vertices)

    def project(self, level: float) -> None:
        """Newton steps until they are shorter than 1e-4 of a cell."""
        todo = np.arange(len(self.vertices))
        on_field = np.ones(len(self.vertices), dtype=bool)
        for _ in range(NEWTON):
            f, gradient = self._field.value_and_gradient(self.vertices[todo])
            square = np.maximum(np.einsum("nd,nd->n", gradient, gradient), 2.3e-308)
            self.slope[todo] = 1.0 / np.sqrt(square)
            self._direction[todo] = gradient / square[:, None]
            step = (level - f)[:, None] * self._direction[todo]
            self._turn_to_cut(todo, (f - level) * self.slope[todo], step, on_field)
            length = np.sqrt(np.einsum("nd,nd->n", step, step))
            share = np.minimum(1.0, self.spacing / np.maximum(length, 1e-300))
            self.vertices[todo] += share[:, None] * step
            # Newton squares the error: what moved by less than 1 % of a cell is there.
            todo = todo[length > 1e-2 * self.spacing]
            if len(todo) == 0:
                break
        self._hold(~on_field)

    def _turn_to_cut(
        self, todo: Integers, height: Floats, step: Floats, on_field: Booleans
    ) -> None:
        """Replace the steps of vertices that lie on the cut; marks which lie on the field's own
        surface.
        """
        rows = np.flatnonzero(self._near_cut[todo])
        if self._cut is None or len(rows) == 0:
            return
        where = self.vertices[todo[rows]]
        distance, outward = self._cut(where, -height[rows])
        on_cut = height[rows] < -distance
        on_field[todo[rows]] = ~on_cut
        step[rows[on_cut]] = _way_out(distance[on_cut], outward[on_cut])

    def _hold(self, rows: Integers | Booleans) -> None:
        """Let vertices stay where they are when the level changes."""
        self._direction[rows] = 0.0
        self.slope[rows] = 0.0

    def volume_step(self, faces: Integers, target: float, steps: int = 1) -> float:
        """Change of level that brings the mesh to a volume, a cubic polynomial of the change, by
        Newton steps.
        """
        change = change_to_volume(self.vertices, faces, self._direction, target, steps)
        if np.isnan(change):
            raise ValueError(f"no level gives a volume of {target:g}: the cut leaves no surface")
        return change

    def push_off(self, faces: Integers, obstacles: Obstacles) -> None:
        """Move vertices around points that came through faces (m, 3), which leave the level."""
        for _ in range(2):
            moved = np.zeros(len(self.vertices), dtype=np.bool_)
            for grid, pose in obstacles:
                push_off(self.vertices, faces, grid, pose, self.spacing, moved)
            rows = np.flatnonzero(moved)
            self._hold(rows)
            if self._cut is None or len(rows) == 0:
                break
            # What was pushed off one bone vertex must not end in the bone beside it.
            where = self.vertices[rows]
            distance, outward = self._cut(where, np.zeros(len(rows)))
            inside = distance < 0.0
            self.vertices[rows[inside]] += _way_out(distance[inside], outward[inside])

    def shift(self, step: float) -> None:
        """Move the vertices as the level set moves with its level, to first order."""
        self.vertices = self.vertices + step * self._direction


def _way_out(distance: Floats, outward: Floats) -> Floats:
    """Newton steps (k, 3) onto the cut from its distances (k,) and gradients (k, 3)."""
    size = np.maximum(np.einsum("ij,ij->i", outward, outward), np.finfo(float).tiny)
    return -(distance / size)[:, None] * outward


def _reach_volume(
    level_set: LevelSet, points: Floats, target: float | None, level: float, obstacles: Obstacles
) -> ExtractedSurface | None:
    """Mesh at the level that gives the target volume; None where the surface leaves the grid."""
    spacing = level_set.grid.spacing
    for _ in range(20):
        found = _sheet_at(level_set, points, level)
        if found is None:
            return None
        vertices, faces, components = found
        projector = Projector(level_set, vertices)
        projector.project(level)
        step = 0.0 if target is None else projector.volume_step(faces, target)
        for _ in range(4):
            # Small steps move the vertices along the gradient; a large one needs another mesh.
            moved = np.abs(step * projector.slope).max()
            if moved > 0.25 * spacing:
                break
            level += step
            projector.shift(step)
            if target is None or moved < 2e-3 * spacing:
                return _finish(projector, faces, target, level, components, obstacles)
            projector.project(level)
            step = projector.volume_step(faces, target)
        largest = np.abs(projector.slope).max()
        level += float(np.clip(step, -spacing / largest, spacing / largest))
    raise ValueError(
        f"no level gives a volume of {target:g}; is it the volume of the surface fitted?"
    )


def _finish(
    projector: Projector,
    faces: Integers,
    target: float | None,
    level: float,
    sheets: int,
    bones: Obstacles,
) -> ExtractedSurface:
    projector.push_off(faces, bones)
    if target is not None:
        step = projector.volume_step(faces, target, steps=3)
        level += step
        projector.shift(step)
    vertices = projector.vertices
    check_finite(vertices, name="extracted vertices")
    return ExtractedSurface(vertices, faces, level, mesh_volume(vertices, faces), sheets)


def _sheet_at(
    level_set: LevelSet, points: Floats, level: float
) -> tuple[Floats, Integers, int] | None:
    """The sheet that lies nearest to most points: vertices, faces, and the number of sheets; None
    where it is open.
    """
    coordinates, faces = level_set.march(level)
    if len(faces) == 0:
        raise ValueError(
            f"the level set is empty: field - {level:g} has one sign in the whole box of the "
            "points; "
            "check the points' place, the sign of the field, the level and the volume"
        )
    vertices = level_set.grid.positions(coordinates)
    sheets, label, own = nearest_sheet(vertices, faces, points)
    used = label == own
    if level_set.on_border(coordinates[used]).any():
        return None
    number = np.cumsum(used) - 1
    return vertices[used], number[faces[used[faces[:, 0]]]], sheets
