"""From a field to a closed triangle mesh of wanted volume, cut by bones.

The surface is the zero set of F = max(f - s, -d): f the field (negative inside), s the level, d the distance to the
bones (negative inside them). Marching cubes on the cells that it crosses give its topology, and Newton steps put each
vertex onto the zero set itself.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from rbfmuscle.geometry.arrays import Booleans, Floats, Integers
from rbfmuscle.geometry.fields import ClipDistance, Field
from rbfmuscle.geometry.surfaces import label_sheets, mesh_volume
from rbfmuscle.implicit.extraction.marching import Band, Grid
from rbfmuscle.implicit.extraction.obstacles import Obstacles
from rbfmuscle.implicit.extraction.projection import Projector
from rbfmuscle.validation import check_finite, check_points, check_positive


@dataclass(frozen=True)
class ExtractedSurface:
    """A closed outward mesh.

    Attributes
    ----------
    vertices : (n, 3) ndarray
        World positions [scene unit].
    faces : (m, 3) ndarray of int
    level : float
        Level s of the field that was extracted.
    volume : float
        Enclosed by the mesh [scene unit cubed].
    components : int
        Sheets found in the cells that were visited; all but the largest closed one are left out.
    spacing : float
        Edge of a grid cell [scene unit].
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
        Predicted surface points, where the search starts; also give the grid's extent [scene unit].
    resolution : int
        Grid cells along the longest side of the points' box.
    cut : ClipDistance, optional
        Distances, negative inside what is to be cut away; beyond 1.2 cells a lower bound of more than that will do.
    volume : float, optional
        Wanted volume of the mesh; the level is then moved from ``level`` until the mesh has it, to 1e-9.
    level : float
        Level of the field, or the first guess of it.
    axes : (3, 3) array_like, optional
        Rotation whose rows are the grid's axes. In a frame that moves with the scene the mesh does too.
    obstacles : list of pairs of PointGrid and (4, 4) ndarray, optional
        Vertices of the bones behind ``cut``, each bone in its own coordinates with its pose: triangles whose
        chords cut across a convex bone are moved until no vertex is inside the mesh by more than 1 % of a cell.

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
        band = Band(Grid.around(points, resolution=resolution, padding=padding, axes=axes), field, cut)
        _start(band, points, level)
        surface = _reach_volume(band, target, level, obstacles or [])
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
    band.visit(band.grid.cells(points))
    while not band.crosses(level):
        if not band.widen():
            raise ValueError(
                f"the level set is empty: field - {level:g} has one sign in the whole box of the points; "
                "check the points' place, the sign of the field and the level"
            )


def _reach_volume(
    band: Band, target: float | None, level: float, obstacles: Obstacles
) -> ExtractedSurface | None:
    """Mesh at the level that gives the target volume; None where the surface leaves the grid."""
    spacing = band.grid.spacing
    for _ in range(20):
        if target is not None and not band.crosses(level):
            raise ValueError(f"no level gives a volume of {target:g}: the level set is empty at {level:g}")
        band.follow(level)
        found = _largest_sheet(band, level)
        if found is None:
            return None
        vertices, faces, near_cut, components = found
        projector = Projector(band.field, band.cut, vertices, spacing, near_cut)
        projector.project(level)
        if target is None:
            return _finish(projector, faces, target, level, components, obstacles)
        step = projector.volume_step(faces, target)
        for _ in range(4):
            # Small steps move the vertices along the gradient; a large one needs another mesh.
            if np.abs(step * projector.slope).max() > 0.25 * spacing:
                break
            level += step
            projector.shift(step)
            if np.abs(step * projector.slope).max() < 2e-3 * spacing:
                return _finish(projector, faces, target, level, components, obstacles)
            projector.project(level)
            step = projector.volume_step(faces, target)
        largest = np.abs(projector.slope).max()
        level += float(np.clip(step, -spacing / largest, spacing / largest))
    raise ValueError(f"no level gives a volume of {target:g}; is it the volume of the surface fitted?")


def _finish(
    projector: Projector,
    faces: Integers,
    target: float | None,
    level: float,
    components: int,
    obstacles: Obstacles,
) -> ExtractedSurface:
    spacing = projector.spacing
    projector.push_off(faces, obstacles, level, spacing, 0.01 * spacing)
    if target is not None:
        step = projector.volume_step(faces, target, steps=3)
        level += step
        projector.shift(step)
    vertices = projector.vertices
    check_finite(vertices, name="extracted vertices")
    return ExtractedSurface(vertices, faces, level, mesh_volume(vertices, faces), components, spacing)


def _largest_sheet(band: Band, level: float) -> tuple[Floats, Integers, Booleans, int] | None:
    """The closed sheet of greatest volume: vertices, faces, which are near the cut, and the number of sheets.

    None where it is open.
    """
    coordinates, faces, on_border, near_cut = band.march(level)
    sheets, label = label_sheets(faces, len(coordinates))
    centred = coordinates - coordinates.mean(axis=0)
    six = np.linalg.det(centred[faces])
    volume = np.bincount(label[faces[:, 0]], six, sheets)
    size = np.bincount(label, minlength=sheets)
    is_open = np.bincount(label, on_border, sheets) > 0
    if is_open.all() or size[is_open].max(initial=0) > size[~is_open].max():
        return None
    used = label == np.argmax(np.where(is_open, -np.inf, volume))
    number = np.cumsum(used) - 1
    faces = number[faces[used[faces[:, 0]]]]
    return band.grid.positions(coordinates[used]), faces, near_cut[used], sheets
