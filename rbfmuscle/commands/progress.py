"""Progress of a command on stderr: a bar on a terminal, else a line now and then."""

from __future__ import annotations

import sys
import time
from typing import Any

EVERY = 10.0  # seconds between lines where there is no terminal


class Progress:
    """Context manager; call it with (done, total), counts of ``what``."""

    def __init__(self, title: str, what: str = "frame") -> None:
        self.title, self.what = title, what
        self.bar: Any = None

    def __enter__(self) -> Progress:
        self.last = time.monotonic()
        if sys.stderr.isatty():
            from rich.console import Console
            from rich.progress import BarColumn, MofNCompleteColumn, TextColumn, TimeRemainingColumn
            from rich.progress import Progress as Bar

            columns = (
                TextColumn("{task.description}"),
                BarColumn(),
                MofNCompleteColumn(),
                TimeRemainingColumn(),
            )
            self.bar = Bar(*columns, console=Console(stderr=True))
            self.bar.start()
            self.task = self.bar.add_task(self.title, total=None)
        return self

    def __call__(self, done: int, total: int) -> None:
        """Draw how much is done."""
        if self.bar is not None:
            self.bar.update(self.task, description=self.title, completed=done, total=total)
        elif done == total or time.monotonic() - self.last >= EVERY:
            self.last = time.monotonic()
            print(f"{self.title}: {self.what} {done} of {total}", file=sys.stderr)

    def __exit__(self, *error: Any) -> None:
        if self.bar is not None:
            self.bar.stop()
