"""Names for annotations, whose shapes stand in the docstrings; directions, and points under rigid
motions.
"""

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[Any]  # of numbers of any kind, which NumPy has no other word for
Booleans = NDArray[np.bool_]
Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Singles = NDArray[np.float32]
# A mesh, or its vertices and faces.
if TYPE_CHECKING:
    import trimesh

    MeshLike = trimesh.Trimesh | tuple[ArrayLike, ArrayLike]
else:
    MeshLike = object


def unit(vectors: Floats) -> Floats:
    """Vectors (3,) or (n, 3) at length one; zero where they are."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.asarray(vectors / np.maximum(length, 1e-300))


def across(vectors: Floats, axis: Floats) -> Floats:
    """Part of vectors (3,) or (n, 3) that is across a unit axis (3,)."""
    return np.asarray(vectors - np.multiply.outer(vectors @ axis, axis))


def to_world(points: Floats, pose: Floats) -> Floats:
    """Points (..., 3) of a frame (4, 4) in the world; the frame may be any affine map."""
    return np.asarray(points @ pose[:3, :3].T + pose[:3, 3])


def to_local(points: Floats, pose: Floats) -> Floats:
    """Points (..., 3) of the world in a frame (4, 4) of unit axes."""
    return np.asarray((points - pose[:3, 3]) @ pose[:3, :3])


def box_size(points: Floats) -> float:
    """Diagonal of the box along the axes that holds points (n, 3)."""
    return float(np.linalg.norm(np.ptp(points, axis=0)))
