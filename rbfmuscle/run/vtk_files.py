"""VTK files written and read directly: PolyData (.vtp) of surfaces and fibres, and collections over
time (.pvd), without loading VTK.
"""

import os
import re
import zlib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import lru_cache
from html import escape
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from rbfmuscle.folders import write_whole
from rbfmuscle.geometry.arrays import Array, Floats, Integers
from rbfmuscle.simulation.frame import FibreLines
from rbfmuscle.validation import MeshError

_TYPES = {"Float64": "<f8", "Float32": "<f4", "Int32": "<i4"}  # of VTK, in NumPy's words
_KINDS = {code: kind for kind, code in _TYPES.items()}
NORMALS = "normals"  # name of the array that VTK takes for them
_PARTS = ("PointData", "CellData", "Points", "Lines", "Polys")
_HEAD = """<?xml version="1.0"?>
<VTKFile type="PolyData" version="1.0"
 byte_order="LittleEndian" header_type="UInt32" compressor="vtkZLibDataCompressor">
<PolyData>
{fields}<Piece NumberOfPoints="{points}" NumberOfVerts="0" NumberOfLines="{lines}"
 NumberOfStrips="0" NumberOfPolys="{faces}">
{parts}</Piece>
</PolyData>
"""
# A text is the numbers of its letters, and a zero.
_NAME = """<FieldData>
<DataArray type="String" Name="name" NumberOfTuples="1" format="ascii">{}</DataArray>
</FieldData>
"""
BEFORE_DATA, AFTER_DATA = b'<AppendedData encoding="raw">\n_', b"\n</AppendedData>\n</VTKFile>\n"


class Block(NamedTuple):
    """An array of a PolyData file."""

    part: str  # that it belongs to, one of `_PARTS`
    name: str
    values: Array  # (n,) or (n, k), of one of `_TYPES`
    same: bool = False  # whether a mesh has it alike in every frame


def write_vtp(
    path: str | Path,
    vertices: ArrayLike,
    faces: ArrayLike,
    arrays: Mapping[str, ArrayLike] | None = None,
    *,
    name: str = "",
) -> None:
    """Write vertices (n, 3) in their precision, faces (m, 3), and ``arrays`` (n,) or (n, k) by name
    in single precision; the ``name`` of the mesh as an array "name" of its field data, as PyVista
    does not read those of a collection.
    """
    single = np.asarray(vertices).dtype == np.float32
    points = np.asarray(vertices, dtype="<f4" if single else "<f8")
    corners = np.asarray(faces, dtype="<i4")
    blocks = []
    for key, values in (arrays or {}).items():
        same = not (np.size(values) and np.ptp(values))
        blocks.append(Block("PointData", key, np.asarray(values, dtype="<f4"), same))
    blocks += [
        Block("Points", "Points", points),
        Block("Polys", "connectivity", corners.ravel(), same=True),
        Block("Polys", "offsets", np.arange(3, corners.size + 1, 3, dtype="<i4"), same=True),
    ]
    write_blocks(path, blocks, points=len(points), faces=len(corners), name=name)


def write_blocks(
    path: str | Path,
    blocks: Sequence[Block],
    *,
    points: int,
    lines: int = 0,
    faces: int = 0,
    name: str = "",
) -> None:
    """Write a PolyData file of so many points, lines and faces, and a ``name`` unless empty."""
    held = [block.name for block in blocks if block.part == "PointData"]
    marked = f' Normals="{NORMALS}"' if NORMALS in held else ""
    elements = dict.fromkeys(_PARTS, "")
    data = b""
    for block in blocks:
        kind = _KINDS[block.values.dtype.str]
        width = 1 if block.values.ndim == 1 else block.values.shape[1]
        elements[block.part] += (
            f'<DataArray type="{kind}" Name="{escape(block.name)}" '
            f'NumberOfComponents="{width}" format="appended" offset="{len(data)}"/>\n'
        )
        data += (_packed_once if block.same else _packed)(block.values.tobytes())
    parts = "".join(
        f"<{part}{marked if part == 'PointData' else ''}>\n{text}</{part}>\n"
        for part, text in elements.items()
        if text
    )
    fields = _NAME.format(" ".join(map(str, [*name.encode(), 0]))) if name else ""
    head = _HEAD.format(points=points, lines=lines, faces=faces, parts=parts, fields=fields)
    Path(path).write_bytes(b"".join([head.encode("ascii"), BEFORE_DATA, data, AFTER_DATA]))


def _packed(raw: bytes, level: int = 0) -> bytes:
    """VTK's header with the sizes of one zlib block, then the block.

    Stored as it is by default: compressing numbers takes ten times as long as writing them, and
    saves a third.
    """
    block = zlib.compress(raw, level)
    return np.array([1, len(raw), 0, len(block)], dtype="<u4").tobytes() + block


@lru_cache(maxsize=256)
def _packed_once(raw: bytes) -> bytes:
    """A compressed block, kept because meshes have it in every frame."""
    return _packed(raw, level=1)


def read_vtp(path: str | Path) -> tuple[Floats, Integers]:
    """Vertices (n, 3) and faces (m, 3) of what `write_vtp` has written; MeshError if missing,
    another or damaged.
    """
    with refusing_damage(path):
        found = read_blocks(path)
        points = numbers_of(*found["Points"]).reshape(-1, 3)
        return points.astype(float), _corners(*found["connectivity"])


@contextmanager
def refusing_damage(path: str | Path) -> Iterator[None]:
    """Context that raises MeshError for a file that is missing, or none that a run has written."""
    try:
        yield
    except FileNotFoundError:
        raise MeshError(f"{path} is missing") from None
    except (KeyError, ValueError, IndexError, zlib.error):
        raise MeshError(
            f"{path} is damaged or was not written by a run; run the scene again"
        ) from None


def read_blocks(path: str | Path) -> dict[str, tuple[bytes, str]]:
    """The zlib block of each array of a file that `write_blocks` has written, and VTK's type, by
    the array's name.
    """
    text, _, data = Path(path).read_bytes().partition(BEFORE_DATA)
    found = {}
    for kind, name, place in re.findall(rb'type="(\w+)" Name="([^"]+)"[^>]*offset="(\d+)"', text):
        start = int(place)
        size = int(np.frombuffer(data, "<u4", 4, start)[3])
        found[name.decode()] = data[start + 16 : start + 16 + size], kind.decode()
    return found


def numbers_of(block: bytes, kind: str) -> Array:
    """Numbers of a zlib block, of VTK's type."""
    return np.frombuffer(zlib.decompress(block), _TYPES[kind])


@lru_cache(maxsize=64)
def _corners(block: bytes, kind: str) -> Integers:
    """Faces (m, 3), kept because a mesh has the same ones in every frame."""
    return numbers_of(block, kind).reshape(-1, 3).astype(int)


class Collection:
    """A .pvd file, complete after every frame, as runs are interrupted; it names files relative to
    its folder.
    """

    _HEAD = b'<?xml version="1.0"?>\n<VTKFile type="Collection" version="0.1">\n<Collection>\n'
    _TAIL = b"</Collection>\n</VTKFile>\n"

    def __init__(self, path: str | Path) -> None:
        self._path = Path(path)
        self._end = len(self._HEAD)  # where the next time step goes
        write_whole(self._path, self._HEAD + self._TAIL)

    def add(self, time: float, entries: list[tuple[str, str]]) -> None:
        """Add one time step; ``entries`` are pairs of name and file.

        What is there is not written again. Where the disk takes no more, the file is as before.
        """
        lines = ""
        for part, (name, file) in enumerate(entries):
            place = f'part="{part}" name="{escape(name)}" file="{escape(file)}"'
            lines += f'<DataSet timestep="{time}" group="" {place}/>\n'
        step = lines.encode()
        try:
            self._write(step + self._TAIL)
        except OSError:
            os.truncate(self._path, self._end)
            self._write(self._TAIL)
            raise
        self._end += len(step)

    def _write(self, data: bytes) -> None:
        with self._path.open("r+b") as file:
            file.seek(self._end)
            file.write(data)


def frame_file(kind: str, name: str, frame: int) -> str:
    """File of a mesh of some kind ("surfaces", "bones" or "fibres") in a frame, in the run's
    folder.
    """
    return f"{kind}/{name}{frame_end(frame)}"


def frame_end(frame: int) -> str:
    """What the names of a frame's files end with."""
    return f"_{frame:04d}.vtp"


def write_fibres(path: Path, fibres: FibreLines) -> None:
    """Write fibres as polylines (VTK PolyData): for each its ``length`` and ``stretch``, for each
    point the ``local_stretch``.
    """
    lines, points = fibres.points.shape[:2]
    count = lines * points
    blocks = [
        Block("PointData", "local_stretch", fibres.local_stretch.ravel()),
        Block("CellData", "length", fibres.lengths),
        Block("CellData", "stretch", fibres.stretch),
        Block("Points", "Points", fibres.points.reshape(-1, 3)),
        Block("Lines", "connectivity", np.arange(count, dtype="<i4")),
        Block("Lines", "offsets", points * np.arange(1, lines + 1, dtype="<i4")),
    ]
    write_blocks(path, blocks, points=count, lines=lines)


def read_fibres(path: Path) -> FibreLines:
    """Fibres of a file that `write_fibres` has written; MeshError if missing or damaged."""
    with refusing_damage(path):
        blocks = read_blocks(path)
        points, stretch, local = (
            numbers_of(*blocks[name]).copy() for name in ("Points", "stretch", "local_stretch")
        )
        lines = len(stretch)
        return FibreLines(points.reshape(lines, -1, 3), stretch, local.reshape(lines, -1))
