"""Files that VTK reads, by pyvista in one process beside this one: some broken files end it."""

import atexit
import contextlib
import io
import json
import mmap
import os
import queue
import re
import subprocess
import sys
import threading
from functools import cache
from pathlib import Path
from typing import IO, NamedTuple

import numpy as np

from rbfmuscle.geometry.arrays import Array, Floats, Integers
from rbfmuscle.validation import BROKEN_FILE, MeshError

PATIENCE = 120.0  # Time after which a file that is not read is refused [s].
MEMORY = (
    2 << 30
)  # Address space of the process that reads [bytes]: a small file may unpack to anything.
# Arrays of a file: VTK compares the name of each with all others, 20 s for 50,000.
MOST_ARRAYS = 1000
# Where an array begins, or how many follow.
_ARRAY = re.compile(rb"<DataArray\s|^(?:SCALARS|VECTORS|TENSORS)\s|^FIELD\s+\S+\s+(\d+)", re.M)
_LOCK = threading.Lock()
_SIZE = 8  # bytes of the size that stands before an answer


class PolyData(NamedTuple):
    """Points (n, 3), and polygons: of polygon k the points ``numbers[ends[k] : ends[k + 1]]``.

    Lines stand in the same way; ``single`` is the number of single points in the file, ``values``
    (n,) are of the vertex array that was asked for, (0,) where none was.
    """

    points: Floats
    ends: Integers
    numbers: Integers
    line_ends: Integers
    line_numbers: Integers
    single: int
    values: Floats


def read_polydata(path: str | Path, *, array: str = "") -> PolyData:
    """Return what a ``.vtk``, ``.vtp`` or ``.ply`` file holds; strips are split into triangles.

    ``array`` is the name of an array of one number at each point.
    """
    with _LOCK:
        child = _child(os.getpid())
        assert child.stdin is not None  # _child asks for pipes
        assert child.stdout is not None
        late = threading.Timer(PATIENCE, child.kill)
        late.daemon = True
        late.start()
        try:
            child.stdin.write(json.dumps([str(Path(path).absolute()), array]).encode() + b"\n")
            child.stdin.flush()
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


def _receive(pipe: IO[bytes]) -> PolyData | str:
    """An answer, or why there is none; EOFError or ValueError if it is neither.

    Arrays alone, as a process that has read a hostile file may send anything.
    """
    size = int.from_bytes(_read_whole(pipe, _SIZE), "little")
    if size > MEMORY:
        raise ValueError("the answer is larger than the process that gives it")
    content = io.BytesIO(_read_whole(pipe, size))
    points = np.load(content, allow_pickle=False)
    if points.dtype.kind == "U":
        return str(points)
    *cells, single, values = (np.load(content, allow_pickle=False) for _ in range(6))
    for array, kind, shape in (
        (points, "f8", (*points.shape[:1], 3)),
        *((array, "i8", (array.size,)) for array in cells),
        (single, "i8", (1,)),
        (values, "f8", (len(points) if values.size else 0,)),
    ):
        if array.dtype != kind or array.shape != shape:
            raise ValueError("the answer is no mesh")
    for ends, numbers in (cells[:2], cells[2:]):
        _check_cells(ends, numbers, len(points))
    ends, numbers, line_ends, line_numbers = cells
    return PolyData(points, ends, numbers, line_ends, line_numbers, int(single[0]), values)


def _read_whole(pipe: IO[bytes], size: int) -> bytes:
    content = pipe.read(size)
    if len(content) < size:
        raise EOFError
    return content


@cache
def _child(process: int) -> subprocess.Popen[bytes]:
    """The process that reads for the process of this number, as none is shared after a fork: this
    module with pipes and one thread for loops; modules in the present folder are not imported.

    It is started by command and not by `multiprocessing`, so that a script needs no guard of its
    main part.
    """
    places = [str(Path(__file__).resolve().parents[3]), os.environ.get("PYTHONPATH", "")]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(place for place in places if place)}
    counts = ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
    environment |= dict.fromkeys(counts, "1")
    command, pipe = [sys.executable, "-P", "-m", __name__], subprocess.PIPE
    # A process group of its own: an interrupt reaches this process, which ends the child.
    child = subprocess.Popen(command, env=environment, stdin=pipe, stdout=pipe, process_group=0)
    atexit.register(_end, child)
    return child


def _end(process: subprocess.Popen[bytes]) -> None:
    """End a process that reads and close its pipes; the next file is read by another."""
    _child.cache_clear()
    process.kill()
    process.wait()
    for pipe in (process.stdin, process.stdout):
        with contextlib.suppress(OSError):  # what it did not read is lost
            if pipe is not None:
                pipe.close()


def _listen(asked: queue.Queue[list[str]]) -> None:
    """Queue the questions on standard input; the process ends when its parent does."""
    for line in sys.stdin.buffer:
        asked.put(json.loads(line))
    os._exit(0)


def _answer() -> None:
    """Take paths, and give what the files hold or why they cannot be read, as `_receive` takes it;
    end where nobody reads.
    """
    answers = os.fdopen(os.dup(1), "wb")
    for output in (1, 2):  # VTK prints pages
        os.dup2(os.open(os.devnull, os.O_WRONLY), output)
    # Windows has no such limit, and macOS takes none that is less than what Python has mapped.
    with contextlib.suppress(ImportError, OSError, ValueError):
        import resource

        resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    asked: queue.Queue[list[str]] = queue.Queue()
    threading.Thread(target=_listen, args=(asked,), daemon=True).start()
    while True:
        path, array = asked.get()
        try:
            arrays = _read(path, array)
        except BROKEN_FILE as error:
            text = " ".join(str(error).split())[:200] or type(error).__name__
            arrays = (np.array(text),)
        content = io.BytesIO()
        for part in arrays:
            np.save(content, part, allow_pickle=False)
        try:
            answers.write(content.tell().to_bytes(_SIZE, "little"))
            answers.write(content.getvalue())
            answers.flush()
        except BrokenPipeError:
            os._exit(0)


def _read(path: str, array: str) -> tuple[Array, ...]:
    import pyvista
    from vtkmodules.vtkCommonCore import vtkOutputWindow, vtkStringOutputWindow

    count = _count_arrays(path)
    if count > MOST_ARRAYS:
        raise ValueError(f"{count} arrays, at most {MOST_ARRAYS} are read")
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
        ends, numbers = _cells(data.GetPolys(), data.n_points)
        if data.n_strips:
            strips = data.copy()
            strips.GetPolys().Reset()
            split = _cells(strips.triangulate().GetPolys(), data.n_points)
            ends = np.concatenate([ends, split[0][1:] + len(numbers)])
            numbers = np.concatenate([numbers, split[1]])
        lines = _cells(data.GetLines(), data.n_points)
        single = np.array([data.n_verts if len(numbers) else 0])
        values = _values(data, array)
    points = np.array(data.points, dtype=np.float64)
    return points, ends, numbers, *lines, single, values


def _count_arrays(path):
    """Number of arrays that a file declares."""
    if not os.path.getsize(path):
        return 0
    with open(path, "rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
        return sum(int(found[1] or 1) for found in _ARRAY.finditer(content))


def _values(data, array):
    """The array (n,) of that name at the points; (0,) for no name."""
    if not array:
        return np.empty(0)
    if array not in data.point_data:
        raise ValueError(
            f"no vertex array {array!r}, it has {', '.join(data.point_data) or 'none'}"
        )
    values = np.array(data.point_data[array], dtype=np.float64)
    if values.ndim != 1:
        raise ValueError(f"the vertex array {array!r} has {values.shape[1]} numbers at a vertex")
    return values


def _cells(cells, points):
    """Where each cell begins and ends, and the numbers of its points."""
    from pyvista import convert_array

    parts = cells.GetOffsetsArray(), cells.GetConnectivityArray()
    ends, numbers = (convert_array(part).astype(np.int64) for part in parts)
    _check_cells(ends, numbers, points)
    return ends, numbers


def _check_cells(ends, numbers, points):
    """ValueError where cells name points that are not there, or do not fit their numbers."""
    if len(numbers) and (numbers.min() < 0 or numbers.max() >= points):
        raise ValueError(
            f"a cell names points {numbers.min()} to {numbers.max()}, there are {points}"
        )
    if len(numbers) and (ends[0] != 0 or (np.diff(ends) < 0).any() or ends[-1] != len(numbers)):
        raise ValueError(f"the cells do not fit their {len(numbers)} point numbers")


if __name__ == "__main__":
    _answer()
