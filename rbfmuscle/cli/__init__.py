"""Entry point of the command line; light, so that interrupts work before anything heavy is
loaded.
"""

import gc
import sys

from rbfmuscle import interruption


def main(arguments: list[str] | None = None) -> None:
    """Run the command line and leave by `SystemExit` with the promised exit code.

    Without ``arguments`` the process is the command: it takes its own arguments, and SIGINT,
    SIGTERM, warnings and unexpected errors are handled as a command does. With ``arguments`` the
    caller's handlers stay as they are, and any thread may call.
    """
    if arguments is not None:
        from rbfmuscle.cli.app import run_command

        raise SystemExit(run_command(list(arguments)))
    arguments = sys.argv[1:]
    interruption.install(as_json="--json" in arguments)
    from rbfmuscle.cli.app import report_in_lines, run_command

    report_in_lines()
    code = run_command(arguments)
    if code:
        gc.collect()  # what an error holds: libigl complains of its objects that are never freed
    gc.freeze()  # no search for garbage among all that is loaded, only to end: 0.3 s
    raise SystemExit(code)
