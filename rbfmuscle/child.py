"""Processes of ours beside this one: how they are started, how they listen and answer, and calls made in several.

They are started by command, not forked or spawned by Python's own means, so that a script needs no guard of its main
part and no thread is cut in two. ``python -m rbfmuscle.child`` is one that answers calls.
"""

from __future__ import annotations

import contextlib
import os
import pickle
import queue
import subprocess
import sys
import threading
import traceback
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, BinaryIO

from rbfmuscle.validation import SolveError


def child_call(module: str, *arguments: str) -> tuple[list[str], dict[str, str]]:
    """Command and environment of a process that runs one of our modules with this interpreter.

    Nothing that lies in the present folder takes the place of a module there.
    """
    command = [sys.executable, "-P", "-m", module, *arguments]
    places = [str(Path(__file__).resolve().parents[1]), os.environ.get("PYTHONPATH", "")]
    return command, {**os.environ, "PYTHONPATH": os.pathsep.join(place for place in places if place)}


def start_child(module: str, threads: int) -> subprocess.Popen[bytes]:
    """Such a process, spoken to by its pipes, whose loops and BLAS use so many threads."""
    command, environment = child_call(module)
    counts = ("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")
    environment |= dict.fromkeys(counts, str(threads))
    # A group of its own: an interrupt is for this process, which ends the child.
    return subprocess.Popen(
        command, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, process_group=0
    )


def send(pipe: BinaryIO | Any, what: Any) -> None:
    """Pickle something straight into a pipe: large arrays are not held twice."""
    pickle.dump(what, pipe, protocol=pickle.HIGHEST_PROTOCOL)
    pipe.flush()


def how_it_ended(process: subprocess.Popen[bytes]) -> str:
    """In what way a process is gone that should be there."""
    code = process.wait()
    return f" by signal {-code}" if code < 0 else f" (exit code {code})"


def gone(how: str) -> SolveError:
    """What is raised where a process is gone."""
    return SolveError(
        f"a helper process was ended{how}; memory may have run out: with NUMBA_NUM_THREADS=1 set, one process does "
        "it all"
    )


class Outbox:
    """A child's standard output, for messages alone: what else is printed goes to standard error."""

    def __init__(self) -> None:
        self.file = os.fdopen(os.dup(1), "wb")
        os.dup2(2, 1)
        self._lock = threading.Lock()

    def put(self, what: Any) -> None:
        """Give a message, whole; where nobody takes it any more, end at once."""
        try:
            with self._lock:
                send(self.file, what)
        except BrokenPipeError:
            os._exit(0)
        except Exception:  # noqa: BLE001 - whatever it is, the message is cut, and none can follow it: the end tells
            traceback.print_exc()
            os._exit(1)


def listen() -> queue.Queue[Any]:
    """What a child is told on its standard input; when there is nobody left to tell more, it ends at once."""
    words: queue.Queue[Any] = queue.Queue()
    threading.Thread(target=_listen, args=(words,), daemon=True).start()
    return words


def _listen(words: queue.Queue[Any]) -> None:
    try:
        while True:
            words.put(pickle.load(sys.stdin.buffer))
    except (EOFError, pickle.UnpicklingError):
        os._exit(0)
    except BaseException:  # noqa: BLE001 - what was told needs what is not there: nobody would answer
        traceback.print_exc()
        os._exit(1)


def calls_apart(function: Callable[..., Any], calls: Sequence[tuple[Any, ...]], jobs: int) -> Iterator[Any]:
    """What a function returns, in the order of the calls, from so many processes of one thread each.

    They are ended with the iteration, however it ends, so that an interrupt leaves nothing behind.

    Parameters
    ----------
    function : callable
        Of a module, which a process can import.
    calls : sequence of tuple
        Positional arguments.
    jobs : int

    Raises
    ------
    SolveError
        Where a process was ended; what the function raises is raised, with a note of where.
    """
    children: list[Any] = []
    pool, waiting = ThreadPoolExecutor(jobs), []
    try:
        idle: queue.Queue[Any] = queue.Queue()
        for _ in range(min(jobs, len(calls))):
            children.append(start_child(__name__, 1))
            idle.put(children[-1])
        waiting = [pool.submit(_ask, idle, function, call) for call in calls]
        for one in waiting:
            yield one.result()
        for child in children:
            child.stdin.close()
            child.wait()
    finally:
        for one in waiting:
            one.cancel()
        for child in children:
            child.kill()
            child.wait()
        pool.shutdown()
        for child in children:
            for pipe in (child.stdin, child.stdout):
                with contextlib.suppress(OSError):
                    pipe.close()


def _ask(idle, function, call):
    """One call, by the next process that is idle."""
    child = idle.get()
    try:
        send(child.stdin, (function, call))
        found, failed = pickle.load(child.stdout)
    except (OSError, EOFError, pickle.UnpicklingError):
        raise gone(how_it_ended(child)) from None
    finally:
        idle.put(child)
    if failed is not None:
        raise failed
    return found


def _answer() -> None:
    """The life of a process that is given functions and their arguments, and gives what they return or raise."""
    outbox, asked = Outbox(), listen()
    while True:
        function, call = asked.get()
        found = failed = None
        try:
            found = function(*call)
        except Exception as error:  # noqa: BLE001 - whatever it is, it is raised where the call was made
            error.add_note(traceback.format_exc())
            failed = _that_travels(error)
        outbox.put((found, failed))


def _that_travels(error: Exception) -> Exception:
    """The error, or where it cannot be pickled one that says the same."""
    try:
        pickle.loads(pickle.dumps(error))
    except Exception:  # noqa: BLE001 - whatever pickling says
        return RuntimeError("".join(traceback.format_exception(error)))
    return error


if __name__ == "__main__":
    _answer()
