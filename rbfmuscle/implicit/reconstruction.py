"""A closed surface from points alone, or from points with normals: oriented, fitted, extracted."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial import cKDTree

from rbfmuscle.geometry.arrays import Booleans, Floats
from rbfmuscle.implicit.extraction.surface import extract_surface
from rbfmuscle.implicit.field import RBFField
from rbfmuscle.implicit.orientation import orient_points
from rbfmuscle.implicit.partition import PartitionField, fit_points_with_normals
from rbfmuscle.implicit.selection import spacing
from rbfmuscle.validation import MeshError, UsageError, check_points, check_vectors

# Points closer than this share of the median spacing are one.
SAME = 0.02
# Cells a spacing, and their number along the longest side.
CELLS, RANGE = 2.0, (48, 256)
# Points up to which the field is one dense fit.
DENSE = 1500


@dataclass(frozen=True)
class Reconstruction:
    """A surface made from points.

    Attributes
    ----------
    vertices : (n, 3) ndarray
    faces : (m, 3) ndarray of int
        Closed, outward.
    points, normals : (K, 3) ndarray
        What the field was fitted to: the points without repeats.
    field : RBFField or PartitionField
    spurious : int
        Smaller sheets that were left out.
    """

    vertices: np.ndarray
    faces: np.ndarray
    points: np.ndarray
    normals: np.ndarray
    field: RBFField | PartitionField
    spurious: int


def reconstruct_surface(
    points: ArrayLike,
    normals: ArrayLike | None = None,
    *,
    resolution: int = 0,
    progress: Callable[[int, int], None] | None = None,
) -> Reconstruction:
    """Make a closed surface through points.

    Parameters
    ----------
    points : (n, 3) array_like
        Of a closed surface, all around it [length].
    normals : (n, 3) array_like, optional
        Outward; found by the energy of the field where they are not given (`orient_points`).
    resolution : int
        Cells along the longest side; two a spacing of the points by default.
    progress : callable, optional
        As in `orient_points`.

    Returns
    -------
    Reconstruction

    Raises
    ------
    UsageError
        For too few points or a resolution out of range.
    MeshError
        Where the field through the points shows no closed surface.

    Examples
    --------
    >>> import trimesh
    >>> ball = trimesh.creation.icosphere(2, 1.0)
    >>> found = reconstruct_surface(ball.vertices, resolution=24)
    >>> bool((found.normals * ball.vertices).sum(axis=1).min() > 0.99)
    True
    """
    points = check_points(points)
    if resolution and not 8 <= resolution <= 1000:
        raise UsageError(f"resolution must be from 8 to 1000 cells, or 0, got {resolution}")
    keep = _without_repeats(points)
    points = points[keep]
    if normals is None:
        normals = orient_points(points, progress=progress)
    else:
        normals = check_vectors(normals, len(keep))[keep]
    field = fit_points_with_normals(points, normals, most=DENSE)
    between = float(np.median(spacing(points)))
    cells = resolution or int(np.clip(CELLS * np.ptp(points, axis=0).max() / between, *RANGE))
    try:
        found = extract_surface(field, points=points, resolution=cells)
    except ValueError as error:
        raise MeshError(
            f"the {len(points)} points show no closed surface ({error}); are there points all around it?"
        ) from None
    return Reconstruction(found.vertices, found.faces, points, np.asarray(normals), field, found.spurious)


def _without_repeats(points: Floats) -> Booleans:
    """A mask (n,) that leaves out points all but on an earlier one."""
    keep = np.ones(len(points), dtype=bool)
    if len(points) < 2:
        return keep
    tree = cKDTree(points)
    between = float(np.median(tree.query(points, k=2)[0][:, 1]))
    for first, second in tree.query_pairs(SAME * between, output_type="ndarray"):
        if keep[first]:
            keep[second] = False
    return keep
