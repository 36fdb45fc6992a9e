"""Plots of a kernel study: fronts of error against cost, and what the search tried."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from rbfmuscle.study.experiment.kernel_study import KernelStudy


# A figure's width [inch]: two stand beside each other on a wide page and one fills a telephone, its letters still read.
WIDTH, HEIGHT = 5.6, 4.4


def draw_times(study: KernelStudy, figure: Figure) -> None:
    """Error against the time of a fit and 20,000 values, with the front, whose kernels are named beside."""
    axes = _begin(study, figure)
    good, cost = _fit_rows(study), lambda row: 1e3 * (row["fit_time"] + row["evaluation_time"])
    best = _draw_rows(axes, good, cost, "front_time")
    _plain_ticks(axes.xaxis, axes.yaxis)
    _name_beside(axes, best)
    axes.set_xlabel("fit and 20,000 values [ms of one thread]")
    if good:
        axes.legend(fontsize=9, loc="upper right")


def draw_sizes(study: KernelStudy, figure: Figure) -> None:
    """Error against stored numbers, with the front and meshes of as many numbers."""
    axes = _begin(study, figure)
    _draw_rows(axes, _fit_rows(study), lambda row: row["numbers"], "front_size")
    sizes = sorted((n, d["rms"]) for n, d in study.decimated.items())
    axes.plot(
        [n for n, _ in sizes], [rms for _, rms in sizes], "s--", color="#a63d38", ms=4, label="decimated mesh"
    )
    _plain_ticks(axes.xaxis, axes.yaxis)
    axes.set_xlabel("stored numbers [1]")
    axes.legend(fontsize=9)


def _fit_rows(study):
    return [row for row in study.rows if not row["unfit"]]


def _begin(study, figure):
    """Axes with the error upwards, the same for both plots."""
    figure.set_size_inches(WIDTH, HEIGHT)
    axes = figure.subplots()
    errors = [row["rms"] for row in _fit_rows(study)] + [d["rms"] for d in study.decimated.values()]
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.set_ylim(min(errors, default=1.0) / 1.2, 1.2 * max(errors, default=1.0))
    axes.set_ylabel(f"RMS error [{study.units or 'mesh units'}]")
    return axes


def _draw_rows(axes, good, cost, front):
    """Points by number of centres and the line of the front; cost, error and kernel of what is on it."""
    for count in sorted({row["centres"] for row in good}):
        rows = [row for row in good if row["centres"] == count]
        axes.plot([cost(r) for r in rows], [r["rms"] for r in rows], "o", ms=5, alpha=0.6, mec="none",
                  label=f"{count} centres")  # fmt: skip
    best = sorted((cost(r), r["rms"], r["kernel"]) for r in good if r[front])
    axes.plot([b[0] for b in best], [b[1] for b in best], "-", color="0.3", lw=1.0, zorder=0)
    return best


def _plain_ticks(*along):
    """1, 2, 5 and their multiples of ten, as plain numbers, and no others, which would lie on each other."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    for axis in along:
        low, high = axis.get_view_interval()
        # less than a factor of five holds one or two of these at most
        subs = (1.0, 2.0, 5.0) if high > 5.0 * low else (1.0, 1.2, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 6.0, 8.0)
        axis.set_major_locator(LogLocator(subs=subs))
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.6g}"))
        axis.set_minor_formatter(NullFormatter())


def _name_beside(axes, best):
    """Names of the front in the order of their errors, in a column within the axes, with a line to each point."""
    low, high = (math.log(limit) for limit in axes.get_ylim())
    step = 0.056  # of the axes' height: the height of a line of this size
    heights, last = [], -math.inf
    for _, y, _ in sorted(best, key=lambda point: point[1]):
        last = max((math.log(y) - low) / (high - low), last + step)
        heights.append(last)
    over = max(heights[-1] - 0.98, 0.0) if heights else 0.0
    for (x, y, name), height in zip(sorted(best, key=lambda point: point[1]), heights, strict=True):
        axes.annotate(name, (x, y), xytext=(1.03, height - over), textcoords="axes fraction", fontsize=9, va="center",
                      arrowprops={"arrowstyle": "-", "lw": 0.4, "color": "0.5"}, annotation_clip=False)  # fmt: skip


def draw_map(study: KernelStudy, figure: Figure, *, key: str) -> None:
    """What the search tried: one row a kernel, each trial a cell that reaches half-way to the next.

    Parameters
    ----------
    study : KernelStudy
    figure : matplotlib.figure.Figure
    key : {"error", "condition"}
    """
    count = max(row["centres"] for row in study.scan)
    rows = [row for row in study.scan if row["centres"] == count]
    names = list(dict.fromkeys(row["kernel"] for row in rows))
    figure.set_size_inches(WIDTH, max(2.6, 1.2 + 0.24 * len(names)))
    axes = figure.subplots()
    norm = _log_norm([row[key] for row in rows if row[key] and np.isfinite(row[key])])
    for line, name in enumerate(names):
        tried = sorted((r["shape"], r[key]) for r in rows if r["kernel"] == name and r[key])
        at = np.log([shape for shape, _ in tried])
        edges = np.concatenate([at[:1], 0.5 * (at[1:] + at[:-1]), at[-1:]])
        picture = axes.pcolormesh(np.exp(edges), [line - 0.45, line + 0.45], [[v for _, v in tried]], norm=norm,
                                  cmap="viridis_r" if key == "error" else "cividis_r")  # fmt: skip
    axes.set_xscale("log")
    axes.set_ylim(len(names) - 0.5, -0.5)
    axes.set_yticks(range(len(names)), names, fontsize=9)
    axes.set_xlabel("epsilon times spacing [1]")
    label = f"RMS error [{study.units or 'mesh units'}]" if key == "error" else "condition [1]"
    bar = figure.colorbar(picture, ax=axes, label=f"{label}, {count} centres")
    if key == "error":
        _plain_ticks(bar.ax.yaxis)


def _log_norm(values):
    """A logarithmic scale from the least value to the 80th percentile, so that what broke stretches no scale."""
    from matplotlib.colors import LogNorm

    return LogNorm(min(values), max(float(np.quantile(values, 0.8)), 1.01 * min(values)), clip=True)
