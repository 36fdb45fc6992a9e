"""Lengths and moment arms of a saved run as CSV and as OpenSim storage files (.sto)."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rbfmuscle.validation import UsageError

if TYPE_CHECKING:
    from rbfmuscle.study.files.saved import SavedRun


# Quantity: title of its file, for one coordinate.
_TITLES = {
    "length": "Length",
    "moment_arm": "MomentArm_{}",
    "fibre_length_mean": "FibreLength",
    "fibre_moment_arm_mean": "FibreMomentArm_{}",
}


def write_sto(path: Path, name: str, columns: dict[str, Any]) -> None:
    """Write an OpenSim storage file.

    Parameters
    ----------
    path : path
    name : str
        First line of the file.
    columns : dict of str to (n,) array_like
        Label to values; the first is ``time`` [s]. NaN stands where a value is not known.

    Notes
    -----
    The header is that of OpenSim's analyses: name, version, counts, ``inDegrees``, ``endheader``, then labels
    and rows separated by tabs.
    """
    table = np.column_stack([np.asarray(values, dtype=float) for values in columns.values()])
    head = [name, "version=1", f"nRows={table.shape[0]}", f"nColumns={table.shape[1]}", "inDegrees=no"]
    rows = ["\t".join(repr(float(value)) for value in row) for row in table]
    text = "\n".join([*head, "endheader", "\t".join(columns), *rows])
    path.write_text(text + "\n", encoding="ascii")


def export_lengths(saved: SavedRun, folder: Path, frames: list[int], factor: float) -> list[Path]:
    """Write lengths and moment arms as OpenSim's muscle analysis names them, and once as CSV.

    Parameters
    ----------
    saved : SavedRun
    folder : pathlib.Path
        Takes ``Length.sto``, ``MomentArm_COORDINATE.sto`` for each coordinate, the same of the fibres' means
        where there are fibres, and ``moment_arms.csv``.
    frames : list of int
        Frames to write; the frame's number is its time.
    factor : float
        From the scene's unit to the wanted one.

    Returns
    -------
    list of pathlib.Path

    Raises
    ------
    UsageError
        If the run measured no lengths.
    """
    rows = [row for row in saved.metrics if row.quantity in _TITLES]
    place = {frame: k for k, frame in enumerate(frames)}
    tables = {}
    for row in rows:
        title = _TITLES[row.quantity].format(row.coordinate)
        table = tables.setdefault(title, {"time": np.array(frames, dtype=float)})
        values = table.setdefault(row.muscle, np.full(len(frames), np.nan))
        if row.frame in place:
            values[place[row.frame]] = row.value * factor
    if not tables:
        raise UsageError(f"{saved.directory} has no lengths: its scene had output.metrics = false")
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    for title, table in tables.items():
        written.append(folder / f"{title}.sto")
        write_sto(written[-1], title, table)
    written.append(folder / "moment_arms.csv")
    with open(written[-1], "w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(("frame", "coordinate", "angle", "muscle", "quantity", "value"))
        for row in rows:
            if row.frame in place:
                writer.writerow((*row[:5], row.value * factor))
    return written
