"""From a field to a closed triangle mesh of wanted volume, cut by bones.

The surface is the zero set of F = max(f - s, -d): f the field (negative inside), s the level, d the distance to the
bones (negative inside them). Marching cubes give its topology, and Newton steps put each vertex onto the zero set.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.geometry.fields import ClipDistance, Field
from rbfmuscle.geometry.surfaces import mesh_volume
from rbfmuscle.implicit.extraction.marching import Grid, LevelSet, nearest_sheet
from rbfmuscle.implicit.extraction.obstacles import Obstacles
from rbfmuscle.implicit.extraction.projection import Projector
from rbfmuscle.validation import check_finite, check_points, check_positive

# A vertex farther than this from the cut, in cells, stays clear of it.
NEAR_CUT = 1.2


@dataclass(frozen=True)
class ExtractedSurface:
    """A closed outward mesh: vertices (n, 3) in the world [scene unit], faces (m, 3), and the volume that it holds.

    ``level`` is that of the field that was extracted, ``components`` the number of sheets in the box, of which all but
    the one nearest to the points are left out, ``spacing`` the edge of a grid cell [scene unit].
    """

    vertices: np.ndarray
    faces: np.ndarray
    level: float
    volume: float
    components: int
    spacing: float


def extract_surface(
    field: Field,
    *,
    points: ArrayLike,
    resolution: int = 48,
    cut: ClipDistance | None = None,
    volume: float | None = None,
    level: float = 0.0,
    axes: ArrayLike | None = None,
    obstacles: Obstacles | None = None,
) -> ExtractedSurface:
    """Extract the zero set of max(field - level, -cut) as a closed mesh.

    Parameters
    ----------
    field : Field
        Negative inside.
    points : (n, 3) array_like
        Predicted surface points: give the grid's extent, and which sheet is the surface's [scene unit].
    resolution : int
        Grid cells along the longest side of the points' box.
    cut : ClipDistance, optional
        Distances, negative inside what is to be cut away; beyond 1.2 cells a lower bound of more than that will do.
    volume, level : float
        The level is moved from ``level`` until the mesh has the volume, if one is wanted, to 1e-9.
    axes : (3, 3) array_like, optional
        Rotation whose rows are the grid's axes. In a frame that moves with the scene the mesh does too.
    obstacles : list of pairs of PointGrid and (4, 4) ndarray, optional
        Vertices of the bones behind ``cut``, each bone in its own coordinates with its pose: triangles whose chords cut
        across a convex bone are moved until no vertex is inside the mesh by more than 1 % of a cell.

    Raises
    ------
    ValueError
        On bad arguments, NaN in field or cut, an empty level set, or one that is not closed within twice the box of the
        points; on a volume that no level reaches.
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


def _reach_volume(
    level_set: LevelSet, points: Floats, target: float | None, level: float, obstacles: Obstacles
) -> ExtractedSurface | None:
    """Mesh at the level that gives the target volume; None where the surface leaves the grid."""
    spacing = level_set.grid.spacing
    for _ in range(20):
        found = _nearest_sheet(level_set, points, level)
        if found is None:
            return None
        vertices, faces, components = found
        near_cut = np.zeros(len(vertices), dtype=np.bool_)  # what a shift by a cell may bring to the cut
        if level_set.cut is not None:
            near_cut = np.asarray(level_set.cut(vertices) < NEAR_CUT * spacing)
        projector = Projector(level_set.field, level_set.cut, vertices, spacing, near_cut)
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
    raise ValueError(f"no level gives a volume of {target:g}; is it the volume of the surface fitted?")


def _finish(
    projector: Projector, faces: Integers, target: float | None, level: float, sheets: int, bones: Obstacles
) -> ExtractedSurface:
    spacing = projector.spacing
    projector.push_off(faces, bones, spacing, 0.01 * spacing)
    if target is not None:
        step = projector.volume_step(faces, target, steps=3)
        level += step
        projector.shift(step)
    vertices = projector.vertices
    check_finite(vertices, name="extracted vertices")
    return ExtractedSurface(vertices, faces, level, mesh_volume(vertices, faces), sheets, spacing)


def _nearest_sheet(level_set: LevelSet, points: Floats, level: float) -> tuple[Floats, Integers, int] | None:
    """The sheet that lies nearest to most points: vertices, faces, and the number of sheets; None where it is open."""
    coordinates, faces = level_set.march(level)
    if len(faces) == 0:
        raise ValueError(
            f"the level set is empty: field - {level:g} has one sign in the whole box of the points; "
            "check the points' place, the sign of the field, the level and the volume"
        )
    vertices = level_set.grid.positions(coordinates)
    sheets, label, own = nearest_sheet(vertices, faces, points)
    used = label == own
    if level_set.on_border(coordinates[used]).any():
        return None
    number = np.cumsum(used) - 1
    return vertices[used], number[faces[used[faces[:, 0]]]], sheets
