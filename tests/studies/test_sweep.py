"""Sweeps: the grid, the front, failures, and the same table however the points were run."""

import csv
import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from blend_model import arm_files, arm_scene, use_blend_model

import rbfmuscle as rm
from rbfmuscle.cli.app import run_command as command
from rbfmuscle.cli.options import named_scenes
from rbfmuscle.studies.sweep import (
    SweepFolder,
    SweepPoint,
    SweepRow,
    mark_front,
    pareto_front,
    parse_grid,
    plan_sweep,
    run_point,
    run_sweep,
    scene_content,
    sweep_rows,
    write_page,
    write_table,
)
from rbfmuscle.validation import UsageError

GRID = ["model.centres=40,60", "model.resolution=16,24"]
FRAMES = "0:3"
POINTS = 5  # four combinations and the scene's own settings
# Of a clock, a machine and a process.
CLOCKED = ("time_frame", "time_frame_p95", "time_extract", "seconds", "threads", "machine", "front")


def plan_of(texts=GRID, **options):
    return plan_sweep(
        {"arm": arm_scene(end=10, step=5)}, parse_grid(texts), frames=FRAMES, **options
    )


def sweep(folder, texts=GRID, runner=run_point, **options):
    points, scenes = plan_of(texts), {"arm": arm_scene(end=10, step=5)}
    return points, run_sweep(
        runner, scenes, points, folder, frames=FRAMES, **{"jobs": 1, **options}
    )


DEADLY = "model.centres=60 model.resolution=16"


def crash_or_run(scene, settings, frames):
    """A runner whose process ends without a word for one point."""
    if (settings.get("model.centres"), settings.get("model.resolution")) == (60, 16):
        os._exit(1)
    return run_point(scene, settings, frames)


def failing(scene, settings, frames):
    """A runner without a run."""
    raise UsageError("not run")


def rows_of(points, folder):
    """Lines of the table without what differs from run to run."""
    write_table(points, folder, {"arm": "mm"})
    with open(folder / "sweep.csv", encoding="utf-8", newline="") as file:
        return [{k: v for k, v in row.items() if k not in CLOCKED} for row in csv.DictReader(file)]


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A sweep run in this process: (points, folder)."""
    folder = tmp_path_factory.mktemp("sweep")
    points, count = sweep(folder)
    assert count == len(points) == POINTS
    return points, folder


class TestGrid:
    def test_values_are_read_as_toml_or_text(self):
        texts = [
            "model.centres=100,200",
            "contact.substep_angle=0.5,2",
            "model.kernel=cubic,wendland_c2",
        ]
        assert list(parse_grid(texts).values()) == [[100, 200], [0.5, 2], ["cubic", "wendland_c2"]]
        assert parse_grid(["a=[1,2],[3],[1,2]"]) == {"a": [[1, 2], [3]]}
        for wrong in (["centres"], ["=1,2"], ["a="], ["motion.step=1,a"], ["a=1", "a=2"]):
            with pytest.raises(UsageError):
                parse_grid(wrong)

    def test_the_model_comes_first_and_all_are_measured_against_one_reference(self):
        points = plan_of(["model.samples=40,60", "model=rbf,pbd"])
        (reference,) = [p for p in points if p.role == "reference"]
        assert reference.settings == {"model.samples": 60} and len(points) == 6
        assert all(next(iter(p.settings)) == "model" for p in points[2:])
        assert {p.reference for p in points} == {reference.key}

    def test_reference_is_the_finest_of_the_grid(self):
        texts = ["model.centres=80,40", "contact.substep_angle=2,1", "model.kernel=cubic,quintic"]
        assert plan_of(texts)[0].settings == {"model.centres": 80, "contact.substep_angle": 1}
        given = plan_of(texts, reference={"model.centres": 200})[0]
        assert given.role == "reference" and given.settings["model.centres"] == 200

    def test_scenes_without_a_grid_are_a_point_each(self):
        one, other = plan_sweep({"a": arm_scene(end=10), "b": arm_scene(end=20)}, {})
        assert (one.scene, one.role, one.reference) == ("a", "default", "") and other.scene == "b"
        assert one.key != other.key

    def test_keys_hold_the_version_and_no_paths(self, tmp_path, monkeypatch):
        scene = rm.Scene.load(arm_files(tmp_path, end=10))
        (tmp_path / "other").mkdir()
        moved = rm.Scene.load(arm_files(tmp_path / "other", end=10))
        for number, folder in enumerate((scene, moved)):
            motion, file = folder.motion, tmp_path / str(number) / "gait.mot"
            motion.options = motion.options.model_copy(update={"file": file})
        assert scene_content(scene) == scene_content(moved)
        before = scene_content(scene)
        monkeypatch.setattr(rm, "__version__", "0.0.0")
        assert scene_content(scene) != before


def row(error, time, role=""):
    label = role or f"{error:g} {time:g}"
    values = {"error_rms": error, "time_frame": time}
    names = {"scene": "s", "units": "mm", "label": label, "reference": "r", "key": label}
    return SweepRow(role=role, settings={}, values=values, **names)


class TestFront:
    def test_known_front(self):
        assert pareto_front([5, 3, 4, 1, 1, np.nan], [1, 2, 3, 4, 5, 0.1]) == [0, 1, 3]

    @pytest.mark.parametrize(
        ("error", "time", "factor", "near"),
        [(1.0, 1.0, 1.0, True), (1.05, 1.08, 1.05, True), (2.0, 3.0, 2.0, False)],
    )
    def test_default_is_judged_by_the_factor_to_the_front(self, error, time, factor, near):
        rows = [
            row(1.0, 1.0),
            row(5.0, 0.5),
            row(error, time, "default"),
            row(np.nan, 0.1, "reference"),
        ]
        exact = mark_front([row(0.0, 1.0, "default"), row(0.0, 0.5)])[0]
        assert (exact.factor, exact.faster, exact.better) == (1.0, "0 0.5", None)
        (verdict,) = mark_front(rows)
        assert verdict.factor == pytest.approx(factor)
        assert verdict.near is near
        assert ("lies on the Pareto front" in verdict.text) is rows[2].front


class TestRun:
    def test_error_falls_with_refinement_and_the_reference_has_none(self, finished):
        points, folder = finished
        table = write_table(points, folder, {"arm": "mm"})
        write_page(folder, table)
        page = (folder / "sweep.html").read_text(encoding="utf-8")
        assert "<svg" in page and "http" not in page and "the default lies" in page
        rows = {r.label: r for r in table.rows}
        assert all(r.status == "done" for r in rows.values())
        coarse, fine = (rows[f"model.centres=40 model.resolution={n}"] for n in (16, 24))
        assert 0 < fine.value("error_rms") < coarse.value("error_rms") < 1
        (reference,) = [r for r in rows.values() if r.role == "reference"]
        assert np.isnan(reference.value("error_rms")) and not reference.front

    def test_what_is_done_is_not_done_twice(self, finished):
        before = {path: path.stat().st_mtime_ns for path in (finished[1] / "points").iterdir()}
        assert sweep(finished[1])[1] == 0 and len(before) == POINTS
        assert {path: path.stat().st_mtime_ns for path in before} == before
        other = [replace(point, reference="other") for point in finished[0]]
        assert not any(SweepFolder(finished[1]).is_done(point) for point in other)

    @pytest.mark.slow  # processes that each load all, and others after one of them has died
    @pytest.mark.filterwarnings("ignore:A worker stopped:UserWarning")
    def test_processes_give_the_same_table_but_for_the_point_of_one_that_dies(
        self, finished, tmp_path
    ):
        points, count = sweep(tmp_path, runner=crash_or_run, jobs=2)
        every = zip(points, rows_of(points, tmp_path), rows_of(*finished), strict=True)
        assert count == POINTS
        assert all(found == wanted for p, found, wanted in every if p.label != DEADLY)
        rows = {r.label: r for r in write_table(points, tmp_path, {"arm": "mm"}).rows}
        assert {label for label, r in rows.items() if r.status != "done"} == {DEADLY}
        assert "process ended" in rows[DEADLY].message
        results = [
            SweepFolder(tmp_path).read(p.key) for p in points if rows[p.label].status == "done"
        ]
        assert os.getpid() not in {found["process"] for found in results}
        # The cores of jobs are shared: a point each.
        assert {found["threads"] for found in results} == {1}

    def test_one_core_is_one_point_on_one_thread(self, finished):
        points, folder = finished
        assert {SweepFolder(folder).read(point.key)["threads"] for point in points} == {1}

    def test_failed_points_leave_the_others_and_are_tried_again(self, tmp_path):
        points, _ = sweep(tmp_path, ["model.centres=40,-3", "model.resolution=16,24"])
        rows = write_table(points, tmp_path, {"arm": "mm"}).rows
        failed = [r for r in rows if r.status == "failed"]
        assert {r.settings["model.centres"] for r in failed} == {-3} and all(
            r.message for r in failed
        )
        assert sweep(tmp_path, ["model.centres=40,-3", "model.resolution=16,24"])[1] == len(failed)

    def test_each_point_is_read_a_few_times_however_many_there_are(self, tmp_path, monkeypatch):
        read, keys = SweepFolder.read, []
        monkeypatch.setattr(
            SweepFolder, "read", lambda self, key: keys.append(key) or read(self, key)
        )
        angles = ",".join(str(0.1 * k) for k in range(1, 31))
        points, count = sweep(tmp_path, [f"contact.substep_angle={angles}"], runner=failing)
        assert count == len(points) == 31 and 0 < len(keys) <= 2 * count


@pytest.fixture
def cluster(tmp_path):
    """Address of a Dask scheduler on loopback, and its two workers, which nobody replaces."""
    file = tmp_path / "scheduler.json"
    home = ["--scheduler-file", str(file), "--no-dashboard"]
    quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    python = [sys.executable, "-m"]
    words = [*python, "distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", "0", *home]
    started = [subprocess.Popen(words, **quiet)]
    deadline = time.monotonic() + 60
    while not file.exists() and time.monotonic() < deadline:
        time.sleep(0.1)
    words = [*python, "distributed.cli.dask_worker", *home, "--nthreads", "1", "--no-nanny"]
    for place in (tmp_path / "one", tmp_path / "two"):
        started.append(subprocess.Popen([*words, "--local-directory", str(place)], **quiet))
    try:
        yield json.loads(file.read_text(encoding="utf-8"))["address"], started[1:]
    finally:
        # A worker that is asked to end may wait for ever for a scheduler that has ended.
        for process in started:
            process.kill()
            process.wait()


@pytest.mark.slow  # a scheduler and two workers have to start, and one has to be missed
def test_a_cluster_that_loses_one_of_two_workers_gives_the_same_table(finished, cluster, tmp_path):
    address, workers = cluster

    def kill(done, total):
        if done == 2:
            workers[0].send_signal(signal.SIGKILL)

    points, count = sweep(tmp_path / "out", jobs=address, progress=kill)
    assert count == POINTS and workers[0].wait(timeout=30) != 0
    assert rows_of(points, tmp_path / "out") == rows_of(*finished)


class TestCommand:
    def test_scenes_of_one_name_are_named_by_their_folders(self):
        assert named_scenes(["x/a.toml", "x/b.toml"]) == {"a": "x/a.toml", "b": "x/b.toml"}
        assert named_scenes(["x/a.toml", "y/a.toml"]) == {"x": "x/a.toml", "y": "y/a.toml"}
        with pytest.raises(UsageError, match="different names"):
            named_scenes(2 * ["x/a.toml"])

    def test_failed_points_end_with_five_and_are_run_again(self, tmp_path, monkeypatch, capsys):
        scenes = [str(arm_files(tmp_path, name)) for name in ("arm.toml", "other.toml")]
        base = ["sweep", *scenes, "-o", str(tmp_path / "out"), "--jobs", "1"]
        base += ["--grid", "contact.substep_angle=0.5,1,2"]
        use_blend_model(monkeypatch, fail_at=1)
        assert command(base) == 5
        err = capsys.readouterr().err  # of all that failed the first five are shown
        assert err.count("planted failure") == 5 and "8 of 8 points failed" in err
        use_blend_model(monkeypatch)
        assert command(base) == 0
        table = json.loads((tmp_path / "out" / "sweep.json").read_text(encoding="utf-8"))
        assert {r["scene"] for r in table["rows"]} == {"arm", "other"}
        assert table["done"] == len(table["rows"])
        page = tmp_path / "out" / "sweep.html"
        first = page.read_bytes()
        page.unlink()
        assert command(["report", str(tmp_path / "out")]) == 0 and page.read_bytes() == first
        capsys.readouterr()
        assert command([*base, "--fail-on", "volume_error=1"]) == 0
        assert command([*base, "--fail-on", "volume_error=0"]) == 6
        assert ": volume_error = " in capsys.readouterr().err
        assert command([*base, "--fail-on", "length=1000"]) == 0
        # A quantity that the model has not is none of "all", and not measured where it is named.
        command([*base, "--fail-on", "all"])
        err = capsys.readouterr().err
        assert "flicker" not in err and "bone_overlap" not in err  # which is measured of the scene
        assert command([*base, "--fail-on", "flicker"]) == 6
        assert "not measured: flicker" in capsys.readouterr().err

    @pytest.mark.parametrize(
        "words",
        ["", "--quantity rms", "--jobs 0", "--grid contact.substep_angel=1,2", "--frames a:b"],
    )
    def test_wrong_usage(self, tmp_path, words):
        grid = ["--grid", "model.iterations=1,2"] if words else []
        out = ["-o", str(tmp_path / "out")]
        assert command(["sweep", str(arm_files(tmp_path)), *out, *grid, *words.split()]) == 2
        assert not (tmp_path / "out").exists()


def test_rows_are_those_of_their_points_in_order():
    points = [
        SweepPoint(f"k{n}", "s", {"a": n} if n else {}, "" if n else "default", "r")
        for n in range(3)
    ]
    done, failed = (
        {"status": "done", "values": {"error_rms": 0.25}},
        {"status": "failed", "message": "no"},
    )
    folder = SimpleNamespace(read=lambda key: {"k0": done, "k1": failed}.get(key, {}))
    rows = sweep_rows(points, folder, {"s": "cm"})
    assert [r.status for r in rows] == ["done", "failed", "missing"]
    assert [r.label for r in rows] == ["default", "a=1", "a=2"]
    assert [r.message for r in rows] == ["", "no", ""] and rows[0].units == "cm"
    np.testing.assert_array_equal([r.value("error_rms") for r in rows], [0.25, np.nan, np.nan])
