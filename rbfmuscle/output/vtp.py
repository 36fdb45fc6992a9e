"""VTK files written and read directly: PolyData (.vtp) and collections over time (.pvd), without
loading VTK.
"""

import re
import zlib
from collections.abc import Mapping
from functools import lru_cache
from html import escape
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from rbfmuscle.folders import write_whole
from rbfmuscle.geometry.arrays import Array, Floats, Integers
from rbfmuscle.validation import MeshError

_TYPES = {"f8": "Float64", "f4": "Float32", "i4": "Int32"}
# Names of arrays that VTK takes for texture coordinates and normals.
TEXTURE, NORMALS = "texture_coordinates", "normals"
_HEAD = """<?xml version="1.0"?>
<VTKFile type="PolyData" version="1.0"
 byte_order="LittleEndian" header_type="UInt32" compressor="vtkZLibDataCompressor">
<PolyData>
<Piece NumberOfPoints="{}" NumberOfVerts="0" NumberOfLines="0"
 NumberOfStrips="0" NumberOfPolys="{}">
<PointData{}>
{}</PointData>
<Points>
{}</Points>
<Polys>
{}{}</Polys>
</Piece>
</PolyData>
"""
BEFORE_DATA, AFTER_DATA = b'<AppendedData encoding="raw">\n_', b"\n</AppendedData>\n</VTKFile>\n"


def write_vtp(
    path: str | Path,
    vertices: ArrayLike,
    faces: ArrayLike,
    arrays: Mapping[str, ArrayLike] | None = None,
) -> None:
    """Write vertices (n, 3) in their precision, faces (m, 3), and ``arrays`` (n,) or (n, k) by name
    in single precision.
    """
    points = np.ascontiguousarray(vertices)
    points = points.astype("<f4" if points.dtype == np.float32 else "<f8", copy=False)
    corners = np.ascontiguousarray(faces, dtype="<i4")
    values = {name: np.asarray(value, dtype="<f4") for name, value in (arrays or {}).items()}
    names = [*values, "Points", "connectivity", "offsets"]
    kinds = ["f4"] * len(values) + [points.dtype.str[1:], "i4", "i4"]
    widths = [value.size // max(len(value), 1) for value in values.values()] + [3, 1, 1]
    marks = (("TCoords", TEXTURE), ("Normals", NORMALS))
    marked = "".join(f' {mark}="{name}"' for mark, name in marks if name in values)
    contents = [np.ascontiguousarray(value) for value in values.values()]
    blocks = [
        packed(value.tobytes()) if len(value) and np.ptp(value) else _compressed(value.tobytes())
        for value in contents
    ]
    blocks += [packed(points.tobytes()), _compressed(corners.tobytes()), _ends(len(corners))]
    elements, offset = [], 0
    for name, kind, components, block in zip(names, kinds, widths, blocks):
        elements.append(
            f'<DataArray type="{_TYPES[kind]}" Name="{escape(name)}" '
            f'NumberOfComponents="{components}" format="appended" offset="{offset}"/>\n'
        )
        offset += len(block)
    data = "".join(elements[: len(values)])
    rest = elements[len(values) :]
    head = _HEAD.format(len(points), len(corners), marked, data, *rest).encode("ascii")
    Path(path).write_bytes(b"".join([head, BEFORE_DATA, *blocks, AFTER_DATA]))


def packed(raw: bytes, *, level: int = 0) -> bytes:
    """VTK's header with the sizes of one zlib block, then the block.

    Stored as it is by default: compressing numbers takes ten times as long as writing them, and
    saves a third.
    """
    block = zlib.compress(raw, level)
    return np.array([1, len(raw), 0, len(block)], dtype="<u4").tobytes() + block


@lru_cache(maxsize=128)
def _compressed(raw: bytes) -> bytes:
    """A block of what a mesh has alike in every frame."""
    return packed(raw, level=1)


@lru_cache(maxsize=128)
def _ends(faces: int) -> bytes:
    """The block of where each of so many faces ends."""
    return packed(np.arange(3, 3 * faces + 1, 3, dtype="<i4").tobytes(), level=1)


def read_vtp(path: str | Path) -> tuple[Floats, Integers]:
    """Vertices (n, 3) and faces (m, 3) of what `write_vtp` has written; MeshError if missing,
    another or damaged.
    """
    try:
        text, _, data = Path(path).read_bytes().partition(BEFORE_DATA)
        starts = re.findall(rb'type="(\w+)" Name="(Points|connectivity)"[^>]*offset="(\d+)"', text)
        found = {name: (_block(data, int(start)), kind.decode()) for kind, name, start in starts}
        points = _numbers(*found[b"Points"]).reshape(-1, 3)
        return points.astype(float), _corners(*found[b"connectivity"])
    except FileNotFoundError:
        raise MeshError(f"{path} is missing") from None
    except (KeyError, ValueError, IndexError, StopIteration, zlib.error):
        raise MeshError(
            f"{path} is damaged or was not written by a run; run the scene again"
        ) from None


def unpacked(data: bytes, kind: str, start: int) -> Array:
    """Numbers of a block of VTK's type ``kind`` that begins at a byte of the appended data."""
    return _numbers(_block(data, start), kind)


def _block(data: bytes, start: int) -> bytes:
    """The zlib block behind VTK's header at a byte of the appended data."""
    size = int(np.frombuffer(data, "<u4", 4, start)[3])
    return data[start + 16 : start + 16 + size]


def _numbers(block: bytes, kind: str) -> Array:
    code = next(f"<{code}" for code, name in _TYPES.items() if name == kind)
    return np.frombuffer(zlib.decompress(block), code)


@lru_cache(maxsize=64)
def _corners(block: bytes, kind: str) -> Integers:
    """Faces (m, 3), kept because a mesh has the same ones in every frame."""
    return _numbers(block, kind).reshape(-1, 3).astype(int)


class Collection:
    """A .pvd file, complete after every frame, as runs are interrupted; it names files relative to
    its folder.
    """

    def __init__(self, path: str | Path) -> None:
        self._path, self._lines = Path(path), ""
        self.add(0.0, [])

    def add(self, time: float, entries: list[tuple[str, str]]) -> None:
        """Add one time step; ``entries`` are pairs of name and file."""
        for part, (name, file) in enumerate(entries):
            place = f'part="{part}" name="{escape(name)}" file="{escape(file)}"'
            self._lines += f'<DataSet timestep="{time}" group="" {place}/>\n'
        head = '<?xml version="1.0"?>\n<VTKFile type="Collection" version="0.1">\n<Collection>\n'
        write_whole(self._path, f"{head}{self._lines}</Collection>\n</VTKFile>\n")
