"""Plots: lines along a motion, and points of error against time."""

from collections.abc import Mapping, Sequence
from itertools import cycle
from typing import NamedTuple

import numpy as np

from rbfmuscle.display import svg
from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.run.appearance import MUSCLE_COLOURS
from rbfmuscle.run.data import RunData

_LIMIT = "#a3281f"
# Width and height of a plot of lines, what lies beside its axes, and height of a row of labels
# [point].
_WIDE, _TALL = 302.4, 165.6
_LEFT, _RIGHT = 36.0, 10.0
_TOP, _BOTTOM = 18.0, 30.0
_STILL = 1e-9  # coordinates that vary by less do not move [radian, or scene unit]
_ROW = 11.5
# Sides of the axes of a plot of points.
_FRONT = (331.0, 235.0)


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
    are ``bands``. Several lines have their names at their ends, beside the plot.

    ``labels`` are those of the axes, ``limits`` dashed lines; the axis begins at ``zero``; a
    ``legend`` stands below instead.
    """
    named = [] if legend or len(tracks) < 2 else tracks
    tall = max(_TALL, _TOP + _BOTTOM + _ROW * len(named))
    places = [*(track.x for track in tracks), *(band.x for band in bands)]
    values = [track.y for track in tracks]
    values += [edge for band in bands for edge in (band.low, band.high)]
    x = svg.axis_about(places, _LEFT, _WIDE - _RIGHT)
    known = [*values, np.array(limits, dtype=float)]
    y = svg.axis_about(known, tall - _BOTTOM, _TOP, margin=0.05)
    if zero:
        y = y._replace(low=0.0)
    parts = [svg.frame(x, y, labels)]
    parts.append(svg.text(title, _LEFT, _TOP - svg.LETTER, colour="black", bold=True))
    for limit in limits:
        ends = y.place([limit, limit])
        parts.append(svg.line([x.start, x.end], ends, _LIMIT, width=0.8, dashed=True))
    for band in bands:
        parts.append(_named(band.name, _band(band, x, y)))
    for track in tracks:
        parts.append(_named(track.name, svg.line(x.place(track.x), y.place(track.y), track.colour)))
    for k, track in enumerate(tracks if legend else ()):
        height = tall + _ROW * (k + 0.5)
        parts.append(svg.line([4.0, 16.0], [height, height], track.colour))
        parts.append(svg.text(track.name, 20.0, height, colour="black"))
    parts += _names_at_ends(named, x, y)
    letters = max((len(track.name) for track in named), default=0)
    beside = 14.0 + svg.WIDE * letters if named else 0.0
    return svg.picture(parts, (_WIDE + beside, tall + _ROW * len(tracks) * legend), title)


def _names_at_ends(tracks: Sequence[Track], x: svg.Axis, y: svg.Axis) -> list[str]:
    """The names of lines below each other beside the plot, each joined to the last known place of
    its line.
    """
    places = []
    for track in tracks:
        known = np.flatnonzero(np.isfinite(track.y))
        if len(known):
            last = known[np.argmax(track.x[known])]
            places.append((track, float(x.place(track.x[last])), float(y.place(track.y[last]))))
    top, parts = y.end, []
    for k, (track, at, height) in enumerate(sorted(places, key=lambda place: place[2])):
        top = min(max(height, top), y.start - _ROW * (len(places) - 1 - k))
        join = svg.line([at, x.end + _RIGHT], [height, top], track.colour, width=0.5)
        name = svg.text(track.name, x.end + _RIGHT + 2.0, top, colour=track.colour)
        parts.append(_named(track.name, join + name))
        top += _ROW
    return parts


def _named(name: str, markup: str) -> str:
    """Markup that is switched on and off with a muscle."""
    name = svg.escape(name)
    return f'<g data-muscle="{name}"><title>{name}</title>{markup}</g>\n'


def _band(band: Band, x: svg.Axis, y: svg.Axis) -> str:
    """A band as an area, or its edges dashed."""
    at, edges = x.place(band.x), (y.place(band.low), y.place(band.high))
    if not band.dashed:
        return svg.area(at, *edges, band.colour)
    return "".join(svg.line(at, edge, band.colour, width=0.8, dashed=True) for edge in edges)


def front_plot(points: Sequence[Point], labels: tuple[str, str]) -> str:
    """Markup of error against time on logarithmic axes: each group's front joined, it and the
    default labelled.
    """
    shown = [point for point in points if point.x > 0 and point.y > 0]
    if not shown:
        return ""
    colours = dict(zip(sorted({point.group for point in shown}), cycle(MUSCLE_COLOURS)))
    groups = colours if len(colours) > 1 else {}
    named = [point for point in shown if point.star or point.front]
    letters = max((len(text) for text in (*groups, *(point.label for point in named))), default=0)
    tall = max(_FRONT[1], _ROW * (len(named) + len(groups)))
    x = _logarithmic([point.x for point in shown], _LEFT + 8.0, _LEFT + 8.0 + _FRONT[0])
    y = _logarithmic([point.y for point in shown], _TOP + tall, _TOP)
    parts = [svg.frame(x, y, labels)]
    for group, colour in colours.items():
        front = sorted(point for point in shown if point.front and point.group == group)
        places = x.place([point.x for point in front]), y.place([point.y for point in front])
        parts.append(svg.line(*places, colour, width=1.0))
    for point in shown:
        place, opacity = _at(point, x, y), 1.0 if point.star or point.front else 0.4
        parts.append(svg.mark(*place, colours[point.group], star=point.star, opacity=opacity))
    parts += _labels_beside([(point, _at(point, x, y)) for point in named], groups, x.end, y)
    size = x.end + 14.0 + svg.WIDE * letters, _TOP + tall + _BOTTOM
    return svg.picture(parts, size, f"{labels[1]} against {labels[0]}")


def _logarithmic(values: Sequence[float], start: float, end: float) -> svg.Axis:
    """A logarithmic axis about values."""
    found = svg.axis_about([np.log10(values)], start, end, margin=0.05)
    return svg.Axis(10.0**found.low, 10.0**found.high, start, end, logarithmic=True)


def _at(point: Point, x: svg.Axis, y: svg.Axis) -> tuple[float, float]:
    return float(x.place(point.x)), float(y.place(point.y))


def _labels_beside(
    places: Sequence[tuple[Point, tuple[float, float]]],
    groups: Mapping[str, str],
    side: float,
    y: svg.Axis,
) -> list[str]:
    """Groups, then the points' labels, below each other beside the plot, each joined to its point
    at a place.
    """
    top, parts = y.end, []
    for name, colour in groups.items():
        parts.append(svg.text(name, side + 13.0, top, colour=colour, bold=True))
        top += _ROW
    for k, (point, (x, height)) in enumerate(sorted(places, key=lambda found: found[1][1])):
        top = min(max(height, top), y.start - _ROW * (len(places) - 1 - k))
        parts.append(svg.line([x, side + 11.0], [height, top], svg.SOFT, width=0.5))
        parts.append(svg.text(point.label, side + 13.0, top, colour="black", bold=point.star))
        top += _ROW
    return parts


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
