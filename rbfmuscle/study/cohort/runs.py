"""Running the jobs of a cohort: one after another, on all cores, or on a cluster."""

from __future__ import annotations

import os
import platform
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from rbfmuscle.study.cohort.jobs import CohortFolder, CohortJob
from rbfmuscle.study.experiment.sweep_points import POINT_ERRORS
from rbfmuscle.study.experiment.workers import available_cores, connect_cluster, threads_limited

DIED = "its process ended without a word (out of memory, or a crash)"


def run_job(
    runner: Callable[[CohortJob, Path], dict[str, Any]], job: CohortJob, folder: CohortFolder, threads: int
) -> None:
    """Run one job and keep how it went; an error becomes the result of a failed job.

    Parameters
    ----------
    runner : callable
        ``runner(job, directory)`` leaves a run in a folder and gives its ``run.json``; module-level, so that it can be
        sent away.
    job : CohortJob
    folder : CohortFolder
    threads : int
        For this job.
    """
    start = time.perf_counter()
    folder.prepare()
    folder.marker(job).touch()
    result: dict[str, Any] = {"status": "done", "error": ""}
    try:
        with threads_limited(threads):
            runner(job, folder.run_of(job))
    except POINT_ERRORS as error:
        result = {"status": "failed", "error": f"{type(error).__name__}: {' '.join(str(error).split())}"}
    result |= {
        "seconds": time.perf_counter() - start,
        "threads": threads,
        "machine": platform.node(),
        "process": os.getpid(),
    }
    folder.write(job, result)


class CohortRunner:
    """Runs what is missing of a cohort.

    Parameters
    ----------
    runner : callable
        See `run_job`.
    jobs : list of CohortJob
    directory : path
    count : int, optional
        Jobs beside each other; all cores by default. Each gets cores / count threads.
    scheduler : str, optional
        Address of a Dask scheduler whose workers see all files; a job for each worker's thread.
    progress : callable, optional
        ``progress(done, total)``.
    """

    def __init__(
        self,
        runner: Callable[[CohortJob, Path], dict[str, Any]],
        jobs: list[CohortJob],
        directory: str | Path,
        *,
        count: int | None = None,
        scheduler: str | None = None,
        progress: Callable[[int, int], None] | None = None,
    ) -> None:
        self.runner, self.jobs, self.progress = runner, jobs, progress
        self.folder = CohortFolder(os.path.abspath(directory))
        self.count, self.scheduler = count or available_cores(), scheduler
        self.threads = 1 if scheduler else max(1, available_cores() // self.count)
        self.done = self.total = 0

    def run(self, *, retry: bool = False) -> int:
        """Run the jobs that are not done, and with ``retry`` those that failed before.

        Returns
        -------
        int
            How many were run.
        """
        self.folder.prepare()
        waiting = [job for job in self.jobs if not self._has_ended(job, retry)]
        for job in waiting:
            (self.folder.results / f"{job.name}.json").unlink(missing_ok=True)
        self.total = len(waiting)
        if self.scheduler:
            self._on_cluster(waiting)
        elif self.count == 1:
            for job in waiting:
                run_job(self.runner, job, self.folder, self.threads)
                self._advance()
        else:
            self._side_by_side(waiting)
        return self.total

    def _has_ended(self, job, retry):
        found = self.folder.read(job)
        if found is not None and found["status"] == "failed":
            return not retry
        return self.folder.is_done(job)

    def _side_by_side(self, jobs):
        """On some processes; one that dies takes its own job along, which then goes on in a process of its own."""
        while jobs:
            for job in jobs:
                self.folder.marker(job).unlink(missing_ok=True)
            if not self._in_pool(jobs, self.count):
                return
            jobs = [job for job in jobs if self.folder.read(job) is None]
            for job in [job for job in jobs if self.folder.marker(job).exists()]:
                if self._in_pool([job], 1):
                    self.folder.write(job, {"status": "failed", "error": DIED})
                    self._advance()
            jobs = [job for job in jobs if self.folder.read(job) is None]

    def _in_pool(self, jobs, count):
        """Run jobs on processes; True where one of these died."""
        with ProcessPoolExecutor(min(count, len(jobs)), mp_context=get_context("spawn")) as pool:
            try:
                calls = [pool.submit(run_job, self.runner, job, self.folder, self.threads) for job in jobs]
                for call in as_completed(calls):
                    call.result()
                    self._advance()
            except BrokenProcessPool:
                return True
            except BaseException:
                pool.shutdown(wait=False, cancel_futures=True)
                raise
        return False

    def _on_cluster(self, jobs):
        """A job whose worker dies goes on at another one; one that takes worker after worker along has failed."""
        if not jobs:
            return
        with connect_cluster(self.scheduler, 1) as client:
            from distributed import as_completed as as_they_come

            calls = {
                client.submit(run_job, self.runner, job, self.folder, self.threads, pure=False): job
                for job in jobs
            }
            for call in as_they_come(list(calls)):
                job = calls.pop(call)
                error = call.exception()
                if error is not None and self.folder.read(job) is None:
                    told = f"{type(error).__name__}: {' '.join(str(error).split())}"
                    self.folder.write(job, {"status": "failed", "error": told})
                self._advance()

    def _advance(self):
        self.done += 1
        if self.progress is not None:
            self.progress(self.done, self.total)
