"""VTK and VTP files, read by pyvista in one process beside this one: some broken files end it."""

import atexit
import contextlib
import io
import os
import subprocess
import threading
from functools import cache
from pathlib import Path
from typing import IO

import numpy as np

from rbfmuscle.child import Outbox, end_child, listen, send, start_child
from rbfmuscle.geometry.arrays import Array, Floats, Integers
from rbfmuscle.validation import MeshError

PATIENCE = 120.0  # Time after which a file that is not read is refused [s].
MEMORY = (
    2 << 30
)  # Address space of the process that reads [bytes]: a small file may unpack to anything.
_LOCK = threading.Lock()
_SIZE = 8  # bytes of the size that stands before an answer


def read_polydata(path: str | Path) -> tuple[Floats, Integers]:
    """Return points (n, 3) and triangles (m, 3) of a ``.vtk`` or ``.vtp`` file; polygons and strips
    split.
    """
    with _LOCK:
        child = _child(os.getpid())
        assert child.stdout is not None  # start_child asks for a pipe
        late = threading.Timer(PATIENCE, child.kill)
        late.daemon = True
        late.start()
        try:
            send(child.stdin, str(Path(path).absolute()))
            found = _receive(child.stdout)
        except (OSError, EOFError, ValueError, MemoryError):
            _end(child)
            found = "VTK ends, or does not end, at it"
        except BaseException:  # its answer would be taken for that of the next file
            _end(child)
            raise
        finally:
            late.cancel()
    if isinstance(found, str):
        raise MeshError(
            f"{path}: not a readable file of VTK PolyData ({found}); export the mesh again"
        )
    return found


def _end(child: subprocess.Popen[bytes]) -> None:
    end_child(child)
    _child.cache_clear()


def _receive(pipe: IO[bytes]) -> tuple[Floats, Integers] | str:
    """An answer, points and triangles or why there are none; EOFError or ValueError if it is none.

    Arrays alone, as a process that has read a hostile file may send anything.
    """
    size = int.from_bytes(_read_whole(pipe, _SIZE), "little")
    if size > MEMORY:
        raise ValueError("the answer is larger than the process that gives it")
    content = io.BytesIO(_read_whole(pipe, size))
    first = np.load(content, allow_pickle=False)
    if first.dtype.kind == "U":
        return str(first)
    corners = np.load(content, allow_pickle=False)
    for array, kind in ((first, "f8"), (corners, "i8")):
        if array.dtype != kind or array.ndim != 2 or array.shape[1] != 3:
            raise ValueError("the answer is no mesh")
    return first, corners


def _read_whole(pipe: IO[bytes], size: int) -> bytes:
    content = pipe.read(size)
    if len(content) < size:
        raise EOFError
    return content


def _reply(pipe: IO[bytes], *arrays: Array) -> None:
    """Send arrays, which `_receive` takes; end the process where nobody reads."""
    content = io.BytesIO()
    for array in arrays:
        np.save(content, array, allow_pickle=False)
    try:
        pipe.write(content.tell().to_bytes(_SIZE, "little"))
        pipe.write(content.getvalue())
        pipe.flush()
    except BrokenPipeError:
        os._exit(0)


@cache
def _child(process: int) -> subprocess.Popen[bytes]:
    """The process that reads for the process of this number: none is shared after a fork."""
    child = start_child(__name__, 1)
    atexit.register(end_child, child)
    return child


def _answer() -> None:
    """Take paths, and give what the files hold or why they cannot be read."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)  # VTK prints pages
    with contextlib.suppress(ImportError):  # Windows has no such limit
        import resource

        resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    outbox, asked = Outbox(), listen()
    while True:
        path = asked.get()
        try:
            arrays: tuple[Array, ...] = _read(path)
        except Exception as error:  # noqa: BLE001 - any error of a library becomes one line
            text = " ".join(str(error).split())[:200] or type(error).__name__
            arrays = (np.array(text),)
        _reply(outbox.file, *arrays)


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
