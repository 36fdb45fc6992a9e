"""VTK and VTP files of PolyData, read by VTK in one process beside this one: some broken files end it."""

from __future__ import annotations

import atexit
import contextlib
import os
import pickle
import select
import subprocess
import threading
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rbfmuscle.child import Outbox, listen, send, start_child
from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.validation import MeshError

PATIENCE = 120.0  # Time after which a file that VTK has not read is refused [s].
MEMORY = 8 << 30  # Address space of the process that reads [bytes]: a small file may unpack to anything.
MOST_CORNERS = 100  # From which a polygon is split: trying each takes time with their square.
_TURN = threading.Lock()


class PolyData(NamedTuple):
    """Points (n, 3), triangles (m, 3), and the point numbers of each line."""

    points: Floats
    triangles: Integers
    lines: list[Integers]


def read_polydata(path: str | Path) -> PolyData:
    """Return what a ``.vtk`` (legacy) or ``.vtp`` (XML) file of PolyData holds; polygons and strips as triangles.

    Raises
    ------
    MeshError
        If the file is damaged or of another kind.
    """
    path = Path(path)
    try:
        path.open("rb").close()
    except OSError as error:
        raise MeshError(f"{path}: cannot be read: {error.strerror}") from None
    with _TURN:
        child = _child(os.getpid())
        assert child.stdout is not None  # start_child asks for a pipe
        try:
            send(child.stdin, str(path.absolute()))
            if not select.select([child.stdout], [], [], PATIENCE)[0]:
                raise EOFError
            found = pickle.load(child.stdout)
        except (OSError, EOFError, pickle.UnpicklingError):
            _end(child)
            _child.cache_clear()
            found = "VTK ends, or takes without end, at it"
    if isinstance(found, str):
        raise MeshError(f"{path}: not a readable file of VTK PolyData ({found}); export the mesh again")
    return PolyData(*found)


@cache
def _child(process: int) -> subprocess.Popen[bytes]:
    """The process that reads for a process of this number: none is shared after a fork."""
    child = start_child(__name__, 1)
    atexit.register(_end, child)
    return child


def _end(child: subprocess.Popen[bytes]) -> None:
    child.kill()
    child.wait()
    for pipe in (child.stdin, child.stdout):
        with contextlib.suppress(OSError, AttributeError):
            pipe.close()  # type: ignore[union-attr]


def _answer() -> None:
    """The life of the process that reads: it is given paths, and gives what they hold, or why they cannot be read."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), 2)  # VTK prints pages
    with contextlib.suppress(ImportError, ValueError, OSError):
        import resource

        resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    outbox, asked = Outbox(), listen()
    while True:
        path = asked.get()
        try:
            found = _read(path)
        except Exception as error:  # noqa: BLE001 - whatever a file brings about costs its user one line
            found = " ".join(str(error).split())[:200] or type(error).__name__
        outbox.put(found)


def _read(path):
    """What VTK reads of a file, or in words why it reads nothing."""
    # Not pyvista, which takes twice as long to import.
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkCommonCore import vtkOutputWindow, vtkStringOutputWindow
    from vtkmodules.vtkIOLegacy import vtkPolyDataReader
    from vtkmodules.vtkIOXML import vtkXMLPolyDataReader

    said = vtkStringOutputWindow()
    vtkOutputWindow.SetInstance(said)
    if path.lower().endswith(".vtp"):
        reader = vtkXMLPolyDataReader()
        reader.SetFileName(path)
    else:
        content = Path(path).read_bytes()
        if content[:1000].split(b"\n")[2:3] in ([b"BINARY"], [b"BINARY\r"]):
            # Behind the end of a file VTK takes whatever is in memory; blanks are no numbers of points.
            content += 64 * b" "
        reader = vtkPolyDataReader()
        reader.ReadFromInputStringOn()
        reader.SetBinaryInputString(content, len(content))
    reader.Update()
    data, text = reader.GetOutput(), said.GetOutput()
    text = text if isinstance(text, str) else text.decode(errors="replace")
    if "ERROR: " in text or data.GetPoints() is None:
        return " ".join(text.partition("): ")[2].split("\n\n")[0].split())[:200] or "no points"
    points = vtk_to_numpy(data.GetPoints().GetData()).astype(np.float64)
    kinds = (data.GetLines(), data.GetPolys(), data.GetStrips())
    lines, polygons, strips = (_cells(cells, len(points)) for cells in kinds)
    triangles = np.vstack([_split_polygons(points, *polygons), _split_strips(*strips)])
    return points, triangles, np.split(lines[1], lines[0][1:-1]) if len(lines[1]) else []


def _cells(cells, points):
    """Where each cell begins and ends, and the numbers of its points."""
    from vtkmodules.util.numpy_support import vtk_to_numpy

    ends = vtk_to_numpy(cells.GetOffsetsArray()).astype(np.int64)
    numbers = vtk_to_numpy(cells.GetConnectivityArray()).astype(np.int64)
    bad = numbers[(numbers < 0) | (numbers >= points)]
    if len(bad):
        raise ValueError(f"a cell names point {bad[0]}, the points are 0 to {points - 1}")
    if len(numbers) and (ends[0] != 0 or (np.diff(ends) < 0).any() or ends[-1] != len(numbers)):
        raise ValueError(f"the cells do not fit their {len(numbers)} point numbers")
    return ends, numbers


def _split_polygons(points, ends, numbers):
    """Polygons as fans of triangles, in their order."""
    sizes, cells, found = np.diff(ends), [np.zeros(0, np.int64)], [np.zeros((0, 3), np.int64)]
    for size in np.unique(sizes[sizes >= 3]):
        chosen = np.flatnonzero(sizes == size)
        cells.append(np.repeat(chosen, size - 2))
        found.append(_fans(points, numbers[ends[chosen][:, None] + np.arange(size)]))
    return np.vstack(found)[np.argsort(np.concatenate(cells), kind="stable")]


def _fans(points, corners):
    """Triangles (k (s - 2), 3) of polygons (k, s), about the corner whose worst triangle faces most as they do.

    VTK's own filter leaves out what has no area, which opens the surface.
    """
    count, size = corners.shape
    places = points[corners]
    normal = np.cross(places, np.roll(places, -1, axis=1)).sum(axis=1)
    worst = np.zeros((count, 1 if size == 3 else min(size, MOST_CORNERS)))
    for first in range(worst.shape[1]):
        turned = np.roll(places, -first, axis=1)
        sides = turned[:, 1:] - turned[:, :1]
        worst[:, first] = (np.cross(sides[:, :-1], sides[:, 1:]) @ normal[:, :, None])[..., 0].min(axis=1)
    best = (worst.argmax(axis=1)[:, None] + np.arange(size)) % size
    turned = np.take_along_axis(corners, best, axis=1)
    first = np.broadcast_to(turned[:, :1], (count, size - 2))
    return np.stack([first, turned[:, 1:-1], turned[:, 2:]], axis=2).reshape(-1, 3)


def _split_strips(ends, numbers):
    found = [np.zeros((0, 3), np.int64)]
    for strip in np.split(numbers, ends[1:-1]) if len(numbers) else []:
        found.append(np.column_stack([strip[:-2], strip[1:-1], strip[2:]]))
        found[-1][1::2] = found[-1][1::2, [1, 0, 2]]
    return np.vstack(found)


if __name__ == "__main__":
    _answer()
