"""Activation of the muscles along a motion, and the sub-steps that it asks for."""

from __future__ import annotations

import difflib
import itertools
import math
from pathlib import Path
from typing import Any

import numpy as np

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.scene.motion import interpolate
from rbfmuscle.scene.motion_file import storage_parts
from rbfmuscle.scene.objects import Motion, Muscle, SceneData
from rbfmuscle.validation import SceneError

# No activation changes by more in one sub-step; smaller steps change the shapes that are reached by less than
# 0.1 mm (tests/contract/test_contraction.py).
STEP = 0.1
# Further solves after activation has changed while no bone moved.
SETTLING = 4


def activation_curve(muscle: Muscle, motion: Motion) -> Floats:
    """Activation of one muscle in each frame.

    Parameters
    ----------
    muscle : rbfmuscle.scene.objects.Muscle
        With the keys of contraction.
    motion : rbfmuscle.scene.motion.Motion
        Its times tell the rows of a file of controls; without times these are spread over the motion.

    Returns
    -------
    (n,) ndarray
        0 to 1.

    Raises
    ------
    SceneError
        If its file cannot be used.
    """
    progress = np.asarray(motion.progress, dtype=float)
    given = 0.0 if muscle.contraction is None else muscle.contraction.activation
    if isinstance(given, (int, float)):
        return np.full(len(progress), float(given))
    if isinstance(given, list):
        if len(given) == 1:
            return np.full(len(progress), float(given[0]))
        return np.interp(progress, np.linspace(0.0, 1.0, len(given)), given)
    times, values = read_controls(Path(given.file), given.column or muscle.name, muscle=muscle.name)
    when = times[0] + progress * (times[-1] - times[0]) if motion.times is None else motion.times
    return np.interp(when, times, values)


def read_controls(path: Path, column: str, *, muscle: str) -> Any:
    """Times and activations of one column of an OpenSim storage file (.sto).

    Parameters
    ----------
    path : pathlib.Path
    column : str
        The column's name, or the muscle's in ``/forceset/NAME/activation`` or ``NAME.activation``.
    muscle : str
        For messages.

    Returns
    -------
    times, values : (n,) ndarray
        [s], 0 to 1.

    Raises
    ------
    SceneError
        If the file or the column cannot be used.
    """
    _, labels, rows = storage_parts(path, place=f"muscle {muscle!r} activation")
    place = f"muscle {muscle!r} activation: {path}"
    index = _column(labels, column, place)
    if any(len(row) != len(labels) for row in rows):
        raise SceneError(f"{place}: rows need {len(labels)} values each, as the header names")
    try:
        table = np.array([[float(word) for word in row] for row in rows])
    except ValueError as error:
        raise SceneError(f"{place}: {error}") from None
    values = table[:, index]
    bad = np.flatnonzero(~((values >= 0.0) & (values <= 1.0)))
    if len(bad):
        raise SceneError(
            f"{place} row {bad[0] + 1}: {labels[index]} is {values[bad[0]]:g}, activation lies from 0 to 1"
        )
    times = table[:, 0]
    if not np.all(np.diff(times) > 0.0):
        raise SceneError(f"{place}: the first column must be a time that increases")
    return times, values


def _column(labels, wanted, place):
    for number, label in enumerate(labels[1:], start=1):
        parts = label.replace(".", "/").strip("/").split("/")
        if label == wanted or (parts[-1] in ("activation", "excitation") and parts[-2:-1] == [wanted]):
            return number
    near = difflib.get_close_matches(wanted, labels[1:], n=1, cutoff=0.5)
    hint = (
        f"did you mean {near[0]!r}?"
        if near
        else f"it has {', '.join(labels[1:6])}" + ", ..." * (len(labels) > 6)
    )
    raise SceneError(f"{place} has no column {wanted!r}, {hint}; give activation.column")


class Activations:
    """What the frame loop asks about activation: sub-steps, and the activations at the end of each.

    Parameters
    ----------
    scene : Scene
        Its muscles without keys of contraction are left out; where there are no others, nothing is done.

    Attributes
    ----------
    here : dict of str to float
        By muscle, now: 0 before the first frame.
    target : dict of str to float
        Set by hand, as a window does; goes before the scene's own courses.
    """

    def __init__(self, scene: SceneData) -> None:
        self.courses = {
            muscle.name: activation_curve(muscle, scene.motion)
            for muscle in scene.muscles
            if muscle.contraction is not None
        }
        self.here = dict.fromkeys(self.courses, 0.0)
        self.target = {}

    def at(self, frame: int) -> Any:
        """Activation of each muscle that contracts in a frame, by its place in the motion."""
        return {
            name: self.target.get(name, float(course[min(frame, len(course) - 1)]))
            for name, course in self.courses.items()
        }

    def refine(self, frame: int, stops: list[Any]) -> Any:
        """Sub-steps short enough in activation too.

        Parameters
        ----------
        frame : int
        stops : list of dict
            Coordinates: where the bones are, then the ends of the sub-steps that they ask for.

        Returns
        -------
        stops : list of dict
            The same with further ones between them.
        activations : list of dict
            For each stop but the first: activation by muscle.
        """
        if not self.courses:
            return stops, []
        goal, start = self.at(frame), dict(self.here)
        most = max(abs(goal[name] - start[name]) for name in goal)
        wanted = math.ceil(most / STEP - 1e-9)
        steps = len(stops) - 1
        if steps == 0 and wanted == 0:
            return stops, []
        each = max(1, math.ceil(wanted / steps)) if steps else wanted
        pairs = list(itertools.pairwise(stops)) or [(stops[0], stops[0])]
        fine = [stops[0]]
        for before, after in pairs:
            fine += [interpolate(before, after, k / each) for k in range(1, each)] + [after]
        count = len(fine) - 1
        self.here = goal
        values = [
            {name: start[name] + (goal[name] - start[name]) * (k / count) for name in goal}
            for k in range(1, count + 1)
        ]
        if steps == 0:
            # Bones that stand still leave the muscles nothing else to settle in.
            fine, values = fine + [stops[0]] * SETTLING, values + [goal] * SETTLING
        return fine, values
