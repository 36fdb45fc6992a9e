"""From a field to a closed triangle mesh of wanted volume, cut by bones.

The surface is the zero set of F = max(f - s, -d): f the field (negative inside), s the level, d the distance
to the bones (negative inside them). A band follows it through the grid, marching cubes gives its topology,
and Newton steps put each vertex onto the zero set itself: all that is left of the grid is the chords.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from rbfmuscle.geometry.arrays import Booleans, Floats, Integers
from rbfmuscle.geometry.fields import ClipDistance, Field
from rbfmuscle.geometry.surfaces import corner_from, mesh_volume, six_volumes
from rbfmuscle.implicit.extraction.band import Band, BandGrid
from rbfmuscle.implicit.extraction.obstacles import CHORD, points_near_cells
from rbfmuscle.implicit.extraction.projection import Projector
from rbfmuscle.jit import compiled
from rbfmuscle.validation import check_finite, check_points, check_positive

if TYPE_CHECKING:
    from rbfmuscle.implicit.extraction.obstacles import ObstaclePoints

    # Points of bones with their poses, and the tolerance.
    Obstacles = tuple[list[tuple[ObstaclePoints, Floats]], float]


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
    field: Field,
    *,
    points: ArrayLike,
    resolution: int = 48,
    cut: ClipDistance | None = None,
    volume: float | None = None,
    level: float = 0.0,
    axes: ArrayLike | None = None,
    obstacles: list[tuple[ObstaclePoints, Floats]] | None = None,
    obstacle_tolerance: float | None = None,
) -> ExtractedSurface:
    """Extract the zero set of max(field - level, -cut) as a closed mesh.

    Parameters
    ----------
    field : rbfmuscle.geometry.fields.Field
        Negative inside.
    points : (n, 3) array_like
        Predicted surface points, where the search starts; also give the grid's extent [scene unit].
    resolution : int
        Grid cells along the longest side of the points' box.
    cut : rbfmuscle.geometry.fields.Cut, optional
        Distances, negative inside what is to be cut away; beyond 1.2 cells any lower bound of more than that will do.
    volume : float, optional
        Wanted volume of the mesh; the level is then moved from ``level`` until the mesh has it, to 1e-9.
    level : float
        Level of the field, or the first guess of it.
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
    target = None if volume is None else check_positive(volume, name="volume")
    padding = 3
    while True:
        grid = BandGrid.around(points, resolution=resolution, padding=padding, axes=axes)
        band = Band(grid, field, cut)
        _start(band, points, level)
        tolerance = 0.01 * grid.spacing if obstacle_tolerance is None else float(obstacle_tolerance)
        surface = _reach_volume(band, target, level, (obstacles or [], tolerance))
        if surface is not None:
            return surface
        if padding >= resolution:
            raise ValueError(
                "the level set is open: it leaves three times the box of the points; "
                "check normals (all outward?), or fit with more centres"
            )
        padding = min(4 * padding, int(resolution))


def _start(band: Band, points: Floats, level: float) -> None:
    """Visit first cells until some are crossed."""
    band.seed(points)
    band.grow(level)
    while not band.crosses(level):
        if not band.widen():
            raise ValueError(
                f"the level set is empty: field - {level:g} has one sign in the whole box of the points; "
                "check the points' place, the sign of the field and the level"
            )
        band.grow(level)


def _reach_volume(
    band: Band, target: float | None, level: float, obstacles: Obstacles
) -> ExtractedSurface | None:
    """Mesh at the level that gives the target volume; None where the surface leaves the grid."""
    spacing = band.grid.spacing
    for _ in range(20):
        if target is not None and not band.crosses(level):
            raise ValueError(f"no level gives a volume of {target:g}: the level set is empty at {level:g}")
        band.grow(level)
        found = _closed_sheets(band, level)
        if found is None:
            return None
        vertices, faces, near_cut, components, spurious = found
        projector = Projector(band.field, band.cut, vertices, spacing, near_cut)
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


def _finish(
    band: Band,
    projector: Projector,
    faces: Integers,
    target: float | None,
    level: float,
    components: int,
    spurious: int,
    obstacles: Obstacles,
) -> ExtractedSurface:
    bones, tolerance = obstacles
    if bones:
        points = points_near_cells(bones, band.grid, band.state, band.cells)
        points = points[band.field(points) - level < CHORD * band.grid.spacing]
        projector.push_off(faces, points, band.grid, tolerance)
    if target is not None:
        step = projector.volume_step(faces, target, steps=3)
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


def _closed_sheets(band: Band, level: float) -> tuple[Floats, Integers, Booleans, int, int] | None:
    """The largest closed sheet: vertices, faces, which are near the cut, number of sheets and of the others.

    None where it is open.
    """
    coordinates, faces, on_border, near_cut = band.march(level)
    label, sheets = _label_sheets_loop(faces, len(coordinates))
    volume = _sheet_volumes_loop(coordinates, faces, label, coordinates.mean(axis=0), np.zeros(sheets))
    size = np.bincount(label, minlength=sheets)
    is_open = np.bincount(label, on_border, sheets) > 0
    closed = np.flatnonzero(~is_open)
    if len(closed) == 0 or (is_open.any() and size[is_open].max() > size[closed].max()):
        return None
    if sheets == 1:
        return band.grid.positions(coordinates), faces, near_cut, 1, 0
    used = label == closed[np.argmax(volume[closed])]
    number = np.cumsum(used) - 1
    faces = number[faces[used[faces[:, 0]]]]
    vertices = band.grid.positions(coordinates[used])
    return vertices, faces, near_cut[used], sheets, sheets - 1


@compiled(error_model="numpy")
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


@compiled(error_model="numpy")
def _sheet_volumes_loop(x, faces, label, origin, out):
    """Add the signed volumes of the tetrahedra under all triangles to those of their sheets, out."""
    for f in range(len(faces)):
        p = corner_from(x, faces[f, 0], origin)
        q = corner_from(x, faces[f, 1], origin)
        r = corner_from(x, faces[f, 2], origin)
        out[label[faces[f, 0]]] += six_volumes(q, r, p) / 6.0
    return out
