"""Where compiled loops lie on disk: one file a loop and signature, named by content, whole or absent.

Folders are read in turn and the first that can be written is written to: ``RBFMUSCLE_LOOPS``, else the user's
cache folder of the platform, else a folder of this user's in the temporary one.
"""

from __future__ import annotations

import contextlib
import hashlib
import logging
import os
import tempfile
import time
from functools import cache
from pathlib import Path
from typing import Any

log = logging.getLogger(__name__)

SUFFIX = ".loop"
LOCK = ".lock"
# Entries that no process has read for so long are removed, and of the rest the oldest beyond the size.
KEEP_DAYS = 60.0
KEEP_BYTES = 1_500_000_000
_DAY = 86400.0
# How long one process waits for another that compiles the same loop, before it does so itself [s].
PATIENCE = 60.0


@cache
def folders() -> tuple[Path, ...]:
    """Folders that entries are read from; the first is written to. Empty where nothing can be kept."""
    wanted = _wanted_folder()
    if _can_write(wanted):
        _sweep(wanted)
        return (wanted,)
    spare = _spare_folder()
    log.warning(
        "compiled loops cannot be kept in %s; %s", wanted, f"{spare} is used" if spare else "none are kept"
    )
    return tuple(folder for folder in (spare, wanted) if folder is not None)


def _wanted_folder():
    place = os.environ.get("RBFMUSCLE_LOOPS")
    if place:
        return Path(place)
    import platformdirs

    return Path(platformdirs.user_cache_dir("rbfmuscle", appauthor=False)) / "loops"


def _spare_folder():
    """A folder in the temporary one that only this user may write to, or None: what lies there is executed."""
    user = os.getuid() if hasattr(os, "getuid") else os.environ.get("USERNAME", "user")
    folder = Path(tempfile.gettempdir()) / f"rbfmuscle-loops-{user}"
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        state = folder.stat(follow_symlinks=False)
    except OSError:
        return None
    foreign = hasattr(os, "getuid") and (state.st_uid != user or state.st_mode & 0o022)
    return folder if not foreign and _can_write(folder) else None


def _can_write(folder):
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            return True
    except OSError:
        return False


def read_entry(name: str) -> bytes | None:
    """Bytes of an entry, or None where there is none; a damaged one is removed."""
    for folder in folders():
        path = folder / (name + SUFFIX)
        try:
            data = path.read_bytes()
        except OSError:
            continue
        if hashlib.sha256(data[32:]).digest() == data[:32]:
            with contextlib.suppress(OSError):
                if time.time() - path.stat().st_mtime > _DAY:
                    os.utime(path)  # what is used stays
            return data[32:]
        log.warning("compiled loop %s is damaged and is compiled again", path)
        with contextlib.suppress(OSError):
            path.unlink()
    return None


def has_entry(name: str) -> bool:
    """Whether there is an entry of this name; it may still turn out to be damaged."""
    return any((folder / (name + SUFFIX)).exists() for folder in folders())


def write_entry(name: str, data: bytes) -> None:
    """Keep bytes under a name: written beside its place and moved there, so that nobody reads half of it."""
    if not folders():
        return
    try:
        handle, part = tempfile.mkstemp(prefix=name, suffix=".part", dir=folders()[0])
        try:
            with os.fdopen(handle, "wb") as file:
                file.write(hashlib.sha256(data).digest() + data)
            Path(part).replace(folders()[0] / (name + SUFFIX))
        except BaseException:
            Path(part).unlink(missing_ok=True)
            raise
    except OSError as error:
        log.warning("compiled loop %s cannot be kept (%s)", name, error)


class EntryLock:
    """Held by the process that compiles an entry; one that dies lets go of it."""

    def __init__(self, name: str) -> None:
        self.path = folders()[0] / (name + LOCK) if folders() else None
        self.file: Any = None

    def try_acquire(self) -> bool:
        """Take the lock if it is free; also true where there is nothing to lock with."""
        if self.path is None:
            return True
        try:
            self.file = self.path.open("ab")
            _lock_file(self.file)
        except BlockingIOError:
            self.file.close()
            self.file = None
            return False
        except OSError:  # a file system without locks: work may be done twice, and comes out the same
            return True
        return True

    def release(self) -> None:
        """Let go; the file is removed, as whoever waits for it looks for the entry first."""
        if self.file is not None:
            with contextlib.suppress(OSError):
                if self.path is not None:
                    self.path.unlink(missing_ok=True)
            self.file.close()
            self.file = None


def _lock_file(file):
    """Lock an open file for this process, or raise BlockingIOError."""
    try:
        import fcntl
    except ImportError:  # Windows
        import msvcrt

        try:
            msvcrt.locking(file.fileno(), msvcrt.LK_NBLCK, 1)
        except OSError:
            raise BlockingIOError from None
    else:
        fcntl.flock(file.fileno(), fcntl.LOCK_EX | fcntl.LOCK_NB)


def clear_entries() -> tuple[int, int]:
    """Remove all compiled loops; return their number and bytes."""
    count = size = 0
    for folder in folders():
        for path in [*folder.glob("*" + SUFFIX), *folder.glob("*.part"), *folder.glob("*" + LOCK)]:
            with contextlib.suppress(OSError):
                found = path.stat().st_size
                path.unlink()
                count, size = count + (path.suffix == SUFFIX), size + found
    return count, size


def _sweep(folder):
    """Once a day, remove what was not used for long and what interrupted processes left."""
    stamp = folder / "swept"
    now = time.time()
    with contextlib.suppress(OSError):
        if stamp.exists() and now - stamp.stat().st_mtime < _DAY:
            return
        stamp.touch()
        entries = []
        for path in folder.iterdir():
            with contextlib.suppress(OSError):
                state = path.stat()
                if path.suffix == SUFFIX:
                    entries.append((state.st_mtime, state.st_size, path))
                elif path.suffix in (".part", LOCK) and now - state.st_mtime > _DAY:
                    path.unlink()
        left = 0
        for used, size, path in sorted(entries, reverse=True):
            left += size
            if now - used > KEEP_DAYS * _DAY or left > KEEP_BYTES:
                with contextlib.suppress(OSError):
                    path.unlink()
