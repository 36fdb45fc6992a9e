"""The page of a sweep: the default's place, the Pareto front with labelled points, rows to choose
from, every point.
"""

from collections.abc import Iterable
from pathlib import Path

from rbfmuscle.experiments.front import LENGTHS
from rbfmuscle.experiments.sweep_table import FrontVerdict, SweepRow, SweepTable
from rbfmuscle.report.page import (
    GOOD,
    NEAR,
    PLAIN,
    Cell,
    CheckRow,
    ReportPage,
    Section,
    Table,
    number_cell,
)
from rbfmuscle.report.plots import Point, front_plot

ROUNDING = 1e-9  # errors below it are none
SHOWN = (
    "error_rms",
    "error_max",
    "volume_error",
    "penetration_max",
    "bone_penetration_max",
    "time_frame",
)
_READING = """error_rms is the distance between a point's surfaces and those of the reference at
the same poses, both ways, root mean square over frames and muscles: how far a setting is from
the reference, not how far the model is from a real muscle. A point is on the front if no other
is as accurate in less time."""
_INSIDE = """ The reference is itself a point of the grid, so points near it err little by
definition. Give a finer one (--reference) to judge the default."""


def write_page(found: SweepTable, directory: str | Path) -> None:
    """Write the self-contained ``sweep.html`` of what `write_table` returns."""
    rows, quantity = found.rows, found.quantity
    picture = front_picture(rows, quantity)
    verdicts, inside = found.verdicts, inside_grid(rows)
    scenes = list(dict.fromkeys(row.scene for row in rows))
    judged = PLAIN if inside or not verdicts else GOOD if all(v.near for v in verdicts) else NEAR
    ReportPage(
        f"Sweep of {', '.join(scenes)}"[:120],
        [
            f"{getattr(found, status)} points {status}"
            for status in ("done", "failed", "missing")
            if getattr(found, status)
        ],
        " ".join(v.text for v in verdicts) or f"{found.done} points are done; none is judged.",
        judged,
        plot=picture,
        missing="" if picture else "No front: no point has both an error and a time.",
        lights=_lights(rows, verdicts, quantity),
        heads=[quantity.replace("_", " "), "per frame"],
        sections=[
            Section("Every point", table=_points(rows)),
            Section("How to read this", text=_READING + (_INSIDE if inside else "")),
        ],
    ).write(Path(directory) / "sweep.html")


def inside_grid(rows: Iterable[SweepRow]) -> bool:
    """Whether a reference has no setting beyond those of the other points."""
    found = [(row.role, {(key, str(value)) for key, value in row.settings.items()}) for row in rows]
    others = set().union(*(settings for role, settings in found if role != "reference"))
    return any(settings <= others for role, settings in found if role == "reference")


def front_picture(rows: Iterable[SweepRow], quantity: str) -> str:
    """SVG of error against time per frame: a colour for each scene and model, fronts joined; no
    reference itself.
    """
    points = []
    for row in rows:
        if row.role != "reference" and row.status == "done" and row.value(quantity) > ROUNDING:
            group = f"{row.scene} {row.settings.get('model', '')}".strip()
            place = 1e3 * row.value("time_frame"), row.value(quantity), _short(row), group
            points.append(Point(*place, row.role == "default", row.front))
    return front_plot(points, ("time per frame [ms]", quantity.replace("_", " ")))


def _short(row: SweepRow) -> str:
    """A point's settings without what names the table that they are in."""
    if row.role == "default":
        return "default"
    named = {key.rpartition(".")[2]: value for key, value in row.settings.items() if key != "model"}
    return ", ".join(f"{key} {value}" for key, value in named.items())


def _lights(rows: list[SweepRow], verdicts: list[FrontVerdict], quantity: str) -> list[CheckRow]:
    """Of each default: itself, what is quicker, what is more accurate; then the two ends of the
    front.
    """
    front = sorted((row for row in rows if row.front), key=lambda row: row.value("time_frame"))
    chosen: list[tuple[str, str | None, str]] = []
    for verdict in verdicts:
        state = PLAIN if inside_grid(rows) else GOOD if verdict.near else NEAR
        name = f"default of {verdict.scene}" if len(verdicts) > 1 else "default"
        chosen += [
            (name, verdict.default, state),
            ("as accurate, quicker", verdict.faster, PLAIN),
            ("as quick, more accurate", verdict.better, PLAIN),
        ]
    if front:
        chosen += [
            ("the quickest", front[0].key, PLAIN),
            ("the most accurate", front[-1].key, PLAIN),
        ]
    by_key = {row.key: row for row in rows}
    return [_light(by_key[key], title, quantity, state) for title, key, state in chosen if key]


def _light(row: SweepRow, title: str, quantity: str, state: str) -> CheckRow:
    unit = row.units if quantity in LENGTHS else ""
    cells = [
        number_cell(row.value(quantity), unit, state),
        number_cell(row.value("time_frame"), "s"),
    ]
    return CheckRow(title, cells, note="" if row.role == "default" else _short(row))


def _points(rows: list[SweepRow]) -> Table:
    settings = list(dict.fromkeys(key for row in rows for key in row.settings))
    head = [
        "scene",
        *settings,
        "role",
        "front",
        *(name.replace("_", " ") for name in SHOWN),
        "status",
    ]
    lines = []
    for row in rows:
        values = (str(row.settings.get(key, "")) for key in settings)
        numbers = (
            number_cell(row.value(name), "s" if name.startswith("time_") else "") for name in SHOWN
        )
        texts = row.scene, *values, row.role, "yes" if row.front else ""
        lines.append([*map(Cell, texts), *numbers, Cell(row.error or row.status)])
    return Table(head, lines)
