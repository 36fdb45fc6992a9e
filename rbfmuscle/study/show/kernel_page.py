"""The kernel study as files: a table, a page, plots, and pictures of the surfaces with their errors."""

from __future__ import annotations

import base64
import csv
import html
import io
import json
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rbfmuscle.study.experiment.kernel_choice import named
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
# Surfaces that are drawn.
PICTURES = 6

PAGE = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width,initial-scale=1">
<title>{title}</title><style>{style} tr.front td:first-child{{font-weight:650}} td.text{{text-align:left}}</style>
</head><body><main><h1>{title}</h1>
<p class="sub">Each kernel with as many centres, its shape parameter chosen by the error at other points of the mesh</p>
<p>Recommended: <b>{best}</b>: {reason}.{others} Distances{units} are measured both ways between the mesh and the
extracted surface, with the interval that holds nine of ten other sets of points; rows whose intervals reach the
best one's are a tie, in which time decides;
normals by the field's gradient; the mesh in the last but one column was decimated to as many stored numbers. Kernels in
bold are on the front of error against time. A volume error is that of the level zero; a muscle's level is moved until
its volume is right.</p>
<h2>What each costs</h2><div class="plots"><figure><img alt="error against time and size" src="{fronts}"></figure>
</div>{maps}{pictures}
<h2>All of them</h2><div class="wide"><table><tr>{head}</tr>{body}</table></div>{unfit}
<h2>To paste</h2><pre>{toml}</pre>
</main></body></html>
"""


def write_study(
    study: KernelStudy, directory: str | Path, *, title: str = "Kernels", pictures: bool = True
) -> Exception | None:
    """Write ``kernels.csv``, ``kernels.json``, ``kernels.html`` and the plots it holds.

    Parameters
    ----------
    study : KernelStudy
    directory : path
    title : str
    pictures : bool
        Draw the best surfaces too.

    Returns
    -------
    MissingPartError or None
        Where there are no graphics to draw with; everything else is written.
    """
    directory = Path(directory)
    directory.mkdir(parents=True, exist_ok=True)
    with (directory / "kernels.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, fieldnames=list(study.rows[0]))
        writer.writeheader()
        writer.writerows(study.rows)
    facts = {"title": title, "units": study.units, "rows": study.rows, "scan": study.scan}
    (directory / "kernels.json").write_text(json.dumps(facts, indent=1), encoding="utf-8")
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
        pictures=_figure("The best surfaces, coloured by their distance to the mesh", drawn),
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


def _figure(title, data):
    if data is None:
        return ""
    return f'<h2>{title}</h2><figure><img alt="{title}" src="{_inline(data)}"></figure>'


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
    left, right = figure.subplots(1, 2, sharey=True)
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
        for x, y, name in best:
            axes.annotate(name, (x, y), fontsize=7.5, xytext=(4, 4), textcoords="offset points")
        axes.set_xscale("log")
        axes.set_yscale("log")
    sizes = sorted((n, d["rms"]) for n, d in study.decimated.items())
    right.plot(
        [s[0] for s in sizes], [s[1] for s in sizes], "s--", color="#a63d38", ms=4, label="decimated mesh"
    )
    left.set(xlabel="fit and 20,000 values [ms]", ylabel=f"RMS error [{study.units or 'mesh units'}]")
    right.set_xlabel("stored numbers")
    right.legend(fontsize=8)


def _draw_maps(study, figure):
    """What the search tried: one row a kernel, each trial a cell that reaches half-way to the next."""
    count = max(row["centres"] for row in study.scan)
    rows = [row for row in study.scan if row["centres"] == count]
    names = list(dict.fromkeys(row["kernel"] for row in rows))
    figure.set_size_inches(11, 1.6 + 0.26 * len(names))
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
    chosen = [
        (row, surface)
        for row, surface in zip(study.rows, study.surfaces, strict=True)
        if surface is not None and not row["unfit"]
    ][:PICTURES]
    if not chosen:
        return None
    arrays = {"most": np.array(max(float(np.quantile(s[2], 0.995)) for _, s in chosen))}
    for k, (row, (vertices, faces, error)) in enumerate(chosen):
        text = f"{named(row)}: {row['rms']:.2g} RMS, {row['hausdorff']:.2g} greatest"
        arrays |= {f"v{k}": vertices, f"f{k}": faces, f"e{k}": error, f"t{k}": np.array(text)}
    np.savez(directory / "surfaces.npz", **arrays)
    picture = directory / "surfaces.png"
    command = [
        sys.executable,
        "-m",
        "rbfmuscle.study.show.kernel_page",
        str(directory / "surfaces.npz"),
        str(picture),
    ]
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
        count = sum(name.startswith("v") for name in arrays.files)
        columns = min(3, count)
        rows = -(-count // columns)
        plotter = pyvista.Plotter(off_screen=True, shape=(rows, columns), border=False,
                                  window_size=(420 * columns, 460 * rows))  # fmt: skip
        for k in range(count):
            plotter.subplot(k // columns, k % columns)
            mesh = pyvista.make_tri_mesh(arrays[f"v{k}"], arrays[f"f{k}"])
            mesh["distance"] = arrays[f"e{k}"]
            plotter.add_mesh(mesh, scalars="distance", cmap="viridis", clim=(0.0, float(arrays["most"])),
                             smooth_shading=True, show_scalar_bar=k == 0)  # fmt: skip
            plotter.add_text(str(arrays[f"t{k}"]), font_size=7, color="black")
            plotter.set_background("white")
            plotter.view_xz()
        plotter.screenshot(target)
        plotter.close()


if __name__ == "__main__":
    main(*sys.argv[1:])
