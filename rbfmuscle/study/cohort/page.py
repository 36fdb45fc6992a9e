"""A cohort as one page: what failed, who lies apart, how each quantity is spread over muscles and jobs."""

from __future__ import annotations

import html
import io
from collections import defaultdict
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np

from rbfmuscle.study.cohort.table import APART, LEAST_JOBS, shown_name
from rbfmuscle.study.show.appearance import LINE_COLOURS
from rbfmuscle.study.show.page import STYLE, embedded_image
from rbfmuscle.study.show.plots import PLOT_STYLE

MOST_OUTLIERS = 60
PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width,initial-scale=1">
<title>{title}</title><style>{style}
td.text,th.text{{text-align:left}}td.reason{{text-align:left;color:#8e2a22;max-width:560px}}
</style></head><body><main>
<h1>{title}</h1><p class="sub">{counts}</p>
{failed}
<h2>Apart from the others</h2>{outliers}
<h2>By muscle</h2><p class="note">A dot is a job, the bar the median; red dots are the ones above. One value stands
for a run: the mean over its frames of lengths, volumes and moment arms, the worst of all else. Lengths in mm.</p>
<div class="plots">{plots}</div>
<h2>Jobs</h2><div class="wide">{jobs}</div>
<h2>How to read this</h2><p>A value lies <b>apart</b> where it is more than {apart} robust standard deviations (1.4826
times the median absolute deviation) from the median of its muscle over all jobs, of which there must be {least} or
more. It says that a job is unlike the others, not that it is wrong: look at its report. <code>cohort.csv</code> has all
quantities of all jobs.</p>
</main></body></html>
"""


def write_cohort_page(table: dict[str, Any], directory: str | Path, title: str = "Cohort") -> None:
    """Write the self-contained ``cohort.html``.

    Parameters
    ----------
    table : dict
        From `write_cohort`.
    directory : path
    title : str
    """
    subjects = len({row["subject"] for row in table["jobs"]})
    counts = f"{subjects} subjects, {len(table['jobs'])} jobs: {table['done']} done"
    for status in ("failed", "missing"):
        counts += f", {table[status]} {status}" if table[status] else ""
    text = PAGE.format(
        title=html.escape(title),
        style=STYLE,
        counts=counts,
        failed=_failed(table),
        outliers=_outliers(table),
        plots="".join(_plots(table)),
        jobs=_jobs(table),
        apart=APART,
        least=LEAST_JOBS,
    )
    Path(directory, "cohort.html").write_text(text, encoding="utf-8")


def _link(row):
    name = html.escape(shown_name(row))
    target = row["report"] or row["folder"]
    return f'<a href="{quote(target)}">{name}</a>'


def _failed(table):
    bad = [row for row in table["jobs"] if row["status"] == "failed"]
    if not bad:
        return ""
    rows = "".join(
        f'<tr><td>{_link(row)}</td><td class="reason">{html.escape(row["error"])}</td></tr>' for row in bad
    )
    return (
        f'<p class="bad">{len(bad)} of {len(table["jobs"])} jobs failed; what they have written is kept.</p>'
        f'<div class="wide"><table><tr><th>job</th><th class="text">reason</th></tr>{rows}</table></div>'
    )


def _outliers(table):
    found = table["outliers"]
    if not found:
        return '<p class="good">No job lies apart in any quantity.</p>'
    links = {(row["subject"], row["trial"]): _link(row) for row in table["jobs"]}
    rows = "".join(
        f"<tr><td>{links[one['subject'], one['trial']]}</td>"
        f'<td class="text">{html.escape(one["muscle"])}</td><td class="text">{html.escape(one["quantity"])}</td>'
        f"<td>{one['value']:.4g}</td><td>{one['median']:.4g}</td><td>{html.escape(one['unit'])}</td>"
        f"<td>{one['apart']:.1f}</td></tr>"
        for one in found[:MOST_OUTLIERS]
    )
    more = len(found) - MOST_OUTLIERS
    return (
        '<div class="wide"><table><tr><th>job</th><th class="text">muscle</th><th class="text">quantity</th>'
        f"<th>value</th><th>median</th><th>unit</th><th>deviations</th></tr>{rows}</table></div>"
        + (f'<p class="note">{more} more are in cohort.json.</p>' if more > 0 else "")
    )


def _jobs(table):
    rows = []
    for row in table["jobs"]:
        beyond = row.get("beyond") or []
        shown = ", ".join(beyond[:4]) + (f" and {len(beyond) - 4} more" if len(beyond) > 4 else "")
        settings = ", ".join(f"{key}={value}" for key, value in row["settings"].items())
        seconds = "" if row["seconds"] is None else f"{row['seconds']:.1f}"
        rows.append(
            f"<tr><td>{_link(row)}</td><td>{row['status']}</td><td>{row.get('frames', '')}</td><td>{seconds}</td>"
            f'<td class="text">{html.escape(settings)}</td><td class="text">{html.escape(shown)}</td></tr>'
        )
    return (
        '<table><tr><th>job</th><th>status</th><th>frames</th><th>seconds</th><th class="text">settings</th>'
        f'<th class="text">beyond the limits</th></tr>{"".join(rows)}</table>'
    )


def _plots(table):
    """A picture a quantity, with muscles down the side."""
    apart = {(o["subject"], o["trial"], o["muscle"], o["quantity"]) for o in table["outliers"]}
    groups = defaultdict(list)
    for value in table["values"]:
        groups[value.quantity, value.unit].append(value)
    for (quantity, unit), values in sorted(groups.items()):
        text = f"{quantity.replace(':', ' about ')} [{unit}]"
        yield f"<figure>{embedded_image(_spread(values, text, apart), 'png', text)}</figure>"


def _spread(values, text, apart):
    """PNG of one quantity: dots of the jobs and their median, a line a muscle."""
    import matplotlib
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    muscles = list(dict.fromkeys(value.muscle for value in values))
    with matplotlib.rc_context(PLOT_STYLE):
        figure = Figure(figsize=(6.4, 1.1 + 0.24 * len(muscles)), layout="constrained")
        FigureCanvasAgg(figure)
        axes = figure.add_subplot()
        for line, muscle in enumerate(muscles):
            mine = [value for value in values if value.muscle == muscle]
            numbers = np.array([value.value for value in mine])
            odd = np.array([(v.subject, v.trial, v.muscle, v.quantity) in apart for v in mine])
            # Side by side where they are many, always the same way.
            height = line + 0.28 * (np.arange(len(mine)) / max(1, len(mine) - 1) - 0.5)
            axes.plot(numbers[~odd], height[~odd], "o", ms=3.5, alpha=0.55, mec="none", color=LINE_COLOURS[0])
            axes.plot(numbers[odd], height[odd], "o", ms=5.0, mec="none", color="#c0392b")
            if np.isfinite(numbers).any():
                axes.plot(
                    [np.nanmedian(numbers)] * 2, [line - 0.33, line + 0.33], "-", color="#222222", lw=1.6
                )
        axes.set_yticks(range(len(muscles)), muscles, fontsize=8)
        axes.set_ylim(len(muscles) - 0.4, -0.6)
        axes.set_title(text, fontsize=10)
        axes.ticklabel_format(axis="x", useOffset=False)
        out = io.BytesIO()
        figure.savefig(out, format="png", dpi=120, metadata={"Software": None})
    return out.getvalue()
