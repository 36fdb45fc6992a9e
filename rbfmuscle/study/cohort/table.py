"""The table of a cohort: what each job came to, and which jobs lie apart from the others."""

from __future__ import annotations

import csv
import math
import os
from collections import Counter, defaultdict
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rbfmuscle.sim.scene.scene import MM_PER_UNIT
from rbfmuscle.study.cohort.jobs import CohortFolder, CohortJob
from rbfmuscle.study.files.writer import write_json
from rbfmuscle.study.measure.summary import exceeded

FORMAT = 1
FACTS = ("count", "min", "max", "mean", "median", "last", "worst", "worst_frame")
COLUMNS = ("subject", "trial", "muscle", "quantity", "unit", *FACTS)
# What is looked at over a cohort, and the value of a run that stands for it; moment arms by coordinate.
LOOKED_AT = {
    "moment_arm": "mean",
    "length": "mean",
    "volume": "mean",
    "fibre_stretch": "mean",
    "edge_strain_rms": "worst",
    "rest_error_rms": "worst",
    "volume_error": "worst",
    "penetration_max": "worst",
    "bone_penetration_max": "worst",
    "unfitted_fraction": "worst",
    "flicker_max": "worst",
}
# A job lies apart where its value is so many robust standard deviations (1.4826 times the median absolute deviation)
# from the median of at least so many jobs (Iglewicz and Hoaglin 1993). The deviation counts as no less than a share of
# the median, and than a value that nobody would look at, in millimetres where it is a length.
APART, LEAST_JOBS = 3.5, 5
LEAST_SHARE, LEAST_VALUE = 0.005, 0.01


class Value(NamedTuple):
    """What one job came to: in millimetres and their powers where it has a unit of length."""

    subject: str
    trial: str
    muscle: str
    quantity: str
    unit: str
    value: float


class Outlier(NamedTuple):
    """A value apart from those of the other jobs; ``apart`` in robust standard deviations."""

    subject: str
    trial: str
    muscle: str
    quantity: str
    unit: str
    value: float
    median: float
    apart: float


def write_cohort(jobs: list[CohortJob], directory: str | Path) -> dict[str, Any]:
    """Write ``cohort.csv`` and ``cohort.json``.

    Parameters
    ----------
    jobs : list of CohortJob
    directory : path
        Of the cohort.

    Returns
    -------
    dict
        What the JSON file holds: a row for each job, outliers the farthest first.
    """
    folder = CohortFolder(directory)
    rows, table, values = [], [], []
    for job in jobs:
        info, row = folder.info(job), _row_of(job, folder)
        if row["status"] == "done":
            row |= _facts(info)
            rows += _long(job, info)
            values += _values(job, info)
        table.append(row)
    _write_rows(folder.directory / "cohort.csv", rows)
    facts = {
        "format": FORMAT,
        **{
            status: Counter(row["status"] for row in table)[status]
            for status in ("done", "failed", "missing")
        },
        "jobs": table,
        "outliers": [found._asdict() for found in outliers(values)],
    }
    write_json(folder.directory / "cohort.json", facts)
    return {**facts, "values": values}


def shown_name(row: dict[str, Any]) -> str:
    """Subject and trial of a row, as texts name a job."""
    return " ".join(part for part in (row["subject"], row["trial"]) if part)


def outliers(values: list[Value]) -> list[Outlier]:
    """Values far from the median of their muscle and quantity over the cohort, the farthest first."""
    groups = defaultdict(list)
    for value in values:
        groups[value.muscle, value.quantity, value.unit].append(value)
    found = []
    for group in groups.values():
        numbers = np.array([value.value for value in group])
        sound = numbers[np.isfinite(numbers)]
        if len(sound) < LEAST_JOBS:
            continue
        median = float(np.median(sound))
        least = max(LEAST_SHARE * abs(median), LEAST_VALUE if group[0].unit.startswith("mm") else 1e-3)
        deviation = max(1.4826 * float(np.median(np.abs(sound - median))), least)
        for value in group:
            apart = abs(value.value - median) / deviation
            if not apart <= APART:
                found.append(Outlier(*value, median, apart if math.isfinite(apart) else math.inf))
    return sorted(found, key=lambda one: -one.apart)


def _row_of(job, folder):
    result = folder.read(job)
    run = os.path.relpath(folder.run_of(job), folder.directory)
    return {
        "subject": job.subject,
        "trial": job.trial,
        "status": "missing" if result is None else result["status"],
        "error": "" if result is None else result["error"],
        "scene": job.scene,
        "settings": job.settings,
        "folder": run,
        "report": f"{run}/report.html" if (folder.run_of(job) / "report.html").exists() else None,
        "seconds": None if result is None else result.get("seconds"),
    }


def _facts(info):
    """How many frames, and which limits a run exceeds."""
    beyond = exceeded(info["muscles"], info["limits"])
    return {
        "frames": len(info["frames"]),
        "beyond": sorted({f"{muscle}: {name}" for muscle, name, *_ in beyond}),
    }


def _long(job, info):
    """Rows of ``cohort.csv`` for one job."""
    return [
        [job.subject, job.trial, muscle, quantity, facts["unit"], *(facts.get(name) for name in FACTS)]
        for muscle, quantities in info["muscles"].items()
        for quantity, facts in quantities.items()
    ]


def _values(job, info):
    units = info["scene"]["units"]
    found = []
    for muscle, quantities in info["muscles"].items():
        for name, facts in quantities.items():
            which = LOOKED_AT.get(name.partition(":")[0])
            value = facts.get(which) if which else None
            if value is not None:
                unit, factor = _in_mm(facts["unit"], units)
                found.append(Value(job.subject, job.trial, muscle, name, unit, factor * value))
    return found


def _in_mm(unit, units):
    """Unit and factor of a value in millimetres, for a unit that is a power of the scene's."""
    base, _, power = unit.partition("^")
    if base != units:
        return unit, 1.0
    return f"mm^{power}" if power else "mm", MM_PER_UNIT[units] ** int(power or 1)


def _write_rows(path, rows):
    part = path.with_name(f".{path.name}.part")
    with open(part, "w", encoding="utf-8", newline="") as file:
        table = csv.writer(file, lineterminator="\n")
        table.writerow(COLUMNS)
        table.writerows(rows)
    os.replace(part, path)
