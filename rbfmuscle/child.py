"""Child processes: start them, send them messages, receive theirs.

They are started by command and not by `multiprocessing`, so that a script needs no guard of its
main part.
"""

import contextlib
import os
import pickle
import queue
import subprocess
import sys
import threading
import traceback
from pathlib import Path
from typing import IO


def start_child(module: str, threads: int) -> subprocess.Popen[bytes]:
    """Start a process that runs a module of ours, with pipes, and with ``threads`` threads for
    loops and BLAS.

    Modules in the present folder are not imported.
    """
    places = [str(Path(__file__).resolve().parents[1]), os.environ.get("PYTHONPATH", "")]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(place for place in places if place)}
    counts = ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
    environment |= dict.fromkeys(counts, str(threads))
    command, pipe = [sys.executable, "-P", "-m", module], subprocess.PIPE
    # A process group of its own: an interrupt reaches this process, which ends the child.
    return subprocess.Popen(command, env=environment, stdin=pipe, stdout=pipe, process_group=0)


def send(pipe: IO[bytes], what: object) -> None:
    """Pickle an object into a pipe."""
    pickle.dump(what, pipe, protocol=pickle.HIGHEST_PROTOCOL)
    pipe.flush()


def end_child(process: subprocess.Popen[bytes]) -> None:
    """End a process and close its pipes."""
    process.kill()
    process.wait()
    for pipe in (process.stdin, process.stdout):
        with contextlib.suppress(OSError):  # what it did not read is lost
            if pipe is not None:
                pipe.close()


class Outbox:
    """A child's standard output, for messages only; other output goes to standard error."""

    def __init__(self) -> None:
        self.file = os.fdopen(os.dup(1), "wb")
        os.dup2(2, 1)
        self._lock = threading.Lock()

    def put(self, what: object) -> None:
        """Send a message; end the process where nobody reads."""
        try:
            with self._lock:
                send(self.file, what)
        except BrokenPipeError:
            os._exit(0)
        except Exception:  # noqa: BLE001 - whatever it is, the message is cut: none can follow
            traceback.print_exc()
            os._exit(1)


def listen() -> queue.Queue[object]:
    """Return a queue of the messages on standard input; the process ends when its parent does."""
    words: queue.Queue[object] = queue.Queue()
    threading.Thread(target=_listen, args=(words,), daemon=True).start()
    return words


def _listen(words: queue.Queue[object]) -> None:
    try:
        while True:
            words.put(pickle.load(sys.stdin.buffer))
    except (EOFError, pickle.UnpicklingError):
        os._exit(0)
    except BaseException:  # noqa: BLE001 - the message cannot be read: nobody would answer
        traceback.print_exc()
        os._exit(1)
