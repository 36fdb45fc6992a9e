"""VTK files written directly: PolyData (.vtp) and collections over time (.pvd), without loading VTK."""

from __future__ import annotations

import base64
import errno
import os
import zlib
from collections.abc import Mapping
from functools import lru_cache
from pathlib import Path
from xml.sax.saxutils import quoteattr

import numpy as np
from numpy.typing import ArrayLike

_TYPES = {"f8": "Float64", "i4": "Int32"}


def write_vtp(
    path: str | Path, vertices: ArrayLike, faces: ArrayLike, *, values: Mapping[str, ArrayLike] | None = None
) -> None:
    """Write a triangle mesh as VTK XML PolyData, positions in double precision.

    Parameters
    ----------
    path : path
    vertices : (n, 3) array_like
    faces : (m, 3) array_like of int
    values : mapping of str to (n,) array_like, optional
        Of the vertices, by name.
    """
    points = np.ascontiguousarray(vertices, dtype="<f8")
    corners = np.ascontiguousarray(faces, dtype="<i4")
    ends = np.arange(3, 3 * len(corners) + 1, 3, dtype="<i4")
    data = "".join(_array(np.ascontiguousarray(v, dtype="<f8"), name) for name, v in (values or {}).items())
    text = (
        '<?xml version="1.0"?>\n'
        '<VTKFile type="PolyData" version="1.0" byte_order="LittleEndian" header_type="UInt32" '
        'compressor="vtkZLibDataCompressor">\n<PolyData>\n'
        f'<Piece NumberOfPoints="{len(points)}" NumberOfVerts="0" NumberOfLines="0" NumberOfStrips="0" '
        f'NumberOfPolys="{len(corners)}">\n'
        f"<Points>\n{_array(points, 'Points', 3)}</Points>\n"
        f"<Polys>\n{_array(corners.ravel(), 'connectivity')}{_array(ends, 'offsets')}</Polys>\n"
        f"<PointData>\n{data}</PointData>\n</Piece>\n</PolyData>\n</VTKFile>\n"
    )
    Path(path).write_text(text, encoding="ascii")


def _array(values, name, components=1):
    # Digits of positions are as good as random: zlib would take forty times as long to save 7 %.
    text = (
        _compressed(values.tobytes(), 0) if values.dtype.kind == "f" else _compressed_again(values.tobytes())
    )
    return (
        f'<DataArray type="{_TYPES[values.dtype.str[1:]]}" Name="{name}" NumberOfComponents="{components}" '
        f'format="binary">\n{text}\n</DataArray>\n'
    )


@lru_cache(maxsize=128)
def _compressed_again(data: bytes) -> str:
    """Numbers of points and ends, which are those of the frame before where a surface keeps its faces."""
    return _compressed(data, 1)


def _compressed(data, level):
    """VTK's inline form: a header with the sizes of one zlib block, then the block, each in base64."""
    block = zlib.compress(data, level)
    header = np.array([1, len(data), 0, len(block)], dtype="<u4")
    return (base64.b64encode(header.tobytes()) + base64.b64encode(block)).decode("ascii")


class Collection:
    """A .pvd file that is complete after every frame, so that an interrupted run can be opened.

    Its ``end`` is the number of bytes before the closing tags.

    Parameters
    ----------
    path : path
        The files that it names are relative to its folder.
    """

    _HEAD = '<?xml version="1.0"?>\n<VTKFile type="Collection" version="0.1">\n<Collection>\n'
    _TAIL = "</Collection>\n</VTKFile>\n"

    def __init__(self, path: str | Path) -> None:
        # Unbuffered: entries and closing tags go to the disk in one piece.
        self._file = open(path, "wb", buffering=0)  # noqa: SIM115
        self.roll_back(self._file.write(self._HEAD.encode()))

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
