"""Plots as SVG: lines along a motion, and points of error against time."""

import io
import re
from collections.abc import Sequence
from itertools import cycle
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.output.appearance import MUSCLE_COLOURS
from rbfmuscle.output.run_data import RunData

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


_SOFT, _LIMIT = "#5f646b", "#a3281f"
_STYLE = {
    "svg.fonttype": "none",
    "svg.hashsalt": "rbfmuscle",
    "font.size": 8.5,
    "axes.titlesize": 9,
    "axes.titleweight": "bold",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": "#b9b5ab",
    "axes.labelcolor": _SOFT,
    "xtick.color": _SOFT,
    "ytick.color": _SOFT,
    "axes.grid": True,
    "grid.color": "#e8e6e0",
    "axes.axisbelow": True,
    "lines.linewidth": 1.4,
    "legend.frameon": False,
    "text.parse_math": False,
}
# Height of a row of labels, and width of a letter [inch].
_ROW, _LETTER = 0.16, 0.075


class Track(NamedTuple):
    """A line of a plot: its name, colour, and places x and values y."""

    name: str
    colour: str
    x: Floats
    y: Floats


class Band(NamedTuple):
    """An area of a plot between y ``low`` and ``high`` at places x: shaded, or its edges dashed."""

    name: str
    colour: str
    x: Floats
    low: Floats
    high: Floats
    dashed: bool = False


class Point(NamedTuple):
    """A point of error against time: a star where it is the default; its label is drawn there and
    on the front.
    """

    x: float
    y: float
    label: str
    group: str
    star: bool = False
    front: bool = False


def line_plot(
    title: str,
    tracks: Sequence[Track],
    labels: tuple[str, str],
    *,
    bands: Sequence[Band] = (),
    limits: Sequence[float] = (),
    zero: bool = False,
    legend: bool = False,
) -> str:
    """Markup of a plot of lines; one that bears a muscle's name is switched on and off with it, as
    are ``bands``.

    ``labels`` are those of the axes, ``limits`` dashed lines; the axis begins at ``zero``; a
    ``legend`` stands below.
    """
    from matplotlib import style
    from matplotlib.figure import Figure

    tall = 2.3 + _ROW * len(tracks) * legend
    with style.context(["default", _STYLE]):
        figure = Figure((4.2, tall))
        axes = figure.add_axes((0.12, 1.0 - 1.9 / tall, 0.86, 1.65 / tall), xlabel=labels[0])
        axes.set_title(title, loc="left")
        axes.set_title(labels[1], loc="right", color=_SOFT, weight="normal")
        for limit in limits:
            axes.axhline(limit, color=_LIMIT, linestyle="--", linewidth=0.8)
        for track in tracks:
            axes.plot(
                track.x, track.y, color=track.colour, label=track.name, gid=f"muscle:{track.name}"
            )
        for band in bands:
            _draw_band(axes, band)
        axes.margins(x=0.0)
        axes.set_ylim(bottom=0.0 if zero else None)
        if legend:
            figure.legend(loc="lower left", handlelength=1.0, labelspacing=0.2)
        return _svg(figure, title)


def _draw_band(axes: "Axes", band: Band) -> None:
    name = f"muscle:{band.name}"
    if not band.dashed:
        area = axes.fill_between(band.x, band.low, band.high, alpha=0.2, linewidth=0.0, gid=name)
        area.set_color(band.colour)
        return
    for edge in (band.low, band.high):
        axes.plot(band.x, edge, color=band.colour, linestyle="--", linewidth=0.8, gid=name)


def front_plot(points: Sequence[Point], labels: tuple[str, str]) -> str:
    """Markup of error against time on logarithmic axes: each group's front joined, it and the
    default labelled.
    """
    from matplotlib import style
    from matplotlib.figure import Figure
    from matplotlib.ticker import LogLocator, MaxNLocator, NullLocator

    shown = [point for point in points if point.x > 0 and point.y > 0]
    if not shown:
        return ""
    colours = dict(zip(sorted({point.group for point in shown}), cycle(MUSCLE_COLOURS)))
    groups = colours if len(colours) > 1 else {}
    named = [point for point in shown if point.star or point.front]
    letters = max((len(text) for text in (*groups, *(point.label for point in named))), default=0)
    wide, tall = 5.4 + _LETTER * letters, max(3.8, 0.6 + _ROW * (len(named) + len(groups)))
    with style.context(["default", _STYLE]):
        figure = Figure((wide, tall))
        place = (0.6 / wide, 0.45 / tall, 4.6 / wide, 1.0 - 0.55 / tall)
        axes = figure.add_axes(
            place, xscale="log", yscale="log", xlabel=labels[0], ylabel=labels[1]
        )
        for group, colour in colours.items():
            front = sorted(point for point in shown if point.front and point.group == group)
            axes.plot(
                [point.x for point in front],
                [point.y for point in front],
                color=colour,
                linewidth=1.0,
            )
        for point in shown:
            marker, size = ("*", 13.0) if point.star else ("o", 6.0)
            shade = colours[point.group] + ("" if point.star or point.front else "66")
            axes.plot(point.x, point.y, marker, color=shade, markersize=size, markeredgewidth=0.0)
        for axis, (low, high) in ((axes.xaxis, axes.get_xlim()), (axes.yaxis, axes.get_ylim())):
            axis.set_major_locator(
                MaxNLocator(5) if high < 10.0 * low else LogLocator(subs=(1, 2, 5))
            )
            axis.set_minor_locator(NullLocator())
            axis.set_major_formatter("{x:.4g}")
        _label_beside(axes, named, groups, _ROW / (tall - 0.55))
        return _svg(figure, f"{labels[1]} against {labels[0]}")


def _label_beside(axes, points, groups, row):
    """Write groups, then the points' labels, below each other beside the plot, each joined to its
    point.
    """
    top, whole = 1.0, axes.transAxes
    for name, colour in groups.items():
        axes.text(1.04, top, name, color=colour, weight="bold", transform=whole, va="center")
        top -= row
    line = {"arrowstyle": "-", "linewidth": 0.5, "color": _SOFT, "shrinkA": 0.0, "shrinkB": 0.0}
    for k, point in enumerate(sorted(points, key=lambda point: -point.y)):
        height = whole.inverted().transform(axes.transData.transform((point.x, point.y)))[1]
        top = max(min(height, top), row * (len(points) - 1 - k))
        weight = "bold" if point.star else "normal"
        place = (point.x, point.y), (1.04, top), "data", whole
        axes.annotate(point.label, *place, arrowprops=line, va="center", weight=weight)
        top -= row


def _svg(figure: "Figure", title: str) -> str:
    """Markup of a figure, without what only a file of its own needs; lines of muscles bear their
    names.
    """
    from markupsafe import escape

    file = io.BytesIO()
    figure.savefig(
        file, format="svg", metadata=dict.fromkeys(("Date", "Creator", "Format", "Type"))
    )
    text = file.getvalue().decode()
    text = re.sub(r' xmlns(:\w+)?="[^"]*"', "", text[text.index("<svg") :])
    text = re.sub(r'<g id="muscle:([^"]*)">', r'<g data-muscle="\1"><title>\1</title>', text)
    text = re.sub(r'<g id="[^"]*">', "<g>", text)
    return text.replace("<svg", f'<svg role="img" aria-label="{escape(title)}"', 1)


def motion_axis(saved: RunData) -> tuple[dict[int, float], str]:
    """Place of each frame on plots and their label: the only coordinate that moves, if one way, or
    frame numbers.
    """
    rows = saved.info.frames
    units = saved.info.scene.coordinate_units
    names = sorted({name for row in rows for name in row.coordinates})
    tracks = {name: np.array([row.coordinates.get(name, 0.0) for row in rows]) for name in names}
    moving = {name: track for name, track in tracks.items() if np.ptp(track) > 1e-9}
    if len(moving) == 1:
        name, track = next(iter(moving.items()))
        unit = units.get(name, "degree").strip() or "1"
        if np.all(np.diff(track) > 0) or np.all(np.diff(track) < 0):
            return dict(zip(saved.frame_numbers, track.tolist())), f"{name} [{unit}]"
    return {frame: float(frame) for frame in saved.frame_numbers}, "frame"


def arm_unit(saved: RunData, coordinate: str) -> str:
    """Unit of the moment arms about a coordinate of a saved run."""
    return "1" if saved.info.scene.coordinate_units.get(coordinate, "").strip() else saved.units
