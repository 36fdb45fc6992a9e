"""Arrays that take long to work out, kept on disk by the content of mesh and options: distance fields, weights.

An entry is an uncompressed archive of arrays (`numpy.load` reads it), whose checksums are tested on reading. It is
written beside its place and moved there, so that several processes may build the same field and none reads half of
it; those that read it share its pages in memory.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import logging
import mmap
import os
import struct
import tempfile
import zipfile
from pathlib import Path
from threading import Lock
from typing import IO, Any

import numpy as np

from rbfmuscle.geometry.arrays import Array, Floats, Integers

log = logging.getLogger(__name__)

# Part of every name: raise it when the arrays or the way they are built change.
VERSION = 11
SUFFIX = ".sdf.npz"
# Arrays begin at multiples of this in a file [bytes], so that they can be used where they lie; the extra field that
# fills the way there is marked as padding, as other writers of archives mark it.
ALIGNED, _PADDING = 64, 0xD935
# What an archive says before the name of an entry [bytes]; the lengths of name and extra field come last.
_HEADER = 30
_READING = Lock()
# What reading a damaged, foreign or half-removed archive may raise.
_DAMAGE = (OSError, ValueError, KeyError, EOFError, IndexError, NotImplementedError, zipfile.BadZipFile)


def cache_path() -> Path:
    """Folder of the cache: ``RBFMUSCLE_CACHE``, or the user's cache folder of the platform."""
    import platformdirs

    place = os.environ.get("RBFMUSCLE_CACHE")
    return Path(place) if place else Path(platformdirs.user_cache_dir("rbfmuscle", appauthor=False)) / "sdf"


def content_key(vertices: Floats, faces: Integers, options: tuple[Any, ...]) -> str:
    """Name of an entry: a digest of the mesh and of all options that shape the field."""
    digest = hashlib.sha256(repr((VERSION, np.dtype(float).byteorder, options)).encode())
    for array in (vertices, faces):
        digest.update(repr((array.shape, array.dtype.str)).encode())
        digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()[:32]


def load_arrays(key: str) -> dict[str, Array] | None:
    """Arrays of an entry by name, or None where there is none; a damaged entry is removed."""
    path = cache_path() / (key + SUFFIX)
    if not path.exists():
        return None
    try:
        # One thread at a time: Python 3.11 counts the depth of what it parses, as NumPy's headers, for all together.
        with _READING:
            arrays = _mapped(path)
        if str(arrays.pop("key")) != key:
            raise ValueError("the entry belongs to another mesh")
    except _DAMAGE as error:
        log.warning("cache: %s is damaged (%s) and is built again", path, error)
        with contextlib.suppress(OSError):
            path.unlink()
        return None
    return arrays


def store_arrays(key: str, arrays: dict[str, Any]) -> None:
    """Keep arrays under a name; a cache that cannot be written is reported in the log and does no harm."""
    folder = cache_path()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(prefix=key, suffix=SUFFIX + ".part", dir=folder)
        try:
            with os.fdopen(handle, "wb") as file:
                _write(file, {"key": np.array(key), **arrays})
            Path(name).replace(folder / (key + SUFFIX))
        except BaseException:
            Path(name).unlink(missing_ok=True)
            raise
    except OSError as error:
        log.warning("cache: %s cannot be written (%s); nothing is kept", folder, error)


def _write(file: IO[bytes], arrays: dict[str, Any]) -> None:
    """An archive of arrays, each of which begins at a multiple of ALIGNED."""
    with zipfile.ZipFile(file, "w", zipfile.ZIP_STORED) as archive:
        for name, array in arrays.items():
            text, entry = io.BytesIO(), zipfile.ZipInfo(name + ".npy")
            # Its own header is padded to a multiple of 64.
            np.lib.format.write_array(text, np.asarray(array, order="C"), allow_pickle=False)
            room = -(file.tell() + _HEADER + len(entry.filename) + 4) % ALIGNED
            entry.extra = struct.pack("<HH", _PADDING, room) + bytes(room)
            archive.writestr(entry, text.getvalue())


def _mapped(path: Path) -> dict[str, Array]:
    """Arrays of an archive where they lie in the file: what is written to them stays with this process."""
    with path.open("rb") as file, zipfile.ZipFile(file) as archive:
        broken = archive.testzip()
        if broken is not None:
            raise ValueError(f"the checksum of {broken} is wrong")
        pages = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_COPY)
        found = {}
        for entry in archive.infolist():
            lengths = struct.unpack_from("<HH", pages, entry.header_offset + _HEADER - 4)
            file.seek(entry.header_offset + _HEADER + sum(lengths))
            if np.lib.format.read_magic(file) != (1, 0) or entry.compress_type != zipfile.ZIP_STORED:
                raise ValueError(f"{entry.filename} is of another format")
            shape, by_columns, dtype = np.lib.format.read_array_header_1_0(file)
            count = int(np.prod(shape, dtype=np.int64))
            array = np.frombuffer(pages, dtype, count, file.tell()).reshape(
                shape, order="F" if by_columns else "C"
            )
            found[entry.filename.removesuffix(".npy")] = array if array.flags.aligned else array.copy()
    return found
