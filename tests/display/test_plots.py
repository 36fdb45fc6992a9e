"""Plots: each line holds the values of the quantity that its title names, in the unit of its
axis."""

import re
from xml.etree import ElementTree

import numpy as np

from rbfmuscle.display.plots import Point, Track, front_plot, line_plot
from rbfmuscle.run.appearance import MUSCLE_COLOURS


def ticks(svg, axis):
    """Places (n, 2) of the ticks of an axis, and their numbers (n,)."""
    found = re.findall(
        rf'<g id="{axis}tick_\d+">.*?<use [^>]*x="([\d.]+)" y="([\d.]+)".*?<text[^>]*>([−\d.]+)<',
        svg,
        re.S,
    )
    numbers = np.array([[float(x.replace("−", "-")) for x in row] for row in found])
    return numbers[:, :2], numbers[:, 2]


def drawn(svg, line):
    """Values of a line that a pattern finds, read back by the ticks of the axes."""
    (across, x), (up, y) = ticks(svg, "x"), ticks(svg, "y")
    path = re.search(line, svg, re.S)[1]
    points = np.array(re.findall(r"[ML] ([-\d.]+) ([-\d.]+)", path), dtype=float)
    at = np.polyval(np.polyfit(across[:, 0], x, 1), points[:, 0])
    return at, np.polyval(np.polyfit(up[:, 1], y, 1), points[:, 1])


STRAP = r'<g data-muscle="strap">.*?<path d="([^"]*)"'


def test_lines_lie_where_the_numbers_at_the_axes_say():
    x, y = np.arange(0.0, 90.0, 10.0), np.sin(np.arange(9)) * 30.0 + 7.0
    svg = line_plot("a <title>", [Track("strap", "#cc6677", x, y)], ("angle", "mm"), limits=[50.0])
    np.testing.assert_allclose(drawn(svg, STRAP), [x, y], atol=1e-3)  # six digits of a point
    limit = drawn(svg, r'<path d="([^"]*)"[^>]*stroke-dasharray')[1]
    np.testing.assert_allclose(limit, 50.0, atol=1e-3)
    for text in ("a &lt;title&gt;", ">angle</text>", ">mm</text>"):
        assert text in svg
    assert "http" not in svg
    y[4] = np.nan  # where the line is broken
    svg = line_plot("a", [Track("strap", "#cc6677", x, y)], ("angle", "mm"))
    path = re.search(STRAP, svg, re.S)[1]
    assert path.count("M") == 2 and path.count("L") == 6


def test_names_of_lines_stand_in_the_order_of_their_ends_and_none_covers_another():
    x, ends = np.arange(3.0), np.random.default_rng(2).permutation(38) * 0.1
    ends[:5] = 2.0
    tracks = [Track(f"muscle {k}", "#cc6677", x, x * end / 2.0) for k, end in enumerate(ends)]
    svg = line_plot("a", tracks, ("angle", "mm"))
    labels = re.findall(r'translate\([\d.]+ ([\d.]+)\)"[^>]*>muscle (\d+)</text>', svg) or (
        re.findall(r'y="([\d.]+)"[^>]*>muscle (\d+)</text>', svg)
    )
    heights, numbers = zip(*((float(y), int(number)) for y, number in labels))
    assert sorted(numbers) == list(range(38))
    assert np.diff(sorted(heights)).min() > 10.0  # letters are 8.5 points high
    order = np.array(numbers)[np.argsort(heights)]  # heights count from the top
    assert (np.diff(ends[order]) <= 0.0).all()
    # The lines to the names end before these.
    left = min(float(x) for x in re.findall(r'(?:translate\(| x=")([\d.]+)[^>]*>muscle', svg))
    joints = re.findall(r'<path d="M ([\d.]+) [\d.]+\s+Q', svg)
    assert len(joints) == 38 and max(map(float, joints)) < left


def test_the_same_plot_is_the_same_markup():
    track = Track("strap", "#cc6677", np.arange(3.0), np.arange(3.0))
    plots = {line_plot("a", [track], ("angle", "mm"), limits=[1.0]) for _ in range(2)}
    assert len(plots) == 1


def test_front_labels_the_front_and_the_default_and_no_label_covers_another():
    rng = np.random.default_rng(1)
    places = np.exp(rng.normal(size=(40, 2)))
    points = [
        Point(x, y, f"point {k}", "one", k == 0, k % 2 == 0) for k, (x, y) in enumerate(places)
    ]
    svg = front_plot(points, ("ms", "mm"))
    labels = re.findall(r'translate\([\d.]+ ([\d.]+)\)"[^>]*>point (\d+)</text>', svg) or (
        re.findall(r'y="([\d.]+)"[^>]*>point (\d+)</text>', svg)
    )
    heights, numbers = zip(*((float(y), int(number)) for y, number in labels))
    assert sorted(numbers) == list(range(0, 40, 2))
    assert np.diff(sorted(heights)).min() > 10.0  # letters are 8.5 points high
    colour = MUSCLE_COLOURS[0].lower()
    assert len(re.findall(rf"<use [^>]*fill: {colour}", svg)) == 40
    front = max(re.findall(rf'<path d="([^"]*)"[^>]*stroke: {colour}', svg), key=len)
    x = np.array(re.findall(r"[ML] ([-\d.]+)", front), dtype=float)
    wanted = np.sort([np.log(point.x) for point in points if point.front])
    np.testing.assert_allclose(
        (x - x[0]) / np.ptp(x), (wanted - wanted[0]) / np.ptp(wanted), atol=1e-5
    )
    assert front_plot([Point(1.0, 0.0, "exact", "one")], ("ms", "mm")) == ""


def test_a_plot_of_one_value_or_of_none_has_axes():
    for values in ([3.0, 3.0], [np.nan, np.nan]):
        svg = line_plot("a", [Track("b", "#cc6677", np.arange(2.0), np.array(values))], ("x", "y"))
        assert "nan " not in svg and len(ticks(svg, "y")[1]) > 1


def test_any_name_stands_in_a_plot_as_it_is():
    tracks = [Track('<"strap">', "#cc6677", np.arange(3.0), np.arange(3.0))]
    plot = line_plot(r"$\frac$ & <b>", tracks, ("angle", "mm"), legend=True)
    found = ElementTree.fromstring(plot.replace("xlink:href", "href"))
    assert found.get("aria-label") == r"$\frac$ & <b>"
    assert '<"strap">' in [group.get("data-muscle") for group in found.iter("g")]
    assert {r"$\frac$ & <b>", '<"strap">'} <= {element.text for element in found.iter("text")}
