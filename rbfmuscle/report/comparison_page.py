"""The report of a comparison: pictures side by side, distance maps, plots, table; one HTML file."""

from __future__ import annotations

import html
import math
from pathlib import Path
from typing import Any

from rbfmuscle.experiments.comparison import COST, FIRST, LAW, MEASURES, MESH, OWN, best_models
from rbfmuscle.metrics.quantities import ALL
from rbfmuscle.output.saved import SavedRun
from rbfmuscle.report.appearance import line_colours
from rbfmuscle.report.comparison_plots import plot_models
from rbfmuscle.report.page import STYLE, embedded_image
from rbfmuscle.report.render import chosen_frames, draw_pictures
from rbfmuscle.validation import SolveError

_VIEWS = ["front", "back"]
_MODULE = "rbfmuscle.report.comparison_pictures"
# Of all panels beside each other, and the least and greatest of one [pixel].
_WIDTH, _LEAST, _MOST = 1560, 220, 420
# Distance maps: from the greatest distance of the models down to what leaves the map its colours.
_MAP_SHARE = 0.25
GROUPS = {
    LAW: "Against laws",
    MESH: "Against the input mesh",
    OWN: "Of each run itself",
    FIRST: "Against the first model",
    COST: "What it costs",
}
PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width,initial-scale=1">
<title>{title}</title><style>{style}
td.best{{font-weight:700;color:#1f6138;background:#e9f4ec}}tr.group th{{background:#f4f2ed;text-align:left}}
</style></head><body><main>
<h1>{title}</h1><p class="sub">Comparison of muscle models</p>
{failed}<div class="facts">{facts}</div>
<h2>In short</h2>{verdicts}
<h2>Side by side</h2>{pictures}
<h2>Distance to {first}</h2>{maps}
<h2>Table</h2><p class="note">Worst over muscles and frames, unless a row says otherwise. Green: the best model,
and those within 5 % of it or nearer than what counts. Each row belongs to the reference above it.</p>
<div class="wide">{table}</div>
<h2>Between the models</h2><p class="note">Distance of each pair of models in the last pose, root mean square over
all muscles [{units}].</p><div class="wide">{matrix}</div>
<h2>Over the motion</h2><p class="legend">{legend}</p><div class="plots">{plots}</div>
<h2>How to read this</h2>{explanation}<dl>{measures}</dl>
<footer>{footer}</footer></main></body></html>
"""
EXPLANATION = """<p>All models ran through the same frames and sub-steps of the same scene, one after another in one
process, with the same bone fields, contact margin and number of threads, each after a warm-up that loads and
compiles. <b>The time a frame</b> is the wall time of prediction, solution, contacts, tunnelling test and surface of
all muscles; metrics, files and pictures are outside. Where muscles run side by side the sums over muscles exceed
it. Mesh models show the mesh that they carry, so their surface costs nothing; the RBF model fits a field and
extracts its zero level set. <b>Strain</b> is that of the same material points for all models, so a finer mesh does not
count as better or worse. <b>Curvature variation</b> is high where a surface is creased or lumpy. The
<b>distance to the first model</b> is no error: it says how far models differ, not which is right.</p>"""


def write_page(folder: Path, table: dict[str, Any], *, pictures: bool = True) -> Exception | None:
    """Write ``report.html`` and ``models.webp``.

    Parameters
    ----------
    folder : pathlib.Path
        With a run of each model.
    table : dict
        From `rbfmuscle.experiments.comparison.write_tables`.
    pictures : bool

    Returns
    -------
    MissingPartError or None
        Why there are no pictures, where drawing failed. The report is written all the same.

    Raises
    ------
    SolveError
        If the report cannot be written.
    """
    images, missing = draw_pictures(
        folder, lambda work: _jobs(table, folder, work) if pictures else [], module=_MODULE
    )
    moving = folder / "models.webp"
    try:
        page = _page(folder, table, images, moving.read_bytes() if moving.is_file() else None, missing)
        (folder / "report.html").write_text(page, encoding="utf-8")
    except OSError as error:
        raise SolveError(f"cannot write the report: {error.strerror}") from None
    return missing


def _jobs(table, folder, work):
    models, poses = table["models"], table["poses"]
    wide = min(_MOST, max(_LEAST, _WIDTH // len(models)))
    size = (wide, int(1.15 * wide))
    job = {"models": models, "views": _VIEWS, "size": size}
    jobs = [{**job, "file": str(work / f"pose_{k:06d}.png"), "frames": [k]} for k in poses]
    if len(models) > 1:
        others = {**job, "models": models[1:], "reference": models[0], "limit": map_limit(table)}
        jobs += [
            {**others, "file": str(work / f"map_{k:06d}.png"), "frames": [k]} for k in poses[1:] or poses
        ]
    if table["frames"] > 1:
        moving = {**job, "views": _VIEWS[:1], "file": str((folder / "models.webp").resolve())}
        jobs.append({**moving, "frames": chosen_frames(SavedRun(folder / models[0]).frames)})
    return jobs


def map_limit(table: dict[str, Any]) -> float:
    """Distance at which the maps' colours end: one, two or five times a power of ten."""
    greatest = max(found[ALL].get("distance_max", 0.0) for found in table["results"].values())
    wanted = max(_MAP_SHARE * greatest, 1e-12)
    power = 10.0 ** math.floor(math.log10(wanted))
    return next(step * power for step in (1, 2, 5, 10) if step * power >= wanted * 0.999)


def _page(folder, table, images, moving, missing):
    runs = {name: SavedRun(folder / name) for name in table["models"]}
    poses = [embedded_image(data, "png", name) for name, data in images.items() if name.startswith("pose")]
    maps = [embedded_image(data, "png", name) for name, data in images.items() if name.startswith("map")]
    if moving is not None:
        poses.insert(0, embedded_image(moving, "webp", "the motion, models beside each other"))
    nothing = f'<p class="note">There are no pictures: {html.escape(str(missing or "switched off"))}.</p>'
    return PAGE.format(
        style=STYLE,
        title=html.escape(table["scene"]),
        first=html.escape(table["models"][0]),
        units=table["units"],
        failed=_failed(table),
        facts=_facts(table),
        verdicts=_verdicts(table),
        pictures="".join(f"<figure>{item}</figure>" for item in poses) or nothing,
        maps="".join(f"<figure>{item}</figure>" for item in maps) or nothing,
        table=_table(table),
        matrix=_matrix(table),
        legend="".join(
            f'<span><i style="background:{colour}"></i>{html.escape(name)}</span>'
            for name, colour in line_colours(table["models"]).items()
        ),
        plots="".join(
            f"<figure>{embedded_image(svg, 'svg+xml', title)}</figure>" for title, svg in plot_models(runs)
        ),
        explanation=EXPLANATION,
        measures="".join(
            f"<dt>{html.escape(m.title)}</dt><dd>{html.escape(m.meaning)}</dd>" for m in MEASURES.values()
        ),
        footer=html.escape(", ".join(f"{name} {value}" for name, value in table["versions"].items())),
    )


def _failed(table):
    return "".join(
        f'<p class="bad">{html.escape(name)} did not finish: {html.escape(reason)}</p>'
        for name, reason in table["failed"].items()
    )


def _facts(table):
    machine = table["machine"]
    facts = [
        ("models", len(table["models"])),
        ("muscles", len(next(iter(table["results"].values()))) - 1),
        ("frames", table["frames"]),
        ("cores", machine["cores"]),
        ("threads", machine["threads"]),
    ]
    return "".join(f"<div><b>{html.escape(str(value))}</b><span>{name}</span></div>" for name, value in facts)


def _verdicts(table):
    rows = []
    for name, found in table["verdicts"].items():
        best = ", ".join(MEASURES[quantity].title for quantity in found["best"])
        loses = "; ".join(
            f"{MEASURES[e['quantity']].title} {cell(table, e['quantity'], e['value'])} against "
            f"{cell(table, e['quantity'], e['other_value'])} ({html.escape(e['other'])})"
            for e in found["loses"]
        )
        rows.append(
            f"<p><b>{html.escape(name)}</b> alone is best in: {best or 'nothing'}. Another is better in: "
            f"{loses or 'nothing'}.</p>"
        )
    return "".join(rows)


def _table(table):
    models = table["models"]
    head = "".join(f"<th>{html.escape(name)}</th>" for name in models)
    rows, group = [], None
    for quantity, measure in MEASURES.items():
        values = [table["results"][name][ALL].get(quantity) for name in models]
        if all(value is None for value in values):
            continue
        if measure.against != group:
            group = measure.against
            rows.append(f'<tr class="group"><th colspan="{len(models) + 1}">{GROUPS[group]}</th></tr>')
        good = best_models(table["results"], quantity, table["units"])
        good = [] if len(good) == len(models) else good
        cells = "".join(
            f"<td{' class=best' if name in good else ''}>{cell(table, quantity, value)}</td>"
            for name, value in zip(models, values)
        )
        rows.append(f"<tr><th>{html.escape(measure.title)}</th>{cells}</tr>")
    return f"<table><tr><th></th>{head}</tr>{''.join(rows)}</table>"


def cell(table: dict[str, Any], quantity: str, value: float | None) -> str:
    """A value with its unit, as people read it."""
    if value is None:
        return "-"
    unit = table["measures"][quantity]["unit"]
    if unit == "s":
        return f"{value:.3g} s" if value >= 1.0 else f"{1000 * value:.3g} ms"
    if quantity in ("volume_error", "strain_rms"):
        return f"{100 * value:.2g} %"
    if MEASURES[quantity].kind == "length" and abs(value) < 0.5 * MEASURES[quantity].floor:
        value = 0.0
    return f"{value:.3g}" if unit == "1" else f"{value:.3g} <small>{html.escape(unit)}</small>"


def _matrix(table):
    models = table["models"]
    head = "".join(f"<th>{html.escape(name)}</th>" for name in models)
    rows = "".join(
        f"<tr><th>{html.escape(name)}</th>"
        + "".join(f"<td>{'' if i == j else format(value, '.3g')}</td>" for j, value in enumerate(line))
        + "</tr>"
        for i, (name, line) in enumerate(zip(models, table["distances"]))
    )
    return f"<table><tr><th></th>{head}</tr>{rows}</table>"
