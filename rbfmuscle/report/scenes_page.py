"""The page of models compared on several scenes: means over the scenes, the worst, and a link to
the page of each scene.
"""

from pathlib import Path

from rbfmuscle.experiments.comparison_table import ScenesComparison
from rbfmuscle.metrics.summary import shown_number
from rbfmuscle.report.comparison_page import LIGHTS
from rbfmuscle.report.page import BAD, PLAIN, Cell, CheckRow, ReportPage, Section, Table

_READING = """Each value of a scene is the worst of its muscles and frames. The mean and the
standard deviation (of a sample) are over the scenes, the worst is that of the scene named. Lengths
are in mm, whatever the unit of a scene."""


def write_page(folder: Path, table: ScenesComparison) -> None:
    """Write ``report.html`` of what `write_scenes` found; raises SolveError."""
    known = [name for name in table.measures if any(name in x for x in table.summary.values())]
    failed = [
        f"{scene}: {model} did not finish: {reason}."
        for scene, reasons in table.failed.items()
        for model, reason in reasons.items()
    ]
    labels = [table.labels[name] for name in table.models]
    lights = [
        CheckRow(
            table.measures[name].title,
            [Cell(table.text(model, name)) for model in table.models],
            note=table.measures[name].meaning,
        )
        for name in LIGHTS
        if name in known
    ]
    ReportPage(
        f"{', '.join(labels)} on {len(table.scenes)} scenes",
        [f"{len(table.scenes)} scenes", f"{len(table.models)} models"],
        " ".join([table.answer, *failed]),
        BAD if failed else PLAIN,
        missing="The moving models are on the page of each scene.",
        lights=lights,
        heads=labels,
        sections=[
            Section(
                "Each scene",
                "its page is SCENE/report.html",
                table=Table(
                    ["scene", "answer"],
                    [[Cell(name), Cell(text)] for name, text in table.answers.items()],
                ),
                opened=True,
            ),
            Section("Mean and standard deviation over the scenes", table=_means(table, known)),
            Section("The worst, and its scene", table=_worst(table, known)),
            Section("How to read this", text=_READING),
        ],
        footer=", ".join(f"{name} {value}" for name, value in table.versions.items()),
    ).write(folder / "report.html")


def _means(table: ScenesComparison, known: list[str]) -> Table:
    rows = [
        [
            Cell(table.measures[name].title),
            Cell(table.measures[name].against),
            *(Cell(table.text(model, name)) for model in table.models),
        ]
        for name in known
    ]
    return Table(["", "against", *(table.labels[name] for name in table.models)], rows)


def _worst(table: ScenesComparison, known: list[str]) -> Table:
    rows = []
    for name in known:
        cells = [Cell(table.measures[name].title)]
        for model in table.models:
            found = table.summary[model].get(name)
            unit = table.measures[name].unit
            text = "–" if found is None else f"{shown_number(found.worst, unit)} ({found.scene})"
            cells.append(Cell(text))
        rows.append(cells)
    return Table(["", *(table.labels[name] for name in table.models)], rows)
