"""The command line: reads the arguments, runs a command, turns errors into one line and an exit
code.

0 done; 2 wrong usage; 3 bad scene; 4 unusable mesh; 5 solve failed, frames so far kept; 6 a
``--fail-on`` limit exceeded; 7 an optional part missing; 130 interrupted, frames so far kept.
"""

import contextlib
import json
import logging
import os
import sys
import warnings

from cyclopts import App, CycloptsError, Group, UnusedCliTokensError

from rbfmuscle import __version__
from rbfmuscle.cli.check import check
from rbfmuscle.cli.compare import compare
from rbfmuscle.cli.export import export, render
from rbfmuscle.cli.kernels import kernels
from rbfmuscle.cli.new import import_, new
from rbfmuscle.cli.options import USUAL, Printing, one_line
from rbfmuscle.cli.paths import paths
from rbfmuscle.cli.report import report
from rbfmuscle.cli.run import demo, run
from rbfmuscle.cli.sweep import sweep
from rbfmuscle.cli.view import view
from rbfmuscle.interruption import INTERRUPTED
from rbfmuscle.progress import Progress
from rbfmuscle.validation import RBFMuscleError, SolveError, UsageError

GROUPS = {
    "Start": (demo, new, import_, check),
    "Run": (run, export),
    "Study": (compare, kernels, sweep, paths),
    "Look": (view, render, report),
}
# Commands that there were, and what replaces them.
REPLACED = {"plan": "check SCENE --time"}
app = App(
    name="rbfmuscle",
    help="Muscles as implicit RBF surfaces that move with the bones.",
    version=__version__,
)
app["--help"].group = app["--version"].group = Group("Options", sort_key=1000)
for title, commands in GROUPS.items():
    group = Group.create_ordered(title)
    for command in commands:
        app.command(command, group=group)


def report_in_lines() -> None:
    """Let unexpected errors, warnings and records of logs be one line each, in the whole
    process.
    """
    sys.excepthook = _report_bug
    warnings.showwarning = _show_warning
    logging.lastResort = _LogLines(logging.WARNING)


def run_command(arguments: list[str]) -> int:
    """Run one command and return the exit code; errors are one line."""
    if sys.stdout is None:
        return _fail(
            "standard output is closed; send it to a file, or to /dev/null", UsageError.exit_code
        )
    try:
        code = _run(arguments, "--json" in arguments)
        sys.stdout.flush()
    except BrokenPipeError:  # the reader of our output went away, as `| head` does
        _drop_output()
        return 0
    except OSError as error:
        what = error.filename or "standard output or a file of the command"
        reason = error.strerror or one_line(error)
        message = f"cannot read or write {what}: {reason}; free or choose another place"
        if error.filename:
            return _fail(message, UsageError.exit_code, "--json" in arguments)
        _drop_output()
        return _fail(message, UsageError.exit_code)
    return code


def _run(arguments, as_json):
    if not arguments:
        app.help_print([])
        return 2
    try:
        action, bound, _ = app.parse_args(arguments, exit_on_error=False, print_error=False)
    except CycloptsError as error:
        if arguments[0] in REPLACED:
            return _fail(
                f"there is no command {arguments[0]!r}; use 'rbfmuscle {REPLACED[arguments[0]]}'",
                2,
                as_json,
            )
        command = f"{arguments[0]} " if arguments[0] in app else ""
        message = one_line(error)
        if isinstance(error, UnusedCliTokensError):
            words = ", ".join(map(repr, error.unused_tokens))
            message = f"unexpected {words}; lists are written with commas, as a,b"
        return _fail(message, 2, as_json, hint=f"; try 'rbfmuscle {command}--help'")
    given = (value for value in bound.arguments.values() if isinstance(value, Printing))
    Progress.quiet = next(given, USUAL).quiet
    try:
        code = action(*bound.args, **bound.kwargs)
    except KeyboardInterrupt as error:
        return _fail(str(error) or "interrupted", INTERRUPTED, as_json)
    except RBFMuscleError as error:
        return _fail(one_line(error), error.exit_code, as_json)
    except MemoryError as error:
        asked = f" ({one_line(error)})" if str(error) else ""
        message = f"not enough memory{asked}; take fewer centres, coarser cells or smaller meshes"
        return _fail(message, SolveError.exit_code, as_json)
    finally:
        Progress.quiet = False
    return code if isinstance(code, int) else 0


def _drop_output():
    """Discard buffered output, so that exiting raises no second error."""
    with contextlib.suppress(OSError):  # of a caller in Python, whose stream has no file
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _fail(message, code, as_json=False, *, hint=""):
    print(f"rbfmuscle: {message}{hint}", file=sys.stderr)
    if as_json:
        print(json.dumps({"error": message, "exit_code": code}))
    return code


def _show_warning(message, category, filename, lineno, file=None, line=None):
    print(f"rbfmuscle: warning: {one_line(message)}", file=sys.stderr)


class _LogLines(logging.Handler):
    """Prints log records as warnings in one line, without tracebacks, where logging is not
    configured.
    """

    def emit(self, record):
        print(f"rbfmuscle: warning: {one_line(record.getMessage())}", file=sys.stderr)


def _report_bug(kind, error, trace):
    """Report an unexpected error with its place; the traceback only where it is asked for."""
    if os.environ.get("RBFMUSCLE_TRACEBACK"):
        sys.__excepthook__(kind, error, trace)
        return
    while trace.tb_next:
        trace = trace.tb_next
    print(
        f"rbfmuscle: a bug: {kind.__name__}: {one_line(error)} (at "
        f"{os.path.basename(trace.tb_frame.f_code.co_filename)}:{trace.tb_lineno}); set "
        "RBFMUSCLE_TRACEBACK=1 for the whole trace and report it",
        file=sys.stderr,
    )
