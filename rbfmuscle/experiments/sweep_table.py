"""The tables of a sweep, its Pareto front with the default's place, and scenes that lie apart from the others."""

from __future__ import annotations

import csv
import math
import os
from collections import defaultdict
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from rbfmuscle.experiments.sweep import SweepPoint
from rbfmuscle.experiments.sweep_run import VALUES, SweepFolder
from rbfmuscle.output.writer import write_json

# The default may be this much worse than the front, in error and in time at once.
NEAR = 1.1
FACTS = ("count", "min", "max", "mean", "median", "last", "worst", "worst_frame")
# A scene lies apart where its mean is so many robust standard deviations (1.4826 times the median absolute deviation)
# from the median of at least so many scenes (Iglewicz and Hoaglin 1993). The deviation counts as no less than a share
# of the median.
APART, LEAST_SCENES, LEAST_SHARE = 3.5, 5, 0.005


def sweep_rows(
    points: Sequence[SweepPoint], folder: SweepFolder, units: Mapping[str, str]
) -> list[dict[str, Any]]:
    """One dict a point: scene, its units, role, status, settings, values, threads, error; NaN where unknown."""
    rows = []
    for point in points:
        result = folder.read(point.key)
        values = result.get("values", {})
        rows.append(
            {
                "scene": point.scene,
                "units": units[point.scene],
                "role": point.role,
                "status": result.get("status", "missing"),
                "front": False,
                "settings": point.settings,
                **{name: math.nan if values.get(name) is None else values[name] for name in VALUES},
                **{name: result.get(name, "") for name in ("seconds", "threads", "machine", "error")},
                "label": point.label,
                "model": point.model,
                "reference": point.reference,
                "key": point.key,
            }
        )
    return rows


def pareto_front(errors: Sequence[float], times: Sequence[float]) -> list[int]:
    """Indices of the points that no other beats in one of error and time without losing in the other.

    Parameters
    ----------
    errors, times : sequence of float
        NaN takes no part.

    Returns
    -------
    list of int
        By growing time.
    """
    front, least = [], math.inf
    for k in sorted(range(len(errors)), key=lambda k: (times[k], errors[k])):
        if math.isfinite(errors[k]) and math.isfinite(times[k]) and errors[k] < least:
            front.append(k)
            least = errors[k]
    return front


def mark_front(rows: list[dict[str, Any]], quantity: str = "error_rms") -> list[dict[str, Any]]:
    """Mark the front among the points of each reference, and judge the default of each against ``time_frame``.

    References take no part: their error is zero by definition.

    Returns
    -------
    list of dict
        ``factor``: the least by which both error and time of the default must fall to lie on the front, 1 on it;
        ``near``: up to `NEAR`; ``faster``, ``better``: labels of the quickest point of no greater error and the most
        accurate of no greater time, None where there is none; ``text``: all of it in words.
    """
    verdicts = []
    for group in dict.fromkeys(row["reference"] for row in rows if row["reference"]):
        usable = [
            row
            for row in rows
            if row["reference"] == group and row["status"] == "done" and row["role"] != "reference"
        ]
        for k in pareto_front([r[quantity] for r in usable], [r["time_frame"] for r in usable]):
            usable[k]["front"] = True
        verdicts += [_judge(row, usable, quantity) for row in usable if row["role"] == "default"]
    return verdicts


def _judge(default, rows, quantity):
    error, time = default[quantity], default["time_frame"]
    others = [r for r in rows if r is not default and math.isfinite(r[quantity])]
    factor = max([1.0, *(min(_ratio(error, r[quantity]), _ratio(time, r["time_frame"])) for r in others)])
    quicker = [r for r in others if r[quantity] <= error and r["time_frame"] < time]
    finer = [r for r in others if r["time_frame"] <= time and r[quantity] < error]
    faster = min(quicker, key=lambda r: r["time_frame"], default=None)
    better = min(finer, key=lambda r: r[quantity], default=None)
    what = f"default of {default['model']}" if default["model"] else "default"
    where = "on" if default["front"] else f"{'within 10 % of' if factor <= NEAR else 'off'}"
    figures = f"{_figures(default, quantity)}, factor {factor:.2f}"
    text = f"{default['scene']}: the {what} lies {where} the front ({figures})."
    for row, words in ((faster, "Quicker at no greater error"), (better, "Better in no more time")):
        text += f" {words}: {row['label']} ({_figures(row, quantity)})." if row else ""
    labels = {"faster": faster and faster["label"], "better": better and better["label"]}
    return {"scene": default["scene"], "factor": factor, "near": factor <= NEAR, **labels, "text": text}


def _ratio(mine, other):
    return mine / other if other > 0 else (math.inf if mine > 0 else 1.0)


def _figures(row, quantity):
    return f"{row[quantity]:.3g} at {1e3 * row['time_frame']:.3g} ms a frame"


def outliers(values: Sequence[tuple[str, str, str, float]]) -> list[dict[str, Any]]:
    """Values (scene, muscle, quantity, value) far from the median of their muscle and quantity, the farthest first."""
    groups = defaultdict(list)
    for scene, muscle, quantity, value in values:
        groups[muscle, quantity].append((scene, value))
    found = []
    for (muscle, quantity), group in groups.items():
        sound = np.array([value for _, value in group if math.isfinite(value)])
        if len(sound) < LEAST_SCENES:
            continue
        median = float(np.median(sound))
        spread = max(1.4826 * float(np.median(np.abs(sound - median))), LEAST_SHARE * abs(median), 1e-12)
        for scene, value in group:
            apart = abs(value - median) / spread
            if not apart <= APART:
                row = {"scene": scene, "muscle": muscle, "quantity": quantity, "value": value}
                found.append({**row, "median": median, "apart": apart if math.isfinite(apart) else math.inf})
    return sorted(found, key=lambda row: -row["apart"])


def write_table(
    points: Sequence[SweepPoint],
    directory: str | Path,
    units: Mapping[str, str],
    *,
    quantity: str = "error_rms",
) -> dict[str, Any]:
    """Write ``sweep.csv`` (a line a point), ``quantities.csv`` (a line a muscle and quantity) and ``sweep.json``.

    Returns
    -------
    dict
        What ``sweep.json`` holds: counts, ``verdicts``, ``outliers`` among scenes in their own settings, ``rows``.
    """
    folder = SweepFolder(directory)
    rows = sweep_rows(points, folder, units)
    verdicts = mark_front(rows, quantity)
    own, long = [], []
    for point in points:
        for muscle, found in folder.read(point.key).get("muscles", {}).items():
            for name, facts in found.items():
                long.append([point.scene, point.label, muscle, name, facts["unit"], *map(facts.get, FACTS)])
                if point.role == "default" and not name.startswith("time") and facts.get("mean") is not None:
                    own.append((point.scene, muscle, f"{name} [{facts['unit']}]", facts["mean"]))
    keys = list(dict.fromkeys(key for row in rows for key in row["settings"]))
    columns = [name for name in rows[0] if name not in ("settings", "label", "model")]
    _write_csv(folder.directory / "sweep.csv", [*keys, *columns], [_flat(row, keys, columns) for row in rows])
    head = ["scene", "point", "muscle", "quantity", "unit", *FACTS]
    _write_csv(folder.directory / "quantities.csv", head, long)
    counts = {status: sum(r["status"] == status for r in rows) for status in ("done", "failed", "missing")}
    table = {"quantity": quantity, **counts, "verdicts": verdicts, "outliers": outliers(own), "rows": rows}
    write_json(folder.directory / "sweep.json", table)
    return table


def _flat(row, keys, columns):
    """A row with its settings before its values; digits beyond nine places are rounding."""
    values = [row["settings"].get(key, "") for key in keys] + [row[name] for name in columns]
    return [f"{round(v, 9):.6g}" if isinstance(v, float) else v for v in values]


def _write_csv(path, head, lines):
    part = path.with_name(f".{path.name}.part")
    with open(part, "w", encoding="utf-8", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows([head, *lines])
    os.replace(part, path)
