"""From a field to a closed triangle mesh of wanted volume, cut by bones.

The surface is the zero set of F = max(f - s, -d): f the field (negative inside), s the level, d the distance
to the bones (negative inside them). A band follows it through the grid, marching cubes gives its topology,
and Newton steps put each vertex onto the zero set itself: all that is left of the grid is the chords.
"""

from dataclasses import dataclass

import numba
import numpy as np

from rbfmuscle.implicit.band import Band, BandGrid
from rbfmuscle.implicit.obstacles import CHORD, points_near_cells, push_off_points
from rbfmuscle.validation import check_finite, check_points, check_positive


@dataclass(frozen=True)
class ExtractedSurface:
    """A closed outward mesh and how it came about.

    Attributes
    ----------
    vertices : (n, 3) ndarray
        World positions [scene unit].
    faces : (m, 3) ndarray
    level : float
        Level s of the field that was extracted.
    volume : float
        Enclosed by the mesh [scene unit cubed].
    components : int
        Sheets found in the cells that were visited.
    spurious : int
        Sheets found but left out, open ones included.
    spacing : float
        Edge of a grid cell.
    evaluations : int
        Grid nodes at which the field was evaluated.
    """

    vertices: np.ndarray
    faces: np.ndarray
    level: float
    volume: float
    components: int
    spurious: int
    spacing: float
    evaluations: int


def extract_surface(
    field, *, points, resolution=48, cut=None, volume=None, level=0.0, keep="largest", search="band",
    axes=None, obstacles=None, obstacle_tolerance=None,
):  # fmt: skip
    """Extract the zero set of max(field - level, -cut) as a closed mesh.

    Parameters
    ----------
    field : callable
        ``(n, 3) -> (n,)`` values, negative inside. Its method ``value_and_gradient`` is used if it has one.
    points : (n, 3) array_like
        Predicted surface points, where the search starts; also give the grid's extent [scene unit].
    resolution : int
        Grid cells along the longest side of the points' box.
    cut : callable, optional
        ``(n, 3) -> (n,)`` distances, negative inside what is to be cut away; beyond 1.2 cells any lower
        bound of more than that will do. ``value_and_gradient`` as above.
    volume : float, optional
        Wanted volume of the mesh; the level is then moved from ``level`` until the mesh has it, to 1e-9.
    level : float
        Level of the field, or the first guess of it.
    keep : {"largest", "all"}
        The closed sheet of largest volume, or all of them.
    search : {"band", "box"}
        Follow the surface from the points, or visit the whole box (finds every spurious sheet in it).
    axes : (3, 3) array_like, optional
        Rotation whose rows are the grid's axes. In a frame that moves with the scene the mesh does too.
    obstacles : list of pairs of ObstaclePoints and (4, 4) ndarrays, optional
        Vertices of the bones behind ``cut``, each bone in its own coordinates with its pose: triangles whose
        chords cut across a convex bone are moved until no vertex is inside the mesh by more than the tolerance.
    obstacle_tolerance : float, optional
        By default 1 % of a grid cell [scene unit].

    Returns
    -------
    ExtractedSurface

    Raises
    ------
    ValueError
        On bad arguments, NaN in field or cut, an empty level set, or one that is not closed within three
        times the box of the points; on a volume that no level reaches.
    """
    points = check_points(points)
    level = float(level)
    check_finite(np.array([level]), name="level")
    if keep not in ("largest", "all") or search not in ("band", "box"):
        raise ValueError(f"keep must be largest or all, search band or box, got {keep!r} and {search!r}")
    target = None if volume is None else check_positive(volume, name="volume")
    padding = 3
    while True:
        grid = BandGrid.around(points, resolution=resolution, padding=padding, axes=axes)
        band = Band(grid, field, cut)
        _start(band, points, level, search)
        tolerance = 0.01 * grid.spacing if obstacle_tolerance is None else float(obstacle_tolerance)
        surface = _reach_volume(band, target, level, keep, (obstacles or [], tolerance))
        if surface is not None:
            return surface
        if padding >= resolution:
            raise ValueError(
                "the level set is open: it leaves three times the box of the points; "
                "check normals (all outward?), or fit with more centres"
            )
        padding = min(4 * padding, int(resolution))


def _start(band, points, level, search):
    """Visit first cells until some are crossed."""
    if search == "box":
        band.visit_all()
    else:
        band.seed(points)
    band.grow(level)
    while not band.crosses(level):
        if not band.widen():
            raise ValueError(
                f"the level set is empty: field - {level:g} has one sign in the whole box of the points; "
                "check the points' place, the sign of the field and the level"
            )
        band.grow(level)


def _reach_volume(band, target, level, keep, obstacles):
    """Mesh at the level that gives the target volume; None where the surface leaves the grid."""
    spacing = band.grid.spacing
    for _ in range(20):
        if target is not None and not band.crosses(level):
            raise ValueError(f"no level gives a volume of {target:g}: the level set is empty at {level:g}")
        band.grow(level)
        found = _closed_sheets(band, level, keep)
        if found is None:
            return None
        vertices, faces, near_cut, components, spurious = found
        projector = _Projector(band.field, band.cut, vertices, spacing, near_cut)
        projector.project(level)
        if target is None:
            break
        step = projector.volume_step(faces, target)
        for _ in range(4):
            # Small steps move the vertices along the gradient; a large one needs another mesh.
            if np.abs(step * projector.slope).max() > 0.25 * spacing:
                break
            level += step
            projector.shift(step)
            if np.abs(step * projector.slope).max() < 2e-3 * spacing:
                return _finish(band, projector, faces, target, level, components, spurious, obstacles)
            projector.project(level)
            step = projector.volume_step(faces, target)
        largest = np.abs(projector.slope).max()
        level += float(np.clip(step, -spacing / largest, spacing / largest))
    else:
        raise ValueError(f"no level gives a volume of {target:g}; is it the volume of the surface fitted?")
    return _finish(band, projector, faces, target, level, components, spurious, obstacles)


def _finish(band, projector, faces, target, level, components, spurious, obstacles):
    bones, tolerance = obstacles
    if bones:
        points = points_near_cells(bones, band.grid, band.state)
        points = points[band.field(points) - level < CHORD * band.grid.spacing]
        projector.push_off(faces, points, band.grid, tolerance)
    if target is not None:
        for _ in range(3):
            step = projector.volume_step(faces, target)
            level += step
            projector.shift(step)
    vertices = projector.vertices
    check_finite(vertices, name="extracted vertices")
    return ExtractedSurface(
        vertices,
        faces,
        level,
        mesh_volume(vertices, faces),
        components,
        spurious,
        band.grid.spacing,
        band.node_count,
    )


def _closed_sheets(band, level, keep):
    """Vertices, faces, which are near the cut, number of sheets and of those left out; None where open."""
    coordinates, faces, on_border, near_cut = band.march(level)
    label, sheets = _label_sheets_loop(faces, len(coordinates))
    volume = np.bincount(
        label[faces[:, 0]], _volume_terms(coordinates - coordinates.mean(axis=0), faces), sheets
    )
    size = np.bincount(label, minlength=sheets)
    is_open = np.bincount(label, on_border, sheets) > 0
    closed = np.flatnonzero(~is_open)
    if len(closed) == 0 or (is_open.any() and size[is_open].max() > size[closed].max()):
        return None
    if keep == "all":
        chosen = ~is_open
    else:
        chosen = np.zeros(sheets, dtype=bool)
        chosen[closed[np.argmax(volume[closed])]] = True
    used = chosen[label]
    number = np.cumsum(used) - 1
    faces = number[faces[used[faces[:, 0]]]]
    vertices = band.grid.positions(coordinates[used])
    return vertices, faces, near_cut[used], sheets, sheets - int(chosen.sum())


@numba.njit(cache=True, nogil=True)
def _label_sheets_loop(faces, size):
    """Connected sheets of a triangle mesh: label of each vertex, and their number."""
    parent = np.arange(size)
    for f in range(len(faces)):
        a = faces[f, 0]
        while parent[a] != a:
            parent[a] = parent[parent[a]]
            a = parent[a]
        for k in range(1, 3):
            b = faces[f, k]
            while parent[b] != b:
                parent[b] = parent[parent[b]]
                b = parent[b]
            if a < b:
                parent[b] = a
            elif b < a:
                parent[a] = b
                a = b
    label = np.empty(size, dtype=np.int64)
    count = 0
    for v in range(size):
        # Parents come before their children, so their labels are known.
        if parent[v] == v:
            label[v] = count
            count += 1
        else:
            label[v] = label[parent[v]]
    return label, count


def _volume_terms(vertices, faces):
    """Signed volume of the tetrahedron under each triangle, (m,)."""
    out = np.empty(len(faces))
    _volume_loop(vertices, faces, out)
    return out


@numba.njit(cache=True, nogil=True)
def _volume_loop(x, faces, out):
    for f in range(len(faces)):
        i, a, b = faces[f, 0], faces[f, 1], faces[f, 2]
        out[f] = (
            x[i, 0] * (x[a, 1] * x[b, 2] - x[a, 2] * x[b, 1])
            + x[i, 1] * (x[a, 2] * x[b, 0] - x[a, 0] * x[b, 2])
            + x[i, 2] * (x[a, 0] * x[b, 1] - x[a, 1] * x[b, 0])
        ) / 6.0


@numba.njit(cache=True, nogil=True)
def _volume_and_rate_loop(x, faces, origin, direction):
    """Enclosed volume, and its rate of change as the vertices move along their directions."""
    volume, rate = 0.0, 0.0
    p, d = np.empty((3, 3)), np.empty((3, 3))
    for f in range(len(faces)):
        for k in range(3):
            for a in range(3):
                p[k, a] = x[faces[f, k], a] - origin[a]
                d[k, a] = direction[faces[f, k], a]
        for k in range(3):
            a, b = (k + 1) % 3, (k + 2) % 3
            nx = p[a, 1] * p[b, 2] - p[a, 2] * p[b, 1]
            ny = p[a, 2] * p[b, 0] - p[a, 0] * p[b, 2]
            nz = p[a, 0] * p[b, 1] - p[a, 1] * p[b, 0]
            rate += d[k, 0] * nx + d[k, 1] * ny + d[k, 2] * nz
            if k == 0:
                volume += p[0, 0] * nx + p[0, 1] * ny + p[0, 2] * nz
    return volume / 6.0, rate / 6.0


def mesh_volume(vertices, faces):
    """Volume enclosed by a closed outward mesh."""
    return float(_volume_terms(vertices - vertices.mean(axis=0), faces).sum())


class _Projector:
    """Vertices on their way to the zero set of max(f - level, -d).

    ``near_cut`` (n,) marks the vertices that may lie on or come to the cut.
    """

    def __init__(self, field, cut, vertices, spacing, near_cut):
        self.vertices = vertices
        self.spacing = spacing
        self._field = with_gradient(field, 1e-4 * spacing)
        self._cut_value = cut
        self._cut = None if cut is None else with_gradient(cut, 1e-4 * spacing)
        self._near_cut = near_cut
        self.slope = np.zeros(len(vertices))
        self._direction = np.zeros_like(vertices)

    def project(self, level, rounds=6):
        """Newton steps until they are shorter than 1e-4 of a cell."""
        on_field = np.ones(len(self.vertices), dtype=bool)
        todo = np.arange(len(self.vertices))
        for _ in range(rounds):
            x = self.vertices[todo]
            f, gradient = self._field(x)
            step, slope = np.empty_like(x), np.empty(len(x))
            _newton_loop(f, np.ascontiguousarray(gradient), level, todo, step, slope, self._direction)
            self.slope[todo] = slope
            if self._cut_value is not None:
                self._turn_to_cut(x, todo, (f - level) * slope, step, on_field)
            # Newton squares the error: what moved by less than 1 % of a cell is there.
            unsettled = np.empty(len(x), dtype=np.bool_)
            _step_loop(todo, step, self.spacing, self.vertices, unsettled)
            todo = todo[unsettled]
            if len(todo) == 0:
                break
        self._direction[~on_field] = 0.0
        self.slope[~on_field] = 0.0

    def _turn_to_cut(self, x, todo, height, step, on_field):
        """Replace the steps of vertices that lie on the cut; marks which lie on the field's own surface."""
        rows = np.flatnonzero(self._near_cut[todo])
        if len(rows) == 0:
            return
        # The slope of a distance is one; it is worked out only where the cut is the surface.
        on_cut = height[rows] < -self._cut_value(x[rows])
        on_field[todo[rows]] = ~on_cut
        rows = rows[on_cut]
        if len(rows):
            distance, outward = self._cut(x[rows])
            size = np.maximum(np.einsum("ij,ij->i", outward, outward), np.finfo(float).tiny)
            step[rows] = -(distance / size)[:, None] * outward

    def volume_step(self, faces, target):
        """Change of level that would bring the mesh to the target volume, to first order."""
        volume, rate = _volume_and_rate_loop(
            self.vertices, faces, self.vertices.mean(axis=0), self._direction
        )
        lack = target - volume
        if lack == 0.0:
            return 0.0
        if not rate > 0:
            raise ValueError(f"no level gives a volume of {target:g}: the cut leaves no surface of the field")
        return lack / rate

    def push_off(self, faces, points, grid, tolerance):
        """Move the vertices around points that came through a triangle; these no longer follow the level."""
        for _ in range(2):
            moved = np.flatnonzero(push_off_points(self.vertices, faces, points, grid, tolerance))
            self._direction[moved] = 0.0
            self.slope[moved] = 0.0
            if self._cut_value is None or len(moved) == 0:
                break
            # What was pushed off one bone vertex must not end in the bone beside it.
            inside = moved[self._cut_value(self.vertices[moved]) < 0.0]
            if len(inside) == 0:
                break
            distance, outward = self._cut(self.vertices[inside])
            size = np.maximum(np.einsum("ij,ij->i", outward, outward), 1e-12)
            self.vertices[inside] -= (distance / size)[:, None] * outward

    def shift(self, step):
        """Move the vertices as the level set moves with its level, to first order."""
        self.vertices = self.vertices + step * self._direction


@numba.njit(cache=True, nogil=True)
def _newton_loop(f, gradient, level, rows, step, slope, direction):
    """Newton steps onto f = level, 1 / |g|, and the vertices' motions g / |g|^2 for a change of level."""
    for n in range(len(rows)):
        square = gradient[n, 0] ** 2 + gradient[n, 1] ** 2 + gradient[n, 2] ** 2
        square = max(square, 2.3e-308)
        slope[n] = 1.0 / np.sqrt(square)
        for a in range(3):
            direction[rows[n], a] = gradient[n, a] / square
            step[n, a] = (level - f[n]) * direction[rows[n], a]


@numba.njit(cache=True, nogil=True)
def _step_loop(rows, step, spacing, vertices, unsettled):
    """Take the steps, none longer than a cell."""
    for n in range(len(rows)):
        length = np.sqrt(step[n, 0] ** 2 + step[n, 1] ** 2 + step[n, 2] ** 2)
        share = min(1.0, spacing / max(length, 1e-300))
        for a in range(3):
            vertices[rows[n], a] += share * step[n, a]
        unsettled[n] = length > 1e-2 * spacing


def with_gradient(function, step):
    """``points -> (values, gradients)`` of a callable: its own, or central differences."""
    if hasattr(function, "value_and_gradient"):
        return function.value_and_gradient

    def differences(points):
        offsets = step * np.vstack([np.eye(3), -np.eye(3)])
        around = function((points[None] + offsets[:, None]).reshape(-1, 3)).reshape(6, -1)
        return function(points), ((around[:3] - around[3:]) / (2 * step)).T

    return differences
