"""Plots of several models over the same motion."""

from __future__ import annotations

import io
from typing import TYPE_CHECKING

import numpy as np

from rbfmuscle.metrics.quantities import ALL
from rbfmuscle.report.appearance import line_colours
from rbfmuscle.report.plots import PLOT_STYLE, arm_unit, motion_axis, wrapped

if TYPE_CHECKING:
    from rbfmuscle.output.saved import SavedRun


# Title, quantity, factor, unit (None: the scene's); worst over muscles in each frame.
_WORST = (
    ("Volume error, worst muscle", "volume_error", 100.0, "%"),
    ("Surface inside a bone, worst muscle", "penetration_max", 1.0, None),
    ("Bone inside a muscle, worst muscle", "bone_penetration_max", 1.0, None),
)


def plot_models(runs: dict[str, SavedRun]) -> list[tuple[str, bytes]]:
    """Draw every plot that the runs have values for, a line a model.

    Parameters
    ----------
    runs : dict of str to SavedRun
        Model -> its run, all through the same motion.

    Returns
    -------
    list of (title, bytes)
        SVG pictures.
    """
    import matplotlib

    first = next(iter(runs.values()))
    axis, label = motion_axis(first)
    pictures = []
    with matplotlib.rc_context(PLOT_STYLE):
        time = {name: run.series(ALL, "time_frame") for name, run in runs.items()}
        tracks = {name: (frames[1:], 1000 * values[1:]) for name, (frames, values) in time.items()}
        pictures.append(_plot("Time a frame, all muscles", tracks, axis, label, "ms", zero=True))
        for title, quantity, factor, unit in _WORST:
            tracks = {name: _worst(run, quantity, factor) for name, run in runs.items()}
            pictures.append(_plot(title, tracks, axis, label, unit or first.units))
        for muscle in first.muscles:
            tracks = {name: run.series(muscle, "length") for name, run in runs.items()}
            pictures.append(_plot(f"Length: {muscle}", tracks, axis, label, first.units))
        for muscle in first.muscles:
            for about in first.arm_coordinates(muscle):
                tracks = {name: run.series(muscle, "moment_arm", about) for name, run in runs.items()}
                title = f"Moment arm: {muscle}, {about}"
                pictures.append(_plot(title, tracks, axis, label, arm_unit(first, about)))
    return [picture for picture in pictures if picture is not None]


def _worst(run, quantity, factor):
    """Frames, and of each frame the value of greatest magnitude among the muscles."""
    series = [run.series(muscle, quantity) for muscle in run.muscles]
    series = [(frames, values) for frames, values in series if len(frames)]
    if not series:
        return np.zeros(0, dtype=int), np.zeros(0)
    values = np.array([values for _, values in series])
    row = np.argmax(np.abs(values), axis=0)
    return series[0][0], factor * values[row, np.arange(values.shape[1])]


def _plot(title, tracks, axis, label, unit, *, zero=False):
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    if not any(len(frames) for frames, _ in tracks.values()):
        return None
    figure = Figure(figsize=(4.6, 2.7), layout="constrained")
    FigureCanvasSVG(figure)
    axes = figure.add_subplot()
    for name, colour in line_colours(tracks).items():
        frames, values = tracks[name]
        axes.plot([axis[frame] for frame in frames], values, color=colour, lw=1.5, marker="o", ms=2.0)
    if zero:
        axes.set_ylim(bottom=0.0)
    axes.set(title=wrapped(title), xlabel=label, ylabel=unit)
    out = io.BytesIO()
    figure.savefig(out, format="svg", metadata={"Date": None})
    return title, out.getvalue()
