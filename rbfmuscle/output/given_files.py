"""The meshes of muscles' files in a run folder: ``surfaces/MUSCLE.npz``, a NumPy archive."""

import zipfile
import zlib
from pathlib import Path

import numpy as np

from rbfmuscle.scene.meshes.input_mesh import Corners, InputMesh
from rbfmuscle.validation import UsageError

_DAMAGE = (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, zlib.error, MemoryError)


def given_file(muscle: str) -> str:
    """File of a muscle's input mesh, relative to the folder of a run."""
    return f"surfaces/{muscle}.npz"


def write_given(directory: Path, muscle: str, mesh: InputMesh) -> None:
    """Write the input mesh of a muscle at rest."""
    path = directory / given_file(muscle)
    path.parent.mkdir(exist_ok=True)
    arrays = mesh._asdict()
    np.savez_compressed(path, **arrays.pop("corners")._asdict(), **arrays)


def read_given(directory: Path, muscle: str) -> InputMesh | None:
    """The input mesh of a muscle at rest, None where there is none; UsageError for what no run
    writes.
    """
    path = directory / given_file(muscle)
    if not path.is_file():
        return None
    try:
        with path.open("rb") as file, np.load(file, allow_pickle=False) as found:
            corners = Corners(*(found[name] for name in Corners._fields))
            mesh = InputMesh(found["vertices"], found["faces"], found["source"], corners)
        _check(mesh)
    except _DAMAGE as error:
        message = f"{path} is not as it was written ({error}); run the scene again"
        raise UsageError(message) from None
    return mesh


def _check(mesh: InputMesh) -> None:
    """Raise ValueError where shapes or numbers do not fit."""
    corners = mesh.corners
    for values, width in ((mesh.vertices, 3), (corners.texture, 2), (corners.normals, 3)):
        if values.dtype != np.float64 or values.ndim != 2 or values.shape[1] != width:
            raise ValueError("an array of another shape")
        if not np.isfinite(values).all():
            raise ValueError("numbers that are not finite")
    for numbers, values, shape in (
        (mesh.source[:, None], None, (len(mesh.vertices), 1)),
        (mesh.faces, mesh.vertices, (len(mesh.faces), 3)),
        (corners.texture_faces, corners.texture, (_rows(corners.texture, mesh), 3)),
        (corners.normal_faces, corners.normals, (_rows(corners.normals, mesh), 3)),
    ):
        if numbers.dtype.kind != "i" or numbers.shape != shape or numbers.min(initial=0) < 0:
            raise ValueError("an array of another shape")
        if values is not None and numbers.max(initial=-1) >= len(values):
            raise ValueError("a triangle of a vertex that there is not")


def _rows(values: np.ndarray, mesh: InputMesh) -> int:
    """How many triangles name these values: all, or none where there are none."""
    return len(mesh.faces) if len(values) else 0
