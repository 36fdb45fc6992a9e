"""A sweep as a picture and a page: error against time per frame, the front, scenes that lie apart, every point."""

from __future__ import annotations

import html
import io
import math
from pathlib import Path
from typing import Any

from rbfmuscle.report.appearance import LINE_COLOURS
from rbfmuscle.report.page import STYLE, embedded_image
from rbfmuscle.report.plots import PLOT_STYLE

SHOWN = ("error_rms", "error_max", "volume_error", "penetration_max", "bone_penetration_max", "time_frame")
PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width,initial-scale=1">
<title>{title}</title><style>{style}</style></head><body><main><h1>{title}</h1><p class="sub">{counts}</p>
{verdicts}{picture}{outliers}<h2>Points</h2>
<p class="note">Lengths in the scene's unit, times in milliseconds per frame. Points that ran beside others share
memory and caches with them.</p><div class="wide">{points}</div>
<h2>How to read this</h2><p><b>error_rms</b> is the distance between a point's surfaces and those of the
<b>reference</b>, the finest point of the grid, at the same poses, both ways, root mean square over frames and muscles.
It says how far a setting is from the finest one, not how far the model is from a real muscle. A point is on the
<b>front</b> if no other is as accurate in less time. A scene lies <b>apart</b> where a mean over its frames is more
than 3.5 robust standard deviations from the median of five scenes or more.</p></main></body></html>
"""


def write_page(table: dict[str, Any], directory: str | Path) -> None:
    """Write the self-contained ``sweep.html``, and ``pareto.png`` where there is a front.

    Parameters
    ----------
    table : dict
        From `write_table`.
    directory : path
    """
    directory, rows = Path(directory), table["rows"]
    picture = ""
    if any(row["front"] for row in rows):
        drawn = draw_front(rows, table["quantity"])
        (directory / "pareto.png").write_bytes(drawn)
        picture = f"<figure>{embedded_image(drawn, 'png', 'Error against time per frame')}</figure>"
    settings = list(dict.fromkeys(key for row in rows for key in row["settings"]))
    head = ["scene", *settings, "role", "front", *SHOWN, "error"]
    lines = [[row["settings"].get(name, row.get(name, "")) for name in head] for row in rows]
    apart = [list(found.values()) for found in table["outliers"]]
    text = PAGE.format(
        title=html.escape(f"Sweep of {', '.join(dict.fromkeys(row['scene'] for row in rows))}"[:120]),
        style=STYLE,
        counts=", ".join(f"{table[status]} points {status}" for status in ("done", "failed", "missing")),
        verdicts="".join(
            f'<p class="{"good" if v["near"] else "bad"}">{html.escape(v["text"])}</p>'
            for v in table["verdicts"]
        ),
        picture=picture,
        outliers="<h2>Apart from the other scenes</h2>" + _table(list(table["outliers"][0]), apart)
        if apart
        else "",
        points=_table(head, lines),
    )
    (directory / "sweep.html").write_text(text, encoding="utf-8")


def _table(head, lines):
    rows = "".join(
        "<tr>" + "".join(f"<td>{_cell(n, v)}</td>" for n, v in zip(head, line)) + "</tr>" for line in lines
    )
    return f"<table><tr>{''.join(f'<th>{html.escape(name)}</th>' for name in head)}</tr>{rows}</table>"


def _cell(name, value):
    if isinstance(value, bool):
        return "yes" if value else ""
    if not isinstance(value, float):
        return html.escape(str(value))
    shown = 1e3 * value if name.startswith("time_") else value
    return "" if math.isnan(value) else f"{shown:.3g}"


def draw_front(rows: list[dict[str, Any]], quantity: str) -> bytes:
    """PNG of the error against time per frame, a colour a scene and model, stars for the defaults."""
    import matplotlib
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    with matplotlib.rc_context(PLOT_STYLE):
        figure = Figure(figsize=(7.6, 4.6), layout="constrained")
        FigureCanvasAgg(figure)
        axes = figure.add_subplot()
        groups = list(dict.fromkeys(f"{row['scene']} {row['model']}".strip() for row in rows))
        for row in rows:
            if row["role"] == "reference" or not (row[quantity] > 0.0 and row["time_frame"] > 0.0):
                continue
            group = f"{row['scene']} {row['model']}".strip()
            shape = "*" if row["role"] == "default" else "o"
            (dot,) = axes.plot(1e3 * row["time_frame"], row[quantity], shape, label=group)
            dot.set(ms=14 if shape == "*" else 5, alpha=1.0 if row["front"] else 0.4)
            dot.set_color(LINE_COLOURS[groups.index(group) % len(LINE_COLOURS)])
        axes.set(xscale="log", yscale="log", xlabel="time per frame [ms]", ylabel=quantity)
        named = dict(zip(*reversed(axes.get_legend_handles_labels())))
        axes.legend(named.values(), named.keys(), frameon=False, fontsize=8.5)
        out = io.BytesIO()
        figure.savefig(out, format="png", dpi=130, metadata={"Software": None})
    return out.getvalue()
