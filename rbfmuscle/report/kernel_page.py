"""The kernel study as files: a table, a page with a plot, and the recommended surface with its error."""

from __future__ import annotations

import base64
import csv
import html
import io
from pathlib import Path
from typing import TYPE_CHECKING

from rbfmuscle.experiments.kernel_study import cost, row_name, row_toml
from rbfmuscle.metrics.mesh_distance import MeshDistance
from rbfmuscle.output.vtp import write_vtp
from rbfmuscle.output.writer import json_text
from rbfmuscle.report.page import STYLE

if TYPE_CHECKING:
    from rbfmuscle.experiments.kernel_study import KernelStudy

COLUMNS = {
    "kernel": "kernel", "centres": "centres", "placement": "placement", "shape": "epsilon times spacing",
    "rms": "RMS", "hausdorff": "Hausdorff", "normal_error": "normals, degrees", "volume_error": "volume, %",
    "components": "sheets", "condition": "condition", "fit_time": "fit, ms",
    "evaluation_time": "20,000 values, ms", "note": "note",
}  # fmt: skip
SCALE = {"volume_error": 100.0, "fit_time": 1e3, "evaluation_time": 1e3}

PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width,initial-scale=1">
<title>{title}</title><style>{style} tr.front td:first-child{{font-weight:650}} td.text{{text-align:left}}
pre{{overflow-x:auto}} td{{white-space:nowrap}} td.text{{min-width:19em;white-space:normal}}</style>
</head><body><main><h1>{title}</h1>
<p class="sub">Each kernel with as many centres, its shape parameter chosen by the error at other points of the mesh</p>
<p>Recommended: <b>{best}</b>, the quickest of those within 5 % of the least error. Distances{units} are measured both
ways between the mesh and the extracted surface, normals by the field's gradient. Kernels in bold are on the Pareto
front of error against time. A volume error is that of the level zero; a muscle's level is moved until its volume is
right.</p>
<figure><img alt="error against time" src="data:image/png;base64,{plot}"></figure>
<h2>All of them</h2><div class="wide"><table><tr>{head}</tr>{body}</table></div>{unfit}
<h2>To paste</h2><pre>{toml}</pre>
</main></body></html>
"""


def write_study(
    study: KernelStudy, directory: str | Path, *, title: str = "Kernels", mesh: MeshDistance | None = None
) -> None:
    """Write ``kernels.csv``, ``kernels.json``, ``kernels.html``, and the recommended surface.

    Parameters
    ----------
    study : KernelStudy
    directory : path
    title : str
    mesh : MeshDistance, optional
        With it ``recommended.vtp`` holds each vertex's distance from the mesh, positive outside.
    """
    directory = Path(directory)
    directory.mkdir(parents=True, exist_ok=True)
    with (directory / "kernels.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, fieldnames=list(study.rows[0]))
        writer.writeheader()
        writer.writerows(study.rows)
    facts = {"title": title, "units": study.units, "rows": study.rows}
    (directory / "kernels.json").write_text(json_text(facts), encoding="utf-8")
    best = study.recommended
    if best is not None and mesh is not None:
        surfaces = dict(zip(map(row_name, study.rows), study.surfaces, strict=True))
        surface = surfaces[row_name(best)]
        if surface is not None:
            values = {"distance": mesh.signed(surface[0])}
            write_vtp(directory / "recommended.vtp", *surface, values=values)
    bad = "".join(
        f"<li>{html.escape(row_name(row))}: {html.escape(row['unfit'])}</li>"
        for row in study.rows
        if row["unfit"]
    )
    page = PAGE.format(
        title=html.escape(title), style=STYLE, plot=base64.b64encode(_plot(study)).decode(),
        best=html.escape(row_name(best)) if best else "none, every field is unfit",
        toml=html.escape(row_toml(best)) if best else "", unfit=f"<h2>Unfit</h2><ul>{bad}</ul>" if bad else "",
        units=f" in {html.escape(study.units)}" if study.units else "",
        head="".join(f"<th>{html.escape(name)}</th>" for name in COLUMNS.values()),
        body="".join(_row(row) for row in study.rows if not row["unfit"]),
    )  # fmt: skip
    (directory / "kernels.html").write_text(page, encoding="utf-8")


def _plot(study: KernelStudy) -> bytes:
    """Error against the time of a fit and 20,000 values, the front named, as a PNG."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.0, 5.0), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    good = [row for row in study.rows if not row["unfit"]]
    for count in sorted({row["centres"] for row in good}):
        rows = [row for row in good if row["centres"] == count]
        axes.plot([1e3 * cost(r) for r in rows], [r["rms"] for r in rows], "o", ms=5, alpha=0.6,
                  label=f"{count} centres")  # fmt: skip
    front = sorted((1e3 * cost(row), row["rms"], row["kernel"]) for row in good if row["front"])
    axes.plot(
        [point[0] for point in front], [point[1] for point in front], "-", color="0.3", lw=1.0, zorder=0
    )
    for x, y, name in front:
        axes.annotate(name, (x, y), xytext=(6, 3), textcoords="offset points", fontsize=9)
    if good:
        axes.set_xscale("log")
        axes.set_yscale("log")
        axes.legend(fontsize=9)
    axes.set_xlabel("fit and 20,000 values [ms of one thread]")
    axes.set_ylabel(f"RMS error [{study.units or 'mesh units'}]")
    buffer = io.BytesIO()
    figure.savefig(buffer, dpi=110, format="png")
    return buffer.getvalue()


def _row(row: dict) -> str:
    cells = []
    for name in COLUMNS:
        value = row[name]
        if isinstance(value, float):
            value = f"{value * SCALE.get(name, 1.0):.3g}"
        kind = ' class="text"' if name == "note" else ""
        cells.append(f"<td{kind}>{'' if value is None else html.escape(str(value))}</td>")
    return f"<tr{' class=front' if row['front'] else ''}>{''.join(cells)}</tr>"
