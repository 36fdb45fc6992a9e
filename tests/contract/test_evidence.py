"""Tables of the pages say what their files of evidence hold, and where these come from."""

import json
import re
import sys

import pytest
from conftest import ROOT

sys.path.insert(0, str(ROOT / "docs"))
import figures

FILES = sorted((ROOT / "docs" / "evidence").glob("*.json"))


@pytest.mark.parametrize("page", figures.page_files(), ids=lambda path: path.stem)
def test_page_says_what_the_files_hold(page):
    text = page.read_text(encoding="utf-8")
    assert figures.written(text) == text, "run python docs/figures.py"


@pytest.mark.parametrize("path", FILES, ids=lambda path: path.stem)
def test_file_is_shown_and_names_command_commit_and_machine(path):
    facts = json.loads(path.read_text(encoding="utf-8"))
    assert all(isinstance(facts[key], str) and facts[key] for key in ("command", "commit", "machine"))
    script = re.match(r"python (benchmarks/\w+\.py)", facts["command"]).group(1)
    assert facts["rows"] and (ROOT / script).exists() and (ROOT / figures.COMMANDS[path.stem][0]).exists()
    shown = "".join(page.read_text(encoding="utf-8") for page in figures.page_files())
    assert f"<!-- evidence: {path.stem} -->" in shown
