"""Where the frames of a run go: into memory, or into a folder."""

from collections.abc import Sequence
from typing import Any, Protocol

from rbfmuscle.metrics.quantities import Row
from rbfmuscle.simulation.frame import Frame


class Sink(Protocol):
    """What takes the frames of a run, one by one, as they come.

    Every frame comes once, in the order of the motion; whatever ends the run, the sink is closed.
    """

    def write(self, frame: Frame, rows: Sequence[Row] = ()) -> None:
        """Take a frame, and the rows of metrics that are complete by now: those of the frame before."""

    def close(self, rows: Sequence[Row] = ()) -> None:
        """Take the last rows; nothing follows but `write_info`."""

    def write_info(self, info: dict[str, Any]) -> None:
        """Take the facts of ``run.json``: before the first frame, and again after the last."""


class MemorySink:
    """Keeps every frame, and can hand them on to another sink.

    Attributes
    ----------
    frames : list of Frame
    rows : list of Row
        Metrics of all frames.
    """

    def __init__(self) -> None:
        self.frames: list[Frame] = []
        self.rows: list[Row] = []

    def write(self, frame: Frame, rows: Sequence[Row] = ()) -> None:
        """Keep a frame, and the rows of metrics that are complete by now."""
        self.frames.append(frame)
        self.rows.extend(rows)

    def close(self, rows: Sequence[Row] = ()) -> None:
        """Keep the last rows."""
        self.rows.extend(rows)

    def write_info(self, info: dict[str, Any]) -> None:
        """Nothing: the facts are the run's own."""

    def replay(self, sink: Sink) -> None:
        """Give another sink what came here."""
        for frame in self.frames:
            sink.write(frame)
        sink.close(self.rows)
