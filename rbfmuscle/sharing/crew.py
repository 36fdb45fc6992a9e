"""A run's muscles on several processes, merged frame by frame.

Two threads of one interpreter share its lock and do 1.2 to 1.35 times the work of one, two
processes 1.7 times (docs/speed.md).
"""

import contextlib
import logging
import pickle
import subprocess
import threading
import warnings
from collections.abc import Iterator
from dataclasses import replace

import numba

from rbfmuscle.child import end_child, start_child, unexpected_end
from rbfmuscle.progress import stage
from rbfmuscle.scene.scene import Scene
from rbfmuscle.sharing.share import Solved

# A process more takes about two seconds to begin: fewer muscles, or fewer muscles times frames, are
# quicker in one.
LEAST_MUSCLES, LEAST_WORK = 5, 400
MOST_HELPERS = 4


def helpers_for(scene: Scene, threads: int) -> int:
    """How many processes should share the muscles of a run that may use ``threads``; fewer than
    two: one's own alone.

    Muscles that slide on each other see each other at every sub-step, those that contract share all
    sub-steps: they stay together.
    """
    count, contracts = len(scene.muscles), any(m.contraction is not None for m in scene.muscles)
    if scene.sliding is not None or contracts or count * len(scene.motion.frames) < LEAST_WORK:
        return 0
    return min(threads, count // LEAST_MUSCLES, MOST_HELPERS)


class WorkerPool:
    """Several `MuscleGroup` in two or more processes; the frames are those of one process, to the
    last digit.

    A process continues while its last frame is taken, and waits with the next one until it is asked
    for: memory is bounded by the pipes. ``times`` are wall times so far [s], of the helper that
    spent most.
    """

    def __init__(self, scene: Scene, helpers: int) -> None:
        self.scene = scene
        self.times: dict[str, float] = {}
        self._repeated: set[str] = set()
        self._processes: list[subprocess.Popen[bytes]] = []
        threads = max(1, numba.get_num_threads() // helpers)
        names = [muscle.name for muscle in scene.muscles]
        for k in range(helpers):
            # In turn: neighbours in a scene's list are often alike in size. Pickled here, not in
            # the thread: what a scene computes on demand would change it while another thread
            # pickles it.
            job = pickle.dumps((scene, names[k::helpers]), protocol=pickle.HIGHEST_PROTOCOL)
            process = start_child("rbfmuscle.sharing.helper", threads)
            self._processes.append(process)
            threading.Thread(target=_deliver, args=(process, job), daemon=True).start()

    def wait_until_built(self) -> None:
        """Wait until all muscles are built, or raise what went wrong."""
        for process in self._processes:
            self._next(process)

    def frames(self) -> Iterator[Solved]:
        """See `MuscleGroup.frames`."""
        names = [muscle.name for muscle in self.scene.muscles]
        with stage("solving the first frame"):
            parts = [self._next(process) for process in self._processes]
        while not any(part is None for part in parts):
            yield _joined(parts, names)
            parts.clear()  # a frame that is written need not be here any more
            parts = [self._next(process) for process in self._processes]

    def close(self) -> None:
        """End the processes."""
        for process in self._processes:
            end_child(process)

    def _next(self, process: subprocess.Popen[bytes]) -> Solved | None:
        """The next frame of a process; its warnings and log records are repeated here."""
        assert process.stdout is not None  # start_child asks for a pipe
        while True:
            try:
                kind, what = pickle.load(process.stdout)
            except (OSError, EOFError, pickle.UnpicklingError):
                raise unexpected_end(process) from None
            if kind == "failed":
                raise what
            if kind == "done":
                solved, times = what
                self.times |= {
                    part: max(spent, self.times.get(part, 0.0)) for part, spent in times.items()
                }
                return solved
            if str(what) in self._repeated:
                continue
            self._repeated.add(str(what))
            if kind == "warned":
                warnings.warn(what, stacklevel=3)
            else:
                logging.getLogger(what[0]).log(*what[1:])


def _deliver(process, job):
    """Send a process its pickled job, which it reads when it has started."""
    with contextlib.suppress(OSError, ValueError):  # it has ended: so does what it answers
        process.stdin.write(job)
        process.stdin.flush()


def _joined(parts, order):
    """One frame of several, with all muscles in the scene's order."""

    def joined(dicts):
        found = {name: value for each in dicts for name, value in each.items()}
        return {name: found.pop(name) for name in order if name in found} | found

    first, frames = parts[0].frame, [part.frame for part in parts]
    by_muscle = ("surfaces", "carried", "times", "work", "tendons", "poses")
    frame = replace(
        first,
        events=[event for f in frames for event in f.events],
        wall=max(f.wall for f in frames),
        **{part: joined(getattr(f, part) for f in frames) for part in by_muscle},
    )
    return Solved(frame, joined(p.measured for p in parts))
