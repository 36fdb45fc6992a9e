"""Plots of a kernel study: fronts of error against cost, and what the search tried."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from rbfmuscle.study.experiment.kernel_study import KernelStudy


def draw_fronts(study: KernelStudy, figure: Figure) -> None:
    """Error against time and against stored numbers, with the fronts and meshes of as many numbers."""
    good = [row for row in study.rows if not row["unfit"]]
    figure.set_size_inches(11, 4.6)
    left, right = figure.subplots(1, 2, sharey=True, gridspec_kw={"wspace": 0.32})
    sizes = sorted((n, d["rms"]) for n, d in study.decimated.items())
    errors = [row["rms"] for row in good] + [rms for _, rms in sizes]
    span = min(errors, default=1.0) / 1.2, 1.2 * max(errors, default=1.0)
    for axes, cost, front in (
        (left, lambda r: 1e3 * (r["fit_time"] + r["evaluation_time"]), "front_time"),
        (right, lambda r: r["numbers"], "front_size"),
    ):
        for count in sorted({row["centres"] for row in good}):
            rows = [row for row in good if row["centres"] == count]
            axes.plot([cost(r) for r in rows], [r["rms"] for r in rows], "o", ms=5, alpha=0.6, mec="none",
                      label=f"{count} centres")  # fmt: skip
        best = sorted((cost(r), r["rms"], r["kernel"]) for r in good if r[front])
        axes.plot([b[0] for b in best], [b[1] for b in best], "-", color="0.3", lw=1.0, zorder=0)
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.set_ylim(*span)
        _plain_ticks(axes)
        if axes is left:
            _name_beside(axes, best)
    right.plot(
        [s[0] for s in sizes], [s[1] for s in sizes], "s--", color="#a63d38", ms=4, label="decimated mesh"
    )
    left.set(xlabel="fit and 20,000 values [ms]", ylabel=f"RMS error [{study.units or 'mesh units'}]")
    right.set_xlabel("stored numbers [1]")
    right.legend(fontsize=8)


def _plain_ticks(axes):
    """1, 2, 5 and their multiples of ten, as plain numbers, and no others, which would lie on each other."""
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:,.6g}"))
        axis.set_minor_formatter(NullFormatter())


def _name_beside(axes, best):
    """Names of the front in the order of their errors, in a column within the axes, with a line to each point."""
    low, high = (math.log(limit) for limit in axes.get_ylim())
    step = 0.052  # of the axes' height: the height of a line of this size
    heights, last = [], -math.inf
    for _, y, _ in sorted(best, key=lambda point: point[1]):
        last = max((math.log(y) - low) / (high - low), last + step)
        heights.append(last)
    over = max(heights[-1] - 0.98, 0.0) if heights else 0.0
    for (x, y, name), height in zip(sorted(best, key=lambda point: point[1]), heights, strict=True):
        axes.annotate(name, (x, y), xytext=(1.03, height - over), textcoords="axes fraction", fontsize=7.5, va="center",
                      arrowprops={"arrowstyle": "-", "lw": 0.4, "color": "0.5"}, annotation_clip=False)  # fmt: skip


def draw_maps(study: KernelStudy, figure: Figure) -> None:
    """What the search tried: one row a kernel, each trial a cell that reaches half-way to the next."""
    count = max(row["centres"] for row in study.scan)
    rows = [row for row in study.scan if row["centres"] == count]
    names = list(dict.fromkeys(row["kernel"] for row in rows))
    figure.set_size_inches(11, max(3.4, 1.6 + 0.26 * len(names)))
    for axes, key, label in zip(
        figure.subplots(1, 2, sharey=True), ("error", "condition"),
        (f"RMS error [{study.units or 'mesh units'}]", "condition [1]"), strict=True,
    ):  # fmt: skip
        values = [row[key] for row in rows if row[key] and np.isfinite(row[key])]
        norm = _log_norm(values)
        for line, name in enumerate(names):
            tried = sorted((r["shape"], r[key]) for r in rows if r["kernel"] == name and r[key])
            at = np.log([shape for shape, _ in tried])
            edges = np.concatenate([at[:1], 0.5 * (at[1:] + at[:-1]), at[-1:]])
            picture = axes.pcolormesh(np.exp(edges), [line - 0.45, line + 0.45], [[v for _, v in tried]], norm=norm,
                                      cmap="viridis_r" if key == "error" else "cividis_r")  # fmt: skip
        axes.set_xscale("log")
        axes.set_ylim(len(names) - 0.5, -0.5)
        axes.set_yticks(range(len(names)), names, fontsize=8)
        axes.set_xlabel("epsilon times spacing [1]")
        figure.colorbar(picture, ax=axes, label=f"{label}, {count} centres")


def _log_norm(values):
    """A logarithmic scale from the least value to the 80th percentile, so that what broke stretches no scale."""
    from matplotlib.colors import LogNorm

    return LogNorm(min(values), max(float(np.quantile(values, 0.8)), 1.01 * min(values)), clip=True)
