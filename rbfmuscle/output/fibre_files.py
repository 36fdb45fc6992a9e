"""Fibres of a run in its folder: a file of polylines for each muscle and frame, and one table."""

import csv
import re
import zlib
from collections.abc import Iterator, Mapping
from pathlib import Path

import numpy as np

from rbfmuscle.output.vtp import AFTER_DATA, BEFORE_DATA, packed, unpacked
from rbfmuscle.simulation.frame import FibreLines
from rbfmuscle.validation import MeshError

FOLDER, TABLE = "fibres", "fibres.csv"
COLUMNS = ("frame", "muscle", "fibre", "length", "stretch")
_ARRAYS = {  # name: VTK's type, components, where it belongs
    "Points": ("Float64", 3, "Points"),
    "connectivity": ("Int32", 1, "Lines"),
    "offsets": ("Int32", 1, "Lines"),
    "local_stretch": ("Float64", 1, "PointData"),
    "length": ("Float64", 1, "CellData"),
    "stretch": ("Float64", 1, "CellData"),
}
_NUMPY = {"Float64": "<f8", "Int32": "<i4"}


def fibre_file(muscle: str, frame: int) -> str:
    """Name of the file of a muscle's fibres in a frame, in the run's folder."""
    return f"{FOLDER}/{muscle}_{frame:04d}.vtp"


def write_fibres(path: Path, fibres: FibreLines) -> None:
    """Write fibres as polylines (VTK PolyData): for each its ``length`` and ``stretch``, for each
    point the ``local_stretch``.
    """
    lines, points = fibres.points.shape[:2]
    count = lines * points
    arrays = {
        "Points": fibres.points,
        "connectivity": np.arange(count),
        "offsets": points * np.arange(1, lines + 1),
        "local_stretch": fibres.local_stretch,
        "length": fibres.lengths,
        "stretch": fibres.stretch,
    }
    parts = dict.fromkeys(("PointData", "CellData", "Points", "Lines"), "")
    blocks = []
    offset = 0
    for name, (kind, components, part) in _ARRAYS.items():
        block = packed(np.ascontiguousarray(arrays[name], dtype=_NUMPY[kind]).tobytes())
        parts[part] += (
            f'<DataArray type="{kind}" Name="{name}" NumberOfComponents="{components}" '
            f'format="appended" offset="{offset}"/>\n'
        )
        offset += len(block)
        blocks.append(block)
    inner = "".join(f"<{part}>\n{text}</{part}>\n" for part, text in parts.items())
    head = (
        '<?xml version="1.0"?>\n<VTKFile type="PolyData" version="1.0" byte_order="LittleEndian" '
        'header_type="UInt32" compressor="vtkZLibDataCompressor">\n<PolyData>\n'
        f'<Piece NumberOfPoints="{count}" NumberOfVerts="0" NumberOfLines="{lines}" '
        f'NumberOfStrips="0" NumberOfPolys="0">\n{inner}</Piece>\n</PolyData>\n'
    )
    path.write_bytes(b"".join([head.encode("ascii"), BEFORE_DATA, *blocks, AFTER_DATA]))


def read_fibres(path: Path) -> FibreLines:
    """Fibres of a file that `write_fibres` has written; MeshError if missing or damaged."""
    try:
        text, _, data = path.read_bytes().partition(BEFORE_DATA)
        starts = re.findall(rb'type="(\w+)" Name="(\w+)"[^>]*offset="(\d+)"', text)
        found = {
            name.decode(): unpacked(data, kind.decode(), int(start)) for kind, name, start in starts
        }
        lines = len(found["stretch"])
        points = found["Points"].reshape(lines, -1, 3)
        local = found["local_stretch"].reshape(lines, -1)
        return FibreLines(points.copy(), found["stretch"].copy(), local.copy())
    except FileNotFoundError:
        raise MeshError(f"{path} is missing") from None
    except (KeyError, ValueError, IndexError, StopIteration, zlib.error):
        raise MeshError(
            f"{path} is damaged or was not written by a run; run the scene again"
        ) from None


def begin_table(directory: Path) -> None:
    """Write the table's head."""
    with (directory / TABLE).open("w", encoding="utf-8", newline="") as file:
        csv.writer(file, lineterminator="\n").writerow(COLUMNS)


def write_frame(directory: Path, frame: int, fibres: Mapping[str, FibreLines]) -> None:
    """Write the fibres of a frame, by muscle: the files and the rows of the table."""
    for muscle, lines in fibres.items():
        write_fibres(directory / fibre_file(muscle, frame), lines)
    with (directory / TABLE).open("a", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        for muscle, lines in fibres.items():
            for number, row in enumerate(zip(lines.lengths.tolist(), lines.stretch.tolist())):
                writer.writerow((frame, muscle, number, *row))


class SavedFibres(Mapping[str, FibreLines]):
    """Fibres of the muscles in a frame of a run's folder, each read when it is asked for."""

    def __init__(self, directory: Path, muscles: list[str], frame: int) -> None:
        self._files = {name: directory / fibre_file(name, frame) for name in muscles}
        self._files = {name: file for name, file in self._files.items() if file.is_file()}

    def __getitem__(self, muscle: str) -> FibreLines:
        return read_fibres(self._files[muscle])

    def __iter__(self) -> Iterator[str]:
        return iter(self._files)

    def __len__(self) -> int:
        return len(self._files)
