"""The page of a run, a comparison, a kernel study or a sweep: answer, picture, rows with lights,
all else folded.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from rbfmuscle.folders import write_whole
from rbfmuscle.metrics.summary import COUNTS, meets_limit, shown_number
from rbfmuscle.validation import SolveError

GOOD = "good"
NEAR = "near"
BAD = "bad"
PLAIN = "plain"
# From this share of a limit a value is near it.
_NEAR_LIMIT = 0.8


class Cell(NamedTuple):
    """A cell of a table: its text, and good, near, bad or plain."""

    text: str
    state: str = PLAIN


def number_cell(value: float | None, unit: str = "", state: str = PLAIN) -> Cell:
    """A cell that shows a number."""
    return Cell(shown_number(value, unit), state)


class Table(NamedTuple):
    """Headings and rows of cells; the first cell of a row names it."""

    head: Sequence[str]
    rows: Sequence[Sequence[Cell]]


class CheckRow(NamedTuple):
    """A row beside the picture: cells with their states, the limit, and a note below the title."""

    title: str
    cells: Sequence[Cell]
    limit: str = ""
    note: str = ""


class Section(NamedTuple):
    """What is folded unless ``opened``: plots (SVG), a table, a text, terms with meanings, text
    to copy; left out where empty.
    """

    title: str
    hint: str = ""
    plots: Sequence[str] = ()
    table: Table | None = None
    text: str = ""
    terms: Sequence[tuple[str, str]] = ()
    code: str = ""
    opened: bool = False


@dataclass
class ReportPage:
    """What a page says, in its order.

    The ``answer`` is one sentence, ``detail`` stands below it. ``scene``, from `pack_runs`, moves;
    ``plot`` is SVG; ``missing`` says why there is none of them. ``heads`` are those of the lights'
    columns; the lights stand beside the picture, below a scene where they have several.
    """

    title: str
    facts: Sequence[str]
    answer: str
    state: str = PLAIN
    detail: str = ""
    scene: str = ""
    plot: str = ""
    missing: str = ""
    lights: Sequence[CheckRow] = ()
    heads: Sequence[str] = ("worst",)
    sections: Sequence[Section] = ()
    footer: str = ""

    def write(self, path: Path) -> None:
        """Write the page, which needs no other file; raises SolveError where that fails."""
        from jinja2 import Environment, PackageLoader

        from rbfmuscle.display.animation import scene_file

        pages = Environment(loader=PackageLoader("rbfmuscle.display"), autoescape=True)
        text = pages.get_template("page.html").render(page=self, scene_file=scene_file)
        try:
            write_whole(path, text)
        except OSError as error:
            raise SolveError(f"cannot write {path}: {error.strerror}") from None


def limit_state(quantity: str, value: float | None, limit: float | None) -> str:
    """State of a value: bad beyond its limit, near from four fifths of it (no count is), good, or
    plain without one.
    """
    if value is None or limit is None:
        return PLAIN
    if not meets_limit(quantity, value, limit):
        return BAD
    return NEAR if quantity not in COUNTS and abs(value) > _NEAR_LIMIT * limit else GOOD
