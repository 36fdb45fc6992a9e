"""VTK XML files (``.vtp``) of PolyData: text, base64 or raw appended data, plain or compressed."""

from __future__ import annotations

import base64
import binascii
import lzma
import re
import zlib
from typing import Any, NamedTuple
from xml.etree import ElementTree

import numpy as np

from rbfmuscle.sim.formats.legacy import parse_numbers
from rbfmuscle.sim.formats.lz4 import unpack_lz4
from rbfmuscle.sim.formats.polydata import (
    NO_CELLS,
    BrokenFileError,
    Cells,
    PolyData,
    check_cells,
    check_room,
)

_TYPES = {
    "Int8": "i1", "UInt8": "u1", "Int16": "i2", "UInt16": "u2", "Int32": "i4", "UInt32": "u4", "Int64": "i8",
    "UInt64": "u8", "Float32": "f4", "Float64": "f8",
}  # fmt: skip
_COMPRESSORS = ("vtkZLibDataCompressor", "vtkLZMADataCompressor", "vtkLZ4DataCompressor")
_APPENDED = re.compile(rb"<AppendedData([^>]{0,400})>\s*_")


def parse_vtp(content: bytes, *, values: bool = False) -> PolyData:
    """Return what the bytes of a VTP file hold, the cells' values where asked; raises BrokenFileError."""
    file = _open(content)
    pieces = [_read_piece(file, piece, values) for piece in file.root.iterfind("./PolyData/Piece")]
    if not pieces:
        raise BrokenFileError("the file has no piece of PolyData")
    return pieces[0] if len(pieces) == 1 else _joined(pieces)


class _File(NamedTuple):
    """A file's elements, its appended bytes, and how numbers are written in it."""

    root: object
    appended: bytes
    appended_raw: bool
    order: str
    header: np.dtype
    compressor: str
    size: int


def _open(content):
    found = _APPENDED.search(content)
    xml = content if found is None else content[: found.start()] + b"</VTKFile>"
    if b"<VTKFile" not in xml[:4096]:
        raise BrokenFileError("not a VTK PolyData file (no <VTKFile> at its beginning)")
    if b"<!DOCTYPE" in xml or b"<!ENTITY" in xml:
        raise BrokenFileError("not a readable VTP file (it declares a document type)")
    try:
        root = ElementTree.fromstring(xml)
    except (ElementTree.ParseError, ValueError, LookupError) as error:
        raise BrokenFileError(f"not a readable VTP file ({error})") from None
    if root.tag != "VTKFile" or root.get("type") != "PolyData":
        raise BrokenFileError(f"not a VTK PolyData file but {root.get('type', root.tag)[:40]!r}")
    order = {"LittleEndian": "<", "BigEndian": ">"}.get(root.get("byte_order", "LittleEndian"))
    header = {"UInt32": "u4", "UInt64": "u8"}.get(root.get("header_type", "UInt32"))
    compressor = root.get("compressor", "")
    if order is None or header is None:
        raise BrokenFileError(
            f"unknown byte_order {root.get('byte_order')!r} or header_type {root.get('header_type')!r}"
        )
    if compressor and compressor not in _COMPRESSORS:
        raise BrokenFileError(f"unknown compressor {compressor[:40]!r}; known: {', '.join(_COMPRESSORS)}")
    raw = found is not None and b'"raw"' in found.group(1)
    appended = content[found.end() :] if found is not None else b""
    return _File(root, appended, raw, order, np.dtype(order + header), compressor, len(content))


def _read_piece(file, piece, values):
    count = _number(piece, "NumberOfPoints", file.size)
    array = piece.find("./Points/DataArray")
    points = np.zeros((0, 3))
    if array is not None and count:
        points = _values(file, array, 3 * count).astype(np.float64).reshape(-1, 3)
    elif count:
        raise BrokenFileError(f"{count} points are promised, none are given")
    cells = [_read_cells(file, piece, kind, count) for kind in ("Lines", "Polys", "Strips")]
    return PolyData(points, *cells, _cell_values(file, piece) if values else {})


def _cell_values(file, piece):
    """Arrays of one number a cell by name."""
    count = sum(
        _number(piece, f"NumberOf{kind}", file.size) for kind in ("Verts", "Lines", "Polys", "Strips")
    )
    arrays = [array for array in piece.iterfind("./CellData/DataArray") if array.get("type") in _TYPES]
    return {
        array.get("Name", ""): _values(file, array, count)
        for array in arrays
        if array.get("NumberOfComponents", "1") == "1"
    }


def _read_cells(file, piece, kind, points):
    count = _number(piece, f"NumberOf{kind}", file.size)
    if count == 0:
        return NO_CELLS
    arrays = {array.get("Name"): array for array in piece.iterfind(f"./{kind}/DataArray")}
    if not {"connectivity", "offsets"} <= set(arrays):
        raise BrokenFileError(f"{count} {kind} are promised, without their connectivity and offsets")
    ends = _values(file, arrays["offsets"], count).astype(np.int64)
    numbers = _values(file, arrays["connectivity"], None).astype(np.int64)
    return check_cells(Cells(ends, numbers), points, kind)


def _values(file, array, count):
    """Numbers of a DataArray as they are in the file: ``count`` of them where that is known."""
    code = _TYPES.get(array.get("type", ""))
    name = (array.get("Name") or "an array")[:40]
    if code is None:
        raise BrokenFileError(f"{name} has the unknown number type {array.get('type', '')[:40]!r}")
    form = array.get("format", "ascii")
    try:
        if form == "ascii":
            return parse_numbers(array.text or "", count, whole=code[0] != "f")
        dtype = np.dtype(file.order + code)
        most = None if count is None else count * dtype.itemsize
        if form == "binary":
            source = _Base64(b"".join((array.text or "").encode("ascii", errors="replace").split()))
        elif form == "appended":
            offset = _number(array, "offset", file.size)
            source = (_Raw if file.appended_raw else _Base64)(file.appended[offset:])
        else:
            raise BrokenFileError(f"unknown format {form[:40]!r}")
        data = _unpack(file, source, most, name) if file.compressor else _plain(file, source, most, name)
    except BrokenFileError as error:
        raise BrokenFileError(f"not a readable VTP file: {name}: {error}") from None
    if len(data) % dtype.itemsize or (most is not None and len(data) != most):
        raise BrokenFileError(f"{name} holds {len(data)} bytes, {most} are promised")
    return np.frombuffer(data, dtype)


class _Raw:
    """Bytes as they stand."""

    def __init__(self, data: Any) -> None:
        self.data, self.at = data, 0

    def take(self, size: Any) -> Any:
        """The next ``size`` bytes."""
        found = self.data[self.at : self.at + size]
        if len(found) < size:
            raise BrokenFileError(f"ends after {len(found)} of {size} bytes")
        self.at += size
        return found

    def end_part(self) -> None:
        """The part that begins here is written by itself."""


class _Base64(_Raw):
    """Bytes in base64; parts may be written by themselves, each with its own padding."""

    def __init__(self, text: bytes) -> None:
        self.text, self.start, self.at = text, 0, 0

    def take(self, size: Any) -> Any:
        # Only what is asked for is decoded, from the four characters on in which it begins.
        first, last = self.at // 3 * 4, -(-(self.at + size) // 3) * 4
        piece = self.text[self.start + first : self.start + last]
        try:
            found = base64.b64decode(piece + b"=" * (-len(piece) % 4), validate=True)[self.at % 3 :][:size]
        except (binascii.Error, ValueError) as error:
            raise BrokenFileError(f"not base64 ({error})") from None
        if len(found) < size:
            raise BrokenFileError(f"ends after {len(found)} of {size} bytes")
        self.at += size
        return found

    def end_part(self) -> None:
        self.start += -(-self.at // 3) * 4
        self.at = 0

    def header_is_apart(self) -> Any:
        """Whether what was taken so far ends in padding."""
        end = self.start + -(-self.at // 3) * 4
        return self.text[end - 1 : end] == b"="


def _plain(file, source, most, name):
    """An array behind its size in bytes."""
    size = int(np.frombuffer(source.take(file.header.itemsize), file.header)[0])
    if most is not None and size != most:
        raise BrokenFileError(f"says {size} bytes where {most} are promised")
    if size > file.size:
        raise BrokenFileError(f"says {size} bytes, more than the file has")
    if isinstance(source, _Base64) and source.header_is_apart():
        source.end_part()
    return source.take(size)


def _unpack(file, source, most, name):
    """An array in blocks, behind their number, their size, the last one's size and their packed sizes."""
    width = file.header.itemsize
    blocks, size, last = (int(n) for n in np.frombuffer(source.take(3 * width), file.header))
    if blocks * width > file.size:
        raise BrokenFileError(f"says {blocks} blocks, more than the file can hold")
    sizes = [size] * blocks
    if blocks and last:
        sizes[-1] = last
    total = sum(sizes)
    if most is not None and total != most:
        raise BrokenFileError(f"unpacks to {total} bytes where {most} are promised")
    check_room(total, file.size, name)
    packed = np.frombuffer(source.take(blocks * width), file.header).tolist()
    if sum(packed) > file.size:
        raise BrokenFileError("has blocks of more bytes than the file")
    source.end_part()
    return b"".join(_unpack_block(file, source.take(int(n)), whole) for n, whole in zip(packed, sizes))


def _unpack_block(file, data, size):
    """One block; not a byte more than it says is unpacked."""
    try:
        if file.compressor == "vtkZLibDataCompressor":
            found = zlib.decompressobj().decompress(data, size)
        elif file.compressor == "vtkLZMADataCompressor":
            found = lzma.LZMADecompressor(memlimit=1 << 28).decompress(data, size)
        else:
            found = unpack_lz4(data, size)
    except (zlib.error, lzma.LZMAError, EOFError) as error:
        raise BrokenFileError(f"a block cannot be unpacked ({error})") from None
    if len(found) != size:
        raise BrokenFileError(f"a block unpacks to {len(found)} bytes where {size} are promised")
    return found


def _number(element, key, most):
    text = element.get(key, "0").strip()
    if not (text.isascii() and text.isdigit()) or len(text) > 18 or int(text) > 100 * most:
        raise BrokenFileError(f"{key} of {text[:40]!r}: not a number that the file can hold")
    return int(text)


def _joined(pieces):
    """Several pieces as one, their point numbers shifted."""
    shift, parts = 0, {"lines": [], "polygons": [], "strips": []}
    for piece in pieces:
        for kind, found in parts.items():
            cells = getattr(piece, kind)
            filled = sum(len(numbers) for _, numbers in found)
            found.append((cells.ends + filled, cells.numbers + shift))
        shift += len(piece.points)
    cells = {
        kind: Cells(np.concatenate([e for e, _ in found]), np.concatenate([n for _, n in found]))
        for kind, found in parts.items()
    }
    return PolyData(np.vstack([piece.points for piece in pieces]), **cells, values={})
