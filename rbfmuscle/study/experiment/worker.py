"""The life of a process that measures for another: ``python -m rbfmuscle.study.experiment.worker``, by `side_by_side`.

It is given functions and their arguments on standard input, and gives what they return, or raise, on standard output.
It ends with the process that started it, at once, whatever it is at.
"""

from __future__ import annotations

import contextlib
import os
import pickle
import queue
import sys
import threading
from typing import Any


def main() -> None:
    """Answer until nobody asks any more."""
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # for answers alone: what is printed goes to standard error
    asked: queue.Queue[Any] = queue.Queue()
    threading.Thread(target=_listen, args=(asked,), daemon=True).start()
    while True:
        function, call = asked.get()
        found = failed = None
        try:
            found = function(*call)
        except Exception as error:  # noqa: BLE001 - whatever it is, it is raised where the call was made
            failed = error
        pickle.dump((found, failed), answers, protocol=pickle.HIGHEST_PROTOCOL)
        answers.flush()


def _listen(asked: queue.Queue[Any]) -> None:
    """Take calls; when there is nobody left to make one, end."""
    with contextlib.suppress(EOFError, pickle.UnpicklingError):
        while True:
            asked.put(pickle.load(sys.stdin.buffer))
    os._exit(0)


if __name__ == "__main__":
    main()
