"""Whether the pages hold what they say: links and headings, files, commands, public names, and the
tables of ``docs/evidence``.

    python docs/check.py

Prints a line for each fault; exit code 1 where there is one. Part of ``make check``.
"""

import argparse
import importlib.util
import json
import os
import re
import shlex
import sys
from contextlib import redirect_stderr
from io import StringIO
from pathlib import Path
from unittest.mock import patch

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "docs")]

import figures  # noqa: E402
import gallery  # noqa: E402

import rbfmuscle as rm  # noqa: E402
from rbfmuscle.cli.app import app  # noqa: E402

TOPS = ("rbfmuscle", "pbd_baseline", "benchmarks", "tests", "docs", "examples")
CALLED = ("rbfmuscle", ".venv/bin/rbfmuscle", "python", "make")
GENERATED = {"gallery/index", "gallery/reference", "gallery/scene_reference"}


def wrong_links(page, text):
    """Links and pictures that lead to no file or heading."""
    for target, anchor in re.findall(r"\]\(([^)#\s]*)(?:#([^)]*))?\)", text):
        if target.startswith("https://"):
            continue
        file = page.parent / target if target else page
        if not file.exists() or (anchor and anchor not in anchors(file)):
            yield f"no such link: {target}#{anchor}"


def anchors(page):
    """The names of a page's headings, as links have them."""
    titles = re.findall(r"^#+ (.+)$", without_blocks(page.read_text(encoding="utf-8")), flags=re.M)
    return {re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-") for title in titles}


def without_blocks(text):
    return re.sub(r"```.*?```", "", text, flags=re.S)


def missing_files(page, text):
    """Files of the project that a page names and that are not there."""
    there = [
        f"/{path.relative_to(ROOT).as_posix()}"
        for top in TOPS
        for path in (ROOT / top).rglob("*")
        if "__pycache__" not in path.parts
    ]
    text = without_blocks(text)
    named = re.findall(r"[\w./]*\w\.py\b", text)
    named += re.findall(rf"(?<![\w./])(?:{'|'.join(TOPS)})/[\w./]*\w", text)
    for name in sorted(set(named)):
        if not any(file.endswith(f"/{name}") for file in there):
            yield f"no such file: {name}"


def unread_commands(page, text):
    """Commands that the library, a script of this folder or make does not take."""
    for words in commands(text):
        try:
            with redirect_stderr(StringIO()):
                read = is_read(words)
        except (Exception, SystemExit) as error:  # noqa: BLE001  whatever a parser raises
            read = False
            words = [*words, f"({error})"]
        if not read:
            yield f"not a command: {' '.join(words)}"


def commands(text):
    """Commands of a page, in blocks of shell and in lines, without comments and placeholders."""
    blocks = re.findall(r"```(?:sh|text)?\n(.*?)```", text, flags=re.S)
    listed = [line for block in blocks for line in block.splitlines()]
    listed += re.findall(r"`([^`\n]+)`", without_blocks(text))
    for line in listed:
        line = re.sub(r"[\[\]]|\.\.\.", "", line.partition("  #")[0])
        if line.split()[:1] and line.split()[0] in CALLED:
            yield shlex.split(line)


def is_read(words):
    if words[0] == "make":
        targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), flags=re.M))
        return all(word in targets or "=" in word for word in words[1:])
    if words[0] == "python":
        return words[1] == "-m" or arguments_are_read(ROOT / words[1], words[2:])
    if len(words) == 2 and words[1] in app:
        return True
    app.parse_args(words[1:], exit_on_error=False, print_error=False)
    return True


def arguments_are_read(path, words):
    """Whether a script's parser takes these words; it does nothing else with them."""

    class Read(Exception):
        pass

    read = argparse.ArgumentParser.parse_args

    def parse(parser, *_):
        read(parser, words)
        raise Read

    spec = importlib.util.spec_from_file_location("__main__", path)
    module = importlib.util.module_from_spec(spec)
    with (
        patch.object(argparse.ArgumentParser, "parse_args", parse),
        patch.object(sys, "argv", [str(path), *words]),
        patch.object(sys, "path", [str(path.parent), *sys.path]),
        # Some scripts choose their threads in the environment, for themselves alone.
        patch.dict(os.environ),
    ):
        try:
            spec.loader.exec_module(module)
        except Read:
            return True
    return False


def private_names(page, text):
    """Names after ``rm.`` that are not public."""
    for name in sorted(set(re.findall(r"\brm\.(\w+)", text)) - set(rm.__all__)):
        yield f"not public: rm.{name}"


def stale_tables(page, text):
    """Tables that differ from their files of evidence."""
    if page.name != "CONTRIBUTING.md" and figures.written(text) != text:
        yield "tables are not those of docs/evidence: run python docs/figures.py"


def wrong_evidence(shown):
    """Files of evidence without command, commit, machine or rows, or that no page shows."""
    for path in sorted((ROOT / "docs" / "evidence").glob("*.json")):
        facts = json.loads(path.read_text(encoding="utf-8"))
        if not all(facts.get(key) for key in ("command", "commit", "machine", "rows")):
            yield f"{path}: command, commit, machine or rows are missing"
        script = re.match(r"python (benchmarks/\w+\.py)", facts.get("command", ""))
        if not script or script[1] != f"benchmarks/{figures.COMMANDS[path.stem].split()[0]}":
            yield f"{path}: not made by the command of docs/figures.py"
        if f"<!-- evidence: {path.stem} -->" not in shown:
            yield f"{path}: on no page"


def unlisted_pages():
    """Pages that are neither in the index nor in the gallery, and entries without a page."""
    index = (ROOT / "docs" / "index.md").read_text(encoding="utf-8")
    listed = {line for line in index.splitlines() if re.fullmatch(r"[\w/]+", line)} - GENERATED
    listed |= {Path(page).name for page in gallery.PAGES}
    pages = {path.stem for path in (ROOT / "docs").glob("*.md")} - {"index"}
    for name in sorted(listed ^ pages):
        yield f"docs/index.md: {name} is listed without a page, or a page without being listed"


def main():
    pages = figures.page_files()
    found = []
    for page in [*pages, ROOT / "CONTRIBUTING.md"]:
        text = page.read_text(encoding="utf-8")
        for faults in (wrong_links, missing_files, unread_commands, private_names, stale_tables):
            found += [f"{page.relative_to(ROOT)}: {fault}" for fault in faults(page, text)]
    found += wrong_evidence("".join(page.read_text(encoding="utf-8") for page in pages))
    found += unlisted_pages()
    for fault in found:
        print(fault)
    return int(bool(found))


if __name__ == "__main__":
    raise SystemExit(main())
