"""Names for what annotations speak of; shapes stand in the docstrings."""

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[Any]  # of numbers of any kind, which NumPy has no other word for
Booleans = NDArray[np.bool_]
Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
# A mesh, or its vertices and faces.
if TYPE_CHECKING:
    import trimesh

    MeshLike = trimesh.Trimesh | tuple[ArrayLike, ArrayLike]
else:
    MeshLike = object
