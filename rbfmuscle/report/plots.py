"""Plots as SVG: lines along a motion, and points of error against time."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from rbfmuscle.geometry.arrays import Floats

if TYPE_CHECKING:
    from rbfmuscle.output.saved import SavedRun

_INK, _SOFT, _GRID, _LIMIT = "#26282b", "#5f646b", "#e8e6e0", "#a3281f"
_LEFT, _RIGHT, _TOP, _BOTTOM = 52, 12, 26, 36
# Width of a letter of a bold label, and height of a row of labels [pixel].
_LETTER, _ROW = 6.6, 15


class Track(NamedTuple):
    """A line of a plot: its name, colour, and places x and values y."""

    name: str
    colour: str
    x: Floats
    y: Floats


class Point(NamedTuple):
    """A point of error against time: a star where it is the default; its label is drawn where it has one."""

    x: float
    y: float
    label: str
    colour: str
    star: bool = False
    front: bool = False


class _Axes:
    """The frame of a plot, and where values lie in it."""

    def __init__(self, size: tuple[int, int], spans: Sequence[tuple[float, float]], *, log: bool) -> None:
        self.size, self.log = size, log
        self.spans = [_widened(*span, log) for span in spans]
        self.parts: list[str] = []

    def place(self, value: float, axis: int) -> float:
        low, high = self.spans[axis]
        share = (
            math.log(value / low) / math.log(high / low) if self.log else (value - low) / (high - low or 1.0)
        )
        wide, tall = self.size
        if axis == 0:
            return _LEFT + share * (wide - _LEFT - _RIGHT)
        return tall - _BOTTOM - share * (tall - _TOP - _BOTTOM)

    def text(
        self,
        x: float,
        y: float,
        words: str,
        *,
        anchor: str = "start",
        colour: str = _SOFT,
        bold: bool = False,
    ) -> None:
        """Add words at a place [pixel]."""
        from markupsafe import escape

        weight = ' font-weight="600"' if bold else ""
        self.parts.append(
            f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}" fill="{colour}" font-size="11.5"{weight}>'
            f"{escape(words)}</text>"
        )

    def line(
        self,
        x: Sequence[float] | Floats,
        y: Sequence[float] | Floats,
        colour: str,
        *,
        width: float = 1.8,
        more: str = "",
    ) -> None:
        """Add a line through values; it is broken where one is no number."""
        path, pen = [], "M"
        for a, b in zip(x, y):
            if math.isfinite(a) and math.isfinite(b):
                path.append(f"{pen}{self.place(a, 0):.1f} {self.place(b, 1):.1f}")
            pen = "L" if math.isfinite(b) else "M"
        self.parts.append(
            f'<path d="{"".join(path)}" fill="none" stroke="{colour}" stroke-width="{width}" '
            f'stroke-linejoin="round" {more}/>'
        )

    def frame(self, title: str, labels: tuple[str, str]) -> None:
        """Add the grid with its numbers, the title and the labels of the axes."""
        (left, right), (low, high) = self.spans
        wide, tall = self.size
        for value in _ticks(left, right, 6, self.log):
            x = self.place(value, 0)
            self.parts.append(f'<path d="M{x:.1f} {_TOP}V{tall - _BOTTOM}" stroke="{_GRID}"/>')
            self.text(x, tall - _BOTTOM + 14, f"{value:.4g}", anchor="middle")
        for value in _ticks(low, high, 5, self.log):
            y = self.place(value, 1)
            self.parts.append(f'<path d="M{_LEFT} {y:.1f}H{wide - _RIGHT}" stroke="{_GRID}"/>')
            self.text(_LEFT - 5, y + 4, f"{value:.4g}", anchor="end")
        self.text(6, 15, title, colour=_INK, bold=True)
        self.text(wide - _RIGHT, tall - 5, labels[0], anchor="end")
        self.text(wide - _RIGHT, 15, labels[1], anchor="end")

    def svg(self, title: str) -> str:
        from markupsafe import escape

        wide, tall = self.size
        return (
            f'<svg viewBox="0 0 {wide} {tall}" role="img"><title>{escape(title)}</title>'
            f"{''.join(self.parts)}</svg>"
        )


def line_plot(
    title: str,
    tracks: Sequence[Track],
    labels: tuple[str, str],
    *,
    limits: Sequence[float] = (),
    zero: bool = False,
    legend: bool = False,
) -> str:
    """Markup of a plot of lines.

    Parameters
    ----------
    title : str
    tracks : sequence of Track
        A line that bears a muscle's name is switched on and off with it.
    labels : (str, str)
        Of the axes.
    limits : sequence of float
        Drawn as dashed lines.
    zero : bool
        Whether the axis begins at zero.
    legend : bool
        Whether the lines' names stand below.
    """
    from markupsafe import escape

    values = np.concatenate([track.y[np.isfinite(track.y)] for track in tracks])
    places = np.concatenate([track.x for track in tracks])
    low, high = [*values, *limits], [*values, *limits]
    span = (0.0 if zero else float(min(low)), float(max(high)))
    axes = _Axes((420, 230), [(float(places.min()), float(places.max())), span], log=False)
    axes.spans[0] = (float(places.min()), float(places.max()) or 1.0)
    axes.frame(title, labels)
    for limit in limits:
        axes.line(axes.spans[0], (limit, limit), _LIMIT, width=1.0, more='stroke-dasharray="5 4"')
    for track in tracks:
        axes.parts.append(f'<g data-muscle="{escape(track.name)}"><title>{escape(track.name)}</title>')
        axes.line(track.x, track.y, track.colour)
        axes.parts.append("</g>")
    for k, track in enumerate(tracks if legend else ()):
        axes.size = (axes.size[0], 230 + 15 * (k + 1))
        axes.text(_LEFT, axes.size[1] - 4, f"— {track.name}", colour=track.colour, bold=True)
    return axes.svg(title)


def front_plot(points: Sequence[Point], labels: tuple[str, str], *, groups: Mapping[str, str] = {}) -> str:
    """Markup of error against time on logarithmic axes: the front joined, its points and the default labelled.

    Parameters
    ----------
    points : sequence of Point
    labels : (str, str)
        Of the axes.
    groups : dict of str to str
        What the colours stand for.
    """
    shown = [point for point in points if point.x > 0 and point.y > 0]
    if not shown:
        return ""
    spans = [(min(values), max(values)) for values in ([p.x for p in shown], [p.y for p in shown])]
    named = [point for point in shown if point.label and (point.star or point.front)]
    column = _LETTER * max((len(name) for name in [*groups, *(p.label for p in named)]), default=0)
    tall = max(370, _TOP + _BOTTOM + _ROW * (len(named) + len(groups)))
    axes = _Axes((500, tall), spans, log=True)
    axes.frame("", labels)
    for colour in dict.fromkeys(point.colour for point in shown):
        front = sorted(point for point in shown if point.front and point.colour == colour)
        axes.line([p.x for p in front], [p.y for p in front], colour, width=1.2)
    for point in shown:
        x, y = axes.place(point.x, 0), axes.place(point.y, 1)
        shape = _star(x, y) if point.star else f'<circle cx="{x:.1f}" cy="{y:.1f}" r="4.5"'
        faint = 1.0 if point.star or point.front else 0.4
        axes.parts.append(f'{shape} fill="{point.colour}" fill-opacity="{faint}"/>')
    left = axes.size[0] + 14
    for k, (name, colour) in enumerate(groups.items()):
        axes.text(left, _TOP + _ROW * k + 8, name, colour=colour, bold=True)
    _label_beside(axes, named, left, _TOP + _ROW * len(groups) + 8)
    axes.size = int(left + column + 4), tall
    return axes.svg(f"{labels[1]} against {labels[0]}")


def _label_beside(axes: _Axes, points: Sequence[Point], left: float, top: float) -> None:
    """Write labels below each other beside the plot, each joined to its point."""
    points = sorted(points, key=lambda point: axes.place(point.y, 1))
    lowest = axes.size[1] - _BOTTOM
    for k, point in enumerate(points):
        x, y = axes.place(point.x, 0), axes.place(point.y, 1)
        top = min(max(y, top), lowest - _ROW * (len(points) - 1 - k))
        axes.parts.append(
            f'<path d="M{x:.1f} {y:.1f}L{left - 3:.1f} {top:.1f}" stroke="{_SOFT}" stroke-width="0.6"/>'
        )
        axes.text(left, top + 4, point.label, colour=_INK, bold=point.star)
        top += _ROW


def _star(x: float, y: float) -> str:
    corners = [
        (x + r * math.sin(math.pi * k / 5), y - r * math.cos(math.pi * k / 5))
        for k, r in zip(range(10), (10, 4) * 5)
    ]
    return f'<polygon points="{" ".join(f"{a:.1f},{b:.1f}" for a, b in corners)}"'


def _widened(low: float, high: float, log: bool) -> tuple[float, float]:
    if log:
        share = max((high / low) ** 0.12, 1.15)
        return low / share, high * share
    room = 0.06 * (high - low) or 0.05 * abs(high) or 1.0
    return (low if low == 0.0 else low - room), high + room


def _ticks(low: float, high: float, count: int, log: bool) -> list[float]:
    """Round values between two, about so many."""
    if log:
        steps = (1, 2, 5) if high / low < 300 else (1,)
        powers = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
        found = [
            step * 10.0**power for power in powers for step in steps if low <= step * 10.0**power <= high
        ]
        if len(found) > 2:
            return found
    raw = (high - low) / count
    power = 10.0 ** math.floor(math.log10(raw)) if raw > 0 else 1.0
    step = next(s * power for s in (1, 2, 2.5, 5, 10) if s * power >= raw * 0.999)
    return [round(k * step, 12) for k in range(math.ceil(low / step), math.floor(high / step) + 1)]


def motion_axis(saved: SavedRun) -> tuple[dict[int, float], str]:
    """What plots run along.

    Returns
    -------
    values : dict of int to float
        Place of each frame on the axis.
    label : str
        The only coordinate that moves, in degrees, if it goes one way; else the frame number.
    """
    rows = saved.info["frames"]
    names = sorted({name for row in rows for name in row["coordinates"]})
    tracks = {name: np.array([row["coordinates"].get(name, 0.0) for row in rows]) for name in names}
    moving = {name: track for name, track in tracks.items() if np.ptp(track) > 1e-9}
    if len(moving) == 1:
        name, track = next(iter(moving.items()))
        unit = saved.info.get("scene", {}).get("coordinate_units", {}).get(name, "degree").strip() or "1"
        if np.all(np.diff(track) > 0) or np.all(np.diff(track) < 0):
            return dict(zip(saved.frames, track.tolist())), f"{name} [{unit}]"
    return {frame: float(frame) for frame in saved.frames}, "frame"


def arm_unit(saved: SavedRun, coordinate: str) -> str:
    """Unit of the moment arms about a coordinate of a saved run."""
    shift = saved.info.get("scene", {}).get("coordinate_units", {}).get(coordinate, "").strip()
    return "1" if shift else saved.units
