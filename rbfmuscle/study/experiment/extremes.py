"""Every kernel at the extremes: right within a bound, or a warning or an error that names cause and remedy.

A fit that is wrong and says nothing is the one outcome that must not occur; the table calls it "silent".
"""

from __future__ import annotations

import csv
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from rbfmuscle.implicit.extraction.surface import extract_surface
from rbfmuscle.implicit.field import RBFField
from rbfmuscle.implicit.kernels.table import KERNELS, get_kernel
from rbfmuscle.implicit.placement.off_surface import off_surface_points
from rbfmuscle.implicit.selection import spacing
from rbfmuscle.study.files.writer import json_text
from rbfmuscle.validation import NumericalWarning, RBFMuscleError

# Shape parameters, in units of 1 / (mean distance to the nearest centre).
SHAPES = (1e-3, 1e-2, 0.1, 1.0, 10.0, 1e3)
CENTRES = 200
COUNTS = (4, 10, 50, 1000)
# Centres of a fit to values on the surface and off it, three a point; with normals as many would be 16,000 unknowns.
MOST_VALUES = 4002
OF_VALUES = f"{MOST_VALUES} centres, of values"
HEADER = ("case", "kernel", "outcome", "error", "bound", "said")


def study_extremes(
    *, kernels: list[str] | None = None, progress: Callable[[int, int], None] | None = None
) -> list[dict[str, Any]]:
    """Fit an ellipsoid under every extreme with every kernel.

    Parameters
    ----------
    kernels : list of str, optional
        All by default.
    progress : callable, optional
        Called as ``progress(done, total)``.

    Returns
    -------
    list of dict
        ``case, kernel, outcome`` ("right", "warned", "refused" or "silent"), ``error`` (RMS distance of the surface at
        unseen points, as a share of the shortest half axis), ``bound``, ``said``.
    """
    kernels = [get_kernel(name) for name in (kernels or KERNELS)]
    cases = list(_cases())
    rows = []
    for kernel in kernels:
        shapes = SHAPES if kernel.has_epsilon else ()
        for shape in shapes:
            rows.append(_try(f"epsilon h = {shape:g}", kernel, _ellipsoid(CENTRES), shape, bound=0.1))
        for name, sample, bound in cases:
            rows.append(_try(name, kernel, sample, 0.1, bound=bound))
        if progress is not None:
            progress(len(rows), len(kernels) * (len(SHAPES) + len(cases)))
    return rows


def _ellipsoid(count, *, size=1.0, shift=0.0, noise=0.0, seed=0):
    """Points and normals on a spiral over an ellipsoid of half axes 3, 2 and 1, and a judge of fields."""
    half = np.array([3.0, 2.0, 1.0])
    points, normals = _spiral(count, half)
    rng = np.random.default_rng(seed)
    normals = normals + noise * rng.normal(size=normals.shape)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    unseen, true = _spiral(997, half)

    def judge(field):
        value, gradient = field.value_and_gradient(unseen * size + shift)
        slope = np.einsum("ij,ij->i", gradient, true)
        # Where the field does not rise outwards there is no surface, or it is inside out.
        off = np.where(slope > 0.2, np.abs(value) / np.maximum(slope, 0.2), size)
        return float(np.sqrt((np.minimum(off, size) ** 2).mean()) / size)

    return points * size + shift, normals, judge


def _spiral(count, half):
    i = np.arange(count) + 0.5
    z = 1 - 2 * i / count
    angle, ring = np.pi * (1 + 5**0.5) * i, np.sqrt(1 - z * z)
    unit = np.column_stack([ring * np.cos(angle), ring * np.sin(angle), z])
    normals = unit / half
    return unit * half, normals / np.linalg.norm(normals, axis=1, keepdims=True)


def _cases():
    """Name, (points, normals, judge), bound of the error."""
    for size in (1e-6, 1e-3, 1e3, 1e6):
        yield f"coordinates of {size:g}", _ellipsoid(CENTRES, size=size), 0.1
    yield "1e6 from the origin", _ellipsoid(CENTRES, shift=1e6), 0.1
    for count in COUNTS:
        yield f"{count} centres", _ellipsoid(count), {4: 1.0, 10: 1.0, 50: 0.5}.get(count, 0.05)
    yield OF_VALUES, _ellipsoid(MOST_VALUES // 3), 0.05
    for noise in (0.01, 0.1):
        yield f"{100 * noise:g} % noise on normals", _ellipsoid(CENTRES, noise=noise), 0.1
    points, normals, judge = _ellipsoid(CENTRES)
    yield "single precision", (points.astype(np.float32), normals.astype(np.float32), judge), 0.1
    near = points.copy()
    near[10] = near[20] + [1e-12, 0.0, 0.0]
    yield "two centres 1e-12 apart", (near, normals, judge), 0.1
    yield (
        "two centres in one place",
        (np.vstack([points, points[:1]]), np.vstack([normals, normals[:1]]), judge),
        0.1,
    )
    yield "thin plate, 0.1 of 50", _plate(), 0.2
    up = np.tile([0.0, 0.0, 1.0], (25, 1))
    grid = np.stack(np.meshgrid(np.arange(5.0), np.arange(5.0), [0.0]), axis=-1).reshape(-1, 3)
    yield "coplanar centres", (grid, up, _flat_judge(grid)), 0.1
    line = np.arange(25.0)[:, None] * [1.0, 0.0, 0.0]
    yield "collinear centres", (line, up, _flat_judge(line)), 0.1


def _plate():
    axis = np.linspace(0.0, 50.0, 12)
    side = np.stack(np.meshgrid(axis, axis, [0.0]), axis=-1).reshape(-1, 3)
    points = np.vstack([side, side + [0.0, 0.0, 0.1]])
    normals = np.repeat([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]], len(side), axis=0)

    def judge(field):
        between = 0.5 * (side[:-1] + side[1:]) + [0.0, 0.0, 0.05]
        wrong = (
            (field(between) >= 0) | (field(between + [0, 0, 0.2]) <= 0) | (field(between - [0, 0, 0.2]) <= 0)
        )
        return float(wrong.mean())

    return points, normals, judge


def _flat_judge(points):
    def judge(field):
        between = 0.5 * (points[:-1] + points[1:])
        up, down = field(between + [0.0, 0.0, 0.2]), field(between - [0.0, 0.0, 0.2])
        return float(((up <= 0) | (down >= 0)).mean())

    return judge


def _try(case, kernel, sample, shape, *, bound):
    points, normals, judge = sample
    row = dict.fromkeys(HEADER, "") | {"case": case, "kernel": kernel.name, "error": None, "bound": bound}
    with warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always", NumericalWarning)
        try:
            apart = spacing(np.unique(np.asarray(points, dtype=float), axis=0)).mean()
            if case == OF_VALUES:
                values = off_surface_points(points, normals)
                field = RBFField.fit(*values, kernel=kernel, epsilon=shape / apart)
            else:
                field = RBFField.fit_surface(points, normals, kernel=kernel, epsilon=shape / apart)
            row["error"] = judge(field)
        except (RBFMuscleError, ValueError, np.linalg.LinAlgError) as error:
            row["outcome"], row["said"] = "refused", " ".join(str(error).split())
            return row
    row["said"] = "; ".join(dict.fromkeys(str(w.message) for w in heard))
    if heard:
        row["outcome"] = "warned"
    elif row["error"] <= bound:
        row["outcome"] = "right"
    else:
        row["outcome"], row["said"] = _look(field, points)
    return row


def _look(field, points):
    """What showing the surface says of a field that is off between its centres: sheets, an open or empty level set."""
    try:
        found = extract_surface(field, points=np.asarray(points, dtype=float), resolution=32, search="box")
    except ValueError as error:
        return "refused", f"when shown: {' '.join(str(error).split())}"
    if found.components > 1:
        return "warned", f"when shown: {found.components} sheets, {found.spurious} of them spurious"
    return "silent", ""


def write_extremes(rows: list[dict[str, Any]], directory: Path) -> None:
    """Write ``extremes.csv``, ``extremes.json`` and the matrix ``extremes.md`` of cases and kernels."""
    directory = Path(directory)
    directory.mkdir(parents=True, exist_ok=True)
    with (directory / "extremes.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, fieldnames=HEADER)
        writer.writeheader()
        writer.writerows(rows)
    (directory / "extremes.json").write_text(json_text(rows), encoding="utf-8")
    (directory / "extremes.md").write_text(extremes_matrix(rows), encoding="utf-8")


def extremes_matrix(rows: list[dict[str, Any]]) -> str:
    """A table in Markdown: how many kernels are right, warned of, refused, or silent in each case, and which."""
    lines = [
        "| case | right | warned | refused | silent | worst error of the right |",
        "|---|---|---|---|---|---|",
    ]
    for case in dict.fromkeys(row["case"] for row in rows):
        found = [row for row in rows if row["case"] == case]
        count = {
            name: [r for r in found if r["outcome"] == name]
            for name in ("right", "warned", "refused", "silent")
        }
        worst = max((r["error"] for r in count["right"]), default=None)
        silent = ", ".join(r["kernel"] for r in count["silent"]) or "0"
        shown = "" if worst is None else f"{worst:.2g}"
        counts = " | ".join(str(len(count[name])) for name in ("right", "warned", "refused"))
        lines.append(f"| {case} | {counts} | {silent} | {shown} |")
    return "\n".join(lines) + "\n"
