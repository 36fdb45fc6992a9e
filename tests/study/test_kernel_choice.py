"""Ties, unfit rows and the recommendation of a kernel study, on rows whose right answer is known."""

import numpy as np
import pytest

from rbfmuscle.implicit.selection import by_worth
from rbfmuscle.study.experiment.kernel_choice import Bootstrap, mark_unfit, recommend


def row(kernel, rms, milliseconds, *, width=0.02, condition=1e6, epsilon=0.0, **other):
    facts = {
        "kernel": kernel,
        "centres": 300,
        "rms": rms,
        "low": rms * (1 - width),
        "high": rms * (1 + width),
    }
    facts |= {
        "fit_time": milliseconds * 1e-3,
        "evaluation_time": 0.0,
        "condition": condition,
        "epsilon": epsilon,
    }
    return facts | {"unfit": "", "components": 1, "spurious": 0, "volume_error": 0.0, "note": ""} | other


def test_interval_holds_the_error_of_other_sets_of_points():
    rng = np.random.default_rng(0)
    true = np.sqrt(1.0)
    held = 0
    for seed in range(60):
        there, back = rng.normal(size=2000), rng.normal(size=1500)
        low, high = Bootstrap(2000, seed).interval(there, back)
        assert low < high
        held += low <= true <= high
    # Nine of ten are promised; of 60, 47 to 60 are within three standard deviations of 54.
    assert held >= 47


def test_interval_shrinks_with_the_root_of_the_points():
    rng = np.random.default_rng(1)
    width = []
    for count in (1000, 16000):
        low, high = Bootstrap(count, 0).interval(rng.normal(size=count), rng.normal(size=count))
        width.append(high - low)
    assert width[0] / width[1] == pytest.approx(4.0, rel=0.35)


def test_the_quickest_of_a_tie_is_recommended():
    found = recommend(
        [row("multiquadric", 0.1407, 20.0, epsilon=0.1), row("cubic", 0.143, 2.0), row("linear", 0.4, 1.0)]
    )
    assert found.row["kernel"] == "cubic" and [r["kernel"] for r in found.tie] == ["cubic", "multiquadric"]
    assert found.most_accurate["kernel"] == "multiquadric" and found.quickest is None
    assert "2 that cannot be told apart" in found.reason and "10.0 times" in found.reason


def test_no_parameter_then_the_condition_decide_between_equally_quick_rows():
    rows = [
        row("matern_52", 0.14, 2.0, epsilon=0.2, condition=1e5),
        row("quintic", 0.14, 2.01, condition=4e11),
    ]
    rows.append(row("cubic", 0.141, 2.02, condition=1e7))
    assert [r["kernel"] for r in recommend(rows).tie] == ["cubic", "matern_52", "quintic"]


def test_times_a_few_per_cent_apart_are_alike():
    rows = [row("matern_52", 0.14, 2.0, epsilon=0.2, condition=1e5), row("quintic", 0.14, 2.2, condition=1e8)]
    found = recommend(rows)
    assert found.row["kernel"] == "quintic" and "as quick as the quickest" in found.reason
    rows[1]["fit_time"] = 2.4e-3
    assert recommend(rows).row["kernel"] == "matern_52"


def test_a_row_that_is_really_better_is_no_tie():
    found = recommend([row("quintic", 0.10, 20.0), row("cubic", 0.14, 2.0), row("linear", 0.19, 1.0)])
    assert (
        found.row["kernel"] == "quintic"
        and found.quickest["kernel"] == "cubic"
        and found.most_accurate is None
    )


def test_rows_that_broke_are_never_recommended():
    rows = [
        row("gaussian", 0.05, 1.0, components=9, spurious=10),
        row("matern_12", 0.06, 1.0, volume_error=-0.2),
        row("buhmann", 0.9, 1.0),
        row("linear", 0.4, 1.0),
        row("cubic", 0.15, 2.0),
    ]
    mark_unfit(rows)
    why = {r["kernel"]: r["unfit"] for r in rows}
    assert why["gaussian"].startswith("9 sheets") and "volume" in why["matern_12"]
    assert "beyond that of linear, 0.4" in why["buhmann"]
    assert why["linear"] == why["cubic"] == ""
    assert recommend(rows).row["kernel"] == "cubic"
    for r in rows:
        r["unfit"] = "x"
    assert recommend(rows) is None


def test_without_the_coarsest_kernel_the_median_bounds_the_error():
    rows = [row("cubic", 0.1, 1.0), row("quintic", 0.11, 1.0), row("gaussian", 120.0, 1.0)]
    mark_unfit(rows)
    assert [bool(r["unfit"]) for r in rows] == [False, False, True]


def test_best_conditioned_of_those_alike_comes_first():
    tried = np.array([[1.0, 0.100, 1e12], [2.0, 0.1015, 1e6], [3.0, 0.103, 1e3], [4.0, 0.2, 1e1]])
    assert by_worth(tried).tolist() == [1, 0, 2, 3]


def test_of_those_that_err_nowhere_the_best_conditioned_comes_first():
    assert by_worth(np.array([[1.0, 0.0, 1e6], [2.0, 0.0, 1e3], [3.0, 0.1, 1e1]])).tolist() == [1, 0, 2]
