"""Calling the command line inside a test."""

import signal
import sys
import warnings

import pytest

from rbfmuscle.cli import main


def call(capsys, *arguments):
    """Exit code, stdout and stderr of a command."""
    before = sys.excepthook
    show = warnings.showwarning
    handlers = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        with pytest.raises(SystemExit) as caught:
            main([str(argument) for argument in arguments])
    finally:
        sys.excepthook, warnings.showwarning = before, show
        for number, handler in handlers.items():
            signal.signal(number, handler)
    out, err = capsys.readouterr()
    return caught.value.code, out, err
