"""Rows of metrics in long form: what was measured of the muscles, frame by frame."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from rbfmuscle.sim.scene.motion import shown_value
from rbfmuscle.study.measure.metrics import Measured
from rbfmuscle.study.measure.quantities import ALL, FIBRES, QUANTITIES, Row, unit_text

if TYPE_CHECKING:
    from rbfmuscle.sim.loop.frame import Frame
    from rbfmuscle.sim.scene.scene import Scene


class MetricsRecorder:
    """Makes rows of measures, frame by frame; moment arms by differences need the frames on both sides.

    Parameters
    ----------
    scene : Scene
    """

    def __init__(self, scene: Scene) -> None:
        self.scene, self.units = scene, scene.units
        self.motion = scene.motion
        self._path: list[Any] = []
        self._waiting: list[Row] = []

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
            Rows of the frame before, which is complete once its successor is known (moment arms).
        """
        coordinate, angle = self._leading(frame)
        rows = []
        for name, found in measured.items():
            rows += [self._row(frame, coordinate, angle, name, q, v) for q, v in found.values.items()]
        if self.motion.times is not None:
            now = self.motion.times[frame.index]
            rows.append(self._row(frame, coordinate, angle, ALL, "time", now))
        rows.append(self._row(frame, coordinate, angle, ALL, "time_frame", frame.wall))
        lengths: dict[Any, Any] = {name: found.length for name, found in measured.items()}
        lengths.update({(FIBRES, name): lines.lengths for name, lines in frame.fibres.items()})
        nudged = {name: found.arms for name, found in measured.items()}
        self._path = [*self._path[-2:], (dict(frame.coordinates), lengths, frame.index, nudged)]
        done = self._waiting + (self._arms(len(self._path) - 2) if self._waiting else [])
        self._waiting = rows
        return done

    def state(self) -> dict[str, Any]:
        """What `go_on` needs behind the frame taken in last."""
        path = [(coordinates, list(lengths.items()), *rest) for coordinates, lengths, *rest in self._path]
        return {"path": path, "waiting": self._waiting}

    def go_on(self, state: Mapping[str, Any]) -> None:
        """Take over what another recorder knew."""
        self._path = [
            (coordinates, dict(lengths), index, {name: _rows(arms) for name, arms in nudged.items()})
            for coordinates, lengths, index, nudged in state["path"]
        ]
        self._waiting = _rows(state["waiting"])

    def finish(self) -> list[Row]:
        """Rows of the last frame."""
        done = self._waiting + (self._arms(len(self._path) - 1) if self._waiting else [])
        self._waiting = []
        return done

    def _arms(self, here):
        coordinates, lengths, index, nudged = self._path[here]
        unit = unit_text("length", self.units)
        rows = []
        for muscle, arms in nudged.items():
            rows += arms or []
            by_difference = [] if arms is not None else moment_arms([n[:2] for n in self._path], here, muscle)
            for name, arm in by_difference:
                angle = shown_value(self.scene, name, coordinates.get(name, 0.0))
                rows.append(Row(index, name, angle, muscle, "moment_arm", arm, unit))
            if (FIBRES, muscle) not in lengths:
                continue
            for name, each in moment_arms([node[:2] for node in self._path], here, (FIBRES, muscle)):
                angle = shown_value(self.scene, name, coordinates.get(name, 0.0))
                for quantity, value in (("mean", np.mean(each)), ("std", np.std(each))):
                    quantity = f"fibre_moment_arm_{quantity}"
                    rows.append(Row(index, name, angle, muscle, quantity, float(value), unit))
        return rows

    def _row(self, frame, coordinate, angle, muscle, quantity, value):
        unit = unit_text(QUANTITIES[quantity][0], self.units)
        return Row(frame.index, coordinate, angle, muscle, quantity, float(value), unit)

    def _leading(self, frame):
        """The coordinate that moved most to reach this frame, and its angle [degree]."""
        before = self._path[-1][0] if self._path else {}
        names = self.motion.coordinates or list(frame.coordinates)
        if not names:
            return "", 0.0
        moved = {n: abs(frame.coordinates.get(n, 0.0) - before.get(n, 0.0)) for n in names}
        name = max(names, key=moved.get) if self._path else names[0]
        return name, shown_value(self.scene, name, frame.coordinates.get(name, 0.0))


def _rows(plain):
    """Rows of what a checkpoint made of them; None stays."""
    return None if plain is None else [Row(*row) for row in plain]


def moment_arms(
    path: list[tuple[dict[str, Any], dict[Any, Any]]], here: int, muscle: str | tuple[str, str]
) -> list[Any]:
    """Tendon-excursion moment arms -dl/dq at one place of a path.

    Parameters
    ----------
    path : list of (coordinates, lengths)
        Neighbouring frames in order: angles [radian] by coordinate, lengths [scene unit] by muscle; a length
        may be an array, of fibres.
    here : int
        Place in the path.
    muscle : str

    Returns
    -------
    list of (coordinate, arm)
        [scene unit per radian]. Central where the coordinate goes on in one direction, else one-sided. Two
        frames between which several coordinates change cannot tell them apart and give none.
    """
    slopes = defaultdict(list)
    for k in (here - 1, here):
        if not 0 <= k < len(path) - 1:
            continue
        (q0, l0), (q1, l1) = path[k], path[k + 1]
        changed = [n for n in {*q0, *q1} if abs(q1.get(n, 0.0) - q0.get(n, 0.0)) > 1e-9]
        if len(changed) == 1 and np.isfinite(l0[muscle]).all() and np.isfinite(l1[muscle]).all():
            step = q1.get(changed[0], 0.0) - q0.get(changed[0], 0.0)
            slopes[changed[0]].append((step, (l1[muscle] - l0[muscle]) / step))
    return [(name, -_combine(found)) for name, found in slopes.items()]


def _combine(slopes):
    """Second-order derivative from the slopes on both sides; the earlier one alone at a turning point."""
    if len(slopes) == 1 or slopes[0][0] * slopes[1][0] < 0:
        return slopes[0][1]
    (a, left), (b, right) = slopes
    return (b * left + a * right) / (a + b)
