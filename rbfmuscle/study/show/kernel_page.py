"""The kernel study as files: a table, a page, plots, and pictures of the surfaces with their errors."""

from __future__ import annotations

import base64
import csv
import html
import io
import math
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rbfmuscle.study.experiment.kernel_choice import named
from rbfmuscle.study.files.writer import json_text
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
# Surfaces whose difference to the recommended one is drawn.
DIFFERENCES = 4
SIGNED = (
    "Above: the recommended surface from both sides, by its signed distance to the mesh, with its five worst places; "
    "below: how far others lie outside (+) or inside (&#8722;) the recommended one. One colour scale for all."
)

PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width,initial-scale=1">
<title>{title}</title><style>{style} tr.front td:first-child{{font-weight:650}} td.text{{text-align:left}}
.plots{{grid-template-columns:1fr}} pre{{overflow-x:auto}}
td{{white-space:nowrap}} td.text{{min-width:19em;white-space:normal}}
@media(max-width:760px){{figure{{overflow-x:auto}}figure img{{width:860px;max-width:none}}}}</style>
</head><body><main><h1>{title}</h1>
<p class="sub">Each kernel with as many centres, its shape parameter chosen by the error at other points of the mesh</p>
<p>Recommended: <b>{best}</b>: {reason}.{others} Distances{units} are measured both ways between the mesh and the
extracted surface, with the interval that holds nine of ten other sets of points; rows whose intervals reach the
best one's are a tie, in which time decides;
normals by the field's gradient; the mesh in the last but one column was decimated to as many stored numbers. Kernels in
bold are on the front of error against time. A volume error is that of the level zero; a muscle's level is moved until
its volume is right.</p>
<h2>What each costs</h2><div class="plots"><figure><img alt="error against time and size" src="{fronts}"></figure>
</div>{pictures}{moved}{maps}
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
    fronts = _save(directory / "fronts.png", _draw_fronts, study)
    maps = _save(directory / "map.png", _draw_maps, study) if study.scan else None
    missing, drawn = None, None
    if pictures:
        try:
            drawn = _draw_surfaces(study, directory)
        except MissingPartError as error:
            missing = error
    page = PAGE.format(
        title=html.escape(title), style=STYLE, **_advice(study),
        units=f" in {study.units}" if study.units else "", fronts=_inline(fronts),
        maps=_figure("Error and condition over the shape parameter", maps),
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


def _figure(title, data, words=""):
    if data is None:
        return ""
    note = f'<p class="note">{words}</p>' if words else ""
    return f'<h2>{title}</h2>{note}<figure><img alt="{title}" src="{_inline(data)}"></figure>'


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


def _draw_fronts(study, figure):
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


def _draw_maps(study, figure):
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


def _draw_surfaces(study, directory):
    """Draw in a child process: VTK may end the process where no graphics exist."""
    found = study.recommended
    if found is None:
        return None
    from rbfmuscle.study.measure.mesh_distance import MeshDistance

    pairs = list(zip(study.rows, study.surfaces, strict=True))
    vertices, faces, error = next(surface for row, surface in pairs if row is found.row)
    unit = study.units or "mesh units"
    arrays = {
        "most": np.array(float(np.quantile(np.abs(error), 0.995))), "unit": np.array(unit), "v": vertices, "f": faces,
        "worst": np.array([place["point"] for place in found.row["worst"]]).reshape(-1, 3), "e0": error,
        "t0": np.array(f"{named(found.row)}, recommended: {found.row['rms']:.2g} {unit} RMS"),
    }  # fmt: skip
    others = [found.quickest, found.most_accurate, *(row for row, _ in pairs if not row["unfit"])]
    others = list({id(row): row for row in others if row is not None and row is not found.row}.values())[
        :DIFFERENCES
    ]
    for k, other in enumerate(others, 1):
        surface = next(surface for row, surface in pairs if row is other)
        away = MeshDistance(surface[0], surface[1], closed=False).signed(vertices)
        arrays |= {f"e{k}": -away, f"t{k}": np.array(f"{named(other)}: {other['rms']:.2g} {unit} RMS")}
    np.savez(directory / "surfaces.npz", **arrays)
    picture = directory / "surfaces.png"
    module = "rbfmuscle.study.show.kernel_page"
    command = [sys.executable, "-m", module, str(directory / "surfaces.npz"), str(picture)]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=600)
    if done.returncode != 0 or not picture.exists():
        words = [line.strip() for line in done.stderr.splitlines() if line.strip()]
        reason = words[-1][-160:] if words else f"the drawing process ended with code {done.returncode}"
        raise MissingPartError(
            f"no pictures: {reason}; drawing needs OpenGL (a display, or Mesa's libegl1 and libgl1)"
        )
    return picture.read_bytes()


def main(source: Any, target: Any) -> None:
    """The child's part."""
    import pyvista

    with np.load(source) as arrays:
        count = sum(name.startswith("e") for name in arrays.files)
        middle = arrays["v"].mean(axis=0)
        axes = np.linalg.svd(arrays["v"] - middle, full_matrices=False)[2]
        axes[2] *= np.sign(np.linalg.det(axes))
        shapes, columns = [(0, 1.0), (0, -1.0)] + [(k, 1.0) for k in range(1, count)], 2
        rows = -(-len(shapes) // columns)
        plotter = pyvista.Plotter(
            off_screen=True, shape=(rows, columns), border=False, window_size=(1040, 330 * rows)
        )
        for number, (k, side) in enumerate(shapes):
            plotter.subplot(number // columns, number % columns)
            turn = axes * np.array([[1.0], [side], [side]])
            mesh = pyvista.make_tri_mesh((arrays["v"] - middle) @ turn.T, arrays["f"])
            mesh["distance"] = arrays[f"e{k}"]
            most = float(arrays["most"])
            plotter.add_mesh(mesh, scalars="distance", cmap="PuOr_r", clim=(-most, most), smooth_shading=True,
                             show_scalar_bar=False)  # fmt: skip
            if number == 0:
                plotter.add_scalar_bar(title="", width=0.5, height=0.07, position_x=0.25,
                                       position_y=0.02, n_labels=3, fmt="%.2g", label_font_size=13,
                                       color="black")  # fmt: skip
            if k == 0 and len(arrays["worst"]):
                places = (arrays["worst"] - middle) @ turn.T
                seen = places[:, 2] >= np.median(mesh.points[:, 2]) - 0.25 * np.ptp(mesh.points[:, 2])
                labels = [str(n + 1) for n in np.flatnonzero(seen)]
                if labels:
                    plotter.add_point_labels(places[seen], labels, font_size=15, text_color="black", point_size=9,
                                             point_color="black", shape=None, render_points_as_spheres=True,
                                             always_visible=True)  # fmt: skip
            words = f"; colours in {arrays['unit']}" if number == 0 else ""
            plotter.add_text(f"{arrays[f't{k}']}{words}", font_size=9, color="black")
            plotter.set_background("white")
            plotter.view_xy()
            plotter.camera.zoom(1.25)
        plotter.screenshot(target)
        plotter.close()


if __name__ == "__main__":
    main(*sys.argv[1:])
