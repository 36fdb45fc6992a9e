"""OpenSim storage files (``.mot``, ``.sto``) as they stand."""

from pathlib import Path

import numpy as np

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.validation import SceneError, read_text, shown


def read_storage(
    path: Path, *, context: str = "[motion]: "
) -> tuple[dict[str, str], list[str], Floats]:
    """Header (lower case), labels of the columns, and values (rows, columns) of an OpenSim storage
    file; ``context`` begins each message.
    """
    lines = read_text(path, context=context).splitlines()
    end = next(
        (row for row, line in enumerate(lines) if line.strip().lower() == "endheader"), len(lines)
    )
    if len(lines) < end + 3:
        words = "no 'endheader' line with columns and rows after it"
        raise SceneError(f"{context}{path} is no OpenSim motion: {words}")
    pairs = [line.lower().split("=", 1) for line in lines[:end] if "=" in line]
    labels = [label.strip("\"'") for label in lines[end + 1].split()]
    rows = [line.split() for line in lines[end + 2 :] if line.strip()]
    for number, row in enumerate(rows, 1):
        if len(row) != len(labels):
            words = f"row {number} has {len(row)} values, the header names {len(labels)}"
            raise SceneError(f"{context}{path} {words}")
    if not rows:
        raise SceneError(f"{context}{path} has no rows under its labels")
    try:
        values = np.array(rows, dtype=float)
    except ValueError:
        raise SceneError(f"{context}{path} {_first_text(rows, labels)}") from None
    return {key.strip(): value.strip() for key, value in pairs}, labels, values


def _first_text(rows: list[list[str]], labels: list[str]) -> str:
    """Where the first value stands that is no number, and what to do."""
    for number, row in enumerate(rows, 1):
        for label, text in zip(labels, row):
            try:
                float(text)
            except ValueError:
                more = "; part columns by tabs and write decimal points" if "," in text else ""
                return f"row {number}: {shown(label)} is {shown(repr(text))}, not a number{more}"
    return "has rows that are no numbers"
