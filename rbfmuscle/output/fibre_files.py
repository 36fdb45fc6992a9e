"""Fibres of a run in its folder: a file of polylines for each muscle and frame, and one table."""

import csv
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from rbfmuscle.output.vtp import (
    made_block,
    numbers_of,
    read_blocks,
    refusing_damage,
    write_blocks,
)
from rbfmuscle.simulation.frame import FibreLines

FOLDER, TABLE = "fibres", "fibres.csv"
COLUMNS = ("frame", "muscle", "fibre", "length", "stretch")


def fibre_file(muscle: str, frame: int) -> str:
    """Name of the file of a muscle's fibres in a frame, in the run's folder."""
    return f"{FOLDER}/{muscle}_{frame:04d}.vtp"


def write_fibres(path: Path, fibres: FibreLines) -> None:
    """Write fibres as polylines (VTK PolyData): for each its ``length`` and ``stretch``, for each
    point the ``local_stretch``.
    """
    lines, points = fibres.points.shape[:2]
    count = lines * points
    blocks = [
        made_block("PointData", "local_stretch", fibres.local_stretch.ravel(), "Float64"),
        made_block("CellData", "length", fibres.lengths, "Float64"),
        made_block("CellData", "stretch", fibres.stretch, "Float64"),
        made_block("Points", "Points", fibres.points.reshape(-1, 3), "Float64"),
        made_block("Lines", "connectivity", np.arange(count), "Int32"),
        made_block("Lines", "offsets", points * np.arange(1, lines + 1), "Int32"),
    ]
    write_blocks(path, blocks, points=count, lines=lines)


def read_fibres(path: Path) -> FibreLines:
    """Fibres of a file that `write_fibres` has written; MeshError if missing or damaged."""
    with refusing_damage(path):
        blocks = read_blocks(path)
        points, stretch, local = (
            numbers_of(*blocks[name]).copy() for name in ("Points", "stretch", "local_stretch")
        )
        lines = len(stretch)
        return FibreLines(points.reshape(lines, -1, 3), stretch, local.reshape(lines, -1))


def begin_table(directory: Path) -> None:
    """Write the table's head."""
    with (directory / TABLE).open("w", encoding="utf-8", newline="") as file:
        csv.writer(file, lineterminator="\n").writerow(COLUMNS)


def write_frame(directory: Path, frame: int, fibres: Mapping[str, FibreLines]) -> None:
    """Write the fibres of a frame, by muscle: the files and the rows of the table."""
    for muscle, lines in fibres.items():
        write_fibres(directory / fibre_file(muscle, frame), lines)
    with (directory / TABLE).open("a", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        for muscle, lines in fibres.items():
            for number, row in enumerate(zip(lines.lengths.tolist(), lines.stretch.tolist())):
                writer.writerow((frame, muscle, number, *row))
