"""VTK files written directly: PolyData (.vtp) and collections over time (.pvd), without loading VTK."""

from __future__ import annotations

import base64
import errno
import os
import zlib
from functools import lru_cache
from pathlib import Path
from typing import Any
from xml.sax.saxutils import quoteattr

import numpy as np
from numpy.typing import ArrayLike

_BLOCK = 1 << 20
_TYPES = {"f8": "Float64", "f4": "Float32", "i4": "Int32", "i8": "Int64"}


def write_vtp(
    path: str | Path,
    vertices: ArrayLike,
    faces: ArrayLike,
    *,
    ascii: bool = False,
    single: bool = False,
    values: dict[str, Any] | None = None,
) -> None:
    """Write a triangle mesh as VTK XML PolyData.

    Parameters
    ----------
    path : path
    vertices : (n, 3) array_like
    faces : (m, 3) array_like of int
    ascii : bool
        Plain numbers, as OpenSim reads them; else compressed base64, for which no reader needs a setting.
    single : bool
        Positions in single precision.
    values : dict of str to (n,) array_like, optional
        Of the vertices.
    """
    vertices = np.ascontiguousarray(vertices, dtype=np.float32 if single else np.float64)
    faces = np.ascontiguousarray(faces, dtype=np.int32)
    ends = np.arange(3, 3 * len(faces) + 1, 3, dtype=np.int32)
    _write_polydata(path, vertices, ("Polys", faces.ravel(), ends), ("PointData", values or {}), ascii)


def write_vtp_lines(
    path: str | Path, points: ArrayLike, *, cells: dict[str, Any] | None = None, ascii: bool = False
) -> None:
    """Write polylines of equally many points as VTK XML PolyData.

    Parameters
    ----------
    path : path
    points : (count, k, 3) array_like
    cells : dict of str to (count,) array_like, optional
        Values of each line.
    ascii : bool
        Plain numbers; else compressed base64.
    """
    points = np.asarray(points, dtype=np.float64)
    count, each = points.shape[:2]
    numbers = np.arange(count * each, dtype=np.int32)
    ends = each * np.arange(1, count + 1, dtype=np.int32)
    positions = np.ascontiguousarray(points.reshape(-1, 3))
    _write_polydata(path, positions, ("Lines", numbers, ends), ("CellData", cells or {}), ascii)


def _write_polydata(path, points, cells, values, ascii):
    """Points, one kind of cells as (kind, point numbers, ends), and values of (whom, by name)."""
    whose, values = values
    kind, numbers, ends = cells
    counts = {name: len(ends) * (name == kind) for name in ("Verts", "Lines", "Strips", "Polys")}
    numbered = " ".join(f'NumberOf{name}="{count}"' for name, count in counts.items())
    compressor = "" if ascii else ' compressor="vtkZLibDataCompressor"'
    numbered_values = {name: np.ascontiguousarray(value, dtype=np.float64) for name, value in values.items()}
    data = [_array(value, name, ascii) for name, value in numbered_values.items()]
    parts = [
        '<?xml version="1.0"?>\n',
        '<VTKFile type="PolyData" version="1.0" byte_order="LittleEndian" header_type="UInt32"',
        f'{compressor}>\n<PolyData>\n<Piece NumberOfPoints="{len(points)}" {numbered}>\n<Points>\n',
        _array(points, "Points", ascii, components=3),
        f"</Points>\n<{kind}>\n",
        _array(numbers, "connectivity", ascii),
        _array(ends, "offsets", ascii),
        f"</{kind}>\n",
        *([f"<{whose}>\n", *data, f"</{whose}>\n"] if data else []),
        "</Piece>\n</PolyData>\n</VTKFile>\n",
    ]
    Path(path).write_text("".join(parts), encoding="ascii")


def _array(values, name, ascii, *, components=1):
    kind = _TYPES[values.dtype.str[1:]]
    many = f' NumberOfComponents="{components}"' if components > 1 else ""
    head = f'<DataArray type="{kind}" Name="{name}"{many} format="{"ascii" if ascii else "binary"}">\n'
    if ascii:
        rows = values.reshape(-1, 3) if values.size % 3 == 0 else values.reshape(-1, 1)
        text = "\n".join(" ".join(map(repr, row)) for row in rows.tolist())
    else:
        data = values.astype(values.dtype.newbyteorder("<"), copy=False).tobytes()
        # Digits of positions are as good as random: zlib would take forty times as long to save 7 %.
        text = _compressed(data, 0) if values.dtype.kind == "f" else _compressed_again(data)
    return f"{head}{text}\n</DataArray>\n"


@lru_cache(maxsize=128)
def _compressed_again(data: bytes) -> str:
    """Numbers of points and ends, which are those of the frame before where a surface keeps its faces."""
    return _compressed(data, 1)


def _compressed(data, level):
    """VTK's inline form: a header of block sizes, then the zlib blocks, each part in base64."""
    blocks = [zlib.compress(data[start : start + _BLOCK], level) for start in range(0, len(data), _BLOCK)]
    last = len(data) % _BLOCK
    header = np.array([len(blocks), _BLOCK, last, *map(len, blocks)], dtype="<u4")
    return (base64.b64encode(header.tobytes()) + base64.b64encode(b"".join(blocks))).decode("ascii")


class Collection:
    """A .pvd file that is complete after every frame, so that an interrupted run can be opened.

    Its ``end`` is the number of bytes before the closing tags.

    Parameters
    ----------
    path : path
        The files that it names are relative to its folder.
    end : int, optional
        Go on with the collection that is there, of which so many bytes count; else begin a new one.
    """

    _HEAD = '<?xml version="1.0"?>\n<VTKFile type="Collection" version="0.1">\n<Collection>\n'
    _TAIL = "</Collection>\n</VTKFile>\n"

    def __init__(self, path: str | Path, end: int | None = None) -> None:
        # Unbuffered: entries and closing tags go to the disk in one piece.
        self._file = open(path, "wb" if end is None else "r+b", buffering=0)  # noqa: SIM115
        if end is None:
            end = self._file.write(self._HEAD.encode())
        self.roll_back(end)

    def add(self, time: float, entries: list[tuple[str, str]]) -> None:
        """Add one time step.

        Parameters
        ----------
        time : float
        entries : list of (name, file)
        """
        lines = [
            f'<DataSet timestep="{time}" group="" part="{part}" name={quoteattr(name)} file={quoteattr(file)}/>\n'
            for part, (name, file) in enumerate(entries)
        ]
        self._write("".join(lines))

    def roll_back(self, end: int) -> None:
        """Forget what was added beyond this ``end``."""
        self.end = end
        self._file.truncate(end)
        self._write("")

    def close(self) -> None:
        """End the file."""
        self._file.close()

    def _write(self, text):
        data = text.encode()
        self._file.seek(self.end)
        if self._file.write(data + self._TAIL.encode()) < len(data) + len(self._TAIL):
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        self.end += len(data)
