"""Progress of a command on stderr: a bar on a terminal, else a line per stage and some for the
count.
"""

from __future__ import annotations

import contextlib
import sys
import time
from collections.abc import Iterator
from typing import TYPE_CHECKING, ClassVar

from rbfmuscle import interruption

if TYPE_CHECKING:
    from rich.progress import Progress as Bar

FIRST, EVERY = 2.0, 10.0  # Time before the first line for a count, and then between them [s].


class Progress:
    """Context manager; call it with (done, total). A nested one is shown under the title of the
    outer one.

    ``title`` is that of the command or scene, ``what`` is what is counted, ``done`` the last count;
    ``estimate``: a bar shows the time that is left, by that of what is counted.
    """

    shown: ClassVar[Progress | None] = None
    quiet: ClassVar[bool] = False  # nothing is shown

    def __init__(self, title: str, what: str = "frame", *, estimate: bool = False) -> None:
        self.title, self.what = title, what
        self.estimate = estimate
        self.done = 0
        self.bar: Bar | None = None
        self.begun = time.monotonic()
        self.last = self.begun - EVERY + FIRST

    def __enter__(self) -> Progress:
        if Progress.shown is None:
            Progress.shown = self
            if sys.stderr.isatty() and not Progress.quiet:
                from rich.console import Console
                from rich.progress import (
                    BarColumn,
                    TextColumn,
                    TimeElapsedColumn,
                    TimeRemainingColumn,
                )
                from rich.progress import Progress as Bar

                columns = [TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn()]
                columns += [TextColumn("to go"), TimeRemainingColumn()] if self.estimate else []
                self.bar = Bar(*columns, console=Console(stderr=True), transient=True)
                self.bar.start()
                self.bar.add_task(self.title, total=None)
        return self

    def __call__(self, done: int, total: int) -> None:
        """Show the count; an interrupt that was lost since the last one is raised again."""
        self.done = done
        shown = Progress.shown or self
        if shown.bar is not None or done == total or time.monotonic() - shown.last > EVERY:
            shown.show(f"{self.what} {done} of {total}", done, total)
        interruption.check()

    def show(self, text: str, done: int = 0, total: int | None = None) -> None:
        """Show a text, and a count."""
        self.last = time.monotonic()
        if self.bar is not None:
            self.bar.update(
                self.bar.task_ids[0],
                description=f"{self.title}: {text}",
                completed=done,
                total=total,
            )
        elif not Progress.quiet:
            print(
                f"{self.title}: {text} ({self.last - self.begun:.0f} s)",
                file=sys.stderr,
                flush=True,
            )

    def __exit__(self, *error: object) -> None:
        if Progress.shown is self:
            Progress.shown = None
            if self.bar is not None:
                self.bar.stop()


@contextlib.contextmanager
def stage(text: str) -> Iterator[None]:
    """Show a stage where progress is shown."""
    if Progress.shown is not None:
        Progress.shown.show(text)
    yield
