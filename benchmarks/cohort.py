"""A cohort of 24 jobs on two Dask workers on loopback, one of which is killed half-way, against one process.

    python benchmarks/cohort.py --frames 0:11 [--alone]

Says whether both give the same table (times apart), the ratio of their times, the workers' start left out, and which
jobs were begun more than once. Each job has one thread in either. The killed worker is replaced by its nanny, as Dask
does where nobody says otherwise; with ``--alone`` it is not: then half of the jobs are left to one worker, and no ratio
below 0.75 can be had.
"""

import argparse
import collections
import csv
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from rbfmuscle.study.cohort.jobs import read_cohort
from rbfmuscle.study.cohort.runs import CohortRunner
from rbfmuscle.study.cohort.table import write_cohort


def logged(job, directory):
    """`run_job`, after a line in a log beside the jobs: who began what."""
    from rbfmuscle.commands.cohort import run_job

    with open(directory.parent.parent / "log.txt", "a", encoding="utf-8") as file:
        file.write(f"{job.name} {os.getpid()}\n")
    return run_job(job, directory)


def write_subjects(path: Path) -> None:
    """Six subjects, four trials each, of the phantom."""
    with open(path, "w", encoding="utf-8", newline="") as file:
        table = csv.writer(file)
        table.writerow(("subject", "trial", "scene", "model.centres", "motion.ramp.hip.flexion.step"))
        for subject in range(6):
            for trial, step in enumerate((1.0, 2.0, 3.0, 4.0)):
                table.writerow((f"s{subject}", f"t{trial}", "phantom", 140 + 10 * subject, step))


def table_of(folder: Path) -> list[str]:
    """Rows of ``cohort.csv`` without times."""
    lines = (folder / "cohort.csv").read_text(encoding="utf-8").splitlines()
    return [line for line in lines if ",time_" not in line]


def cluster(home: Path, *, nannies: bool) -> tuple[str, list[subprocess.Popen]]:
    """Scheduler and two workers of one thread: address and processes, scheduler first."""
    file, quiet = home / "scheduler.json", {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    common = ["--scheduler-file", str(file), "--no-dashboard"]
    scheduler = [sys.executable, "-m", "distributed.cli.dask_scheduler", "--host", "127.0.0.1", "--port", "0"]
    started = [subprocess.Popen([*scheduler, *common], **quiet)]
    while not file.exists():
        time.sleep(0.1)
    worker = [sys.executable, "-m", "distributed.cli.dask_worker", *common, "--nthreads", "1"]
    worker.append("--nanny" if nannies else "--no-nanny")
    one_thread = {**os.environ, "NUMBA_NUM_THREADS": "1"}
    for _ in range(2):
        started.append(subprocess.Popen([*worker, "--local-directory", str(home)], **quiet, env=one_thread))
    return json.loads(file.read_text())["address"], started


def worker_processes(address: str) -> list[int]:
    """Process numbers of the workers, once both are there."""
    from distributed import Client

    with Client(address) as client:
        client.wait_for_workers(2, timeout=120)
        return list(client.run(os.getpid).values())


def timed(jobs, out, **how):
    """Seconds that a cohort takes, a thread a job, and which jobs were begun more than once."""
    out.mkdir()
    runner = CohortRunner(logged, jobs, out, **how)
    runner.threads = 1
    begun = time.perf_counter()
    runner.run()
    seconds = time.perf_counter() - begun
    write_cohort(jobs, out)
    starts = collections.Counter(line.split()[0] for line in (out / "log.txt").read_text().splitlines())
    return seconds, [name for name, count in starts.items() if count > 1]


def main() -> int:
    """Both ways, and their comparison."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", default="0:11")
    parser.add_argument(
        "--alone", action="store_true", help="workers without nannies, which are not replaced"
    )
    asked = parser.parse_args()
    settings = {"output.report": False, "output.preview": False}
    with tempfile.TemporaryDirectory() as folder:
        home = Path(folder)
        write_subjects(home / "t.csv")
        jobs = read_cohort((str(home / "t.csv"),), {"frames": asked.frames, "settings": settings})
        address, processes = cluster(home, nannies=not asked.alone)
        try:
            numbers = worker_processes(address)

            def kill(done, total):
                if done == total // 2:
                    os.kill(numbers[-1], signal.SIGKILL)

            # Workers and this process load and compile before the clocks run.
            timed(jobs[:4], home / "warm", scheduler=address)
            cluster_time, twice = timed(jobs, home / "cluster", scheduler=address, progress=kill)
            replaced = set(worker_processes(address)) - set(numbers) if not asked.alone else set()
        finally:
            for process in reversed(processes):
                process.terminate()
        timed(jobs[:1], home / "warm alone", count=1)
        single_time, _ = timed(jobs, home / "single", count=1)
        same = table_of(home / "cluster") == table_of(home / "single")
        print(
            f"one process {single_time:.1f} s; two workers, one killed half-way ({len(replaced)} replaced): "
            f"{cluster_time:.1f} s"
        )
        print(
            f"ratio {cluster_time / single_time:.2f}; tables {'the same' if same else 'DIFFER'}; begun twice: {twice}"
        )
        return not same


if __name__ == "__main__":
    sys.exit(main())
