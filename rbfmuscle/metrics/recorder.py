"""Rows of metrics in long form: what was measured of the muscles, frame by frame."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING

from rbfmuscle.metrics.metrics import Measured
from rbfmuscle.metrics.moment_arms import REACH, moment_arms
from rbfmuscle.metrics.quantities import ALL, QUANTITIES, Row, unit_text
from rbfmuscle.scene.joints.skeleton import all_coordinates
from rbfmuscle.scene.motion import shown_value
from rbfmuscle.scene.objects import MM_PER_UNIT

if TYPE_CHECKING:
    from rbfmuscle.scene.scene import Scene
    from rbfmuscle.simulation.frame import Frame


class MetricsRecorder:
    """Makes rows of measures, frame by frame, and of moment arms at the end.

    Parameters
    ----------
    scene : Scene
    """

    def __init__(self, scene: Scene) -> None:
        self.scene, self.units = scene, scene.units
        self.motion = scene.motion
        self._path: list[tuple[int, dict[str, float]]] = []
        self._lengths: dict[str, list[float]] = {}

    def add(self, frame: Frame, measured: Mapping[str, Measured]) -> list[Row]:
        """Take in what was measured in a frame.

        Parameters
        ----------
        frame : Frame
        measured : dict of str to Measured
            By muscle.

        Returns
        -------
        list of Row
            Of this frame.
        """
        coordinate, angle = self._leading(frame)
        rows = []
        for name, found in measured.items():
            rows += [self._row(frame, coordinate, angle, name, q, v) for q, v in found.values.items()]
        if self.motion.times is not None:
            now = self.motion.times[frame.index]
            rows.append(self._row(frame, coordinate, angle, ALL, "time", now))
        rows.append(self._row(frame, coordinate, angle, ALL, "time_frame", frame.wall))
        self._path.append((frame.index, dict(frame.coordinates)))
        for name, found in measured.items():
            self._lengths.setdefault(name, []).append(found.length)
        return rows

    def finish(self) -> list[Row]:
        """Rows of the moment arms of all frames, which follow from the lengths of all."""
        facts, rows = all_coordinates(self.scene.joints), []
        shifts = {name for name, fact in facts.items() if fact.motion == "translation"}
        path = [coordinates for _, coordinates in self._path]
        reach = {
            name: REACH / MM_PER_UNIT[self.units] if name in shifts else math.radians(REACH)
            for coordinates in path
            for name in coordinates
        }
        for muscle, lengths in self._lengths.items():
            for (index, coordinates), arms in zip(self._path, moment_arms(path, lengths, reach)):
                for name, arm in arms.items():
                    angle = shown_value(self.scene, name, coordinates.get(name, 0.0))
                    unit = "1" if name in shifts else self.units
                    rows.append(Row(index, name, angle, muscle, "moment_arm", arm, unit))
        return rows

    def _row(self, frame, coordinate, angle, muscle, quantity, value):
        unit = unit_text(QUANTITIES[quantity][0], self.units)
        return Row(frame.index, coordinate, angle, muscle, quantity, float(value), unit)

    def _leading(self, frame):
        """The coordinate that moved most to reach this frame, and its angle [degree]."""
        before = self._path[-1][1] if self._path else {}
        names = self.motion.coordinates or list(frame.coordinates)
        if not names:
            return "", 0.0
        moved = {n: abs(frame.coordinates.get(n, 0.0) - before.get(n, 0.0)) for n in names}
        name = max(names, key=moved.get) if self._path else names[0]
        return name, shown_value(self.scene, name, frame.coordinates.get(name, 0.0))
