"""Plots as SVG: axes with their ticks, and what is drawn on them."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from markupsafe import escape
from numpy.typing import ArrayLike

from rbfmuscle.geometry.arrays import Floats

# Height of letters, and width of one at most [point].
LETTER, WIDE = 8.5, 5.4
SOFT = "#5f646b"
_SPINE, _GRID = "#b9b5ab", "#e8e6e0"
_TICK = 3.5  # length of a tick [point]
# Space that a tick with its number takes [point], to the right and upwards.
_ROOM = (42.0, 16.0)
# Decades, or a share of one, that a logarithmic axis spans before its ticks are 1, 2 and 5.
_PLAIN = 1e6  # numbers from here on have a power of ten
_DECADE = 10.0


class Axis(NamedTuple):
    """An axis of a plot: the values at its ends, where these are [point], and whether it is
    logarithmic.
    """

    low: float
    high: float
    start: float
    end: float
    logarithmic: bool = False

    def place(self, values: ArrayLike) -> Floats:
        """Places [point] of values."""
        ends = np.array([self.low, self.high])
        found = np.asarray(values, dtype=float)
        if self.logarithmic:
            ends, found = np.log10(ends), np.log10(found)
        return self.start + (found - ends[0]) * ((self.end - self.start) / (ends[1] - ends[0]))

    def ticks(self, room: float) -> list[tuple[float, str]]:
        """Values of the ticks, each with its text, about ``room`` apart or farther [point]."""
        most = max(int(abs(self.end - self.start) / room), 2)
        if self.logarithmic and self.high >= _DECADE * self.low:
            return [(tick, f"{tick:.4g}") for tick in _decade_ticks(self.low, self.high, most)]
        step = _round_step((self.high - self.low) / most)
        first, last = math.ceil(self.low / step - 1e-9), math.floor(self.high / step + 1e-9)
        digits = max(0, -math.floor(math.log10(step) + 1e-9))
        plain = digits <= 4 and max(abs(self.low), abs(self.high)) < _PLAIN
        form = f".{digits}f" if plain else ".3g"
        return [(k * step, f"{k * step:{form}}") for k in range(first, last + 1)]


def axis_about(values: Sequence[Floats], start: float, end: float, *, margin: float = 0.0) -> Axis:
    """A linear axis over all finite values, and a ``margin`` beyond them as a share of their
    range.
    """
    finite = np.concatenate([*(found[np.isfinite(found)] for found in values), np.empty(0)])
    low, high = (finite.min(), finite.max()) if len(finite) else (0.0, 1.0)
    pad = margin * (high - low) if high > low else 0.05 * abs(low) or 0.05
    return Axis(float(low - pad), float(high + pad), start, end)


def _round_step(least: float) -> float:
    """The least of 1, 2, 5 and 10 times a power of ten that is no less than this."""
    power = 10.0 ** math.floor(math.log10(least))
    return power * next(n for n in (1.0, 2.0, 5.0, 10.0) if n * power >= least * (1.0 - 1e-9))


def _decade_ticks(low: float, high: float, most: int) -> list[float]:
    """Powers of ten in a range, with 2 and 5 times these as far as there is room for so many."""
    powers = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    ticks = [n * 10.0**power for power in powers for n in (1, 2, 5)]
    found = [tick for tick in ticks if low <= tick <= high]
    if len(found) <= most:
        return found
    stride = -(-len(powers) // most)
    return [10.0**p for p in powers if low <= 10.0**p <= high and p % stride == 0]


def text(
    content: str,
    x: float,
    y: float,
    *,
    colour: str = SOFT,
    anchor: str = "start",
    bold: bool = False,
) -> str:
    """A line of text, its middle at height y."""
    weight = ' font-weight="bold"' if bold else ""
    return (
        f'<text x="{x:.7g}" y="{y:.7g}" text-anchor="{anchor}" dominant-baseline="central" '
        f'fill="{colour}"{weight}>{escape(content)}</text>\n'
    )


def line(
    x: ArrayLike, y: ArrayLike, colour: str, *, width: float = 1.4, dashed: bool = False
) -> str:
    """A line through places (n,), broken where one is not finite."""
    dashes = f' stroke-dasharray="{3.7 * width:.3g} {1.6 * width:.3g}"' if dashed else ""
    return (
        f'<path d="{_path(x, y)}" fill="none" stroke="{colour}" stroke-width="{width:g}" '
        f'stroke-linejoin="round"{dashes}/>\n'
    )


def area(x: ArrayLike, low: ArrayLike, high: ArrayLike, colour: str) -> str:
    """What lies between two lines at places (n,), where all are finite."""
    along, lower, upper = (np.asarray(found, dtype=float) for found in (x, low, high))
    known = np.isfinite(along) & np.isfinite(lower) & np.isfinite(upper)
    round_ = np.concatenate([along[known], along[known][::-1]])
    edge = _path(round_, np.concatenate([lower[known], upper[known][::-1]]))
    return f'<path d="{edge} Z" fill="{colour}" fill-opacity="0.2"/>\n'


def mark(x: float, y: float, colour: str, *, star: bool = False, opacity: float = 1.0) -> str:
    """A disc, or a star."""
    shade = f'fill="{colour}"' + (f' fill-opacity="{opacity:g}"' if opacity < 1.0 else "")
    if not star:
        return f'<circle cx="{x:.7g}" cy="{y:.7g}" r="3" {shade}/>\n'
    angle = np.pi * np.arange(10) / 5.0
    radius = np.where(np.arange(10) % 2, 2.5, 6.5)
    edge = _path(x + radius * np.sin(angle), y - radius * np.cos(angle))
    return f'<path d="{edge} Z" {shade}/>\n'


def frame(x: Axis, y: Axis, labels: tuple[str, str]) -> str:
    """Grid, ticks with their numbers, and the label of the horizontal axis below it; that of the
    vertical one above, at its right end.
    """
    parts = []
    for value, number in x.ticks(_ROOM[0]):
        at = float(x.place(value))
        parts.append(line([at, at], [y.start, y.end], _GRID, width=0.8))
        parts.append(line([at, at], [y.start, y.start + _TICK], SOFT, width=0.8))
        parts.append(text(_minus(number), at, y.start + _TICK + LETTER, anchor="middle"))
    for value, number in y.ticks(_ROOM[1]):
        at = float(y.place(value))
        parts.append(line([x.start, x.end], [at, at], _GRID, width=0.8))
        parts.append(line([x.start - _TICK, x.start], [at, at], SOFT, width=0.8))
        parts.append(text(_minus(number), x.start - _TICK - 3.0, at, anchor="end"))
    parts.append(line([x.start, x.start, x.end], [y.end, y.start, y.start], _SPINE, width=0.8))
    middle, below = 0.5 * (x.start + x.end), y.start + _TICK + 2.3 * LETTER
    parts.append(text(labels[0], middle, below, anchor="middle"))
    parts.append(text(labels[1], x.end, y.end - LETTER, anchor="end"))
    return "".join(parts)


def picture(parts: Sequence[str], size: tuple[float, float], title: str) -> str:
    """Markup of a picture of so many points, wide and tall, for a page."""
    wide, tall = size
    return (
        f'<svg role="img" aria-label="{escape(title)}" width="{wide:g}" height="{tall:g}" '
        f'viewBox="0 0 {wide:g} {tall:g}" font-family="system-ui, sans-serif" '
        f'font-size="{LETTER:g}">\n{"".join(parts)}</svg>\n'
    )


def _minus(number: str) -> str:
    return number.replace("-", "−")


def _path(x: ArrayLike, y: ArrayLike) -> str:
    """A path through places (n,), begun anew after one that is not finite."""
    places = np.column_stack([np.asarray(x, dtype=float), np.asarray(y, dtype=float)])
    steps, step = [], "M"
    for a, b in places.tolist():
        if math.isfinite(a) and math.isfinite(b):
            steps.append(f"{step} {a:.7g} {b:.7g}")
            step = "L"
        else:
            step = "M"
    return " ".join(steps)
