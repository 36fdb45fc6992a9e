"""The table of a sweep, its Pareto front, and whether the default stands on it."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rbfmuscle.study.experiment.sweep import SweepFolder, SweepPlan
from rbfmuscle.study.experiment.sweep_points import TIMES, VALUES
from rbfmuscle.study.files.writer import write_json
from rbfmuscle.validation import UsageError

# The default may be this much worse than the front, in error and in time at once.
NEAR = 1.1


@dataclass(frozen=True)
class Verdict:
    """Where the default of one group of points stands.

    Attributes
    ----------
    group : str
        The model, or "" where the grid names none.
    factor : float
        The least factor by which both its error and its time must fall to lie on the front; 1 on it.
    on_front, near : bool
        On the front; within 10 % of it.
    faster, better : dict or None
        The quickest point of no greater error, and the most accurate of no greater time: label, its error
        and its time; None where the default is that point itself.
    error, time : float
        Of the default.
    """

    group: str
    factor: float
    on_front: bool
    near: bool
    faster: dict | None
    better: dict | None
    error: float
    time: float


def sweep_rows(plan: SweepPlan, folder: SweepFolder) -> list[dict[str, Any]]:
    """One dict a point, in the plan's order: role, status, settings, values, error.

    Parameters
    ----------
    plan : SweepPlan
    folder : SweepFolder

    Returns
    -------
    list of dict
        ``status`` is done, failed or missing; ``front`` is filled in by `mark_front`.
    """
    rows = []
    for number, point in enumerate(plan.points):
        result = folder.read(point.key) or {}
        values = result.get("values", {})
        rows.append(
            {
                "point": number,
                "status": result.get("status", "missing"),
                "role": "reference" if point.is_reference else "default" if point.default else "",
                "label": point.label,
                "model": point.model,
                "reference": point.reference,
                "settings": point.settings,
                **{name: math.nan if values.get(name) is None else values[name] for name in VALUES},
                "front": False,
                "threads": result.get("threads", ""),
                "jobs": result.get("jobs", ""),
                "machine": result.get("machine", ""),
                "error": result.get("error", ""),
                "key": point.key,
            }
        )
    return rows


def pareto_front(errors: Sequence[float], times: Sequence[float]) -> list[Any]:
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
    order = sorted(range(len(errors)), key=lambda k: (times[k], errors[k]))
    front, least = [], math.inf
    for k in order:
        if math.isfinite(errors[k]) and math.isfinite(times[k]) and errors[k] < least:
            front.append(k)
            least = errors[k]
    return front


def mark_front(rows: list[Any], quantity: str = "error_rms") -> list[Any]:
    """Mark the front in the rows, a front for each reference, and judge the default of each.

    Parameters
    ----------
    rows : list of dict
        From `sweep_rows`; their ``front`` is set. References take no part: their error is zero by definition.
    quantity : str
        The error that the front trades against ``time_frame``.

    Returns
    -------
    list of Verdict
    """
    verdicts = []
    for group in dict.fromkeys(row["reference"] for row in rows):
        usable = [
            row
            for row in rows
            if row["reference"] == group and row["status"] == "done" and row["role"] != "reference"
        ]
        front = pareto_front([r[quantity] for r in usable], [r["time_frame"] for r in usable])
        for k in front:
            usable[k]["front"] = True
        verdicts += [_judge(row, usable, quantity) for row in usable if row["role"] == "default"]
    return verdicts


def _judge(default, rows, quantity):
    error, time = default[quantity], default["time_frame"]
    others = [r for r in rows if r is not default and math.isfinite(r[quantity])]
    factor = max([1.0, *(min(_ratio(error, r[quantity]), _ratio(time, r["time_frame"])) for r in others)])
    quicker = [r for r in others if r[quantity] <= error and r["time_frame"] < time]
    finer = [r for r in others if r["time_frame"] <= time and r[quantity] < error]
    return Verdict(
        group=default["model"],
        factor=factor,
        on_front=default["front"],
        near=factor <= NEAR,
        faster=_named(min(quicker, key=lambda r: r["time_frame"]), quantity) if quicker else None,
        better=_named(min(finer, key=lambda r: r[quantity]), quantity) if finer else None,
        error=error,
        time=time,
    )


def _ratio(mine, other):
    return mine / other if other > 0 else (math.inf if mine > 0 else 1.0)


def _named(row, quantity):
    return {"label": row["label"], "error": row[quantity], "time": row["time_frame"]}


def verdict_text(verdict: Verdict, units: str, quantity: str = "error_rms") -> str:
    """The verdict in a sentence."""
    what = f"default{f' of {verdict.group}' if verdict.group else ''}"
    unit = f" {units}" if has_length(quantity) else ""
    figures = f"{verdict.error:.3g}{unit} at {1e3 * verdict.time:.3g} ms a frame"
    if verdict.on_front:
        return f"The {what} lies on the front: {figures}."
    if verdict.near:
        text = f"The {what} lies within 10 % of the front (factor {verdict.factor:.2f}): {figures}."
    else:
        text = f"The {what} lies off the front by a factor of {verdict.factor:.2f}: {figures}."
    for found, words in (
        (verdict.faster, "Quicker at no greater error"),
        (verdict.better, "Better in no more time"),
    ):
        if found:
            text += f" {words}: {found['label']} ({found['error']:.3g}{unit}, {1e3 * found['time']:.3g} ms)."
    return text


def has_length(quantity: str) -> bool:
    """Whether a quantity is a length in the scene's unit."""
    return quantity.startswith(("error", "rest_error")) or "penetration" in quantity


def table_columns(rows: list[dict[str, Any]]) -> list[str]:
    """Columns of the table; each key of the grid has its own."""
    keys = dict.fromkeys(key for row in rows for key in row["settings"])
    head = ["point", "status", "role", "front"]
    return [*head, *keys, *VALUES, "threads", "jobs", "machine", "error", "key", "reference"]


def flat_row(row: dict[str, Any]) -> dict[str, Any]:
    """A row with its settings beside its values."""
    rest = {name: value for name, value in row.items() if name not in ("settings", "label", "model")}
    return {**row["settings"], **rest}


def table_text(rows: list[dict[str, Any]], *, times: bool = True) -> str:
    """The table as CSV; without times (and where they were taken) it is the same wherever it was computed."""
    left_out = () if times else (*TIMES, "threads", "jobs", "machine", "front")
    columns = [name for name in table_columns(rows) if name not in left_out]
    out = io.StringIO()
    writer = csv.DictWriter(out, columns, extrasaction="ignore", restval="", lineterminator="\n")
    writer.writeheader()
    for row in rows:
        writer.writerow({k: _cell(v) for k, v in flat_row(row).items()})
    return out.getvalue()


def _cell(value):
    if isinstance(value, float):
        # Digits beyond these (a volume error of 1e-16, say) are rounding, and differ with the threads.
        return "" if math.isnan(value) else f"{round(value, 9):.6g}"
    return int(value) if isinstance(value, bool) else value


def write_table(plan: SweepPlan, directory: Path, *, quantity: str = "error_rms") -> dict[str, Any]:
    """Write ``sweep.csv`` and ``sweep.json``.

    Returns
    -------
    dict
        What ``sweep.json`` holds: the plan's facts, ``verdicts``, counts and ``rows``.
    """
    folder = SweepFolder(directory)
    rows = sweep_rows(plan, folder)
    verdicts = mark_front(rows, quantity)
    counts = {status: sum(r["status"] == status for r in rows) for status in ("done", "failed", "missing")}
    table = {
        **plan.facts,
        "quantity": quantity,
        **counts,
        "verdicts": [
            {**verdict.__dict__, "text": verdict_text(verdict, plan.facts["units"], quantity)}
            for verdict in verdicts
        ],
        "rows": [_plain(row) for row in rows],
    }
    write_json(folder.directory / "sweep.json", table)
    fresh = folder.directory / ".sweep.csv"
    fresh.write_text(table_text(rows), encoding="utf-8")
    fresh.replace(folder.directory / "sweep.csv")
    return table


def _plain(row):
    """JSON knows no NaN."""
    return {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in row.items()}


def merge_sweeps(directories: list[Path], output: str | Path) -> SweepPlan:
    """Gather the results of several folders of one sweep in one.

    Parameters
    ----------
    directories : list of path
    output : path
        May be one of them.

    Returns
    -------
    SweepPlan

    Raises
    ------
    UsageError
        If the folders hold different sweeps.
    """
    plans = [SweepFolder(directory).read_plan() for directory in directories]
    for directory, plan in zip(directories, plans):
        if json.dumps(plan.as_dict()) != json.dumps(plans[0].as_dict()):
            raise UsageError(f"{directory} holds another sweep than {directories[0]}; merge the parts of one")
    plan = plans[0]
    target = SweepFolder(output)
    target.prepare(plan)
    for directory in directories:
        source = SweepFolder(directory)
        for point in plan.points:
            result, kept = source.read(point.key), target.read(point.key)
            # A point that failed here may have been done there.
            if result and (kept is None or (kept["status"] == "failed" and result["status"] == "done")):
                target.write(result)
    return plan
