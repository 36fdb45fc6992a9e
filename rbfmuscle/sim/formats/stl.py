"""STL files, binary or text: three corners a triangle."""

from pathlib import Path

import numpy as np

from rbfmuscle.sim.formats.legacy import parse_numbers
from rbfmuscle.sim.formats.polydata import BrokenFileError
from rbfmuscle.validation import MeshError

_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])


def read_stl(path: str | Path) -> np.ndarray:
    """Return the corners (m, 3, 3) of the triangles of an STL file.

    Raises
    ------
    MeshError
        If the file is damaged.
    """
    content = Path(path).read_bytes()
    count = int.from_bytes(content[80:84], "little") if len(content) >= 84 else -1
    if 84 + 50 * count == len(content):
        return _binary(content, count)
    if content.lstrip()[:5].lower() == b"solid" and b"facet" in content.lower()[:5000]:
        try:
            return _text(content)
        except BrokenFileError as error:
            raise MeshError(f"{path}: not a readable STL file ({error})") from None
    if count >= 0 and 84 + 50 * count < len(content):  # bytes after the triangles, as some programs leave
        return _binary(content, count)
    raise MeshError(
        f"{path}: not a readable STL file: neither text from 'solid' on, nor the {count} triangles that it promises "
        f"in its {len(content)} bytes"
    )


def _binary(content, count):
    return np.frombuffer(content, _TRIANGLE, count, 84)["corners"].astype(np.float64)


def _text(content):
    lines = [line.split(None, 1) for line in content.splitlines()]
    rows = [line[1] for line in lines if len(line) == 2 and line[0].lower() == b"vertex"]
    named = sum(1 for line in lines if line and line[0].lower() == b"vertex")
    if named != len(rows) or len(rows) % 3:
        raise BrokenFileError(f"{named} vertices, which is not three a triangle")
    if not any(line and line[0].lower() == b"endsolid" for line in lines[-5:]):
        raise BrokenFileError("it ends before 'endsolid'")
    return parse_numbers(b" ".join(rows), 3 * len(rows), whole=False).reshape(-1, 3, 3)
