"""Fibres of a run in files: polylines for ParaView and a table of lengths, frame by frame."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import TYPE_CHECKING

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.study.files.vtp import Collection, write_vtp_lines

if TYPE_CHECKING:
    from rbfmuscle.sim.loop.frame import Frame


COLUMNS = ("frame", "muscle", "fibre", "length", "stretch")


class FibreFiles:
    """Writes ``fibres.pvd``, ``fibres/MUSCLE_0000.vtp`` and ``fibre_lengths.csv`` to a folder.

    Parameters
    ----------
    directory : pathlib.Path
    """

    def __init__(self, directory: Path) -> None:
        self.directory = directory
        (directory / "fibres").mkdir(exist_ok=True)
        self._file = open(directory / "fibre_lengths.csv", "w", encoding="utf-8", newline="")  # noqa: SIM115
        self._table = csv.writer(self._file, lineterminator="\n")
        self._table.writerow(COLUMNS)
        self._collection = Collection(directory / "fibres.pvd")

    def write(self, frame: Frame) -> None:
        """Write the fibres of all muscles in a frame."""
        entries = []
        for muscle, lines in frame.fibres.items():
            file = f"fibres/{muscle}_{frame.index:04d}.vtp"
            stretch = lines.lengths / lines.rest_lengths
            write_vtp_lines(
                self.directory / file, lines.points, cells={"length": lines.lengths, "stretch": stretch}
            )
            entries.append((muscle, file))
            for fibre, (length, ratio) in enumerate(zip(lines.lengths.tolist(), stretch.tolist())):
                self._table.writerow((frame.index, muscle, fibre, length, ratio))
        self._file.flush()
        self._collection.add(frame.index, entries)

    def close(self) -> None:
        """End the files."""
        self._file.close()
        self._collection.close()


def read_fibres(path: Path) -> tuple[Floats, dict[str, Floats]]:
    """Fibres of one file that a run has left.

    Parameters
    ----------
    path : path

    Returns
    -------
    points : (count, segments + 1, 3) ndarray
    cells : dict of str to (count,) ndarray
        ``length`` and ``stretch``.
    """
    from rbfmuscle.sim.formats.polydata import read_polydata

    data = read_polydata(path, values=True)
    return data.points.reshape(len(data.lines.ends), -1, 3), dict(data.values)
