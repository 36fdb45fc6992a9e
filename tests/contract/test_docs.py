"""Links in the pages lead somewhere, files and commands that they name are there, tables say what
their files of evidence hold, and listed tests are there.
"""

import argparse
import importlib.util
import json
import os
import re
import shlex
import sys
import tomllib
from pathlib import Path

import pytest
from conftest import ROOT

import rbfmuscle as rm
from pbd_baseline.options import PBDOptions
from rbfmuscle.cli.app import app
from rbfmuscle.muscle.options import RBFOptions
from rbfmuscle.scene.file import SceneFile

sys.path.insert(0, str(ROOT / "docs"))
import figures
import gallery

PAGES = [*figures.page_files(), ROOT / "CONTRIBUTING.md"]
TOPS = ("rbfmuscle", "pbd_baseline", "benchmarks", "tests", "docs", "examples")
FILES = [
    path.relative_to(ROOT).as_posix()
    for top in TOPS
    for path in (ROOT / top).rglob("*")
    if "__pycache__" not in path.parts
]
CALLED = ("rbfmuscle", ".venv/bin/rbfmuscle", "python", "make")
GENERATED = {"gallery/index", "gallery/reference", "gallery/scene_reference"}
of_page = pytest.mark.parametrize("page", PAGES, ids=lambda path: path.stem)


def anchors(page):
    """The names of a page's headings, as links have them."""
    text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.S)
    titles = re.findall(r"^#+ (.+)$", text, flags=re.M)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


def commands(text):
    """Commands of a page, in blocks of shell and in lines, without comments and placeholders."""
    blocks = re.findall(r"```(?:sh|text)?\n(.*?)```", text, flags=re.S)
    listed = [line for block in blocks for line in block.splitlines()]
    prose = re.sub(r"```.*?```", "", text, flags=re.S)
    listed += re.findall(r"`([^`\n]+)`", prose)
    for line in listed:
        line = re.sub(r"[\[\]]|\.\.\.", "", line.partition("  #")[0])
        if line.split()[:1] and line.split()[0] in CALLED:
            yield shlex.split(line)


def is_read(words):
    """Whether a command of the library, of a script of this folder, or a target of make is read."""
    if words[0] == "make":
        targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), flags=re.M))
        return all(word in targets or "=" in word for word in words[1:])
    if words[0] != "python":
        if len(words) == 2 and words[1] in app:
            return True
        app.parse_args(words[1:], exit_on_error=False, print_error=False)
        return True
    return words[1] == "-m" or arguments_are_read(ROOT / words[1], words[2:])


def arguments_are_read(path, words):
    """Whether a script's parser takes these words; it does nothing else with them."""

    class Read(Exception):
        pass

    def parse(parser, *_):
        read(parser, words)
        raise Read

    read = argparse.ArgumentParser.parse_args
    spec = importlib.util.spec_from_file_location("__main__", path)
    module = importlib.util.module_from_spec(spec)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(argparse.ArgumentParser, "parse_args", parse)
        patch.setattr(sys, "argv", [str(path), *words])
        patch.setattr(sys, "path", [str(path.parent), *sys.path])
        # Some scripts choose their threads in the environment, for themselves alone.
        before = dict(os.environ)
        try:
            with pytest.raises(Read):
                spec.loader.exec_module(module)
        finally:
            os.environ.clear()
            os.environ.update(before)
    return True


@of_page
def test_links_and_pictures_lead_to_files_and_headings(page):
    text = page.read_text(encoding="utf-8")
    for target, anchor in re.findall(r"\]\(([^)#\s]*)(?:#([^)]*))?\)", text):
        if target.startswith("https://"):
            continue
        file = page.parent / target if target else page
        assert file.exists(), target
        assert not anchor or anchor in anchors(file), f"{target}#{anchor}"


@of_page
def test_files_that_a_page_names_are_there(page):
    text = re.sub(r"```.*?```", "", page.read_text(encoding="utf-8"), flags=re.S)
    named = re.findall(r"[\w./]*\w\.py\b", text)
    named += re.findall(rf"(?<![\w./])(?:{'|'.join(TOPS)})/[\w./]*\w", text)
    assert [
        name for name in named if not any(f"/{file}".endswith(f"/{name}") for file in FILES)
    ] == []


@of_page
def test_commands_of_a_page_are_read(page):
    for words in commands(page.read_text(encoding="utf-8")):
        assert is_read(words), words


@pytest.mark.parametrize(
    "text",
    [
        "`rbfmuscle plan phantom`",
        "```sh\nrbfmuscle run phantom -o out --muscle a  # no\n```",
        "`make nothing`",
        "`python docs/figures.py --remeasure`",
        "`python benchmarks/gone.py`",
    ],
)
def test_planted_wrong_command_is_found(text):
    (words,) = commands(text)
    with pytest.raises((Exception, SystemExit)):
        assert is_read(words)


@of_page
def test_python_names_of_a_page_are_public(page):
    text = page.read_text(encoding="utf-8")
    assert {name for name in re.findall(r"\brm\.(\w+)", text) if name not in rm.__all__} == set()


def test_scene_page_names_every_key_and_its_example_is_read():
    text = "".join((ROOT / f"docs/{name}.md").read_text() for name in ("scene_file", "contraction"))
    schemas = [table.model_json_schema() for table in (SceneFile, RBFOptions, PBDOptions)]
    tables = [table for schema in schemas for table in (schema, *schema.get("$defs", {}).values())]
    keys = {key for table in tables for key in table.get("properties", {})}
    assert {key for key in keys if not re.search(rf"\b{key}\b", text)} == set()
    example = re.search(r"```toml\n(.*?)```", text, flags=re.S).group(1)
    assert SceneFile.model_validate(tomllib.loads(example)).muscle[0].name == "gluteus_maximus"


def test_pages_are_short_enough_to_be_read():
    """Words are what stands between spaces and has a letter, in tables and code too; the list of
    changes grows with each release and does not count.
    """
    texts = [page.read_text(encoding="utf-8") for page in figures.page_files()]
    texts.remove((ROOT / "docs" / "changes.md").read_text(encoding="utf-8"))
    assert sum(bool(re.search("[A-Za-z]", word)) for text in texts for word in text.split()) <= 15e3


def test_figures_stand_in_one_page_and_the_readme():
    holding = {page.stem for page in PAGES if "<!-- evidence:" in page.read_text(encoding="utf-8")}
    assert holding == {"README", "validation"}


def test_every_page_is_in_the_index_or_in_the_gallery():
    index = (ROOT / "docs" / "index.md").read_text(encoding="utf-8")
    listed = {line for line in index.splitlines() if re.fullmatch(r"[\w/]+", line)} - GENERATED
    listed |= {Path(page).name for page in gallery.PAGES}
    assert listed == {path.stem for path in (ROOT / "docs").glob("*.md")} - {"index"}


def test_reference_of_the_scene_file_names_every_table_and_its_keys(tmp_path):
    (tmp_path / "docs" / "gallery").mkdir(parents=True)
    gallery.write_scene_reference(tmp_path)
    text = (tmp_path / "docs" / "gallery" / "scene_reference.md").read_text(encoding="utf-8")
    tables = re.findall(r"\(#(\w+)\)", text)
    assert {"bonetable", "muscletable"} <= set(tables)
    assert set(tables) <= {name.lower() for name in re.findall(r"^## (\w+)", text, flags=re.M)}
    assert '| `model` | string or table of any | `"rbf"` |' in text


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
    assert script == f"benchmarks/{figures.COMMANDS[path.stem].split()[0]}"
    assert facts["rows"] and (ROOT / script).exists()
    shown = "".join(page.read_text(encoding="utf-8") for page in figures.page_files())
    assert f"<!-- evidence: {path.stem} -->" in shown
