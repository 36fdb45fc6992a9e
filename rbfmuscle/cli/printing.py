"""What commands print: lines or JSON on standard output, errors on standard error."""

import sys
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Annotated

from cyclopts import Parameter

from rbfmuscle.validation import RBFMuscleError

LONGEST_LINE = 1000  # characters of a message: what a hostile file holds is not all shown


@Parameter(name="*")
@dataclass(frozen=True)
class Printing:
    """Options for what a command prints."""

    as_json: Annotated[
        bool, Parameter(name="--json", negative="", help="Print JSON and nothing else.")
    ] = False
    quiet: Annotated[bool, Parameter(negative="", help="Show no progress.")] = False


USUAL = Printing()


def print_result(
    printing: Printing,
    facts: Mapping[str, object],
    lines: Iterable[str],
    *,
    error: RBFMuscleError | None = None,
) -> int:
    """Print what a command found, as JSON or as lines, then an error that it ends with; the exit
    code.
    """
    if printing.as_json:
        from rbfmuscle.run.writer import json_text

        failed = {} if error is None else {"error": str(error), "exit_code": error.exit_code}
        print(json_text({**facts, **failed}))
    else:
        print("\n".join(lines))
    if error is None:
        return 0
    print(f"rbfmuscle: {one_line(error)}", file=sys.stderr)
    return error.exit_code


def one_line(error: object) -> str:
    """Return a message as one line without control characters, shortened if it is very long."""
    text = " ".join(str(error).split())
    text = "".join(char if char.isprintable() else "?" for char in text)
    return text if len(text) <= LONGEST_LINE else f"{text[: LONGEST_LINE - 60]} ... {text[-50:]}"
