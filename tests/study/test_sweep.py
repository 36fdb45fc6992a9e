"""Sweeps: the grid, the front, resuming, failures, and the same table however the points were run."""

import json
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from blend_model import arm_files, arm_scene, use_blend_model
from hypothesis import given, settings
from hypothesis import strategies as st

from rbfmuscle.app import run_command as command
from rbfmuscle.commands.sweep import run_point
from rbfmuscle.study.experiment.sweep import SweepFolder, parse_grid, parse_task, plan_sweep, point_key
from rbfmuscle.study.experiment.sweep_runner import SweepRunner
from rbfmuscle.study.experiment.sweep_table import (
    mark_front,
    merge_sweeps,
    pareto_front,
    table_text,
    verdict_text,
    write_table,
)
from rbfmuscle.study.show.sweep_page import write_page
from rbfmuscle.validation import UsageError

GRID = ["model.centres=40,60", "model.resolution=16,24"]
FRAMES = "0:3"
POINTS = 5  # four combinations and the scene's own settings


def rbf_scene():
    return arm_scene(end=10, step=5)


def plan_of(scene, texts=GRID, **options):
    return plan_sweep(scene, parse_grid(texts), frames=FRAMES, **options)


def run_sweep(folder, *, texts=GRID, part=None, scene=None, **options):
    scene = scene or rbf_scene()
    plan = plan_of(scene, texts)
    runner = SweepRunner(run_point, scene, plan, folder, frames=FRAMES, **{"jobs": 1, **options})
    return plan, runner.run(part=part)


def table_of(plan, folder):
    write_table(plan, folder)
    rows = json.loads((folder / "sweep.json").read_text())["rows"]
    return table_text(
        [{**row, **{k: np.nan for k, v in row.items() if v is None}} for row in rows], times=False
    )


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A sweep run in this process: (plan, folder)."""
    folder = tmp_path_factory.mktemp("sweep")
    plan, count = run_sweep(folder)
    assert count == len(plan.points) == POINTS
    return plan, folder


class TestGrid:
    def test_values_are_read_as_toml_or_text(self):
        grid = parse_grid(
            ["model.centres=100,200", "contact.substep_angle=0.5,2", "model.kernel=cubic,wendland_c2"]
        )
        assert [values for _, _, values in grid] == [[100, 200], [0.5, 2], ["cubic", "wendland_c2"]]

    def test_keys_of_one_model(self):
        plan = plan_of(
            rbf_scene(), ["model=rbf,pbd", "rbf:model.centres=40,60", "pbd:model.iterations=2,4,8"]
        )
        assert len([p for p in plan.points if p.model == "rbf"]) == 3
        assert len([p for p in plan.points if p.model == "pbd"]) == 4
        assert {p.settings["model"] for p in plan.references} == {"rbf", "pbd"}
        assert all(next(iter(p.settings)) == "model" for p in plan.points)

    def test_one_reference_for_all_models_where_one_is_named(self):
        plan = plan_of(rbf_scene(), ["model=rbf,pbd", "rbf:model.centres=40,60"], reference={"model": "rbf"})
        assert [p.settings for p in plan.references] == [{"model": "rbf", "model.centres": 60}]
        assert {p.reference for p in plan.points} == {plan.references[0].key}

    def test_reference_is_the_finest_of_the_grid(self):
        texts = ["model.centres=80,40", "contact.substep_angle=2,1", "model.kernel=cubic,quintic"]
        (reference,) = plan_of(rbf_scene(), texts).references
        assert reference.settings == {"model.centres": 80, "contact.substep_angle": 1}
        (given,) = plan_of(rbf_scene(), texts, reference={"model.centres": 200}).references
        assert given.settings["model.centres"] == 200

    @pytest.mark.parametrize(
        "texts", [[], ["centres"], ["=1,2"], ["a="], ["model.centres=1", "model.centres=2"], ["pbd:a=1"]]
    )
    def test_wrong_grid(self, texts):
        with pytest.raises(UsageError):
            parse_grid(texts)

    def test_wrong_key_fails_before_anything_runs(self):
        with pytest.raises(UsageError, match="substep_angle"):
            plan_of(rbf_scene(), ["contact.substep_angel=1,2"])

    def test_key_depends_on_scene_and_settings_not_on_their_order(self):
        assert point_key("a", {"x": 1, "y": 2}) == point_key("a", {"y": 2, "x": 1})
        assert len({point_key("a", {"x": 1}), point_key("b", {"x": 1}), point_key("a", {"x": 2})}) == 3

    def test_tasks_share_out_the_points(self):
        plan = plan_of(rbf_scene())
        parts = [p.key for i in (1, 2, 3) for p in plan.slice((i, 3))]
        assert sorted(parts) == sorted(p.key for p in plan.points if not p.is_reference)
        assert plan.slice((0, 3)) == []

    @pytest.mark.parametrize("text", ["3", "4/3", "a/b", "-1/2", "1/0", "0/0"])
    def test_wrong_task(self, text):
        with pytest.raises(UsageError):
            parse_task(text)


class TestFront:
    def test_known_front(self):
        errors, times = [5, 3, 4, 1, 1, np.nan], [1, 2, 3, 4, 5, 0.1]
        assert pareto_front(errors, times) == [0, 1, 3]

    @pytest.mark.parametrize(
        ("error", "time", "factor", "near"),
        [(1.0, 1.0, 1.0, True), (1.05, 1.08, 1.05, True), (2.0, 3.0, 2.0, False)],
    )
    def test_default_is_judged_by_the_factor_to_the_front(self, error, time, factor, near):
        def row(error, time, role=""):
            facts = {"status": "done", "role": role, "reference": "r", "model": "", "label": role or "x"}
            return {**facts, "error_rms": error, "time_frame": time, "front": False}

        rows = [row(1.0, 1.0), row(5.0, 0.5), row(error, time, "default"), row(np.nan, 0.1, "reference")]
        (verdict,) = mark_front(rows)
        assert verdict.factor == pytest.approx(factor)
        assert verdict.near is near
        assert verdict.on_front is (factor == 1.0 and rows[2]["front"])

    @settings(deadline=None, derandomize=True)
    @given(st.lists(st.tuples(st.integers(0, 4), st.integers(1, 5)), min_size=2, max_size=8))
    def test_advice_names_what_is_better_and_no_worse(self, pairs):
        """Nothing named costs more in the other quantity, and nothing left out is better than what is named."""
        facts = {"status": "done", "reference": "r", "model": "", "front": False}
        rows = [
            {
                **facts,
                "role": "" if k else "default",
                "label": f"{e} {t}",
                "error_rms": float(e),
                "time_frame": float(t),
            }
            for k, (e, t) in enumerate(pairs)
        ]
        (verdict,) = mark_front(rows)
        (error, time), others = pairs[0], pairs[1:]
        better = [e for e, t in others if e < error and t <= time]
        faster = [t for e, t in others if t < time and e <= error]
        assert (verdict.better and verdict.better["error"]) == (min(better) if better else None)
        assert (verdict.faster and verdict.faster["time"]) == (min(faster) if faster else None)
        assert (verdict.error, verdict.time) == (error, time)
        text = verdict_text(verdict, "mm")
        assert f"{error:.3g} mm at {1e3 * time:.3g} ms" in text
        for found, words in ((verdict.faster, "Quicker"), (verdict.better, "Better")):
            assert (words in text) == bool(found)
            if found:
                assert found["label"] == f"{found['error']:.0f} {found['time']:.0f}"
                assert f"{found['label']} ({found['error']:.3g} mm, {1e3 * found['time']:.3g} ms)" in text
        if better or faster:
            assert not verdict.on_front


class TestRun:
    def test_error_falls_with_refinement_and_the_reference_has_none(self, finished):
        plan, folder = finished
        rows = {row["label"]: row for row in write_table(plan, folder)["rows"]}
        assert all(row["status"] == "done" for row in rows.values())
        coarse, fine = (rows[f"model.centres=40 model.resolution={n}"] for n in (16, 24))
        assert 0 < fine["error_rms"] < coarse["error_rms"] < 1
        reference = next(row for row in rows.values() if row["role"] == "reference")
        assert reference["error_rms"] is None
        assert not reference["front"]

    def test_nothing_is_done_twice(self, finished):
        plan, folder = finished
        before = {path: path.stat().st_mtime_ns for path in (folder / "points").iterdir()}
        assert run_sweep(folder)[1] == 0
        assert {path: path.stat().st_mtime_ns for path in (folder / "points").iterdir()} == before
        assert len(before) == len(plan.points)

    def test_slices_merged_give_the_same_table(self, finished, tmp_path):
        parts = [tmp_path / f"part{i}" for i in (1, 2)]
        for i, part in enumerate(parts, start=1):
            run_sweep(part, part=(i, 2))
        plan = merge_sweeps(parts, tmp_path / "merged")
        assert table_of(plan, tmp_path / "merged") == table_of(*finished)

    def test_of_two_results_the_first_that_is_done_is_kept(self, finished, tmp_path):
        plan, done = finished
        key = plan.points[0].key
        kinds = {
            "a": ("failed", "first"),
            "b": ("done", "second"),
            "c": ("done", "third"),
            "d": ("failed", "last"),
        }
        for name, (status, process) in kinds.items():
            part = SweepFolder(tmp_path / name)
            part.prepare(plan)
            part.write({**SweepFolder(done).read(key), "status": status, "process": process})
        for order, kept in (
            ("abc", "second"),
            ("cb", "third"),
            ("ad", "first"),
            ("db", "second"),
            ("bd", "second"),
        ):
            merge_sweeps([tmp_path / name for name in order], tmp_path / order)
            assert SweepFolder(tmp_path / order).read(key)["process"] == kept

    def test_processes_give_the_same_table(self, finished, tmp_path):
        plan, count = run_sweep(tmp_path, jobs=2)
        assert count == POINTS
        assert table_of(plan, tmp_path) == table_of(*finished)
        results = [SweepFolder(tmp_path).read(point.key) for point in plan.points]
        assert len({result["process"] for result in results}) == 2
        assert os.getpid() not in {result["process"] for result in results}

    def test_failed_points_alone_are_tried_again_where_that_is_asked_for(self, tmp_path):
        texts = ["model.centres=40,-3"]
        _, count = run_sweep(tmp_path, texts=texts)
        plan = plan_of(rbf_scene(), texts)
        failed = [p.key for p in plan.points if SweepFolder(tmp_path).read(p.key)["status"] == "failed"]
        assert 0 < len(failed) < count
        runner = SweepRunner(run_point, rbf_scene(), plan, tmp_path, frames=FRAMES, jobs=1)
        assert runner.run() == 0 and runner.run(retry=True) == len(failed)

    def test_a_failed_point_leaves_the_others(self, tmp_path):
        plan, _ = run_sweep(tmp_path, texts=["model.centres=40,-3", "model.resolution=16,24"])
        rows = write_table(plan, tmp_path)["rows"]
        failed = [row for row in rows if row["status"] == "failed"]
        assert {row["settings"]["model.centres"] for row in failed} == {-3}
        assert all(row["error"] for row in failed)
        assert len([row for row in rows if row["status"] == "done"]) == len(rows) - len(failed) >= 2

    def test_another_sweep_in_the_folder_is_refused(self, finished):
        scene = rbf_scene()
        plan = plan_of(scene, ["model.centres=40,50"])
        with pytest.raises(UsageError, match="another scene or grid"):
            SweepRunner(run_point, scene, plan, finished[1], frames=FRAMES, jobs=1).run()
        with pytest.raises(UsageError, match="not the folder"):
            merge_sweeps([finished[1] / "points"], finished[1])

    def test_page_stands_alone(self, finished):
        plan, folder = finished
        write_page(write_table(plan, folder), folder)
        page = (folder / "sweep.html").read_text()
        assert "data:image/png;base64," in page
        assert "http" not in page
        assert (folder / "pareto.png").stat().st_size > 10_000


@pytest.fixture
def scene_file(tmp_path):
    """The arm as files."""
    return arm_files(tmp_path)


class TestCommand:
    def test_json_tasks_and_merge(self, scene_file, tmp_path, monkeypatch, capsys):
        use_blend_model(monkeypatch)
        out = str(tmp_path / "out")
        base = ["sweep", str(scene_file), "-o", out, "--grid", "contact.substep_angle=1,2,4", "--jobs", "1"]
        assert command([*base, "--task", "1/2", "--json"]) == 0
        first = json.loads(capsys.readouterr().out)
        assert command([*base, "--task", "2/2", "--json"]) == 0
        table = json.loads(capsys.readouterr().out)
        assert first["measured"] == 3  # the reference and two of three
        assert table["done"] == len(table["rows"]) == 4
        assert command(["sweep", "--merge", out, "-o", str(tmp_path / "merged")]) == 0
        assert "4 points done" in capsys.readouterr().out
        assert (tmp_path / "merged" / "sweep.csv").read_text() == (tmp_path / "out" / "sweep.csv").read_text()

    def test_failed_points_end_with_five_and_can_be_retried(self, scene_file, tmp_path, monkeypatch, capsys):
        base = ["sweep", str(scene_file), "-o", str(tmp_path / "out"), "--jobs", "1"]
        base += ["--grid", "contact.substep_angle=1,2"]
        use_blend_model(monkeypatch, fail_at=6)  # half steps need more solves than whole ones
        assert command(base) == 5
        assert "planted failure" in capsys.readouterr().err
        use_blend_model(monkeypatch)
        assert command(base) == 5
        assert command([*base, "--retry"]) == 0

    @pytest.mark.parametrize(
        "words",
        [[], ["--grid", "a=1", "--merge", "x"], ["--task", "9"], ["--error", "rms"], ["--jobs", "0"]],
        ids=str,
    )
    def test_wrong_usage(self, scene_file, tmp_path, words):
        grid = [] if words[:1] == ["--grid"] else ["--grid", "contact.substep_angle=1,2"]
        grid = grid if words else []
        assert command(["sweep", str(scene_file), "-o", str(tmp_path / "out"), *grid, *words]) == 2

    def test_killed_half_way_and_resumed(self, finished, scene_file, tmp_path):
        out = tmp_path / "out"
        words = [
            sys.executable,
            "-c",
            "from rbfmuscle.cli import main; main()",
            "sweep",
            str(scene_file),
            "-o",
            str(out),
            "--jobs",
            "2",
        ]
        words += ["--frames", FRAMES, "--grid", *GRID]
        process = subprocess.Popen(
            words, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True
        )
        deadline = time.monotonic() + 120
        while len(list(out.glob("points/*.json"))) < 2 and time.monotonic() < deadline:
            time.sleep(0.02)
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
        kept = {path: path.stat().st_mtime_ns for path in out.glob("points/*.json")}
        assert 2 <= len(kept) < POINTS
        assert command(words[3:]) == 0
        assert {path: path.stat().st_mtime_ns for path in kept} == kept
        plan = SweepFolder(out).read_plan()
        assert len(list(out.glob("points/*.json"))) == len(plan.points) == POINTS
        labels = [row["label"] for row in write_table(plan, out)["rows"]]
        assert labels == [point.label for point in finished[0].points]


def crash_or_run(scene, settings, frames):
    """A runner whose process ends without a word for one setting."""
    if settings.get("model.centres") == 60:
        os._exit(1)
    return run_point(scene, settings, frames)


@pytest.mark.filterwarnings("ignore:A worker stopped:UserWarning")
def test_a_process_that_dies_takes_only_its_own_points(tmp_path):
    scene = rbf_scene()
    plan = plan_of(scene, ["model.centres=40,60,80"])
    SweepRunner(crash_or_run, scene, plan, tmp_path, frames=FRAMES, jobs=2).run()
    rows = {row["label"]: row for row in write_table(plan, tmp_path)["rows"]}
    assert {label for label, row in rows.items() if row["status"] != "done"} == {"model.centres=60"}
    assert "process ended" in rows["model.centres=60"]["error"]


@pytest.fixture
def scheduler(tmp_path):
    """Address of a Dask scheduler with two workers on loopback."""
    pytest.importorskip("distributed")
    environment = {**os.environ, "DASK_DISTRIBUTED__ADMIN__LOG_FORMAT": "%(message)s"}
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL, "env": environment}
    file = tmp_path / "scheduler.json"
    home = ["--scheduler-file", str(file)]
    python = [sys.executable, "-m", "distributed.cli.dask_scheduler"]
    started = [
        subprocess.Popen([*python, "--host", "127.0.0.1", "--port", "0", "--no-dashboard", *home], **quiet)
    ]
    deadline = time.monotonic() + 60
    while not file.exists() and time.monotonic() < deadline:
        time.sleep(0.1)
    worker = [sys.executable, "-m", "distributed.cli.dask_worker", *home, "--nthreads", "1", "--no-dashboard"]
    for _ in range(2):
        started.append(subprocess.Popen([*worker, "--local-directory", str(tmp_path)], **quiet))
    try:
        yield json.loads(file.read_text())["address"]
    finally:
        for process in reversed(started):
            process.terminate()
        for process in started:
            process.wait(timeout=30)


def test_dask_gives_the_same_table(finished, scheduler, tmp_path):
    plan, count = run_sweep(tmp_path / "out", scheduler=scheduler)
    assert count == POINTS
    assert table_of(plan, tmp_path / "out") == table_of(*finished)
    folder = SweepFolder(tmp_path / "out")
    processes = {folder.read(point.key)["process"] for point in plan.points}
    assert len(processes - {os.getpid()}) == 2


def test_no_scheduler_is_said(tmp_path, monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr("rbfmuscle.study.experiment.workers.CONNECT_WITHIN", 2)
    with pytest.raises(UsageError, match="no Dask scheduler"):
        run_sweep(tmp_path, scheduler="tcp://127.0.0.1:1")
