"""What goes on, shown on stderr: a bar on a terminal, else a line after two seconds and then every ten."""

from __future__ import annotations

import sys
import threading
import time
from typing import Any

from rbfmuscle.compiled.watch import current_stage, loop_in_work, tell_stage

FIRST = 1.4  # seconds before anything: two, less what the start of Python and a loop that holds its lock take
EVERY = 10.0  # seconds between lines
_TICK = 0.1


class Progress:
    """Context manager; call it with (done, total), counts of ``what``. One inside another takes its place meanwhile.

    Parameters
    ----------
    title : str
        Of the command or scene.
    what : str
        What is counted.
    """

    _shown: Any = None  # one display a process
    _lock = threading.Lock()

    def __init__(self, title: str, what: str = "frame") -> None:
        self.title = title
        self.stage = tell_stage("", what)
        self.display: Any = None

    def __enter__(self) -> Any:
        with Progress._lock:
            if Progress._shown is None:
                Progress._shown = self.display = _Bar() if sys.stderr.isatty() else _Lines()
                self.display.start(self.title)
        self.stage.__enter__()
        return self

    def __call__(self, done: int, total: int) -> None:
        """Take note of how much is done."""
        self.stage(done, total)

    def __exit__(self, *error: Any) -> None:
        self.stage.__exit__()
        if self.display is not None:
            Progress._shown = None
            self.display.stop(self.stage, failed=error[0] is not None)


def describe_stage(stage: Any) -> str:
    """What goes on, in words: the loop that is compiled where nothing says more."""
    loop = loop_in_work()
    text = stage.text
    if loop is not None and not text.startswith("compiling"):
        text = f"{text + ', ' if text else ''}compiling {loop}"
    if stage.total:
        text = f"{text + ': ' if text else ''}{stage.what} {stage.done} of {stage.total}"
    return text or "starting"


class _Lines:
    """A line after FIRST seconds and every EVERY from then on, and one for the last count."""

    def start(self, title: Any) -> None:
        self.title, self.begun, self.said = title, time.monotonic(), 0
        self.ended = threading.Event()
        self.thread = threading.Thread(target=self._beat, name="rbfmuscle-progress", daemon=True)
        self.thread.start()

    def _beat(self):
        while not self.ended.wait(EVERY if self.said else FIRST):
            stage = current_stage()
            if stage is not None:
                spent = time.monotonic() - self.begun
                self._say(f"{self.title}: {describe_stage(stage)} ({spent:.0f} s)")

    def _say(self, text):
        self.said += 1
        print(text, file=sys.stderr, flush=True)

    def stop(self, stage: Any, *, failed: Any) -> None:
        self.ended.set()
        self.thread.join()
        if stage.total and not failed and (self.said or stage.done == stage.total):
            self._say(f"{self.title}: {stage.what} {stage.done} of {stage.total}")


class _Bar:
    """A bar that is drawn anew ten times a second, once two seconds have passed."""

    def start(self, title: Any) -> None:
        self.title = title
        self.ended = threading.Event()
        self.thread = threading.Thread(target=self._beat, name="rbfmuscle-progress", daemon=True)
        self.thread.start()

    def _beat(self):
        if self.ended.wait(FIRST):
            return
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

        columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
        with Progress(*columns, console=Console(stderr=True), transient=True) as bar:
            task = bar.add_task(self.title, total=None)
            while not self.ended.wait(_TICK):
                stage = current_stage()
                if stage is not None:
                    text = f"{self.title}: {describe_stage(stage)}"
                    bar.update(task, description=text, completed=stage.done, total=stage.total)

    def stop(self, stage: Any, *, failed: Any) -> None:
        self.ended.set()
        self.thread.join()
