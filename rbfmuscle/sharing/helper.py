"""A process that takes some of a run's muscles: ``python -m rbfmuscle.sharing.helper``, started by `WorkerPool`.

It is given a scene and the names of its muscles on standard input, and gives pairs of a kind and what it is about on
standard output, each with its clock. It ends with the process that started it.
"""

from __future__ import annotations

import logging
import os
import traceback
import warnings
from collections.abc import Callable
from typing import Any

from rbfmuscle.child import Outbox, listen
from rbfmuscle.sharing.share import MuscleGroup
from rbfmuscle.validation import RBFMuscleError


class _Outbox(Outbox):
    """Messages of a kind, each with the worker's times."""

    def __init__(self) -> None:
        super().__init__()
        self.clock: Callable[[], dict[str, Any]] = dict

    def say(self, kind: str, what: Any) -> None:
        """Give one."""
        self.put((kind, what, self.clock()))


class _Forward(logging.Handler):
    """Sends log records to the process that started the run."""

    def __init__(self, outbox: _Outbox) -> None:
        super().__init__()
        self.outbox = outbox

    def emit(self, record: logging.LogRecord) -> None:
        """Send one record."""
        self.outbox.say("logged", (record.name, record.levelno, record.getMessage()))


def main() -> None:
    """Build the models, wait for the start, solve the motion."""
    outbox, words = _Outbox(), listen()
    scene, names = words.get()
    warnings.simplefilter("always")
    warnings.showwarning = lambda message, *_: outbox.say("warned", message)
    logging.getLogger("rbfmuscle").addHandler(_Forward(outbox))
    try:
        _work(outbox, words, MuscleGroup(scene, names))
    except (RBFMuscleError, MemoryError, OSError) as error:  # what the command line tells in one line
        outbox.say("failed", error)
    except Exception:  # noqa: BLE001 - whatever it is, it is told where the run was asked for
        outbox.say("failed", RuntimeError(traceback.format_exc()))
    # Python's normal exit would wait for the listening thread.
    os._exit(0)


def _work(outbox, words, share):
    outbox.clock = lambda: {"times": dict(share.times)}
    outbox.say("done", None)
    words.get()
    for solved in share.frames():
        outbox.say("done", solved)
    outbox.say("done", None)


if __name__ == "__main__":
    main()
