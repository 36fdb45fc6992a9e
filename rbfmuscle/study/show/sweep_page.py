"""A sweep as a picture and a page: error against time a frame, the front and the default on it."""

from __future__ import annotations

import base64
import html
import io
from pathlib import Path
from typing import Any

from rbfmuscle.study.experiment.sweep_table import flat_row, has_length, table_columns
from rbfmuscle.study.show.appearance import LINE_COLOURS
from rbfmuscle.study.show.page import STYLE
from rbfmuscle.study.show.plots import PLOT_STYLE

SHOWN_VALUES = (
    "error_rms",
    "error_max",
    "volume_error",
    "penetration_max",
    "bone_penetration_max",
    "rest_error_rms",
    "time_frame",
    "time_extract",
)
PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width,initial-scale=1">
<title>{title}</title><style>{style}
tr.front td{{background:#fdf6e6}}tr.default td:first-child{{font-weight:650}}
td.text{{text-align:left;color:#8e2a22;max-width:420px}}</style></head><body><main>
<h1>{title}</h1><p class="sub">Error against time a frame</p>
{verdicts}
<figure><img alt="Error against time a frame" src="data:image/png;base64,{picture}"></figure>
<p class="note">{conditions}</p>
<h2>Points</h2><p class="note">Shaded: on the front. Lengths in {units}, times in milliseconds a frame.</p>
<div class="wide"><table><tr>{head}</tr>{body}</table></div>
<h2>How to read this</h2>{explanation}
</main></body></html>
"""
EXPLANATION = """<p>Each point is one combination of settings, run through the same motion. <b>error_rms</b> is the
distance between its surfaces and those of the <b>reference</b> at the same poses, both ways, root mean square over
all frames and muscles; it says how far a setting is from the finest one, not how far the model is from a real
muscle. The reference's own error is zero by definition, so it takes no part in the front. A point is on the
<b>front</b> if no other is as accurate in less time. The default lies <b>within 10 %</b> if no point beats both its
error and its time by more than that. Volume and penetration are the worst over frames and muscles; the time a frame
is the median over the frames after the first (which loads and compiles), all muscles, extraction of the surfaces
included.</p>"""


def draw_front(table: dict[str, Any], path: str | Path) -> bytes:
    """Draw the sweep to a PNG file.

    Parameters
    ----------
    table : dict
        From `write_table`.
    path : path

    Returns
    -------
    bytes
        The picture.
    """
    import matplotlib
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    quantity = table["quantity"]
    with matplotlib.rc_context(PLOT_STYLE):
        figure = Figure(figsize=(7.6, 4.6), layout="constrained")
        FigureCanvasAgg(figure)
        axes = figure.add_subplot()
        groups = dict.fromkeys(row["model"] for row in table["rows"])
        for group, colour in zip(groups, LINE_COLOURS * len(groups)):
            _draw_group(axes, table["rows"], quantity, group, colour)
        axes.set(xscale="log", yscale="log", xlabel="time a frame [ms]")
        _plain_ticks(axes)
        axes.set_ylabel(f"{quantity} [{table['units'] if has_length(quantity) else '1'}]")
        axes.set_title(f"{table['scene']}: {len(table['rows'])} points")
        if axes.get_legend_handles_labels()[0]:
            axes.legend(frameon=False, fontsize=8.5)
        out = io.BytesIO()
        figure.savefig(out, format="png", dpi=130, metadata={"Software": None})
    Path(path).write_bytes(out.getvalue())
    return out.getvalue()


def _plain_ticks(axes):
    """Plain numbers at round places, also where the range is less than a decade."""
    from matplotlib.ticker import FuncFormatter, LogLocator, MaxNLocator, NullLocator

    for axis in (axes.xaxis, axes.yaxis):
        low, high = axis.get_view_interval()
        narrow = high < 8 * low
        axis.set_major_locator(MaxNLocator(6, steps=[1, 2, 5, 10]) if narrow else LogLocator(subs=(1, 2, 5)))
        axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
        axis.set_minor_locator(NullLocator())


def _draw_group(axes, rows, quantity, group, colour):
    name = group or "points"
    usable = [
        (1e3 * r["time_frame"], r[quantity], r)
        for r in rows
        if r["model"] == group and r["role"] != "reference" and r["time_frame"] and r[quantity]
    ]
    plain = [(t, e) for t, e, r in usable if not r["front"]]
    if plain:
        axes.plot(*zip(*plain), "o", color=colour, ms=4.5, alpha=0.45, mec="none", label=name)
    front = sorted((t, e) for t, e, r in usable if r["front"])
    if front:
        axes.plot(*zip(*front), "o-", color=colour, ms=5.5, lw=1.4, label=f"{name}: on the front")
    default = [(t, e) for t, e, r in usable if r["role"] == "default"]
    for t, e in default:
        axes.plot(t, e, "*", color=colour, ms=15, mec="#222222", mew=0.9, zorder=5, label=f"{name}: default")


def write_page(table: dict[str, Any], directory: Path) -> None:
    """Write ``pareto.png`` and the self-contained ``sweep.html``."""
    directory = Path(directory)
    picture = draw_front(table, directory / "pareto.png")
    rows = table["rows"]
    settings = list(dict.fromkeys(key for row in rows for key in row["settings"]))
    columns = ["point", "role", *settings, *(c for c in table_columns(rows) if c in SHOWN_VALUES), "error"]
    head = "".join(f"<th>{html.escape(name)}</th>" for name in columns)
    body = "".join(_row(row, columns) for row in rows)
    verdicts = "".join(
        f'<p class="{"good" if v["near"] else "bad"}">{html.escape(v["text"])}</p>' for v in table["verdicts"]
    )
    if table["failed"] or table["missing"]:
        verdicts += f'<p class="bad">{table["failed"]} points failed, {table["missing"]} are missing.</p>'
    text = PAGE.format(
        title=html.escape(f"Sweep of {table['scene']}"),
        style=STYLE,
        verdicts=verdicts,
        picture=base64.b64encode(picture).decode(),
        conditions=html.escape(_conditions(rows)),
        units=table["units"],
        head=head,
        body=body,
        explanation=EXPLANATION,
    )
    (directory / "sweep.html").write_text(text, encoding="utf-8")


def _conditions(rows):
    found = sorted({(r["jobs"], r["threads"]) for r in rows if r["status"] == "done" and r["jobs"]})
    told = "; ".join(f"{jobs} at a time with {threads} thread(s) each" for jobs, threads in found)
    shared = (
        " Points timed beside others share memory and caches with them."
        if any(j > 1 for j, _ in found)
        else ""
    )
    warning = " Times of different conditions do not compare." if len(found) > 1 else ""
    return f"Points were timed {told}.{shared}{warning}" if found else "No point was timed."


def _row(row, columns):
    values = flat_row(row)
    classes = " ".join(name for name in ("front" if row["front"] else "", row["role"]) if name)
    cells = "".join(_cell(name, values.get(name, "")) for name in columns)
    return f'<tr class="{classes}">{cells}</tr>'


def _cell(name, value):
    if name == "error":
        return f'<td class="text">{html.escape(str(value))}</td>'
    if value is None:
        return "<td></td>"
    if isinstance(value, float):
        value = f"{1e3 * value:.3g}" if name.startswith("time_") else f"{value:.3g}"
    return f"<td>{html.escape(str(value))}</td>"
