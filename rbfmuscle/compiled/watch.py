"""What goes on, told to whoever watches: loops needed and compiled, stages of a command.

Watchers are the bar on stderr (`rbfmuscle.compiled.progress`), the recorder of needs and the clock of a report.
"""

from __future__ import annotations

import threading
import time
from typing import Any

# Objects with any of ``needed(loop, arguments)``, ``begins(loop)``, ``ends(loop, seconds)``, ``stage(stages)``.
_watchers: list[Any] = []
_here = threading.local()
_lock = threading.Lock()
_totals = {"loops": 0, "seconds": 0.0}
_stages: list[Any] = []
_working: list[str] = []  # nested ones after those that call them


class watched_by:
    """Within the context, ``watcher`` is told of every loop; from all threads."""

    def __init__(self, watcher: Any) -> None:
        self.watcher = watcher

    def __enter__(self) -> Any:
        _watchers.append(self.watcher)
        return self.watcher

    def __exit__(self, *error: Any) -> None:
        _watchers.remove(self.watcher)


def compiled_so_far() -> dict[str, float]:
    """Loops that this process has compiled, and the processor time its threads spent at that [s]."""
    with _lock:
        return dict(_totals)


def tell_needed(loop: Any, arguments: Any) -> None:
    """A call from Python needs a loop; one that another loop calls comes with it."""
    if not getattr(_here, "starts", ()):
        _tell("needed", loop, arguments)


def tell_begin(loop: Any) -> None:
    """A thread begins to compile a loop, maybe within another."""
    starts = _here.__dict__.setdefault("starts", [])
    starts.append(time.thread_time())
    _working.append(loop.py_func.__qualname__)
    _tell("begins", loop)


def tell_end(loop: Any) -> None:
    """It has, or has failed to."""
    spent = time.thread_time() - _here.starts.pop()
    _working.remove(loop.py_func.__qualname__)
    with _lock:
        _totals["loops"] += not loop.py_func.__module__.startswith("numba.")
        if not _here.starts:
            _totals["seconds"] += spent
    _tell("ends", loop, spent)


class tell_stage:
    """Within the context this goes on; with a count, call the result with how many are done.

    Parameters
    ----------
    text : str
        What is done, as "building".
    what : str, optional
        What is counted.
    total : int, optional
        How many there are.
    """

    def __init__(self, text: str, what: str = "", total: int | None = None) -> None:
        self.text, self.what, self.total, self.done = text, what, total, 0

    def __call__(self, done: Any, total: Any = None) -> None:
        """Say how many are done."""
        self.done, self.total = done, self.total if total is None else total
        _tell("stage", current_stage())

    def __enter__(self) -> Any:
        with _lock:
            _stages.append(self)
        _tell("stage", self)
        return self

    def __exit__(self, *error: Any) -> None:
        with _lock:
            _stages.remove(self)
        _tell("stage", current_stage())


def current_stage() -> Any:
    """The innermost stage, or None."""
    with _lock:
        return _stages[-1] if _stages else None


def loop_in_work() -> Any:
    """The loop that some thread compiles right now, by name, or None."""
    working = list(_working)
    return working[0] if working else None


def _tell(what, *facts):
    for watcher in list(_watchers):
        listener = getattr(watcher, what, None)
        if listener is not None:
            listener(*facts)
