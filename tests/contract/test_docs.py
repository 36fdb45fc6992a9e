"""Links in the pages lead somewhere, tables say what their files of evidence hold, and listed tests
are there.
"""

import json
import re
import sys

import pytest
from conftest import ROOT

sys.path.insert(0, str(ROOT / "docs"))
import figures


@pytest.mark.parametrize("page", sorted((ROOT / "docs").glob("*.md")), ids=lambda path: path.stem)
def test_links_and_pictures_lead_to_files(page):
    text = page.read_text(encoding="utf-8")
    for target in re.findall(r"\]\(([^)#\s]+)(?:#[^)]*)?\)", text):
        assert target.startswith("https://") or (page.parent / target).exists(), target


@pytest.mark.parametrize("name", ["fast.txt", "nojit.txt"])
def test_what_is_listed_is_there_and_named_once(name):
    lines = re.findall(
        r"^[^#\n].*", (ROOT / "tests" / name).read_text(encoding="utf-8"), flags=re.M
    )
    assert len(set(lines)) == len(lines)
    for line in lines:
        path, *names = line.partition("[")[0].split("::")
        assert (ROOT / path).exists(), line
        text = (ROOT / path).read_text(encoding="utf-8") if names else ""
        assert all(re.search(rf"^ *(def|class) {word}\b", text, flags=re.M) for word in names), line


@pytest.mark.parametrize("page", figures.page_files(), ids=lambda path: path.stem)
def test_page_says_what_the_files_hold(page):
    text = page.read_text(encoding="utf-8")
    assert figures.written(text) == text, "run python docs/figures.py"


@pytest.mark.parametrize(
    "path", sorted((ROOT / "docs" / "evidence").glob("*.json")), ids=lambda path: path.stem
)
def test_file_is_shown_and_names_command_commit_and_machine(path):
    facts = json.loads(path.read_text(encoding="utf-8"))
    assert all(
        isinstance(facts[key], str) and facts[key] for key in ("command", "commit", "machine")
    )
    script = re.match(r"python (benchmarks/\w+\.py)", facts["command"]).group(1)
    assert (
        facts["rows"]
        and (ROOT / script).exists()
        and (ROOT / figures.COMMANDS[path.stem][0]).exists()
    )
    shown = "".join(page.read_text(encoding="utf-8") for page in figures.page_files())
    assert f"<!-- evidence: {path.stem} -->" in shown
