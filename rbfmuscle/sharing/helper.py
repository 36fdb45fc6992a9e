"""The life of a process that takes a share of a run's muscles: ``python -m rbfmuscle.sharing.helper``, by `Crew` alone.

It is given a scene and the names of its muscles on standard input, and gives pairs of a kind and what it is about on
standard output, each with its clock. It ends with the process that started it.
"""

from __future__ import annotations

import contextlib
import logging
import os
import pickle
import queue
import sys
import threading
import traceback
import warnings
from collections.abc import Callable
from typing import Any

from rbfmuscle.compiled.watch import compiled_so_far
from rbfmuscle.sharing.share import Share
from rbfmuscle.validation import RBFMuscleError


class _Outbox:
    """Standard output, for messages alone: what else is printed goes to standard error."""

    def __init__(self) -> None:
        self.file = os.fdopen(os.dup(1), "wb")
        os.dup2(2, 1)
        self.clock: Callable[[], dict[str, Any]] = dict
        self._lock = threading.Lock()

    def put(self, kind: str, what: Any) -> None:
        """Give a message, whole; where nobody takes it any more, end at once."""
        try:
            with self._lock:
                # Straight into the pipe: a frame's arrays are not held twice.
                pickle.dump((kind, what, self.clock()), self.file, protocol=pickle.HIGHEST_PROTOCOL)
                self.file.flush()
        except BrokenPipeError:
            os._exit(0)
        except Exception:  # noqa: BLE001 - whatever it is, the message is cut, and none can follow it: the end tells
            traceback.print_exc()
            os._exit(1)


class _Forward(logging.Handler):
    """What the library logs is said where the run was asked for."""

    def __init__(self, outbox: _Outbox) -> None:
        super().__init__()
        self.outbox = outbox

    def emit(self, record: logging.LogRecord) -> None:
        """Send one record."""
        self.outbox.put("logged", (record.name, record.levelno, record.getMessage()))


def main() -> None:
    """Build, wait for the word, go through the motion."""
    outbox, words = _Outbox(), queue.Queue[Any]()
    threading.Thread(target=_listen, args=(sys.stdin.buffer, words), daemon=True).start()
    scene, names, resumable = words.get()
    warnings.simplefilter("always")
    warnings.showwarning = lambda message, *_: outbox.put("warned", message)
    logging.getLogger("rbfmuscle").addHandler(_Forward(outbox))
    try:
        _work(outbox, words, Share(scene, names, resumable=resumable))
    except (RBFMuscleError, MemoryError, OSError) as error:  # what the command line tells in one line
        outbox.put("failed", error)
    except Exception:  # noqa: BLE001 - whatever it is, it is told where the run was asked for
        outbox.put("failed", RuntimeError(traceback.format_exc()))
    # Not by Python's own end, which would wait for the thread that listens.
    os._exit(0)


def _work(outbox, words, share):
    outbox.clock = lambda: {"times": dict(share.times), "compiled": compiled_so_far()}
    outbox.put("done", None)
    for solved in share.frames(*words.get()):
        outbox.put("done", solved)
    outbox.put("done", None)


def _listen(inbox, words):
    """Pass on the job and the word to begin; when there is nobody left to give another, end at once."""
    with contextlib.suppress(EOFError, pickle.UnpicklingError):
        while True:
            words.put(pickle.load(inbox))
    os._exit(0)


if __name__ == "__main__":
    main()
