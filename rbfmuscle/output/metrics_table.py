"""The metrics of a run as one table: a pandas DataFrame, or a structured array without pandas."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.metrics.quantities import Row

if TYPE_CHECKING:
    import pandas


def metrics_table(
    rows: Sequence[Row], frames: Sequence[int], coordinates: Mapping[str, Floats]
) -> pandas.DataFrame | np.ndarray:
    """Rows of metrics as a table, see `RunData.table`; ``coordinates`` (n,) are by name, at the
    frames (n,).
    """
    place = {frame: k for k, frame in enumerate(frames)}
    at = np.array([place[row.frame] for row in rows], dtype=int)
    about = [row.coordinate if "moment_arm" in row.quantity else "" for row in rows]
    columns = {
        "frame": np.array([row.frame for row in rows], dtype=int),
        **{name: values[at] for name, values in coordinates.items()},
        "muscle": np.array([row.muscle for row in rows], dtype=str),
        "quantity": np.array([row.quantity for row in rows], dtype=str),
        "coordinate": np.array(about, dtype=str),
        "value": np.array([row.value for row in rows], dtype=float),
        "unit": np.array([row.unit for row in rows], dtype=str),
    }
    try:
        import pandas
    except ImportError:
        table = np.empty(len(rows), dtype=[(name, x.dtype) for name, x in columns.items()])
        for name, values in columns.items():
            table[name] = values
        return table
    return pandas.DataFrame(columns)
