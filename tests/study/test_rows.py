"""Rows and lines of studies: each fact is that of its point, and a word about a point is true of it."""

from types import SimpleNamespace

import numpy as np
import pytest

from rbfmuscle.study.experiment.sweep import SweepPoint, check_key
from rbfmuscle.study.experiment.sweep_table import sweep_rows
from rbfmuscle.validation import UsageError

POINTS = [
    SweepPoint("k0", {}, "rbf", True, "k2"),
    SweepPoint("k1", {"model.resolution": 24}, "rbf", False, "k2"),
    SweepPoint("k2", {"model.resolution": 96}, "rbf", False, "k2"),
    SweepPoint("k3", {"model.resolution": 12}, "pbd", False, "k2"),
]
RESULTS = {
    "k0": {
        "status": "done",
        "values": {"error_rms": 0.25, "time_frame": 0.01},
        "threads": 2,
        "jobs": 1,
        "machine": "m",
    },
    "k1": {"status": "failed", "error": "no solution"},
    "k2": {"status": "done", "values": {"error_rms": 0.0, "time_frame": None}},
}


def test_rows_of_a_sweep_are_their_points_in_order():
    rows = sweep_rows(SimpleNamespace(points=POINTS), SimpleNamespace(read=RESULTS.get))
    assert [row["point"] for row in rows] == [0, 1, 2, 3]
    assert [row["role"] for row in rows] == ["default", "", "reference", ""]
    assert [row["status"] for row in rows] == ["done", "failed", "done", "missing"]
    assert [row["error"] for row in rows] == ["", "no solution", "", ""]
    assert [row["label"] for row in rows] == [
        "default", "model.resolution=24", "model.resolution=96", "model.resolution=12",
    ]  # fmt: skip
    assert [row["model"] for row in rows] == ["rbf", "rbf", "rbf", "pbd"]
    np.testing.assert_array_equal([row["error_rms"] for row in rows], [0.25, np.nan, 0.0, np.nan])
    np.testing.assert_array_equal([row["time_frame"] for row in rows], [0.01, np.nan, np.nan, np.nan])
    assert (rows[0]["threads"], rows[0]["jobs"], rows[0]["machine"]) == (2, 1, "m")
    assert not any(row["front"] for row in rows)


def test_unknown_quantity_is_told_with_the_nearest():
    check_key("volume", ("volume", "length"))
    with pytest.raises(UsageError, match="unknown quantity 'volum', did you mean 'volume'"):
        check_key("volum", ("volume", "length"))
