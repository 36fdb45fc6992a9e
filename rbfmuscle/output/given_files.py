"""The order of the vertices in muscles' files, in a run folder: ``surfaces/MUSCLE.npz``."""

import zipfile
import zlib
from pathlib import Path

import numpy as np

from rbfmuscle.scene.meshes.input_mesh import InputOrder
from rbfmuscle.validation import UsageError

_DAMAGE = (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error, MemoryError)


def given_file(muscle: str) -> str:
    """File of the vertex order of a muscle's own file, relative to the folder of a run."""
    return f"surfaces/{muscle}.npz"


def read_given(directory: Path, muscle: str) -> InputOrder | None:
    """The vertex order of a muscle's own file, None where the shown mesh has the same; UsageError
    for what no run writes.
    """
    path = directory / given_file(muscle)
    if not path.is_file():
        return None
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as found:
            order = InputOrder(found["faces"], found["source"])
        if any(numbers.dtype.kind != "i" for numbers in order) or order.source.ndim != 1:
            raise ValueError("arrays of another kind")
        if order.faces.shape[1:] != (3,) or order.source.min(initial=0) < 0:
            raise ValueError("arrays of another shape")
        if not np.array_equal(np.unique(order.faces), np.arange(len(order.source))):
            raise ValueError("triangles of other vertices")
    except _DAMAGE as error:
        message = f"{path} is not as it was written ({error}); run the scene again"
        raise UsageError(message) from None
    return order
