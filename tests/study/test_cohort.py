"""Cohorts: many scenes as one table, resumed, with failures and dead processes, outliers first."""

import csv
import json
import os
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import pytest
from blend_model import arm_files

from rbfmuscle.app import run_command as command
from rbfmuscle.commands.cohort import run_job
from rbfmuscle.study.cohort.jobs import CohortFolder, read_cohort
from rbfmuscle.study.cohort.runs import CohortRunner
from rbfmuscle.study.cohort.table import Value, outliers, write_cohort
from rbfmuscle.validation import UsageError

MODEL = 'model = { name = "pbd", iterations = 3 }\n'


def write_subject(folder, scale=1.0, units="mm"):
    """A subject's scene with meshes of their own size."""
    folder.mkdir(parents=True)
    return arm_files(folder, "scene.toml", scale=scale, units=units, defaults=MODEL)


def write_table(path, rows):
    with open(path, "w", encoding="utf-8", newline="") as file:
        table = csv.DictWriter(file, list(rows[0]))
        table.writeheader()
        table.writerows(rows)
    return str(path)


def table_of(folder):
    """``cohort.csv`` without what a clock wrote."""
    with open(folder / "cohort.csv", encoding="utf-8", newline="") as file:
        return [row for row in csv.DictReader(file) if not row["quantity"].startswith("time_")]


@pytest.fixture(scope="module")
def subjects(tmp_path_factory):
    """A table of three subjects, one of which cannot be read, with two trials each."""
    home = tmp_path_factory.mktemp("cohort")
    write_subject(home / "ann", 1.0)
    write_subject(home / "bob", 1.1)
    (home / "bad.toml").write_text("[scene]\n", encoding="utf-8")
    rows = [
        {"subject": name, "trial": trial, "scene": scene, "motion.ramp.elbow.flexion.to": to}
        for name, scene in (("ann", "ann/scene.toml"), ("bob", "bob/scene.toml"), ("cleo", "bad.toml"))
        for trial, to in (("low", ""), ("high", "20"))
    ]
    return write_table(home / "subjects.csv", rows)


@pytest.fixture(scope="module")
def finished(subjects, tmp_path_factory):
    """The cohort run in this process: (jobs, folder)."""
    folder = tmp_path_factory.mktemp("finished")
    jobs = read_cohort((subjects,), {})
    assert CohortRunner(run_job, jobs, folder, count=1).run() == len(jobs) == 6
    write_cohort(jobs, folder)
    return jobs, folder


class TestTable:
    def test_rows_become_jobs_with_their_settings(self, subjects):
        jobs = read_cohort((subjects,), {"settings": {"contact.substep_angle": 1}, "model": "xpbd"})
        assert [job.name for job in jobs[:3]] == ["ann_low", "ann_high", "bob_low"]
        assert jobs[0].settings == {"contact.substep_angle": 1}
        assert jobs[1].settings == {"contact.substep_angle": 1, "motion.ramp.elbow.flexion.to": 20}
        assert jobs[0].model == "xpbd" and os.path.isabs(jobs[0].scene)

    @pytest.mark.parametrize(
        "text, message",
        [
            ("subject,trial\na,b\n", "no column 'scene'"),
            ("subject,scene,contect.margin\na,b,1\n", "unknown column 'contect.margin'"),
            ("subject,scene\na\n", "line 2: has another number of values"),
            ("subject,scene\na,\n", "line 2: scene is empty"),
            ("subject,scene\na,x.toml\na,y.toml\n", "is there twice"),
            ("subject,scene\n", "has 0 rows"),
            ("subject,scene\na,\xff\n", "UTF-8"),
        ],
    )
    def test_wrong_tables_are_one_line(self, text, message, tmp_path):
        (tmp_path / "t.csv").write_bytes(text.encode("latin-1"))
        with pytest.raises(UsageError, match=message):
            read_cohort((str(tmp_path / "t.csv"),), {})

    def test_patterns_name_subjects_by_what_differs(self, tmp_path):
        for name in ("ann", "bob"):
            write_subject(tmp_path / name)
        assert [job.subject for job in read_cohort((str(tmp_path / "*" / "scene.toml"),), {})] == [
            "ann",
            "bob",
        ]
        with pytest.raises(UsageError, match="no file matches"):
            read_cohort((str(tmp_path / "*" / "other.toml"),), {})


class TestRuns:
    def test_one_table_for_all_and_reasons_for_those_that_failed(self, finished):
        _, folder = finished
        rows = table_of(folder)
        assert {(row["subject"], row["trial"]) for row in rows} == {
            (name, trial) for name in ("ann", "bob") for trial in ("low", "high")
        }
        volume = {row["subject"]: float(row["mean"]) for row in rows if row["quantity"] == "volume"}
        assert volume["bob"] == pytest.approx(1.1**3 * volume["ann"], rel=1e-3)
        facts = json.loads((folder / "cohort.json").read_text())
        assert (facts["done"], facts["failed"], facts["missing"]) == (4, 2, 0)
        assert all("SceneError" in row["error"] for row in facts["jobs"] if row["subject"] == "cleo")

    def test_nothing_is_run_twice_but_what_has_changed(self, finished, subjects, tmp_path):
        home = tmp_path / "home"
        write_subject(home / "ann")
        table = write_table(home / "t.csv", [{"subject": "ann", "scene": "ann/scene.toml"}])
        jobs = read_cohort((table,), {})
        folder = tmp_path / "out"
        assert CohortRunner(run_job, jobs, folder, count=1).run() == 1
        assert CohortRunner(run_job, jobs, folder, count=1).run() == 0
        with open(home / "ann" / "scene.toml", "a", encoding="utf-8") as file:
            file.write("[contact]\nsubstep_angle = 1\n")
        assert CohortRunner(run_job, jobs, folder, count=1).run() == 1
        info = CohortFolder(folder).info(jobs[0])
        assert info["scene"]["contact"]["substep_angle"] == 1

    def test_a_motion_file_that_has_changed_is_run_again(self, tmp_path):
        write_subject(tmp_path / "ann")
        head = "bend\nversion=1\nnRows=2\nnColumns=2\ninDegrees=yes\nendheader\ntime\tflexion\n"
        (tmp_path / "bend.mot").write_text(f"{head}0\t0\n1\t5\n")
        rows = [{"subject": "ann", "scene": "ann/scene.toml", "motion": "bend.mot"}]
        jobs, folder = read_cohort((write_table(tmp_path / "t.csv", rows),), {}), tmp_path / "out"
        assert CohortRunner(run_job, jobs, folder, count=1).run() == 1
        assert CohortRunner(run_job, jobs, folder, count=1).run() == 0
        (tmp_path / "bend.mot").write_text(f"{head}0\t0\n1\t8\n")
        assert CohortRunner(run_job, jobs, folder, count=1).run() == 1
        last = CohortFolder(folder).info(jobs[0])["frames"][-1]
        assert last["coordinates"]["elbow.flexion"] == pytest.approx(8.0)

    def test_failed_jobs_run_again_only_when_asked(self, finished):
        jobs, folder = finished
        assert CohortRunner(run_job, jobs, folder, count=1).run() == 0
        assert CohortRunner(run_job, jobs, folder, count=1).run(retry=True) == 2

    def test_process_that_dies_costs_its_job_only(self, finished, tmp_path):
        jobs, folder = finished
        good = [job for job in jobs if job.subject != "cleo"]
        runner = CohortRunner(run_job, good, tmp_path, count=2)
        killed = []

        def kill_first_child():
            """Kill the process of the first job that is under way."""
            deadline = time.monotonic() + 60
            while not killed and time.monotonic() < deadline:
                if list((tmp_path / "results").glob("*.running")):
                    own = [c for c in _children(os.getpid()) if "spawn_main" in _command(c)]
                    for child in own[:1]:
                        os.kill(child, signal.SIGKILL)
                        killed.append(child)
                time.sleep(0.01)

        watcher = threading.Thread(target=kill_first_child)
        watcher.start()
        runner.run()
        watcher.join()
        assert killed
        write_cohort(good, tmp_path)
        assert table_of(tmp_path) == table_of(folder)


def _children(parent):
    found = []
    for entry in os.listdir("/proc"):
        if entry.isdigit():
            try:
                with open(f"/proc/{entry}/stat", encoding="utf-8") as file:
                    if int(file.read().rpartition(")")[2].split()[1]) == parent:
                        found.append(int(entry))
            except OSError:
                continue
    return found


def _command(process):
    try:
        with open(f"/proc/{process}/cmdline", encoding="utf-8") as file:
            return file.read()
    except OSError:
        return ""


class TestOutliers:
    def values(self, numbers, unit="mm"):
        return [Value(f"s{k}", "", "psoas", "length", unit, float(x)) for k, x in enumerate(numbers)]

    def test_one_apart_among_alike(self):
        (found,) = outliers(self.values([100, 101, 99, 100.5, 99.5, 140]))
        assert found.subject == "s5" and found.median == pytest.approx(100.25)
        deviation = 1.4826 * np.median(np.abs(np.array([100, 101, 99, 100.5, 99.5, 140]) - 100.25))
        assert found.apart == pytest.approx((140 - 100.25) / deviation)

    def test_few_jobs_and_equal_ones_tell_nothing(self):
        assert outliers(self.values([100, 100, 100, 140])) == []
        assert outliers(self.values([100, 100, 100, 100, 100.01, 100])) == []

    def test_what_is_not_finite_is_apart(self):
        (found,) = outliers(self.values([1, 2, 3, 2, 1, np.nan]))
        assert found.subject == "s5" and found.apart == np.inf


def test_command_writes_page_with_failures_outliers_and_links(tmp_path, capsys):
    rows = []
    for k, units in enumerate(["mm"] * 5 + ["cm"]):
        # The sixth is drawn in centimetres: ten times as large as the others.
        write_subject(tmp_path / f"s{k}", 1.0 + 0.01 * k, units)
        rows.append(
            {"subject": f"s{k}", "scene": f"s{k}/scene.toml", "output.report": "true" if k == 0 else ""}
        )
    (tmp_path / "bad.toml").write_text("[scene]\n", encoding="utf-8")
    rows.append({"subject": "<worst>", "scene": "bad.toml", "output.report": ""})
    table, out = write_table(tmp_path / "t.csv", rows), tmp_path / "out"
    assert command(["sweep", table, "-o", str(out), "--frames", "0:2", "--jobs", "1"]) == 5
    told = capsys.readouterr()
    assert "6 jobs done, 1 failed" in told.out and "apart: s5, biceps" in told.out
    assert "rbfmuscle: <worst>: SceneError" in told.err
    page = (out / "cohort.html").read_text()
    assert "&lt;worst&gt;" in page and 'href="jobs/s0/report.html"' in page and "<worst>" not in page
    assert (out / "jobs" / "s0" / "report.html").is_file()
    assert command(["sweep", table, "-o", str(out), "--grid", "model.iterations=2,3"]) == 2


class TestDask:
    @pytest.fixture
    def cluster(self, tmp_path):
        """Scheduler and two workers on loopback: (address, processes)."""
        pytest.importorskip("distributed")
        quiet = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
        file = tmp_path / "scheduler.json"
        home = ["--scheduler-file", str(file), "--no-dashboard"]
        python = [
            sys.executable,
            "-m",
            "distributed.cli.dask_scheduler",
            "--host",
            "127.0.0.1",
            "--port",
            "0",
        ]
        started = [subprocess.Popen([*python, *home], **quiet)]
        deadline = time.monotonic() + 60
        while not file.exists() and time.monotonic() < deadline:
            time.sleep(0.1)
        worker = [sys.executable, "-m", "distributed.cli.dask_worker", *home, "--nthreads", "1", "--no-nanny"]
        for _ in range(2):
            started.append(subprocess.Popen([*worker, "--local-directory", str(tmp_path)], **quiet))
        yield json.loads(file.read_text())["address"], started
        # Not asked: a worker that waits for its scheduler takes its time over a polite end.
        for process in reversed(started):
            process.kill()
            process.wait()

    def test_worker_that_is_killed_leaves_the_same_table(self, cluster, finished, tmp_path):
        jobs, folder = finished
        address, processes = cluster
        good = [job for job in jobs if job.subject != "cleo"]

        def kill(done, total):
            if done == 1 and processes[-1].poll() is None:
                processes[-1].kill()

        out = tmp_path / "out"
        assert CohortRunner(run_job, good, out, scheduler=address, progress=kill).run() == len(good)
        write_cohort(good, out)
        assert table_of(out) == table_of(folder)
        assert processes[-1].poll() == -signal.SIGKILL
