"""Entry point of the command line; light, so that interrupts work before anything heavy is
loaded.
"""

import gc
import sys

from rbfmuscle import interruption


def main(arguments: list[str] | None = None) -> None:
    """Run the command line, on the process's own arguments by default, and leave with the promised
    exit code.
    """
    whole_process = arguments is None
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    interruption.install(as_json="--json" in arguments, watch=whole_process)
    from rbfmuscle.cli.app import run_command

    code = run_command(arguments)
    if whole_process:
        gc.freeze()  # no search for garbage among all that is loaded, only to end: 0.3 s
    raise SystemExit(code)
