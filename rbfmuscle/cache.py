"""Arrays that take long to compute, kept on disk by the content of mesh and options: distance
fields, samples.

An entry is a NumPy archive (`numpy.load` reads it). It is written to a temporary file and moved to
its place, so that several processes may build the same field and none reads half of it. The entries
take `MOST_BYTES` at most.
"""

import contextlib
import hashlib
import logging
import os
import sys
import tempfile
import time
import zipfile
from collections.abc import Mapping
from pathlib import Path
from threading import Lock
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from rbfmuscle.geometry.arrays import Array, Floats, Integers

log = logging.getLogger(__name__)

VERSION = 15  # part of every name: raise it when the arrays or the way they are built change
SUFFIX = ".sdf.npz"
PART = SUFFIX + ".part"  # of an entry that is being written
# Bytes that the cache may take; what was not used for longest is removed first. A file that a
# process leaves half written is removed from this age on [s].
MOST_BYTES, ABANDONED = 2 * 2**30, 3600.0
_READING = Lock()
# What reading a damaged, foreign or half-removed archive may raise.
_DAMAGE = (
    OSError,
    ValueError,
    KeyError,
    EOFError,
    IndexError,
    NotImplementedError,
    zipfile.BadZipFile,
)


def cache_path() -> Path:
    """Folder of the cache: ``RBFMUSCLE_CACHE``, or the user's cache folder of the platform."""
    if place := os.environ.get("RBFMUSCLE_CACHE"):
        return Path(place)
    if sys.platform == "win32":
        local = os.environ.get("LOCALAPPDATA") or Path.home() / "AppData" / "Local"
        return Path(local) / "rbfmuscle" / "Cache" / "sdf"
    if sys.platform == "darwin":
        return Path.home() / "Library" / "Caches" / "rbfmuscle" / "sdf"
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "rbfmuscle" / "sdf"


def content_key(vertices: Floats, faces: Integers, options: tuple[object, ...]) -> str:
    """Name of an entry: a digest of the mesh and of all options that shape the field."""
    digest = hashlib.sha256(repr((VERSION, np.dtype(float).byteorder, options)).encode())
    for array in (vertices, faces):
        digest.update(repr((array.shape, array.dtype.str)).encode())
        digest.update(np.ascontiguousarray(array).data)
    return digest.hexdigest()[:32]


def load_arrays(key: str) -> dict[str, Array] | None:
    """Arrays of an entry by name, or None where there is none; a damaged entry is removed."""
    path = cache_path() / (key + SUFFIX)
    if not os.path.exists(path):
        return None
    try:
        # One thread at a time: Python 3.11 counts the depth of what it parses, as NumPy's headers,
        # for all together.
        with _READING, path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
            if archive.zip.testzip() is not None:
                raise ValueError("a checksum is wrong")
            arrays = {name: archive[name] for name in archive.files}
        with contextlib.suppress(OSError):  # a cache that others own can be read all the same
            os.utime(path)
        if str(arrays.pop("key")) != key:
            raise ValueError("the entry belongs to another mesh")
    except _DAMAGE as error:
        log.warning("cache: %s is damaged (%s) and is built again", path, error)
        with contextlib.suppress(OSError):
            path.unlink()
        return None
    return arrays


def store_arrays(key: str, arrays: Mapping[str, ArrayLike]) -> None:
    """Keep arrays under a name; a cache that cannot be written is reported in the log and does no
    harm.
    """
    folder = cache_path()
    # Of NumPy's keywords none is among the keys.
    entry: dict[str, Any] = {
        "key": np.array(key),
        **{k: np.asarray(a, order="C") for k, a in arrays.items()},
    }
    try:
        folder.mkdir(parents=True, exist_ok=True)
        handle, name = tempfile.mkstemp(prefix=key, suffix=PART, dir=folder)
        try:
            with os.fdopen(handle, "wb") as file:
                np.savez(file, **entry)
            Path(name).replace(folder / (key + SUFFIX))
        except BaseException:
            Path(name).unlink(missing_ok=True)
            raise
    except OSError as error:
        log.warning("cache: %s cannot be written (%s); nothing is kept", folder, error)
        return
    _bound(folder, folder / (key + SUFFIX))


def _bound(folder: Path, fresh: Path) -> None:
    """Remove what was not used for longest until the cache keeps to `MOST_BYTES`; never the
    ``fresh`` entry.
    """
    found = []
    for path in folder.glob(f"*{SUFFIX}*"):
        with contextlib.suppress(OSError):  # another process has removed it
            facts = path.stat()
            found.append((facts.st_mtime, facts.st_size, path))
    total = sum(size for _, size, _ in found)
    for used, size, path in sorted(found):
        writing = path.name.endswith(PART)
        if writing and time.time() - used < ABANDONED:
            continue
        if path != fresh and (writing or total > MOST_BYTES):
            with contextlib.suppress(OSError):
                path.unlink()
                total -= size
