"""Plots as markup of SVG, by matplotlib: lines along a motion, and points of error against time."""

import io
import re
from collections.abc import Sequence
from itertools import cycle
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from markupsafe import escape
from scipy.optimize import isotonic_regression

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.run.appearance import MUSCLE_COLOURS
from rbfmuscle.run.data import RunData

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_LIMIT = "#a3281f"
# Width and height of the axes, what lies at their left, right, above and below, height of a row of
# names and width of a letter [point].
_LINES, _FRONT = (256.0, 118.0), (331.0, 235.0)
_LEFT, _RIGHT, _TOP, _BOTTOM = 46.0, 10.0, 20.0, 32.0
_ROW, _LETTER = 11.5, 5.4
_SOFT = "#5f646b"
_STYLE = {
    "font.sans-serif": ["DejaVu Sans"],
    "font.size": 8.5,
    "axes.edgecolor": "#b9b5ab",
    "axes.grid": True,
    "axes.spines.right": False,
    "axes.spines.top": False,
    "axes.axisbelow": True,
    "axes.titlesize": 8.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.labelcolor": _SOFT,
    "grid.color": "#e8e6e0",
    "lines.linewidth": 1.4,
    "xtick.labelcolor": _SOFT,
    "ytick.labelcolor": _SOFT,
    "svg.fonttype": "none",
    "svg.hashsalt": "rbfmuscle",  # the same plot has the same names of its parts
    "text.parse_math": False,
}
# A line from the left end of a label, so that it does not cross the letters.
_JOINED = {"arrowstyle": "-", "linewidth": 0.5, "relpos": (0.0, 0.5), "shrinkA": 1.0}
_STILL = 1e-9  # coordinates that vary by less do not move [radian, or scene unit]


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
    are ``bands``. The names of several stand beside the plot, joined to the ends of the lines.

    ``labels`` are those of the axes, ``limits`` dashed lines; the axis begins at ``zero``; a
    ``legend`` stands below instead.
    """
    from matplotlib import rc_context

    rows = _ROW * len(tracks)
    beside = 0.0 if legend or len(tracks) < 2 else _LETTER * max(len(t.name) for t in tracks) + 30.0
    with rc_context(_STYLE):
        figure, axes = _axes(_LINES[0], max(_LINES[1], rows), labels, beside, rows * legend)
        axes.set_title(title)
        for band in bands:
            if band.dashed:
                drawn = axes.plot(band.x, np.transpose([band.low, band.high]), "--", lw=0.8)
            else:
                drawn = [axes.fill_between(band.x, band.low, band.high, alpha=0.2, lw=0.0)]
            for part in drawn:
                part.set(color=band.colour, gid=f"muscle:{band.name}")
        lines = [axes.plot(t.x, t.y, color=t.colour, label=t.name)[0] for t in tracks]
        for line, track in zip(lines, tracks):
            line.set_gid(f"muscle:{track.name}")
        for limit in limits:
            axes.axhline(limit, color=_LIMIT, linestyle="--", linewidth=0.8)
        if zero:
            axes.set_ylim(bottom=0.0)
        if legend:
            figure.legend(handles=lines, loc="lower left", frameon=False, labelspacing=0.2)
        elif beside:
            _label_ends(axes, tracks, _ROW / max(_LINES[1], rows))
        return _markup(figure, title)


def _label_ends(axes: "Axes", tracks: Sequence[Track], row: float) -> None:
    """Name lines beside a plot, in the order of their last values and as near to these as leaves
    each name a ``row``, a share of the height, joined to the ends of the lines.
    """
    ends = []
    for track in tracks:
        known = np.flatnonzero(np.isfinite(track.y))
        if len(known):
            ends.append((track, float(track.x[known[-1]]), float(track.y[known[-1]])))
    ends.sort(key=lambda end: end[2])
    low, high = axes.get_ylim()
    # Places less those of as many rows below each other rise, as the places keep a row apart.
    rows = row * np.arange(len(ends))
    wanted = np.clip([(y - low) / (high - low) for _, _, y in ends], 0.0, 1.0)
    places = rows + isotonic_regression(wanted - rows).x if ends else rows
    places = np.clip(places, 0.5 * row + rows, 1.0 - 0.5 * row - rows[::-1])
    for (track, x, y), place in zip(ends, places):
        label = axes.annotate(
            track.name,
            (x, y),
            (1.04, place),
            textcoords="axes fraction",
            verticalalignment="center",
            color=track.colour,
            arrowprops={**_JOINED, "color": track.colour},
        )
        label.set_gid(f"muscle:{track.name}")


def front_plot(points: Sequence[Point], labels: tuple[str, str]) -> str:
    """Markup of error against time on logarithmic axes: each group's front joined, it and the
    default labelled.
    """
    from matplotlib import rc_context
    from matplotlib.ticker import LogLocator

    shown = [point for point in points if point.x > 0 and point.y > 0]
    if not shown:
        return ""
    colours = dict(zip(sorted({point.group for point in shown}), cycle(MUSCLE_COLOURS)))
    named = sorted((p for p in shown if p.star or p.front), key=lambda point: point.y)
    rows = _ROW * (len(named) + len(colours))
    beside = _LETTER * max(len(text) for text in (*colours, *(p.label for p in named))) + 30.0
    with rc_context(_STYLE):
        figure, axes = _axes(_FRONT[0], max(_FRONT[1], rows), labels, beside, 0.0)
        axes.loglog(subs=())
        for axis in (axes.xaxis, axes.yaxis):
            axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
            axis.set_major_formatter("{x:.4g}")
        for point in shown:
            style = {"marker": "*", "markersize": 12.0} if point.star else {"marker": "o"}
            alpha = 1.0 if point in named else 0.4
            axes.plot(point.x, point.y, color=colours[point.group], alpha=alpha, **style)
        for group, colour in colours.items():
            front = sorted(point for point in shown if point.front and point.group == group)
            axes.plot([p.x for p in front], [p.y for p in front], color=colour, label=group, lw=1.0)
        if len(colours) > 1:
            axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False)
        # Labels below each other beside the plot, each joined to its point.
        for row, point in enumerate(named):
            axes.annotate(
                point.label,
                (point.x, point.y),
                (1.04, (row + 0.5) / (len(named) + len(colours))),
                textcoords="axes fraction",
                verticalalignment="center",
                fontweight="bold" if point.star else "normal",
                arrowprops={**_JOINED, "color": _SOFT},
            )
        return _markup(figure, f"{labels[1]} against {labels[0]}")


def _axes(
    wide: float, tall: float, labels: tuple[str, str], beside: float, below: float
) -> "tuple[Figure, Axes]":
    """A figure and its axes of a size, with room ``beside`` and ``below`` [point]; the label of
    the vertical axis stands above, at its right end.
    """
    from matplotlib.figure import Figure

    size = np.array([_LEFT + wide + _RIGHT + beside, _TOP + tall + _BOTTOM + below])
    figure = Figure(figsize=tuple(size / 72.0))
    low = np.array([_LEFT, _BOTTOM + below]) / size
    axes = figure.add_axes((*low, *(np.array([wide, tall]) / size)))
    axes.set_xlabel(labels[0])
    axes.set_title(labels[1], loc="right", color=_SOFT, fontweight="normal")
    return figure, axes


def _markup(figure: "Figure", title: str) -> str:
    """Markup for a page, which names no address; its title is read out."""
    content = io.StringIO()
    nothing = dict.fromkeys(("Creator", "Date", "Format", "Type"))
    figure.savefig(content, format="svg", metadata=nothing)
    _, _, text = content.getvalue().partition("<svg ")
    text = re.sub(r'(xmlns(:\w+)?|version)="[^"]*"|<metadata>.*?</metadata>', "", text, flags=re.S)
    text = re.sub(
        r"""<g id=(["'])muscle:(.*?)\1>""", r"<g data-muscle=\1\2\1><title>\2</title>", text
    )
    return f'<svg role="img" aria-label="{escape(title)}" {text}'


def motion_axis(saved: RunData) -> tuple[dict[int, float], str]:
    """Place of each frame on plots and their label: the only coordinate that moves, if one way, or
    frame numbers.
    """
    rows = saved.info.frames
    units = saved.info.scene.coordinate_units
    names = sorted({name for row in rows for name in row.coordinates})
    tracks = {name: np.array([row.coordinates.get(name, 0.0) for row in rows]) for name in names}
    moving = {name: track for name, track in tracks.items() if np.ptp(track) > _STILL}
    if len(moving) == 1:
        name, track = next(iter(moving.items()))
        unit = units.get(name, "degree").strip() or "1"
        if np.all(np.diff(track) > 0) or np.all(np.diff(track) < 0):
            return dict(zip(saved.frame_numbers, track.tolist())), f"{name} [{unit}]"
    return {frame: float(frame) for frame in saved.frame_numbers}, "frame"


def arm_unit(saved: RunData, coordinate: str) -> str:
    """Unit of the moment arms about a coordinate of a saved run."""
    return "1" if saved.info.scene.coordinate_units.get(coordinate, "").strip() else saved.units
