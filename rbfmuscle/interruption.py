"""Handling of SIGINT and SIGTERM: end at once, or first finish what is being written.

Imports only light parts of the standard library, because it is installed before anything else is
loaded.
"""

import atexit
import contextlib
import os
import signal
import socket
import sys
import threading
from collections.abc import Callable, Iterator

INTERRUPTED = 130  # exit code
_LINE = b"rbfmuscle: interrupted\n"
_ENDING = threading.Lock()
_SHOW_CURSOR = b"\x1b[?25h"  # a progress bar may have hidden it


class _State:
    """State of this process."""

    asked = False
    kept: Callable[[], str] | None = None
    as_json = False


def install(*, as_json: bool = False) -> None:
    """Let SIGINT and SIGTERM end the process with 130, with the error as JSON on standard output
    where ``as_json``.

    A thread listens too: Python's own handlers wait until compiled code of the main thread returns.
    """
    _State.as_json = as_json
    _answer_by(_handle)
    reader, writer = socket.socketpair()  # a pipe cannot be made non-blocking on Windows
    writer.setblocking(False)
    signal.set_wakeup_fd(writer.detach(), warn_on_full_buffer=False)
    threading.Thread(target=_listen, args=(reader,), daemon=True).start()
    # The first of all that is registered is the last that is called: signals are ignored while
    # Python exits.
    atexit.register(_answer_by, signal.SIG_IGN)


@contextlib.contextmanager
def keeping(kept: Callable[[], str]) -> Iterator[None]:
    """While inside, and where ``kept()`` returns text, an interrupt raises KeyboardInterrupt with
    it.

    Output can then be finished; where it returns none, the process ends at once, as at a second
    interrupt. Compiled code and callbacks may lose the exception: :func:`check` raises it again,
    and so does leaving.
    """
    before = _State.kept
    _State.kept = kept
    try:
        yield
        check()
    except KeyboardInterrupt:
        raise KeyboardInterrupt("; ".join(filter(None, ("interrupted", kept())))) from None
    finally:
        _State.kept = before


def check() -> None:
    """Raise KeyboardInterrupt if an earlier one was lost."""
    if _State.asked:
        raise KeyboardInterrupt


def _answer_by(handler):
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, handler)


def _must_finish():
    return _State.kept is not None and bool(_State.kept())


def _handle(number, frame):
    if _State.asked or not _must_finish():
        _end()
    _State.asked = True
    raise KeyboardInterrupt


def _listen(reader):
    while True:
        number = reader.recv(1)
        if not number:
            return
        # An interrupt that the handler has taken is not this thread's, however late it wakes.
        if number[0] in (signal.SIGINT, signal.SIGTERM) and not _State.asked and not _must_finish():
            _end()


def _end():
    """Exit without unwinding."""
    if not _ENDING.acquire(blocking=False):  # the other of the handler and the listener is at it
        threading.Event().wait()
    with contextlib.suppress(OSError):
        if sys.stderr is not None and os.isatty(2):
            os.write(2, _SHOW_CURSOR)
        os.write(2, _LINE)
        if _State.as_json:
            os.write(1, b'{"error": "interrupted", "exit_code": 130}\n')
    os._exit(INTERRUPTED)
