"""Plots of a saved run over its motion."""

from __future__ import annotations

import io
import textwrap
from typing import TYPE_CHECKING, Any

import numpy as np

from rbfmuscle.metrics.quantities import ALL
from rbfmuscle.report.appearance import LINE_COLOURS, line_colours

if TYPE_CHECKING:
    from rbfmuscle.output.saved import SavedRun


# From so many lines on a plot names only those that go furthest, so many of them.
MANY, NAMED = 9, 6
PLOT_STYLE = {
    "font.size": 9,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": "#9a9a9a",
    "axes.labelcolor": "#444444",
    "axes.titlesize": 10.5,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.grid": True,
    "grid.color": "#ececec",
    "xtick.color": "#666666",
    "ytick.color": "#666666",
    "svg.fonttype": "path",
    "svg.hashsalt": "rbfmuscle",
}
# Title, quantity, factor, unit of the axis (None: the table's), whether the limit is drawn on both sides.
PANELS = (
    ("Volume error", "volume_error", 100.0, "%", True),
    ("Surface inside a bone", "penetration_max", 1.0, None, False),
    ("Bone inside the muscle", "bone_penetration_max", 1.0, None, False),
    ("Inside a bone before the cut", "solver_penetration_max", 1.0, None, False),
    ("Time a frame", "time_frame", 1000.0, "ms", False),
    ("Edge strain of the carried mesh (RMS)", "edge_strain_rms", 100.0, "%", False),
    ("Length", "length", 1.0, None, False),
)


def motion_axis(saved: Any) -> tuple[dict[int, float], str]:
    """What the plots run along.

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


def plot_panels(saved: SavedRun) -> list[tuple[str, bytes]]:
    """Draw every panel that the run has values for.

    Parameters
    ----------
    saved : SavedRun

    Returns
    -------
    list of (title, bytes)
        SVG pictures.
    """
    import matplotlib
    from matplotlib.backends.backend_svg import FigureCanvasSVG
    from matplotlib.figure import Figure

    axis, label = motion_axis(saved)
    pictures = []
    panels = [(*panel, None) for panel in PANELS]
    # About one coordinate after the other: arms about several are no one line, nor of one unit.
    panels += [
        (f"Moment arm: {name}", "moment_arm", 1.0, arm_unit(saved, name), False, name)
        for name in saved.arm_coordinates()
    ]
    with matplotlib.rc_context(PLOT_STYLE):
        for title, quantity, factor, unit, both, coordinate in panels:
            figure = Figure(figsize=(4.6, 2.7), layout="constrained")
            FigureCanvasSVG(figure)
            axes = figure.add_subplot()
            if not _draw_lines(axes, saved, quantity, factor, axis, coordinate):
                continue
            _draw_limit(axes, saved, quantity, factor, both)
            axes.set_title(title)
            axes.set_xlabel(label)
            axes.set_ylabel(unit or saved.units)
            out = io.BytesIO()
            figure.savefig(out, format="svg", metadata={"Date": None})
            pictures.append((title, out.getvalue()))
    return pictures


def wrapped(title: str) -> str:
    """A panel's title on as many lines as it needs."""
    return "\n".join(textwrap.wrap(title, 48))


def arm_unit(saved: Any, coordinate: str) -> str:
    """Unit of the moment arms about a coordinate of a saved run."""
    shift = saved.info.get("scene", {}).get("coordinate_units", {}).get(coordinate, "").strip()
    return "1" if shift else saved.units


def _draw_lines(axes, saved, quantity, factor, axis, coordinate=None):
    colours = line_colours(saved.muscles)
    tracks = [
        (muscle, saved.series(muscle, quantity, coordinate), colours[muscle]) for muscle in saved.muscles
    ]
    if quantity == "time_frame":
        tracks.append(("all together", saved.series(ALL, quantity), "#222222"))
    tracks = [(name, *series, colour) for name, series, colour in tracks if len(series[0])]
    named = _furthest(tracks) if len(tracks) > MANY else None
    for name, frames, values, colour in tracks:
        places = [axis[frame] for frame in frames]
        if named is None:
            axes.plot(places, values * factor, color=colour, lw=1.6, label=name, marker="o", ms=2.2)
        elif name not in named:
            axes.plot(places, values * factor, color="#d4d2cd", lw=0.8, zorder=1)
        else:
            axes.plot(places, values * factor, color=named[name], lw=1.6, label=name, zorder=2)
    if named:
        axes.legend(fontsize=6.5, frameon=False, loc="best", handlelength=1.2)
    if quantity == "time_frame" and tracks:
        # The first frame loads and compiles, and so may a later one that meets something new; it would flatten
        # all others, so it ends at the edge, and the edge says how high it goes.
        later = factor * np.concatenate([values[1:] for _, _, values, _ in tracks])
        if len(later):
            top = 1.15 * min(later.max(), 3.0 * np.percentile(later, 90))
            axes.set_ylim(0, top)
            _name_hidden(axes, tracks[-1], axis, factor, top)
    return bool(tracks)


def _furthest(tracks):
    """Colours of the muscles that go furthest, and of all together: what a plot of many names."""
    reach = {name: np.nanmax(np.abs(values), initial=0.0) for name, _, values, _ in tracks}
    chosen = sorted(reach, key=lambda name: -reach[name])[:NAMED]
    return dict(zip(chosen, LINE_COLOURS))


def _name_hidden(axes, track, axis, factor, top):
    """Write the height of frames that go beyond the plot, of one track, beside where they leave it."""
    _, frames, values, colour = track
    for frame, value in zip(frames, values * factor):
        if value > top:
            text = f"{value / 1000:.1f} s" if value >= 1000 else f"{value:.0f} ms"
            axes.annotate(
                text,
                (axis[frame], top),
                (3, -3),
                textcoords="offset points",
                fontsize=7,
                color=colour,
                va="top",
            )


def _draw_limit(axes, saved, quantity, factor, both):
    limit = saved.info.get("limits", {}).get(quantity)
    if limit is None:
        return
    low, high = axes.get_ylim()
    for value in (limit, -limit) if both else (limit,):
        axes.axhline(value * factor, color="#c0392b", lw=0.9, ls=(0, (4, 3)), zorder=0)
    if not both:
        axes.set_ylim(min(0.0, low), max(high, 1.1 * limit * factor))
