"""The command line: reads the arguments, runs a command, turns errors into one line and an exit code.

0 done; 2 wrong usage; 3 bad scene; 4 unusable mesh; 5 solve failed, frames so far kept; 6 a ``--fail-on``
limit exceeded; 7 an optional part missing; 130 interrupted, frames so far kept.
"""

import json
import os
import signal
import sys
import warnings

from cyclopts import App, CycloptsError

from rbfmuscle import __version__
from rbfmuscle.commands.cache import cache_app
from rbfmuscle.commands.check import check
from rbfmuscle.commands.compare import compare
from rbfmuscle.commands.import_osim import import_
from rbfmuscle.commands.kernels import kernels
from rbfmuscle.commands.new import new
from rbfmuscle.commands.plan import plan
from rbfmuscle.commands.run import demo, run
from rbfmuscle.commands.sdf import sdf
from rbfmuscle.commands.show import export, render
from rbfmuscle.commands.sweep import sweep
from rbfmuscle.commands.view import view
from rbfmuscle.validation import RBFMuscleError

INTERRUPTED = 130

app = App(
    name="rbfmuscle", help="Muscles as implicit RBF surfaces that move with the bones.", version=__version__
)
for command in (demo, check, plan, run, compare, sweep, export, render, new, view, sdf, kernels):
    app.command(command)
app.command(import_, name="import")
app.command(cache_app)


def main(arguments=None):
    """Run the command line and leave the process with the promised exit code.

    Parameters
    ----------
    arguments : list of str, optional
        The process's own by default.
    """
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    sys.excepthook = _report_bug
    # A job that is told to end keeps its frames, as one that is interrupted.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    warnings.showwarning = _show_warning
    raise SystemExit(_run(arguments))


def _run(arguments):
    as_json = "--json" in arguments
    if not arguments:
        app.help_print([])
        return 2
    try:
        action, bound, _ = app.parse_args(arguments, exit_on_error=False, print_error=False)
    except CycloptsError as error:
        return _fail(_one_line(error), 2, as_json, hint=f"try 'rbfmuscle {_command_of(arguments)}--help'")
    try:
        code = action(*bound.args, **bound.kwargs)
        sys.stdout.flush()
    except KeyboardInterrupt as error:
        return _fail(str(error) or "interrupted", INTERRUPTED, as_json)
    except RBFMuscleError as error:
        return _fail(_one_line(error), error.exit_code, as_json)
    except BrokenPipeError:  # the reader of our output went away, as `| head` does
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    return code if isinstance(code, int) else 0


def _fail(message, code, as_json, *, hint=""):
    print(f"rbfmuscle: {message}{'; ' + hint if hint else ''}", file=sys.stderr)
    if as_json:
        print(json.dumps({"error": message, "exit_code": code}))
    return code


def _one_line(error):
    return " ".join(str(error).split())


def _command_of(arguments):
    return f"{arguments[0]} " if arguments[0] in app else ""


def _show_warning(message, category, filename, lineno, file=None, line=None):
    print(f"rbfmuscle: warning: {_one_line(message)}", file=sys.stderr)


def _report_bug(kind, error, trace):
    """What is left is a bug: say where, without a traceback unless one is asked for."""
    if os.environ.get("RBFMUSCLE_TRACEBACK"):
        sys.__excepthook__(kind, error, trace)
        return
    while trace.tb_next:
        trace = trace.tb_next
    place = f"{os.path.basename(trace.tb_frame.f_code.co_filename)}:{trace.tb_lineno}"
    print(
        f"rbfmuscle: a bug: {kind.__name__}: {_one_line(error)} (at {place}); "
        "set RBFMUSCLE_TRACEBACK=1 for the whole trace and report it",
        file=sys.stderr,
    )
