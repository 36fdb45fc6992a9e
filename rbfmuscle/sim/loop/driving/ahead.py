"""A frame is solved while the one before is drawn."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping
from concurrent.futures import wait
from typing import TYPE_CHECKING

from rbfmuscle.sim.loop.frame import Frame
from rbfmuscle.sim.loop.stepper import TimedDrawing

if TYPE_CHECKING:
    from rbfmuscle.sim.loop.simulate import FrameLoop


def run_ahead(
    loop: FrameLoop, path: Iterable[Mapping[str, float]], written: Collection[int] | None = None
) -> Iterator[Frame]:
    """Drive a loop so that each frame is solved while the one before is drawn: no thread waits for another muscle.

    Models are then a frame ahead of what was yielded.

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
    frame, drawings = None, []
    for place, coordinates in enumerate(path):
        with loop.clocked(), loop.workers.one_thread_each():
            going = loop.start(coordinates)
            drawn = [done.result() for done in loop.workers.start(TimedDrawing.draw, drawings)]
            wait(going)
        if frame is not None:
            yield loop.finish(frame, drawn)
        frame, drawings = None, [done.result() for done in going]
        if written is None or place in written:
            frame = loop.collect()
        else:
            drawings = []
    if frame is not None:
        with loop.clocked(), loop.workers.one_thread_each():
            drawn = [done.result() for done in loop.workers.start(TimedDrawing.draw, drawings)]
        yield loop.finish(frame, drawn)
