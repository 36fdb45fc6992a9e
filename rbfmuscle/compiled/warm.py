"""Compile ahead what a task needs, in several processes, one loop in one of them."""

import contextlib
import os
import subprocess
import sys
import time
from collections.abc import Callable, Iterable

from rbfmuscle.compiled.child import child_call
from rbfmuscle.compiled.needs import UNFIT, is_settled, loops_missing, task_names
from rbfmuscle.compiled.progress import Progress
from rbfmuscle.compiled.store import PATIENCE, EntryLock, write_entry
from rbfmuscle.compiled.watch import tell_stage
from rbfmuscle.validation import UsageError

# Less work than this, by the times recorded, is not worth the start of another process [s].
_WORTH = 4.0


def compile_ahead(
    tasks: Iterable[str], *, jobs: int | None = None, progress: Callable[[int, int], None] | None = None
) -> int:
    """Compile the loops that tasks need and that are not on disk yet.

    Parameters
    ----------
    tasks : iterable of str
        See `rbfmuscle.compiled.needs.task_names`; unknown ones need nothing.
    jobs : int, optional
        Processes at most, this one included; by default one a core.
    progress : callable, optional
        Called as ``progress(done, total)``, counts of loops.

    Returns
    -------
    int
        How many were missing.
    """
    tasks = list(tasks)
    missing = loops_missing(tasks)
    if not missing:
        return 0
    helpers = _start_helpers(tasks, missing, jobs)
    try:
        with tell_stage("compiling, once for this machine", "loop", len(missing)) as advance:
            left, since = missing, time.monotonic()
            # What another process holds for long is left to the call that needs it.
            while left and time.monotonic() - since < PATIENCE:
                before, left = left, _compile_one(left)
                since = since if len(left) == len(before) else time.monotonic()
                done = len(missing) - sum(not is_settled(need) for need in left)
                advance(done)
                if progress is not None:
                    progress(done, len(missing))
    finally:
        for helper in helpers:
            helper.terminate()
        for helper in helpers:
            helper.wait()
    return len(missing)


def warm_up(*tasks: str, jobs: int | None = None, progress: bool | Callable[[int, int], None] = True) -> int:
    """Compile all that models and commands need, before the first of them is run.

    Parameters
    ----------
    *tasks : str
        Names of models (``"rbf"``, ``"pbd"`` ...) and of commands (``"kernels"``, ``"plan"`` ...); all where none
        is given.
    jobs : int, optional
        Processes at most; by default one a core.
    progress : bool or callable
        ``True`` shows on stderr what goes on; a callable is called as ``progress(done, total)``.

    Returns
    -------
    int
        How many loops were missing; 0 from the second time on.

    Raises
    ------
    UsageError
        For an unknown name.

    Examples
    --------
    >>> import rbfmuscle
    >>> rbfmuscle.warm_up("rbf")  # doctest: +SKIP
    """
    known = task_names()
    for task in tasks:
        if task not in known:
            raise UsageError(f"warm_up: unknown task {task!r}; known: {', '.join(known)}")
    if progress is True:
        with Progress("rbfmuscle", what="loop"):
            return compile_ahead(tasks or known, jobs=jobs)
    return compile_ahead(tasks or known, jobs=jobs, progress=progress or None)


def _compile_one(left):
    """Compile the first loop that nobody works on; return what is still to do, without what others have done.

    What another process has compiled is loaded where it is called. Where all are worked on, wait a little.
    """
    left = [need for need in left if not is_settled(need)]
    for place, need in enumerate(left):
        lock = EntryLock(need.entry)
        if not lock.try_acquire():
            continue
        lock.release()
        try:
            need.loop.compile(need.arguments)
        except _typing_errors():
            # A row that no longer fits its loop; the call will say what is wrong, if it is ever made.
            write_entry(need.entry + UNFIT, b"")
        return left[:place] + left[place + 1 :]
    if left:
        time.sleep(0.05)
    return left


def _typing_errors():
    """What numba raises for types, or a number of arguments, that a loop does not take."""
    from numba.core.errors import NumbaError

    return NumbaError, TypeError, ValueError, LookupError, AttributeError, NotImplementedError, AssertionError


def _start_helpers(tasks, missing, jobs):
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    count = min((jobs or cores) - 1, int(sum(need.cost for need in missing) / _WORTH))
    command, environment = child_call("rbfmuscle.compiled.warm", *tasks)
    quiet = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.DEVNULL)
    helpers = []
    for _ in range(count):
        with contextlib.suppress(OSError):  # then this process does it alone
            helpers.append(subprocess.Popen(command, env=environment, **quiet))
    return helpers


def _help(tasks):
    """A helper's life: compile what nobody works on, and end when nothing is left."""
    left = loops_missing(tasks)
    parent = os.getppid()
    while left and os.getppid() == parent:
        left = _compile_one(left)


if __name__ == "__main__":
    _help(sys.argv[1:])
