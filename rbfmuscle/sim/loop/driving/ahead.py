"""Frames are solved while those before are drawn, and while whoever takes them measures and writes."""

from __future__ import annotations

import time
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future
from typing import TYPE_CHECKING

from rbfmuscle.sim.loop.frame import Frame
from rbfmuscle.sim.loop.stepper import TimedDrawing

if TYPE_CHECKING:
    from rbfmuscle.sim.loop.simulate import FrameLoop


def run_ahead(
    loop: FrameLoop, path: Iterable[Mapping[str, float]], written: Collection[int] | None = None
) -> Iterator[Frame]:
    """Drive a loop so that each frame is solved while the one before is drawn and taken: no thread waits for another
    muscle, nor for what is done with a frame.

    Models are on their way to the next frame when one is yielded.

    Parameters
    ----------
    loop : FrameLoop
        One that ``can_run_ahead``.
    path : iterable of dict
        Coordinates of the frames.
    written : collection of int, optional
        Places in the path of the frames to yield; all where not given.
    """
    loop.workers.widen(2 * len(loop.steppers))
    stops, going = list(path), None
    with loop.workers.one_thread_each():
        for place, here in enumerate(stops):
            with loop.clocked():
                drawings = (going or _UnderWay(loop.start(here))).wait()
                frame = loop.collect() if written is None or place in written else None
                # First in, first out: what is drawn comes before what is solved.
                drawing = [] if frame is None else loop.workers.start(TimedDrawing.draw, drawings)
                going = _UnderWay(loop.start(stops[place + 1])) if place + 1 < len(stops) else None
                drawn = [done.result() for done in drawing]
            if frame is not None:
                left = time.perf_counter()
                yield loop.finish(frame, drawn)
                if going is not None:
                    loop.count(going.busy_since(left))


class _UnderWay:
    """Muscles on their way to a frame."""

    def __init__(self, futures: Sequence[Future]) -> None:
        self.futures, self.ends = futures, []
        for future in futures:
            future.add_done_callback(lambda _: self.ends.append(time.perf_counter()))

    def wait(self) -> list[TimedDrawing]:
        """What draws them there, once all are there."""
        return [future.result() for future in self.futures]

    def busy_since(self, moment: float) -> float:
        """Seconds since a moment in which some were still under way."""
        there = all(future.done() for future in self.futures)
        return max(0.0, (max(self.ends, default=moment) if there else time.perf_counter()) - moment)
