"""Numba's cache of one loop, with names by content in place of names by file and time."""

from __future__ import annotations

import hashlib
import pickle
import time
from functools import cached_property
from typing import Any

from numba.core import compiler, event
from numba.core.caching import _Cache
from numba.core.serialize import dumps

from rbfmuscle.compiled.fingerprint import loop_digest, machine_digest
from rbfmuscle.compiled.store import PATIENCE, EntryLock, folders, has_entry, read_entry, write_entry
from rbfmuscle.compiled.watch import tell_begin, tell_end, tell_needed

_POLL = 0.02  # seconds between looks at an entry that another process compiles


class LoopCache(_Cache):
    """What a dispatcher of numba asks for compiled code and hands compiled code to.

    Parameters
    ----------
    loop : numba.core.dispatcher.Dispatcher
    """

    def __init__(self, loop: Any) -> None:
        _listen()
        self.loop = loop
        self.enabled = True
        self.held = {}

    @property
    def cache_path(self) -> Any:
        """Folder that is written to, None where there is none."""
        return str(folders()[0]) if folders() else None

    @cached_property
    def digest(self) -> str:
        """Content of the loop, read at its first call, when all that it calls is defined."""
        return loop_digest(self.loop)

    def entry_name(self, arguments: tuple[Any, ...], codegen: Any) -> str:
        """Name of the entry for a tuple of numba types."""
        text = repr((self.digest, machine_digest(codegen), [_type_name(kind) for kind in arguments]))
        function = self.loop.py_func
        short = f"{function.__module__.rsplit('.')[-1]}.{function.__qualname__}".replace("<locals>", "in")
        return f"{short}-{hashlib.sha256(text.encode()).hexdigest()[:24]}"

    def load_overload(self, sig: tuple[Any, ...], target_context: Any) -> Any:
        """The compiled loop for these argument types, None where it is not kept."""
        arguments = _arguments(sig)
        tell_needed(self.loop, arguments)
        if not self.enabled:
            return None
        target_context.refresh()
        name = self.entry_name(arguments, target_context.codegen())
        found = _load(name, target_context)
        if found is not None:
            return found
        lock = EntryLock(name)
        end = time.monotonic() + PATIENCE
        while not lock.try_acquire():
            if time.monotonic() > end:
                return None
            time.sleep(_POLL)
            if has_entry(name):
                break
        found = _load(name, target_context)
        if found is None:
            self.held[arguments] = lock
        else:
            lock.release()
        return found

    def save_overload(self, sig: tuple[Any, ...], data: Any) -> None:
        """Keep a compiled loop."""
        arguments = _arguments(sig)
        try:
            if self.enabled and folders() and not data.lifted and not data.library.has_dynamic_globals:
                write_entry(self.entry_name(arguments, data.codegen), dumps(data._reduce()))
        finally:
            self.let_go(arguments)

    def let_go(self, arguments: tuple[Any, ...]) -> None:
        """Free the lock of what was compiled and written, or failed to be."""
        lock = self.held.pop(tuple(arguments), None)
        if lock is not None:
            lock.release()

    def let_go_all(self) -> None:
        """Free what is still held: compiling failed, or gave other argument types than were asked for."""
        for arguments in list(self.held):
            self.let_go(arguments)

    def enable(self) -> None:
        """Read and write from now on."""
        self.enabled = True

    def disable(self) -> None:
        """Neither read nor write from now on."""
        self.enabled = False

    def flush(self) -> None:
        """Nothing: an entry is never wrong, only unused."""


def _arguments(sig):
    return tuple(getattr(sig, "args", sig))


def _type_name(kind):
    """A numba type as text, with the home of classes that it names."""
    home = getattr(kind, "instance_class", None)
    return f"{kind!r} {home.__module__}" if home is not None else repr(kind)


def _load(name, target_context):
    data = read_entry(name)
    return compiler.CompileResult._rebuild(target_context, *pickle.loads(data)) if data is not None else None


class _Listener(event.Listener):
    """Tells who watches. The locks are freed after this, once the loop is written, or could not be compiled."""

    def on_start(self, event: Any) -> None:
        tell_begin(event.data["dispatcher"])

    def on_end(self, event: Any) -> None:
        tell_end(event.data["dispatcher"])


_LISTENER = _Listener()
_listening = False


def _listen():
    global _listening
    if not _listening:
        _listening = True
        event.register("numba:compile", _LISTENER)
