"""Fibres of a run in files: polylines for ParaView and a table of lengths, frame by frame."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

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
    table : (csv.writer, file)
        Of ``fibre_lengths.csv``.
    end : int, optional
        Of the collection that is there, see `Collection`.
    """

    def __init__(self, directory: Path, table: tuple[Any, Any], end: int | None = None) -> None:
        self.directory = directory
        (directory / "fibres").mkdir(exist_ok=True)
        self._table, self._file = table
        self.collection = Collection(directory / "fibres.pvd", end)

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
        self.collection.add(frame.index, entries)


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
