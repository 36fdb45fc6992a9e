"""The kernel study of one or several surfaces as files: tables and a page."""

import datetime
from collections import Counter
from collections.abc import Mapping
from itertools import cycle
from pathlib import Path

import numpy as np

from rbfmuscle.experiments.kernel_rows import (
    ALIKE,
    ENDS,
    KernelFacts,
    KernelRow,
    at_end,
    describe,
    recommend,
)
from rbfmuscle.experiments.kernel_study import KernelStudy
from rbfmuscle.folders import OutputFolder
from rbfmuscle.metrics.summary import shown_number
from rbfmuscle.output.appearance import MUSCLE_COLOURS
from rbfmuscle.output.writer import json_text, versions, write_csv
from rbfmuscle.report.page import (
    BAD,
    GOOD,
    PLAIN,
    Cell,
    CheckRow,
    ReportPage,
    Section,
    Table,
    number_cell,
)
from rbfmuscle.report.plots import Point, Track, front_plot, line_plot

# Quantity: heading, factor.
COLUMNS = {
    "centres": ("centres", 1.0),
    "shape": ("epsilon times spacing", 1.0),
    "rms": ("RMS error", 1.0),
    "hausdorff": ("greatest error", 1.0),
    "normal_error": ("normals [°]", 1.0),
    "volume_error": ("volume [%]", 100.0),
    "condition": ("condition", 1.0),
    "fit_time": ("fit [ms]", 1e3),
    "evaluation_time": ("20,000 values [ms]", 1e3),
}
FILES = ("kernels.csv", "kernels.json", "kernels.html")
_MOST_LIGHTS = 5  # rows at the top of the page
_READING = """A kernel's shape parameter is chosen by the error at other points of the mesh.
Distances are measured both ways between mesh and extracted surface, root mean square and
greatest. Recommended is the quickest row (a fit and 20,000 values) whose error is at most 5 %
more than the least one; of rows with the same time, one without a shape parameter, then the
best-conditioned one. No other row has both a smaller error and a shorter time than a row on the
front. A kernel that is not C2 cannot be fitted to normals: it is fitted to values on and off the
surface."""


def kernels_folder(directory: str | Path) -> OutputFolder:
    """The folder of a kernel study; UsageError if something in it is in the way."""
    return OutputFolder(directory, "kernels", (*FILES, "error.json"))


def write_studies(studies: Mapping[str, KernelStudy], directory: str | Path) -> None:
    """Write ``kernels.csv``, ``kernels.json`` and ``kernels.html`` of studies by the names of their
    surfaces.
    """
    facts = KernelFacts(
        units=next(iter(studies.values())).units,
        version=versions()["rbfmuscle"],
        date=datetime.date.today().isoformat(),
        meshes={name: study.sha256 for name, study in studies.items()},
        rows=[
            row.model_copy(update={"surface": name})
            for name, study in studies.items()
            for row in study.rows
        ],
    )
    with kernels_folder(directory).staged() as stage:
        names = [name for name in KernelRow.model_fields if name != "trials"]
        rows = [[getattr(row, name) for name in names] for row in facts.rows]
        write_csv(stage / "kernels.csv", [names, *rows])
        (stage / "kernels.json").write_text(json_text(facts.model_dump()), encoding="utf-8")
        write_page(stage, facts)


def write_page(directory: Path, facts: KernelFacts) -> None:
    """Write ``kernels.html`` of what ``kernels.json`` holds."""
    studies = {}
    for name, digest in facts.meshes.items():
        rows = [row for row in facts.rows if row.surface == name]
        studies[name] = KernelStudy(rows, [], facts.units, recommend(rows), digest)
    made = f"rbfmuscle {facts.version}, {facts.date}"
    _page(studies, made).write(directory / "kernels.html")


def answer(studies: Mapping[str, KernelStudy]) -> str:
    """What to use and why: of one surface its own sentence, of several the kernel that is near the
    best on most.
    """
    if len(studies) == 1:
        return describe(next(iter(studies.values())).rows)
    tied: Counter[str] = Counter()
    for study in studies.values():
        good = [row for row in study.rows if not row.unfit]
        tied.update({row.kernel for row in good if row.error <= ALIKE * good[0].error})
    if not tied:
        return "Every field is unfit on every surface; take more centres."
    chosen = Counter(study.recommended.kernel for study in studies.values() if study.recommended)
    kernel = max(chosen, key=lambda name: (tied[name], chosen[name]))
    return (
        f"Use {kernel}: within 5 % of the least error on {tied[kernel]} of {len(studies)} muscles, "
        f"and the quickest such kernel on {chosen[kernel]}."
    )


def _page(studies: Mapping[str, KernelStudy], made: str) -> ReportPage:
    several, rows = len(studies) > 1, [row for study in studies.values() for row in study.rows]
    units = next(iter(studies.values())).units
    surfaces = f"all {len(studies)} muscles" if several else next(iter(studies)).replace("_", " ")
    kernels = len({row.kernel for row in rows})
    counts = ", ".join(map(str, sorted({row.centres for row in rows})))
    found = {name: study.recommended for name, study in studies.items() if study.recommended}
    code = "\n\n".join(f"# {name}\n{row.toml()}" for name, row in found.items())
    hint = f"distances in {units or 'mesh units'}"
    return ReportPage(
        f"Kernels for {surfaces}",
        [
            f"{kernels} kernels",
            f"{counts} centres",
            *["every muscle; --muscles for some"][:several],
            made,
        ],
        answer(studies),
        GOOD if found else BAD,
        plot=_plot(studies, units),
        lights=_lights(studies, units),
        heads=["RMS error", "fit and 20,000 values"],
        sections=[
            *(
                Section(f"Fitted rows of {name}", f"{hint}; mesh {s.sha256[:12]}", table=_rows(s))
                for name, s in studies.items()
            ),
            *(
                Section(f"Unfit rows of {name}", hint, table=_rows(s, unfit=True))
                for name, s in studies.items()
                if any(row.unfit for row in s.rows)
            ),
            *(
                Section(f"Error against epsilon: {name}", plots=_curves(s))
                for name, s in studies.items()
                if any(row.trials for row in s.rows)
            ),
            Section("To paste at the end of a [[muscle]]", code=code),
            Section("How to read this", text=_READING),
        ],
    )


def _lights(studies: Mapping[str, KernelStudy], units: str) -> list[CheckRow]:
    """Of one surface its best rows, each with whether it ties; of several what is recommended for
    each.
    """
    chosen = [
        (name, study.recommended, GOOD) for name, study in studies.items() if study.recommended
    ]
    if len(studies) == 1:
        (study,) = studies.values()
        good = [row for row in study.rows if not row.unfit]
        others = [row for row in good if row is not study.recommended]
        chosen = [("recommended", row, GOOD) for _, row, _ in chosen]
        chosen += [
            ("", row, GOOD if row.error <= ALIKE * good[0].error else PLAIN) for row in others
        ]
        chosen = chosen[:_MOST_LIGHTS]
    cells = [[number_cell(row.rms, units, s), number_cell(row.cost, "s")] for _, row, s in chosen]
    return [CheckRow(row.title, pair, note=note) for (note, row, _), pair in zip(chosen, cells)]


def _plot(studies: Mapping[str, KernelStudy], units: str) -> str:
    """Error against the time of a fit and 20,000 values: a colour a surface, or of one a number of
    centres.
    """
    points = []
    for name, study in studies.items():
        for row in study.rows:
            if not row.unfit:
                group = name if len(studies) > 1 else f"{row.centres} centres"
                place = 1e3 * row.cost, row.error, row.kernel, group
                points.append(Point(*place, row is study.recommended, row.front))
    labels = ("a fit and 20,000 values [ms of one thread]", f"RMS error [{units or 'mesh units'}]")
    return front_plot(points, labels)


def _curves(study: KernelStudy) -> list[str]:
    """For each number of centres the error at the held-out points against epsilon, by kernel."""
    pictures = []
    unit = study.units or "mesh units"
    for count in dict.fromkeys(row.centres for row in study.rows):
        rows = [row for row in study.rows if row.centres == count and row.trials]
        tracks = []
        for row, colour in zip(rows, cycle(MUSCLE_COLOURS)):
            shapes, errors = np.array(row.trials).T
            tracks.append(Track(row.kernel, colour, np.log10(shapes), np.log10(errors)))
        labels = "log10 of epsilon times spacing", f"log10 of the RMS error [{unit}]"
        if tracks:
            pictures.append(line_plot(f"{count} centres", tracks, labels, legend=True))
    return pictures


def _rows(study: KernelStudy, *, unfit: bool = False) -> Table:
    rows = []
    for row in (row for row in study.rows if bool(row.unfit) == unfit):
        state = GOOD if row is study.recommended else BAD if row.unfit else PLAIN
        front = "on the front" if row.front else ""
        verdict = row.unfit or ("recommended" if row is study.recommended else front)
        verdict = "; ".join(
            filter(None, [verdict, ENDS if row.shape and at_end(row.shape) else ""])
        )
        values = [(getattr(row, name), factor) for name, (_, factor) in COLUMNS.items()]
        texts = [
            shown_number(x * factor) if isinstance(x, float) else str(x or "")
            for x, factor in values
        ]
        rows.append([Cell(row.kernel), Cell(verdict, state), *map(Cell, texts)])
    return Table(["kernel", "verdict", *(head for head, _ in COLUMNS.values())], rows)
