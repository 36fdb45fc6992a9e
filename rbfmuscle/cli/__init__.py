"""Entry point of the command line; light, so that interrupts work before anything heavy is loaded."""

import sys

from rbfmuscle import interruption


def main(arguments: list[str] | None = None) -> None:
    """Run the command line and leave the process with the promised exit code.

    Parameters
    ----------
    arguments : list of str, optional
        The process's own by default.
    """
    whole_process = arguments is None
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    interruption.install(as_json="--json" in arguments, watch=whole_process)
    from rbfmuscle.cli.app import run_command

    raise SystemExit(run_command(arguments))
