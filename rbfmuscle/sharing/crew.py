"""A run's muscles on several processes, merged frame by frame.

Two threads of one interpreter share its lock and do 1.2 to 1.35 times the work of one, two processes 1.7 times
(docs/speed.md).
"""

from __future__ import annotations

import contextlib
import logging
import pickle
import queue
import threading
import warnings
from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import numba

from rbfmuscle.child import gone, how_it_ended, send, start_child
from rbfmuscle.progress import stage
from rbfmuscle.scene.scene import Scene
from rbfmuscle.sharing.share import Solved

# Frames that a helper may be ahead of what is written: memory is bounded, and nobody waits for the disk.
AHEAD = 1


class WorkerPool:
    """Several `MuscleGroup` in processes, with the frames of one of all muscles, to the last digit.

    Parameters
    ----------
    scene : Scene
    helpers : int
        At least two.

    Attributes
    ----------
    times : dict of str to float
        Wall time spent so far [s], of the helper that spent most: ``simulate``, ``metrics``.
    """

    def __init__(self, scene: Scene, helpers: int) -> None:
        self.scene = scene
        threads = max(1, numba.get_num_threads() // helpers)
        self._told: set[str] = set()
        self._helpers: list[_Worker] = []
        try:
            for names in _dealt([muscle.name for muscle in scene.muscles], helpers):
                self._helpers.append(_Worker((scene, names), threads))
        except BaseException:
            self.close()
            raise

    @property
    def times(self) -> dict[str, float]:
        """See the class."""
        every = [helper.clock.get("times", {}) for helper in self._helpers]
        return {part: max(times.get(part, 0.0) for times in every) for part in {p for t in every for p in t}}

    def built(self) -> None:
        """Wait until all muscles are built, or raise what went wrong."""
        for helper in self._helpers:
            self._next(helper)

    def frames(self) -> Iterator[Solved]:
        """See `MuscleGroup.frames`."""
        for helper in self._helpers:
            helper.begin()
        with stage("solving the first frame"):
            parts = [self._next(helper) for helper in self._helpers]
        while not any(part is None for part in parts):
            yield _joined(parts, [muscle.name for muscle in self.scene.muscles])
            parts.clear()  # a frame that is written need not be here any more
            parts = [self._next(helper) for helper in self._helpers]

    def close(self) -> None:
        """End the workers."""
        for helper in self._helpers:
            helper.close()

    def _next(self, helper):
        """The next frame of a worker; its warnings and log records are repeated here."""
        while True:
            kind, what = helper.take()
            if kind == "done":
                return what
            if kind == "failed":
                raise what
            if kind == "gone":
                raise gone(what)
            if str(what) in self._told:
                continue
            self._told.add(str(what))
            if kind == "warned":
                warnings.warn(what, stacklevel=3)
            else:
                logging.getLogger(what[0]).log(*what[1:])


class _Worker:
    """One process; a thread reads its messages."""

    def __init__(self, job: Any, threads: int) -> None:
        self.process = start_child("rbfmuscle.sharing.helper", threads)
        self._inbox: queue.Queue[tuple[str, Any]] = queue.Queue()
        # Taken before a message is read, so that no more of them than this wait here, each as large as a frame.
        self._room = threading.Semaphore(AHEAD)
        self.clock: dict[str, Any] = {}
        self._closed = False
        self._thread = threading.Thread(target=self._listen, args=(job,), daemon=True)
        self._thread.start()

    def begin(self) -> None:
        """Start the motion."""
        with contextlib.suppress(OSError):  # it is gone: the inbox says so
            send(self.process.stdin, "begin")

    def take(self) -> tuple[str, Any]:
        """Its next message: a kind, and what it is about."""
        found = self._inbox.get()
        self._room.release()
        return found

    def close(self) -> None:
        """End it."""
        self._closed = True
        self._room.release()
        self.process.kill()
        self.process.wait()
        self._thread.join()
        for pipe in (self.process.stdin, self.process.stdout):
            with contextlib.suppress(OSError):
                if pipe is not None:
                    pipe.close()

    def _listen(self, job):
        try:
            send(self.process.stdin, job)
            while self._room.acquire():
                if self._closed:
                    return
                kind, what, self.clock = pickle.load(self.process.stdout)
                self._inbox.put((kind, what))
                del what
        except (OSError, EOFError, pickle.UnpicklingError):
            self._inbox.put(("gone", how_it_ended(self.process)))
        except MemoryError as error:  # of a frame that does not fit here: nobody else would tell
            self._inbox.put(("failed", error))


def _dealt(names, hands):
    """Distribute muscles in turn: neighbours in a scene's list are often alike in size."""
    return [names[k::hands] for k in range(hands)]


def _joined(parts, order):
    """One frame of several, with all muscles in the scene's order."""

    def joined(dicts):
        found = {name: value for each in dicts for name, value in each.items()}
        return {name: found.pop(name) for name in order if name in found} | found

    first, frames = parts[0].frame, [part.frame for part in parts]
    by_muscle = ("surfaces", "carried", "times", "work", "tendons")
    frame = replace(
        first,
        events=[event for f in frames for event in f.events],
        wall=max(f.wall for f in frames),
        **{part: joined(getattr(f, part) for f in frames) for part in by_muscle},
    )
    return Solved(frame, joined(p.measured for p in parts))
