"""A process that takes some of a run's muscles: ``python -m rbfmuscle.sharing.helper``, started by
`WorkerPool`.

It reads a scene and the names of its muscles from standard input, and writes pairs of a kind and
its content to standard output: first that the muscles are built, then frame by frame. It ends with
the process that started it.
"""

import logging
import os
import traceback
import warnings

from rbfmuscle.child import Outbox, listen
from rbfmuscle.sharing.share import MuscleGroup
from rbfmuscle.validation import RBFMuscleError


class _Forward(logging.Handler):
    """Sends log records to the process that started the run."""

    def __init__(self, outbox: Outbox) -> None:
        super().__init__()
        self.outbox = outbox

    def emit(self, record: logging.LogRecord) -> None:
        self.outbox.put(("logged", (record.name, record.levelno, record.getMessage())))


def main() -> None:
    """Build the models, solve the motion."""
    outbox, words = Outbox(), listen()
    scene, names = words.get()
    warnings.simplefilter("always")
    warnings.showwarning = lambda message, *_: outbox.put(("warned", message))
    logging.getLogger("rbfmuscle").addHandler(_Forward(outbox))
    try:
        group = MuscleGroup(scene, names)
        outbox.put(("done", (None, {})))
        for solved in group.frames():
            outbox.put(("done", (solved, group.times)))
        outbox.put(("done", (None, group.times)))
    except (
        RBFMuscleError,
        MemoryError,
        OSError,
    ) as error:  # which the command line reports in one line
        outbox.put(("failed", error))
    except Exception:  # noqa: BLE001 - any other error is reported where the run was asked for
        outbox.put(("failed", RuntimeError(traceback.format_exc())))
    # Python's normal exit would wait for the listening thread.
    os._exit(0)


if __name__ == "__main__":
    main()
