"""Blocks packed by LZ4, which ParaView offers and the standard library does not read."""

from rbfmuscle.sim.formats.polydata import BrokenFileError


def unpack_lz4(data: bytes, size: int) -> bytes:
    """Return the ``size`` bytes of a raw LZ4 block; raises BrokenFileError if it holds more, or fewer.

    Notes
    -----
    A block is a row of sequences: a token with two lengths of four bits, literals, and a distance back from
    which a match is copied (which may overlap what it writes).
    """
    out, at = bytearray(), 0
    try:
        while at < len(data):
            token = data[at]
            count, at = _length(data, at + 1, token >> 4)
            out += data[at : at + count]
            at += count
            if at >= len(data):
                break
            back = data[at] | data[at + 1] << 8
            count, at = _length(data, at + 2, token & 15)
            count += 4
            if not 0 < back <= len(out) or len(out) + count > size:
                raise BrokenFileError("a block packed by LZ4 is damaged")
            if back >= count:
                start = len(out) - back
                out += out[start : start + count]
            else:  # the match repeats what it writes
                piece = bytes(out[-back:])
                out += (piece * (count // back + 1))[:count]
    except IndexError:
        raise BrokenFileError("a block packed by LZ4 ends too early") from None
    if len(out) != size:
        raise BrokenFileError(f"a block unpacks to {len(out)} bytes where {size} are promised")
    return bytes(out)


def _length(data, at, length):
    if length == 15:
        while data[at] == 255:
            length, at = length + 255, at + 1
        length, at = length + data[at], at + 1
    return length, at
