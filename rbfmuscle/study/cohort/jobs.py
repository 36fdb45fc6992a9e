"""A cohort: scenes of many subjects and trials, each run once into a folder of its own.

A folder of a cohort holds ``jobs/NAME/`` (a run each, as ``rbfmuscle run`` leaves it), ``results/NAME.json`` (how it
went, written in one move) and the tables. What is done is not run again, and what was under way goes on.
"""

from __future__ import annotations

import csv
import dataclasses
import glob
import hashlib
import json
from pathlib import Path
from typing import Any

from rbfmuscle.sim.contraction.keys import KEYS
from rbfmuscle.sim.scene.settings import parse_value
from rbfmuscle.study.files.writer import write_json
from rbfmuscle.validation import UsageError, did_you_mean

COLUMNS = ("subject", "trial", "scene", "motion", "model", "frames")
HEADS = ("model", "muscle", "motion", "contact", "sliding", "detect", "output", *KEYS)
PHANTOM = "phantom"
MOST_JOBS = 100_000


@dataclasses.dataclass(frozen=True)
class CohortJob:
    """One trial of one subject.

    Attributes
    ----------
    subject, trial : str
        The trial is "" where a subject has one only.
    scene : str
        File, or "phantom" for the embedded hip.
    motion : str
        OpenSim file of the motion, "" for the scene's own.
    model, frames : str
        As for `simulate`, "" for the scene's own.
    settings : dict
        Dotted keys with their values.
    """

    subject: str
    trial: str
    scene: str
    motion: str = ""
    model: str = ""
    frames: str = ""
    settings: dict[str, Any] = dataclasses.field(default_factory=dict)

    @property
    def name(self) -> str:
        """Name of the job's folder."""
        return "_".join(_file_name(part) for part in (self.subject, self.trial) if part)


def is_cohort(sources: tuple[str, ...]) -> bool:
    """Whether these are several scenes: a table (.csv), a pattern with ``*``, or more than one file."""
    one = sources[0] if len(sources) == 1 else ""
    return (
        len(sources) > 1 or one.lower().endswith(".csv") or (glob.has_magic(one) and not Path(one).exists())
    )


def read_cohort(sources: tuple[str, ...], asked: dict[str, Any]) -> list[CohortJob]:
    """The jobs of a table, a pattern or a list of scene files.

    Parameters
    ----------
    sources : tuple of str
    asked : dict
        ``model`` and ``frames`` (text or None) and ``settings`` (dict) for all; a table's own go before them.

    Raises
    ------
    UsageError
        If there are none, or two of one name.
    """
    common = {
        "model": asked.get("model") or "",
        "frames": asked.get("frames") or "",
        "settings": dict(asked.get("settings") or {}),
    }
    if len(sources) == 1 and sources[0].lower().endswith(".csv"):
        jobs = _from_table(Path(sources[0]), common)
    else:
        jobs = _from_files(sources, common)
    seen: dict[str, CohortJob] = {}
    for job in jobs:
        other = seen.setdefault(job.name, job)
        if other is not job:
            raise UsageError(
                f"subject {job.subject!r}, trial {job.trial!r} is there twice (as {job.name!r}): "
                f"{other.scene} and {job.scene}; name subjects and trials in a table"
            )
    return jobs


def _from_files(sources, common):
    found = []
    for source in sources:
        matched = sorted(glob.glob(source, recursive=True)) if glob.has_magic(source) else [source]
        found += [Path(path) for path in matched]
    if not found:
        raise UsageError(
            f"no file matches {sources[0]!r}; quote a pattern, for instance 'subjects/*/scene.toml'"
        )
    # What tells the files apart: the folder where all are called scene.toml, else their own name.
    alike = len({path.name for path in found}) == 1 and len(found) > 1
    return [
        CohortJob(path.resolve().parent.name if alike else path.stem, "", str(path.resolve()), **common)
        for path in found
    ]


def _from_table(path, common):
    try:
        with open(path, encoding="utf-8-sig", newline="") as file:
            rows = list(csv.DictReader(file, skipinitialspace=True, strict=True))
    except OSError as error:
        raise UsageError(f"cannot read {path}: {error.strerror}") from None
    except (UnicodeDecodeError, csv.Error) as error:
        raise UsageError(f"{path} is no table of comma-separated values in UTF-8: {error}") from None
    if not rows or len(rows) > MOST_JOBS:
        raise UsageError(f"{path} has {len(rows)} rows; a cohort has 1 to {MOST_JOBS}, after a line of names")
    _check_columns(path, list(rows[0]))
    return [_job(path, number, row, common) for number, row in enumerate(rows, start=2)]


def _check_columns(path, names):
    for wanted in ("subject", "scene"):
        if wanted not in names:
            raise UsageError(
                f"{path} has no column {wanted!r}; its first line names them: subject,trial,scene and settings"
            )
    for name in names:
        if name is None or (name not in COLUMNS and name.partition(".")[0] not in HEADS):
            hint = did_you_mean(str(name), [*COLUMNS, *(f"{head}.KEY" for head in HEADS[:7])])
            raise UsageError(f"{path}: unknown column {name!r}, {hint}")


def _job(path, number, row, common):
    if None in row or None in row.values():
        raise UsageError(f"{path} line {number}: has another number of values than the first line has names")
    row = {name: value.strip() for name, value in row.items()}
    for wanted in ("subject", "scene"):
        if not row[wanted]:
            raise UsageError(f"{path} line {number}: {wanted} is empty")
    own = {
        key: parse_value(text, place=f"{path} line {number}: {key}")
        for key, text in row.items()
        if key not in COLUMNS and text
    }
    scene = row["scene"]
    if scene != PHANTOM:
        scene = str((path.parent / scene).resolve())
    motion = row.get("motion", "")
    return CohortJob(
        row["subject"],
        row.get("trial", ""),
        scene,
        str((path.parent / motion).resolve()) if motion else "",
        row.get("model", "") or common["model"],
        row.get("frames", "") or common["frames"],
        {**common["settings"], **own},
    )


def _file_name(text):
    """Text as it may stand in a file's name."""
    return "".join(c if c.isalnum() or c in "-." else "-" for c in text).strip(".") or "-"


class CohortFolder:
    """The files of a cohort.

    Parameters
    ----------
    directory : path
    """

    def __init__(self, directory: str | Path) -> None:
        self.directory = Path(directory)
        self.results = self.directory / "results"

    def prepare(self) -> None:
        """Make the folder; raises UsageError where that cannot be."""
        try:
            self.results.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise UsageError(
                f"cannot write to {self.directory}: {error.strerror}; choose another folder"
            ) from None

    def run_of(self, job: CohortJob) -> Path:
        """Folder of a job's run."""
        return self.directory / "jobs" / job.name

    def marker(self, job: CohortJob) -> Path:
        """A file that is there while a job is under way."""
        return self.results / f"{job.name}.running"

    def read(self, job: CohortJob) -> dict[str, Any] | None:
        """How a job went, None where it has not ended or was another one."""
        try:
            found = json.loads((self.results / f"{job.name}.json").read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return None
        return found if found.get("job") == _as_read(job) else None

    def write(self, job: CohortJob, result: dict[str, Any]) -> None:
        """Keep how a job went: whole or not at all."""
        write_json(self.results / f"{job.name}.json", {"job": dataclasses.asdict(job), **result})
        self.marker(job).unlink(missing_ok=True)

    def info(self, job: CohortJob) -> dict[str, Any] | None:
        """``run.json`` of a job, None where there is none."""
        try:
            return json.loads((self.run_of(job) / "run.json").read_text(encoding="utf-8"))
        except (OSError, ValueError):
            return None

    def is_done(self, job: CohortJob) -> bool:
        """Whether a job is done, with the scene file and meshes as they are now."""
        result, info = self.read(job), self.info(job)
        if result is None or info is None or result["status"] != "done" or info.get("status") != "complete":
            return False
        return all(_hash_of(Path(path)) == known for path, known in info["inputs"].items())


def _as_read(job):
    """A job as JSON gives it back."""
    return json.loads(json.dumps(dataclasses.asdict(job)))


def _hash_of(path):
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError:
        return ""
