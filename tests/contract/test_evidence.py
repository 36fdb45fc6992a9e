"""Tables of the pages say what their files of evidence hold, and where these come from."""

import json
import re
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "docs"))
import figures  # noqa: E402

FILES = sorted((ROOT / "docs" / "evidence").glob("*.json"))


@pytest.mark.parametrize("page", figures.page_files(), ids=lambda path: path.stem)
def test_page_says_what_the_files_hold(page):
    text = page.read_text(encoding="utf-8")
    assert figures.written(text) == text, "run python docs/figures.py"


def test_changed_figure_is_found():
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    planted = text.replace("| volume error | ", "| volume error | 9", 1)
    assert planted != text
    assert figures.written(planted) == text


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_file_is_shown_and_names_command_commit_and_machine(path):
    facts = json.loads(path.read_text(encoding="utf-8"))
    assert all(isinstance(facts[key], str) and facts[key] for key in ("command", "commit", "machine"))
    script = re.match(r"python (benchmarks/\w+\.py)", facts["command"]).group(1)
    assert facts["rows"] and (ROOT / script).exists() and (ROOT / figures.COMMANDS[path.stem][0]).exists()
    shown = "".join(page.read_text(encoding="utf-8") for page in figures.page_files())
    assert f"<!-- evidence: {path.stem} -->" in shown


# Tables whose figures nobody measured: what is allowed, how something is stored.
GIVEN = {
    ("limits", "| what | limit |"),
    ("metrics", "| quantity | limit |"),
    ("pbd", "| model | shape | volume | sweeps per solve |"),
    ("sdf", "| level | edge, in fine cells | where |"),
}
MEASURED_BY = re.compile(
    r"(benchmarks|examples)/\w+(/\w+)?\.py|<!-- evidence: |`make \w|(python -m|rbfmuscle) \w+"
)


def tables(text):
    """Heads of the tables that are full of figures, each with its section of the page."""
    # A comment in a block of commands is no heading.
    text = re.sub(r"^```.*?^```", lambda block: block[0].replace("\n#", "\n #"), text, flags=re.S | re.M)
    for section in re.split(r"^(?=#+ )", text, flags=re.M):
        for head, body in re.findall(r"^(\|.*)\n\|[-| :]+\n((?:\|.*\n?)+)", section, flags=re.M):
            cells = [cell.strip() for row in body.splitlines() for cell in row.strip("|").split("|")[1:]]
            if sum(bool(re.match(r"[-+−<~(]*\d", cell)) for cell in cells) >= 0.4 * len(cells):
                yield head, section


def unexplained(page, text):
    return [
        head
        for head, section in tables(text)
        if (page, head) not in GIVEN and not MEASURED_BY.search(section.replace(head, ""))
    ]


@pytest.mark.parametrize("page", figures.page_files(), ids=lambda path: path.stem)
def test_tables_of_figures_say_what_measures_them(page):
    assert unexplained(page.stem, page.read_text(encoding="utf-8")) == []


def test_planted_table_without_a_command_is_found():
    table = "| model | error mm |\n|---|---|\n| rbf | 0.5 |\n"
    assert unexplained("page", f"# Page\n\n## Here\n\n{table}") == ["| model | error mm |"]
    assert unexplained("page", f"# Page\n\n## Here\n\n`python benchmarks/table.py`\n\n{table}") == []
    assert unexplained("page", f"# Page\n\n`python benchmarks/table.py`\n\n## Here\n\n{table}") != []


def test_scripts_that_pages_name_exist():
    for page in figures.page_files():
        for script in re.findall(
            r"\b((?:benchmarks|examples)/\w+(?:/\w+)?\.py)", page.read_text(encoding="utf-8")
        ):
            assert (ROOT / script).exists(), f"{page.name}: {script}"
