"""VTK and VTP files, read by pyvista in one process beside this one: some broken files end it."""

import atexit
import os
import pickle
import select
import subprocess
import threading
from functools import cache
from pathlib import Path

import numpy as np

from rbfmuscle.child import Outbox, end_child, listen, send, start_child
from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.validation import MeshError

PATIENCE = 120.0  # Time after which a file that is not read is refused [s].
MEMORY = (
    2 << 30
)  # Address space of the process that reads [bytes]: a small file may unpack to anything.
_LOCK = threading.Lock()


def read_polydata(path: str | Path) -> tuple[Floats, Integers]:
    """Return points (n, 3) and triangles (m, 3) of a ``.vtk`` or ``.vtp`` file; polygons and strips
    split.
    """
    with _LOCK:
        child = _child(os.getpid())
        assert child.stdout is not None  # start_child asks for a pipe
        try:
            send(child.stdin, str(Path(path).absolute()))
            if not select.select([child.stdout], [], [], PATIENCE)[0]:
                raise EOFError
            found: tuple[Floats, Integers] | str = pickle.load(child.stdout)
        except (OSError, EOFError, pickle.UnpicklingError):
            end_child(child)
            _child.cache_clear()
            found = "VTK ends, or does not end, at it"
    if isinstance(found, str):
        raise MeshError(
            f"{path}: not a readable file of VTK PolyData ({found}); export the mesh again"
        )
    return found


@cache
def _child(process: int) -> subprocess.Popen[bytes]:
    """The process that reads for the process of this number: none is shared after a fork."""
    child = start_child(__name__, 1)
    atexit.register(end_child, child)
    return child


def _answer() -> None:
    """Take paths, and give what the files hold or why they cannot be read."""
    import resource

    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)  # VTK prints pages
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    outbox, asked = Outbox(), listen()
    while True:
        path = asked.get()
        try:
            outbox.put(_read(path))
        except Exception as error:  # noqa: BLE001 - any error of a library becomes one line
            outbox.put(" ".join(str(error).split())[:200] or type(error).__name__)


def _read(path: str) -> tuple[Floats, Integers]:
    import pyvista
    from vtkmodules.vtkCommonCore import vtkOutputWindow, vtkStringOutputWindow

    with pyvista.VtkErrorCatcher(raise_errors=True, send_to_logging=False):
        data = pyvista.read(path)
        said = vtkOutputWindow.GetInstance()
        assert isinstance(said, vtkStringOutputWindow)  # the catcher of errors has set it
        if "Error reading" in said.GetOutput():  # a warning, and numbers from unused memory
            raise ValueError("it holds fewer numbers than it declares")
        if not isinstance(data, pyvista.PolyData) or not data.n_points:
            raise ValueError(
                "no points" if isinstance(data, pyvista.PolyData) else type(data).__name__
            )
        sides, numbers = _cells(data.GetPolys(), data.n_points)
        if data.n_strips or (np.diff(sides) != 3).any():
            sides, numbers = _cells(data.triangulate().GetPolys(), data.n_points)
    return np.array(data.points, dtype=np.float64), numbers.reshape(-1, 3)


def _cells(cells, points):
    """Where each cell begins and ends, and the numbers of its points."""
    from pyvista import convert_array

    parts = cells.GetOffsetsArray(), cells.GetConnectivityArray()
    ends, numbers = (convert_array(part).astype(np.int64) for part in parts)
    if len(numbers) and (numbers.min() < 0 or numbers.max() >= points):
        raise ValueError(
            f"a cell names points {numbers.min()} to {numbers.max()}, there are {points}"
        )
    if len(numbers) and (ends[0] != 0 or (np.diff(ends) < 0).any() or ends[-1] != len(numbers)):
        raise ValueError(f"the cells do not fit their {len(numbers)} point numbers")
    return ends, numbers


if __name__ == "__main__":
    _answer()
