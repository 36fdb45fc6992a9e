"""Legacy VTK files (``.vtk``) of PolyData: text or binary, with cells as lists or as offsets and numbers."""

from __future__ import annotations

import re
import warnings
from typing import Any

import numpy as np

from rbfmuscle.sim.formats.polydata import NO_CELLS, BrokenFileError, Cells, PolyData, check_cells

# VTK's names of number types; binary files are big-endian, and hold vtkIdType as 32 bits.
_TYPES = {
    "char": "i1", "unsigned_char": "u1", "short": "i2", "unsigned_short": "u2", "int": "i4",
    "unsigned_int": "u4", "long": "i8", "unsigned_long": "u8", "vtkidtype": "i4", "vtktypeint64": "i8",
    "vtktypeint32": "i4", "float": "f4", "double": "f8",
}  # fmt: skip
_KINDS = {"VERTICES": "vertices", "LINES": "lines", "POLYGONS": "polygons", "TRIANGLE_STRIPS": "strips"}
_KEYWORD = re.compile(
    rb"(?:^|(?<=\s))(POINTS|VERTICES|LINES|POLYGONS|TRIANGLE_STRIPS|OFFSETS|CONNECTIVITY|POINT_DATA|CELL_DATA"
    rb"|METADATA|FIELD)(?=\s|$)"
)


def parse_legacy(content: bytes) -> PolyData:
    """Return what the bytes of a legacy file hold; raises BrokenFileError."""
    cursor = _Cursor(content)
    if not cursor.line().lower().startswith("# vtk datafile"):
        raise BrokenFileError("not a VTK PolyData file (no '# vtk DataFile' in its first line)")
    cursor.line()
    form = cursor.words()
    if not form or form[0].upper() not in ("ASCII", "BINARY"):
        raise BrokenFileError(f"not a readable VTK file: neither ASCII nor BINARY but {_shown(form)}")
    cursor.binary = form[0].upper() == "BINARY"
    kind = cursor.words()
    if [word.upper() for word in kind] != ["DATASET", "POLYDATA"]:
        raise BrokenFileError(f"not a VTK PolyData file: {_shown(kind)}")
    points, cells = np.zeros((0, 3)), {}
    while (words := cursor.words()) is not None:
        key = words[0].upper()
        if key == "POINTS":
            points = (
                cursor.values(3 * cursor.count(words, 1), _word(words, 2)).astype(np.float64).reshape(-1, 3)
            )
        elif key in _KINDS:
            cells[_KINDS[key]] = _read_cells(cursor, words)
        elif key == "METADATA":
            cursor.skip_metadata()
        elif key == "FIELD":
            _skip_field(cursor, words)
        elif key in ("POINT_DATA", "CELL_DATA"):
            break
        else:
            raise BrokenFileError(f"not a readable VTK file: {_shown(words)} where a keyword should be")
    kept = {name: check_cells(found, len(points), name) for name, found in cells.items()}
    return PolyData(
        points, kept.get("lines", NO_CELLS), kept.get("polygons", NO_CELLS), kept.get("strips", NO_CELLS), {}
    )


class _Cursor:
    """A place in the bytes of a file; nothing is read beyond their end."""

    def __init__(self, content: Any) -> None:
        self.content, self.at, self.binary = content, 0, False

    def line(self) -> Any:
        end = self.content.find(b"\n", self.at)
        end = len(self.content) if end < 0 else end
        text, self.at = self.content[self.at : min(end, self.at + 1000)], end + 1
        return text.decode("ascii", errors="replace").strip()

    def words(self) -> Any:
        """Words of the next line that has any, None at the end of the file."""
        while self.at < len(self.content):
            found = self.line().split()
            if found:
                return found
        return None

    def peek(self) -> Any:
        """The next word in capitals, without going on."""
        place = self.at
        found = self.words()
        self.at = place
        return found[0].upper() if found else ""

    def count(self, words: Any, place: Any) -> Any:
        """A count that the file could hold: every number takes a byte at least."""
        text = _word(words, place)
        if not (text.isascii() and text.isdigit()) or len(text) > 18 or int(text) > len(self.content):
            raise BrokenFileError(f"{words[0][:40]} of {text[:40]!r}: more than the file can hold")
        return int(text)

    def values(self, count: int, kind: Any) -> Any:
        """The next numbers, of a type given by its name."""
        code = _TYPES.get(kind.lower())
        if code is None:
            raise BrokenFileError(f"unknown number type {kind[:40]!r}; known: {', '.join(_TYPES)}")
        if self.binary:
            dtype = np.dtype(">" + code)
            if self.at + count * dtype.itemsize > len(self.content):
                raise BrokenFileError(f"the file ends within {count} numbers of type {kind}")
            found = np.frombuffer(self.content, dtype, count, self.at)
            self.at += count * dtype.itemsize
            return found.astype(np.float64 if code[0] == "f" else np.int64)
        found = _KEYWORD.search(self.content, self.at)
        end = found.start() if found else len(self.content)
        text, self.at = self.content[self.at : end], end
        return parse_numbers(text, count, whole=code[0] != "f")

    def skip_metadata(self) -> None:
        """Metadata are lines of text up to an empty one."""
        while self.at < len(self.content) and self.line():
            pass


def parse_numbers(text: bytes | str, count: int | None, *, whole: bool) -> np.ndarray:
    """Numbers between blanks as float64, or int64 if ``whole``; exactly ``count`` where that is given."""
    with warnings.catch_warnings():
        # numpy tells of words that are no numbers by a warning, later by a ValueError.
        warnings.simplefilter("error")
        try:
            found = np.fromstring(text, dtype=np.int64 if whole else np.float64, sep=" ")
        except (DeprecationWarning, ValueError, OverflowError):
            raise BrokenFileError(f"text among numbers ({_first_wrong(text)!r})") from None
    if count is not None and len(found) != count:
        raise BrokenFileError(f"{len(found)} numbers where {count} are promised")
    return found


def _first_wrong(text):
    text = text.decode("ascii", errors="replace") if isinstance(text, bytes) else text
    for word in text.split():
        try:
            float(word)
        except ValueError:
            return word[:40]
    return text[:20]


def _read_cells(cursor, words):
    first, second = cursor.count(words, 1), cursor.count(words, 2)
    if cursor.peek() == "OFFSETS":
        offsets = cursor.values(first, _word(cursor.words(), 1))
        head = cursor.words() or [""]
        if head[0].upper() != "CONNECTIVITY":
            raise BrokenFileError(f"{words[0]} have OFFSETS, then {_shown(head)}: CONNECTIVITY is missing")
        numbers = cursor.values(second, _word(head, 1))
        if first and offsets[0] != 0:
            raise BrokenFileError(f"the offsets of {words[0]} begin at {offsets[0]}, not 0")
        return Cells(offsets[1:], numbers)
    listed = cursor.values(second, "int")
    return _unlist(listed, first, words[0])


def _unlist(listed, count, what):
    """Cells from ``n i0 i1 ... n i0 ...``."""
    if count == 0:
        return NO_CELLS
    if len(listed) % count == 0 and len(listed) > count:
        rows = listed.reshape(count, -1)
        if (rows[:, 0] == rows.shape[1] - 1).all():  # all of one size, as triangles are
            width = rows.shape[1] - 1
            return Cells(width * np.arange(1, count + 1), rows[:, 1:].ravel())
    sizes, at = [], 0
    numbers, length = listed.tolist(), len(listed)
    while len(sizes) < count:
        size = numbers[at] if at < length else -1
        if size < 0 or at + 1 + size > length:
            raise BrokenFileError(
                f"cell {len(sizes)} of {count} {what} does not fit the {length} numbers given"
            )
        sizes.append(size)
        at += 1 + size
    ends = np.cumsum(sizes)
    heads = np.concatenate([[0], ends[:-1]]) + np.arange(count)
    return Cells(ends, np.delete(listed[:at], heads))


def _skip_field(cursor, words):
    """Arrays beside the points, which nothing here needs."""
    for _ in range(cursor.count(words, 2)):
        head = cursor.words()
        while head and head[0].upper() == "METADATA":
            cursor.skip_metadata()
            head = cursor.words()
        if head is None or len(head) < 4:
            raise BrokenFileError(f"a field array begins with {_shown(head or [])}")
        if head[3].lower() in ("string", "bit"):
            raise BrokenFileError(
                f"field array {head[0][:40]!r} of type {head[3]}: write the file without fields"
            )
        cursor.values(cursor.count(head, 1) * cursor.count(head, 2), head[3])


def _word(words, place):
    return words[place] if words is not None and len(words) > place else ""


def _shown(words):
    return repr(" ".join(words or [])[:60])
