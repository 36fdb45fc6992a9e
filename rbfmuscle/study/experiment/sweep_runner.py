"""The points of a sweep side by side: references first, what is there left out, a dead process told."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import nullcontext
from multiprocessing import get_context
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rbfmuscle.study.experiment.sweep import SweepFolder
from rbfmuscle.study.experiment.sweep_points import finish_point, measure_point
from rbfmuscle.study.experiment.workers import available_cores, connect_cluster, delayed_calls

if TYPE_CHECKING:
    from rbfmuscle.sim.scene.scene import Scene
    from rbfmuscle.study.experiment.sweep import SweepPlan


class SweepRunner:
    """Measures what is missing of a sweep.

    Parameters
    ----------
    runner, scene, plan, directory
        See `measure_point` and `SweepPlan`.
    frames : str, optional
    jobs : int, optional
        Points beside each other; all cores by default. Each gets cores / jobs threads.
    scheduler : str, optional
        Address of a Dask scheduler whose workers see the folder too.
    progress : callable, optional
        ``progress(done, total)``.
    """

    def __init__(
        self,
        runner: Callable[..., Any],
        scene: Scene,
        plan: SweepPlan,
        directory: Path,
        *,
        frames: str | None = None,
        jobs: int | None = None,
        scheduler: str | None = None,
        progress: Callable[[int, int], None] | None = None,
    ) -> None:
        self.runner, self.scene, self.plan, self.frames = runner, scene, plan, frames
        self.folder = SweepFolder(os.path.abspath(directory))
        self.cores = available_cores()
        # The same threads for every point of a sweep, so that times compare. A Dask worker has one.
        self.jobs = 1 if scheduler else jobs or self.cores
        self.threads = 1 if scheduler else max(1, self.cores // self.jobs)
        self.scheduler, self.progress = scheduler, progress
        self.done = 0

    def run(self, *, part: tuple[int, int] | None = None, retry: bool = False) -> int:
        """Measure the references, then the points of a slice (all by default), leaving out what is there.

        Returns
        -------
        int
            How many points were measured.
        """
        self.folder.prepare(self.plan)
        wanted = self.plan.slice(part)
        if retry:
            self._forget_failed(self.plan.references + wanted)
        for point in self.plan.references:
            found = self.folder.read(point.key)
            if found and found["status"] == "done" and not self.folder.surface_file(point.key).exists():
                self.folder.forget(point.key)
        # The references first: who is done before they are there keeps its surfaces, and is compared later.
        points = self._missing(self.plan.references + wanted)
        self.total = len(points)
        self._measure(self._unmeasured(points))
        late = [p for p in points if self.folder.is_waiting(p.key)]
        if late:
            self._side_by_side(delayed_calls(finish_point, ((p, self.folder) for p in late)), advance=False)
        return self.total

    def _missing(self, points):
        return [point for point in points if self.folder.read(point.key) is None]

    def _unmeasured(self, points):
        return [point for point in self._missing(points) if not self.folder.is_waiting(point.key)]

    def _forget_failed(self, points):
        for point in points:
            found = self.folder.read(point.key)
            if found and found["status"] == "failed":
                self.folder.forget(point.key)

    def _measure(self, points):
        """All points of a stage; a process that dies takes only its own point along."""
        from joblib.externals.loky.process_executor import TerminatedWorkerError

        if not points:
            return
        options = {"frames": self.frames, "threads": self.threads, "jobs": self.jobs}
        calls = ((self.runner, self.scene, point, self.folder) for point in points)
        try:
            self._side_by_side(delayed_calls(measure_point, calls, **options))
        except TerminatedWorkerError:
            left = self._unmeasured(points)
            suspects = [p for p in left if (self.folder.points / f"{p.key}.running").exists()]
            for point in suspects or left:
                self._alone(point)
            self._measure(self._unmeasured(left))

    def _side_by_side(self, tasks, *, advance=True):
        from joblib import Parallel, parallel_config

        config = {"backend": "sequential"}
        if self.jobs > 1:
            config = {"backend": "loky", "inner_max_num_threads": self.threads}
        with self._cluster() as client:
            if client is not None:
                config = {"backend": "dask", "client": client}
            with parallel_config(**config):
                count = -1 if client else self.jobs
                for _ in Parallel(n_jobs=count, return_as="generator_unordered", batch_size=1)(tasks):
                    if advance:
                        self._advance()

    def _alone(self, point):
        """A point that was under way when a process died: in a process of its own, so that it shows which."""
        kept = {"frames": self.frames, "threads": self.threads, "jobs": 1}
        with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
            try:
                pool.submit(measure_point, self.runner, self.scene, point, self.folder, **kept).result()
            except BrokenProcessPool:
                error = "the process ended without a word (out of memory, or a crash)"
                self.folder.write(
                    {
                        "key": point.key,
                        "settings": point.settings,
                        "status": "failed",
                        "error": error,
                        "values": {},
                    }
                )
                (self.folder.points / f"{point.key}.running").unlink(missing_ok=True)
        self._advance()

    def _cluster(self):
        """Context of a connection to the scheduler, of None where there is none."""
        # With one thread in all, joblib would not send anything away.
        return connect_cluster(self.scheduler, 2) if self.scheduler else nullcontext()

    def _advance(self):
        self.done += 1
        if self.progress is not None:
            self.progress(self.done, self.total)
