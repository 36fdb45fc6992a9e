"""What is drawn: each line of a plot holds the values of the quantity that its title names, in the unit of its axis."""

import math
from types import SimpleNamespace

import numpy as np
import pytest
from blend_model import arm_scene, use_blend_model
from matplotlib.figure import Figure
from rbfmuscle.report.comparison_plots import plot_models

from rbfmuscle.metrics.quantities import ALL
from rbfmuscle.output.runinfo import Stages
from rbfmuscle.output.saved import SavedRun
from rbfmuscle.report.plots import plot_panels
from rbfmuscle.run import simulate
from rbfmuscle.simulation.rigid_transport import MuscleStatus

QUANTITY = {
    "Volume error": "volume_error",
    "Surface inside a bone": "penetration_max",
    "Bone inside": "bone_penetration_max",
    "Inside a bone before the cut": "solver_penetration_max",
    "Time a frame": "time_frame",
    "Edge strain": "edge_strain_rms",
    "Length": "length",
}
SCALE = {"%": 100.0, "ms": 1000.0, "mm": 1.0}


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    """Two saved runs of one arm, the second with its times tripled."""
    found = []
    for factor in (1.0, 3.0):
        place = tmp_path_factory.mktemp("run")
        with pytest.MonkeyPatch.context() as patch:
            use_blend_model(patch)
            simulate(arm_scene(end=60)).save(place)
        lines = (place / "metrics.csv").read_text().splitlines()
        for k, line in enumerate(lines):
            if ",time_frame," in line:
                *head, _, unit = line.split(",")
                lines[k] = ",".join([*head, repr(factor * 0.01 * (k + 1)), unit])
        (place / "metrics.csv").write_text("\n".join(lines) + "\n")
        found.append(SavedRun(place))
    return found


@pytest.fixture
def figures(monkeypatch):
    """Axes of what is drawn meanwhile."""
    drawn, save = [], Figure.savefig

    def keep(self, *arguments, **words):
        drawn.append(self.axes[0])
        return save(self, *arguments, **words)

    monkeypatch.setattr(Figure, "savefig", keep)
    return drawn


def quantity_of(title):
    return QUANTITY[max((name for name in QUANTITY if title.startswith(name)), key=len)]


def series_drawn(axes):
    """Data of the lines that run along the motion."""
    return [line for line in axes.lines if len(line.get_xdata()) > 2]


def test_panels_hold_the_values_of_their_quantity(saved, figures):
    run = saved[0]
    titles = [title for title, _ in plot_panels(run) if not title.startswith("Moment")]
    assert len(titles) >= 6
    angles = [math.degrees(math.radians(row["coordinates"]["elbow.flexion"])) for row in run.info["frames"]]
    for title, axes in zip(titles, figures):
        quantity, scale = quantity_of(title), SCALE[axes.get_ylabel()]
        assert axes.get_title(loc="left") == title
        first = series_drawn(axes)[0]
        np.testing.assert_allclose(first.get_ydata(), scale * run.series("biceps", quantity)[1], rtol=1e-12)
        np.testing.assert_allclose(first.get_xdata(), angles, rtol=1e-12)
        assert axes.get_xlabel() == "elbow.flexion [degree]"


def test_limits_are_drawn_at_their_value_and_on_both_sides_of_what_has_a_sign(saved, figures):
    run = saved[0]
    titles = [title for title, _ in plot_panels(run) if not title.startswith("Moment")]
    seen = 0
    for title, axes in zip(titles, figures):
        quantity, scale = quantity_of(title), SCALE[axes.get_ylabel()]
        limit = run.info["limits"].get(quantity)
        levels = sorted(line.get_ydata()[0] for line in axes.lines if len(line.get_xdata()) == 2)
        if limit is None:
            assert levels == []
            continue
        wanted = [-limit, limit] if quantity == "volume_error" else [limit]
        assert levels == pytest.approx([scale * value for value in wanted])
        if quantity != "volume_error":
            low, high = axes.get_ylim()
            assert low <= 0.0 and high >= scale * limit
        seen += 1
    assert seen >= 3


def test_comparison_draws_a_line_a_model_and_the_worst_of_the_muscles(saved, figures):
    runs = {"one": saved[0], "three": saved[1]}
    titles = [title for title, _ in plot_models(runs)]
    time = figures[titles.index("Time a frame, all muscles")]
    for line, run in zip(series_drawn(time), runs.values(), strict=True):
        # The first frame, which loads and compiles, is left out.
        np.testing.assert_allclose(line.get_ydata(), 1000.0 * run.series(ALL, "time_frame")[1][1:])
    assert time.get_ylim()[0] == 0.0
    for title, axes in zip(titles, figures):
        if title.startswith(("Time", "Moment")):
            continue
        scale = SCALE[axes.get_ylabel()]
        for line, run in zip(series_drawn(axes), runs.values(), strict=True):
            wanted = run.series("biceps", quantity_of(title))[1]
            np.testing.assert_allclose(line.get_ydata(), scale * wanted, rtol=1e-12)


def test_worst_of_several_muscles_is_the_greatest_in_size_with_its_sign(figures):
    rows = {"a": [0.1, -0.5, 0.2], "b": [-0.3, 0.4, 0.1]}

    class Run:
        muscles, frames, units = list(rows), [0, 2, 4], "mm"
        info = {"frames": [{"coordinates": {}}] * 3}  # noqa: RUF012

        def series(self, muscle, quantity, coordinate=None):
            if quantity == "volume_error" and muscle in rows:
                return np.array([0, 2, 4]), np.array(rows[muscle])
            return np.zeros(0, dtype=int), np.zeros(0)

        def moment_arm_coordinates(self, muscle=None):
            return []

    titles = [title for title, _ in plot_models({"m": Run()})]
    assert titles == ["Volume error, worst muscle"]
    (line,) = series_drawn(figures[0])
    assert list(line.get_ydata()) == pytest.approx([-30.0, -50.0, 20.0])
    assert list(line.get_xdata()) == [0, 2, 4]


def frame(index, times, *, state="solved", substeps=1, reason="bones turn", pairs=None, inner=None):
    return SimpleNamespace(
        index=index,
        times={"a": times},
        surfaces={} if inner is None else {"a": SimpleNamespace(quantities=inner)},
        work={"a": MuscleStatus(state, substeps, reason)},
        neighbours=pairs or {},
    )


FRAMES = [
    frame(0, {"time_solve": 4.0, "n": 9}, inner={"time_fit": 0.5, "volume": 3.0}, pairs={("a", "b"): (0.1, 0.0)}),
    frame(2, {"time_solve": 1.0}, substeps=3, pairs={("a", "b"): (0.4, 0.2), ("a", "c"): (0.5, 0.0)}),
    frame(4, {"time_solve": 2.0}, state="carried", substeps=0, reason="moves with b", pairs={("a", "b"): (0.3, 0.7)}),
    frame(6, {"time_solve": 3.0}, substeps=2, reason="touches", pairs={("a", "b"): (0.0, 0.1)}),
    frame(8, {"time_solve": 5.0}, substeps=2, reason="touches"),
]  # fmt: skip


def test_stages_sum_times_and_work_and_keep_the_worst_of_neighbours():
    stages = Stages()
    for each in FRAMES:
        stages.add(each)
    table = stages.table()
    assert set(table["a"]) == {"time_solve", "time_fit"}
    assert table["a"]["time_solve"] == pytest.approx({"total": 15.0, "median": 3.0, "p95": 4.8, "first": 4.0})
    assert table["a"]["time_fit"]["total"] == 0.5
    work = stages.work()["a"]
    assert [work[key] for key in ("solved", "carried", "skipped", "substeps")] == [4, 1, 0, 8]
    assert work["reasons"] == {"solved": "bones turn", "carried": "moves with b"}
    first, second = stages.neighbours()
    assert first == {
        "muscles": ["a", "c"],
        "overlap_max": 0.5,
        "overlap_frame": 2,
        "gap_rms": 0.0,
        "gap_frame": 2,
    }
    assert second == {
        "muscles": ["a", "b"],
        "overlap_max": 0.4,
        "overlap_frame": 2,
        "gap_rms": 0.7,
        "gap_frame": 4,
    }
