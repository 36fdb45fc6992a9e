"""The kernel study as files: a table, a page, plots, and pictures of the surfaces with their errors."""

from __future__ import annotations

import base64
import csv
import html
import io
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rbfmuscle.study.experiment.kernel_choice import named
from rbfmuscle.study.files.writer import json_text
from rbfmuscle.study.show.kernels.plots import draw_map, draw_sizes, draw_times
from rbfmuscle.study.show.kernels.surfaces import draw_surfaces
from rbfmuscle.study.show.page import STYLE
from rbfmuscle.validation import MissingPartError

if TYPE_CHECKING:
    from rbfmuscle.study.experiment.kernel_study import KernelStudy


COLUMNS = {
    "kernel": "kernel", "centres": "centres", "placement": "placement", "fit": "fit",
    "shape": "epsilon times spacing", "rms": "RMS",
    "low": "from", "high": "to",
    "hausdorff": "Hausdorff", "normal_error": "normals, degrees", "volume_error": "volume, %",
    "components": "sheets", "condition": "condition", "fit_time": "fit, ms",
    "solved": "solved by", "evaluation_time": "20,000 values, ms", "fits": "fits of the search",
    "search_time": "search, s", "numbers": "stored numbers", "decimated_rms": "mesh of that size, RMS",
    "note": "note",
}  # fmt: skip
SCALE = {"volume_error": 100.0, "fit_time": 1e3, "evaluation_time": 1e3}
# Columns of the runs through a motion.
MOTION = {
    "volume_error": "greatest volume error", "penetration_max": "deepest in a bone, {unit}",
    "bone_penetration_max": "deepest bone vertex, {unit}", "components": "most sheets",
    "condition": "greatest condition",
    "time_frame": "a frame, s", "apart_rms": "from the finest run, RMS {unit}", "apart_max": "greatest, {unit}",
    "error": "failed",
}  # fmt: skip
SIGNED = (
    "Above: the recommended surface from both sides, by its signed distance to the mesh, with its five worst places; "
    "below: how far others lie outside (+) or inside (&#8722;) the recommended one. One colour scale for all."
)

PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width,initial-scale=1">
<title>{title}</title><style>{style} tr.front td:first-child{{font-weight:650}} td.text{{text-align:left}}
.plots{{grid-template-columns:repeat(auto-fit,minmax(min(100%,460px),1fr))}} pre{{overflow-x:auto}}
td{{white-space:nowrap}} td.text{{min-width:19em;white-space:normal}}
@media(max-width:760px){{figure.big{{overflow-x:auto}}figure.big img{{width:860px;max-width:none}}}}</style>
</head><body><main><h1>{title}</h1>
<p class="sub">Each kernel with as many centres, its shape parameter chosen by the error at other points of the mesh</p>
<p>Recommended: <b>{best}</b>: {reason}.{others} Distances{units} are measured both ways between the mesh and the
extracted surface, with the interval that holds nine of ten other sets of points; rows whose intervals reach the
best one's are a tie, in which processor time decides;
normals by the field's gradient; the mesh in the last but one column was decimated to as many stored numbers. Kernels in
bold are on the front of error against time. A volume error is that of the level zero; a muscle's level is moved until
its volume is right.</p>
<h2>What each costs</h2>{fronts}
{pictures}{moved}{maps}
<h2>All of them</h2><div class="wide"><table><tr>{head}</tr>{body}</table></div>{unfit}
<h2>To paste</h2><pre>{toml}</pre>
</main></body></html>
"""


def write_study(
    study: KernelStudy,
    directory: str | Path,
    *,
    title: str = "Kernels",
    pictures: bool = True,
    moved: list[dict[str, Any]] | None = None,
) -> Exception | None:
    """Write ``kernels.csv``, ``kernels.json``, ``kernels.html`` and the plots it holds.

    Parameters
    ----------
    study : KernelStudy
    directory : path
    title : str
    pictures : bool
        Draw the best surfaces too.
    moved : list of dict, optional
        What runs through a scene's motion measured.

    Returns
    -------
    MissingPartError or None
        Where there are no graphics to draw with; everything else is written.
    """
    directory = Path(directory)
    directory.mkdir(parents=True, exist_ok=True)
    with (directory / "kernels.csv").open("w", newline="", encoding="utf-8") as file:
        names = [name for name in study.rows[0] if name != "worst"]
        writer = csv.DictWriter(file, fieldnames=names, extrasaction="ignore")
        writer.writeheader()
        writer.writerows(study.rows)
    facts = {"title": title, "units": study.units, "rows": study.rows, "scan": study.scan}
    (directory / "kernels.json").write_text(json_text(facts), encoding="utf-8")
    fronts = {
        "error against time": _save(directory / "error_time.png", draw_times, study),
        "error against stored numbers": _save(directory / "error_size.png", draw_sizes, study),
    }
    maps = {}
    if study.scan:
        for key in ("error", "condition"):
            name = f"{key} over the shape parameter"
            maps[name] = _save(directory / f"map_{key}.png", partial(draw_map, key=key), study)
    missing, drawn = None, None
    if pictures:
        try:
            drawn = draw_surfaces(study, directory)
        except MissingPartError as error:
            missing = error
    page = PAGE.format(
        title=html.escape(title), style=STYLE, **_advice(study),
        units=f" in {study.units}" if study.units else "", fronts=_beside(fronts),
        maps=f"<h2>Error and condition over the shape parameter</h2>{_beside(maps)}" if maps else "",
        pictures=_figure("Where it errs", drawn, SIGNED) + _worst(study), moved=_motion(moved or [], study.units),
        head="".join(f"<th>{html.escape(name)}</th>" for name in COLUMNS.values()),
        body="".join(_row(row) for row in study.rows if not row["unfit"]),
    )  # fmt: skip
    (directory / "kernels.html").write_text(page, encoding="utf-8")
    return missing


def _advice(study):
    """What the page says to take, and what not."""
    bad = [row for row in study.rows if row["unfit"]]
    items = "".join(f"<li>{html.escape(named(row))}: {html.escape(row['unfit'])}</li>" for row in bad)
    unfit = f"<h2>Unfit</h2><ul>{items}</ul>" if bad else ""
    found = study.recommended
    if found is None:
        return {"best": "none", "reason": "every field is unfit", "others": "", "toml": "", "unfit": unfit}
    others = ""
    if found.quickest is not None:
        others += f" For speed: {named(found.quickest)}, {found.quickest['rms']:.3g} RMS."
    if found.most_accurate is not None:
        others += f" The smallest figure: {named(found.most_accurate)}, {found.most_accurate['rms']:.3g} RMS."
    return {
        "best": html.escape(named(found.row)),
        "reason": html.escape(found.reason),
        "others": html.escape(others),
        "toml": html.escape(study.toml(found.row)),
        "unfit": unfit,
    }


def _save(path, draw, study):
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(layout="constrained")
    FigureCanvasAgg(figure)
    draw(study, figure)
    buffer = io.BytesIO()
    figure.savefig(buffer, dpi=110, format="png")
    path.write_bytes(buffer.getvalue())
    return buffer.getvalue()


def _inline(data):
    return f"data:image/png;base64,{base64.b64encode(data).decode()}"


def _beside(plots):
    """Plots beside each other where the page is wide enough, below each other where not."""
    each = (f'<figure><img alt="{name}" src="{_inline(data)}"></figure>' for name, data in plots.items())
    return f'<div class="plots">{"".join(each)}</div>'


def _figure(title, data, words=""):
    if data is None:
        return ""
    note = f'<p class="note">{words}</p>' if words else ""
    return f'<h2>{title}</h2>{note}<figure class="big"><img alt="{title}" src="{_inline(data)}"></figure>'


def _length(value, unit):
    return "" if value is None else f"{value:.3g}{unit}"


def _worst(study):
    """The recommended row's five worst places, with cause and remedy."""
    if study.recommended is None or not study.recommended.row["worst"]:
        return ""
    unit = f" {study.units}" if study.units else ""
    rows = "".join(
        f"<tr><td>{number}</td><td>{_length(place['distance'], unit)}</td><td>{_length(place['thickness'], unit)}</td>"
        f"<td>{_length(place['radius'], unit)}</td><td>{_length(place['spacing'], unit)}</td>"
        f"<td class=text>{html.escape(place['cause'])}</td><td class=text>{html.escape(place['remedy'])}</td></tr>"
        for number, place in enumerate(study.recommended.row["worst"], 1)
    )
    return (
        f"<h2>The five worst places of {html.escape(named(study.recommended.row))}</h2><div class=wide><table><tr>"
        "<th>place</th><th>distance</th><th>thickness</th><th>radius</th><th>centres apart</th><th>cause</th>"
        f"<th>what would mend it</th></tr>{rows}</table></div>"
    )


def _motion(moved, units):
    """A table of the runs through the motion."""
    if not moved:
        return ""
    names = list(dict.fromkeys(name for facts in moved for name in facts if name != "error"))
    names += ["error"] if any(facts.get("error") for facts in moved) else []
    words = {name: text.format(unit=units or "mesh units") for name, text in MOTION.items()}
    head = "".join(f"<th>{html.escape(words.get(name, name))}</th>" for name in names)
    body = "".join(
        "<tr>" + "".join(f"<td>{_cell(facts.get(name))}</td>" for name in names) + "</tr>" for facts in moved
    )
    return f"<h2>In motion</h2><div class=wide><table><tr>{head}</tr>{body}</table></div>"


def _cell(value):
    if isinstance(value, float):
        return f"{value:.3g}"
    return "" if value is None else html.escape(str(value))


def _row(row):
    cells = []
    for name in COLUMNS:
        value = row[name]
        if isinstance(value, float):
            value = f"{value * SCALE.get(name, 1.0):.3g}"
        kind = ' class="text"' if name == "note" else ""
        cells.append(f"<td{kind}>{'' if value is None else html.escape(str(value))}</td>")
    return f"<tr{' class=front' if row['front_time'] else ''}>{''.join(cells)}</tr>"
