"""The page of a run, a comparison, a kernel study or a sweep: answer, picture, rows with lights, all else folded."""

from __future__ import annotations

import base64
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from importlib import resources
from pathlib import Path
from typing import NamedTuple

from rbfmuscle.validation import SolveError

GOOD, NEAR, BAD, PLAIN = "good", "near", "bad", "plain"
_SYMBOLS = {GOOD: "✓", NEAR: "!", BAD: "✕"}
# From this share of a limit a value is near it.
_NEAR_LIMIT = 0.8


class Cell(NamedTuple):
    """A cell of a table: its text, what a column is sorted by, and good, bad or plain."""

    text: str
    value: float | None = None
    state: str = PLAIN


class Light(NamedTuple):
    """A row beside the picture: cells with their states, the limit, and a note below the title."""

    title: str
    cells: Sequence[Cell]
    limit: str = ""
    note: str = ""


class Section(NamedTuple):
    """What is folded: ``body`` is markup."""

    title: str
    body: str
    hint: str = ""


@dataclass
class Page:
    """What a page says, in its order.

    The ``answer`` is one sentence, ``detail`` stands below it. ``scene``, from `pack_runs`, moves; ``picture`` is
    markup, in place of the scene where a browser cannot show it; ``missing`` says why there is neither. ``heads`` are
    those of the lights' columns; the lights stand beside or below the picture.
    """

    title: str
    facts: Sequence[str]
    answer: str
    state: str = PLAIN
    detail: str = ""
    scene: str = ""
    picture: str = ""
    missing: str = ""
    lights: Sequence[Light] = ()
    heads: Sequence[str] = ("worst",)
    sections: list[Section] = field(default_factory=list)
    footer: str = ""
    layout: str = "beside"

    def html(self) -> str:
        """The page, which needs no other file."""
        from jinja2 import Environment
        from markupsafe import Markup

        from rbfmuscle.output.animation.page import scene_file

        style, script = _template("page.css"), _template("page.js")
        if self.scene:
            style, script = style + scene_file("scene.css"), script + scene_file("scene.js")
        self.picture = Markup(self.picture)
        self.sections = [part._replace(body=Markup(part.body)) for part in self.sections if part.body]
        template = Environment(autoescape=True).from_string(_template("page.html"))
        return template.render(page=self, style=Markup(style), script=Markup(script), symbols=_SYMBOLS)

    def write(self, path: Path) -> None:
        """Write the page; raises SolveError where that fails."""
        try:
            path.write_text(self.html(), encoding="utf-8")
        except OSError as error:
            raise SolveError(f"cannot write {path}: {error.strerror}") from None


def _template(name: str) -> str:
    return (resources.files("rbfmuscle.report") / "templates" / name).read_text(encoding="utf-8")


def embedded_image(data: bytes, kind: str, text: str) -> str:
    """An ``img`` element that holds the picture itself; ``text`` stands where it is not shown."""
    from markupsafe import escape

    return f'<img alt="{escape(text)}" src="data:image/{kind};base64,{base64.b64encode(data).decode()}">'


def limit_state(value: float, limit: float | None, *, least: bool = False, count: bool = False) -> str:
    """Light of a value: good, near its limit (from four fifths of it; no count is near) or bad; without limit plain.

    With ``least`` the limit is the least allowed value.
    """
    if limit is None:
        return PLAIN
    if not (value >= limit if least else abs(value) <= limit):
        return BAD
    return NEAR if not least and not count and abs(value) > _NEAR_LIMIT * limit else GOOD


def number(value: float | None, unit: str = "") -> str:
    """A value with as many digits as say something, and its unit; lengths in millimetres from 0.01 up."""
    if value is None or math.isnan(value):
        return "–"
    if unit == "s":
        return f"{_digits(value)} s" if abs(value) >= 1.0 else f"{_digits(1e3 * value)} ms"
    if unit == "mm" and 0.0 < abs(value) < 0.01:
        return "< 0.01 mm"
    return f"{_digits(value)} {unit}" if unit not in ("", "1") else _digits(value)


def _digits(value: float) -> str:
    size = abs(value)
    if not math.isfinite(value) or value == 0.0:
        return f"{value:g}"
    if 1e-3 <= size < 1e5:
        return f"{value:.0f}" if size >= 100 else f"{value:.3g}" if size >= 1 else f"{value:.2g}"
    return f"{value:.0e}".replace("e-0", "e-").replace("e+0", "e+")


def sentence(text: str) -> str:
    """A text with a capital letter and a full stop."""
    return text[:1].upper() + text[1:] + ("" if text.endswith(".") else ".")


def table(head: Sequence[str], rows: Iterable[Sequence[Cell | str]]) -> str:
    """Markup of a table that a click on a heading sorts; the first cell of a row names it."""
    from markupsafe import escape

    lines = []
    for row in rows:
        cells = []
        for k, cell in enumerate(Cell(c) if isinstance(c, str) else c for c in row):
            kind = "th" if k == 0 else "td"
            data = "" if cell.value is None else f' data-value="{cell.value:.6g}"'
            text = "text" if cell.value is None and len(cell.text) > 24 and k else ""
            style = f' class="{text or cell.state}"' if text or cell.state != PLAIN else ""
            cells.append(f"<{kind}{data}{style}>{escape(cell.text)}</{kind}>")
        lines.append(f"<tr>{''.join(cells)}</tr>")
    headings = "".join(f"<th>{escape(text)}</th>" for text in head)
    return (
        f'<div class="wide"><table class="sortable"><thead><tr>{headings}</tr></thead>'
        f"<tbody>{''.join(lines)}</tbody></table></div>"
    )


def definitions(pairs: Iterable[tuple[str, str]]) -> str:
    """Markup of terms and what they mean."""
    from markupsafe import escape

    return f"<dl>{''.join(f'<dt>{escape(term)}</dt><dd>{escape(text)}</dd>' for term, text in pairs)}</dl>"
