"""Plots: each line holds the values of the quantity that its title names, in the unit of its
axis."""

import re
from xml.etree import ElementTree

import numpy as np

from rbfmuscle.display.plots import Point, Track, front_plot, line_plot
from rbfmuscle.display.svg import Axis
from rbfmuscle.run.appearance import MUSCLE_COLOURS


def ticks(svg, anchor):
    """Places of the ticks whose numbers have this anchor, and the numbers."""
    pattern = rf'<text x="([\d.]+)" y="([\d.]+)" text-anchor="{anchor}"[^>]*>([−\d.]+)<'
    return np.array(
        [[float(x.replace("−", "-")) for x in found] for found in re.findall(pattern, svg)]
    )


def drawn(svg, line):
    """Values of a line that a pattern finds, read back by the ticks of the axes."""
    x, y = ticks(svg, "middle"), ticks(svg, "end")
    across, up = np.polyfit(x[:, 0], x[:, 2], 1), np.polyfit(y[:, 1], y[:, 2], 1)
    points = np.array(
        re.findall(r"[ML] ([-\d.]+) ([-\d.]+)", re.search(line, svg, re.S)[1]), dtype=float
    )
    return np.polyval(across, points[:, 0]), np.polyval(up, points[:, 1])


def test_lines_lie_where_the_numbers_at_the_axes_say():
    x, y = np.arange(0.0, 90.0, 10.0), np.sin(np.arange(9)) * 30.0 + 7.0
    svg = line_plot("a <title>", [Track("strap", "#cc6677", x, y)], ("angle", "mm"), limits=[50.0])
    np.testing.assert_allclose(
        drawn(svg, r'<g data-muscle="strap">.*?<path d="([^"]*)"'), [x, y], atol=1e-4
    )
    limit = drawn(svg, r'<path d="([^"]*)"[^>]*stroke-dasharray')[1]
    np.testing.assert_allclose(limit, 50.0, atol=1e-4)
    assert (
        "a &lt;title&gt;" in svg
        and "http" not in svg
        and ">angle</text>" in svg
        and ">mm</text>" in svg
    )
    y[4] = np.nan  # where the line is broken
    svg = line_plot("a", [Track("strap", "#cc6677", x, y)], ("angle", "mm"))
    path = re.search(r'<g data-muscle="strap">.*?<path d="([^"]*)"', svg, re.S)[1]
    assert path.count("M") == 2 and path.count("L") == 6


def test_front_labels_the_front_and_the_default_and_no_label_covers_another():
    rng = np.random.default_rng(1)
    places = np.exp(rng.normal(size=(40, 2)))
    points = [
        Point(x, y, f"point {k}", "one", k == 0, k % 2 == 0) for k, (x, y) in enumerate(places)
    ]
    svg = front_plot(points, ("ms", "mm"))
    labels = re.findall(r'x="[\d.]+" y="([\d.]+)"[^>]*>point (\d+)</text>', svg)
    heights, numbers = zip(*((float(y), int(number)) for y, number in labels))
    assert sorted(numbers) == list(range(0, 40, 2))
    assert np.diff(sorted(heights)).min() > 11.0  # a row is 11.5 points high
    colour = MUSCLE_COLOURS[0]
    assert len(re.findall(rf'<(?:circle|path) [^>]* fill="{colour}"', svg)) == 40
    front = re.search(rf'<path d="([^"]*)"[^>]*stroke="{colour}"', svg)[1]
    x = np.array(re.findall(r"[ML] ([-\d.]+)", front), dtype=float)
    wanted = np.sort([np.log(point.x) for point in points if point.front])
    np.testing.assert_allclose(
        (x - x[0]) / np.ptp(x), (wanted - wanted[0]) / np.ptp(wanted), atol=1e-6
    )
    assert front_plot([Point(1.0, 0.0, "exact", "one")], ("ms", "mm")) == ""


def test_ticks_are_round_numbers_within_the_axis_wherever_it_lies():
    rng = np.random.default_rng(3)
    for _ in range(200):
        size = 10.0 ** rng.uniform(-14, 8)
        low = rng.normal() * size
        axis = Axis(low, low + size, 100.0, 0.0)
        values = np.array([value for value, _ in axis.ticks(20.0)])
        assert 2 <= len(values) <= 6
        assert values[0] >= low - 1e-9 * size and values[-1] <= low + size * (1 + 1e-9)
        step = float(np.ptp(values)) / (len(values) - 1)
        digits = step / 10.0 ** np.floor(np.log10(step) + 1e-6)
        assert min(abs(digits - n) for n in (1.0, 2.0, 5.0)) < 1e-3
        texts = [float(text) for _, text in axis.ticks(20.0)]
        if abs(low) < 10 * size:  # of a range far from zero three digits say less
            np.testing.assert_allclose(texts, values, atol=0.051 * step, rtol=6e-3)


def test_a_logarithmic_axis_has_ticks_over_less_than_a_decade_and_over_many():
    for high in (2.0, 9.0, 30.0, 1e4, 1e12):
        axis = Axis(1.5, high, 0.0, 200.0, logarithmic=True)
        values = np.array([value for value, _ in axis.ticks(20.0)])
        assert 1 <= len(values) <= 11
        assert values[0] >= 1.5 and values[-1] <= high * (1 + 1e-9)


def test_a_plot_of_one_value_or_of_none_has_axes():
    for values in ([3.0, 3.0], [np.nan, np.nan]):
        svg = line_plot("a", [Track("b", "#cc6677", np.arange(2.0), np.array(values))], ("x", "y"))
        assert "nan " not in svg and len(ticks(svg, "end")) > 1


def test_any_name_stands_in_a_plot_as_it_is():
    tracks = [Track('<"strap">', "#cc6677", np.arange(3.0), np.arange(3.0))]
    found = ElementTree.fromstring(
        line_plot(r"$\frac$ & <b>", tracks, ("angle", "mm"), legend=True)
    )
    assert found.get("aria-label") == r"$\frac$ & <b>"
    assert '<"strap">' in [group.get("data-muscle") for group in found]
    assert {r"$\frac$ & <b>", '<"strap">'} <= {element.text for element in found.iter("text")}
