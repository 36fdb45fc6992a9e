"""Directions: vectors at length one, and their parts across an axis."""

import numpy as np

from rbfmuscle.geometry.arrays import Floats


def unit(vectors: Floats) -> Floats:
    """Vectors (3,) or (n, 3) at length one; zero where they are."""
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return np.asarray(vectors / np.maximum(length, 1e-300))


def across(vectors: Floats, axis: Floats) -> Floats:
    """Part of vectors (3,) or (n, 3) that is across a unit axis (3,)."""
    return np.asarray(vectors - np.multiply.outer(vectors @ axis, axis))
