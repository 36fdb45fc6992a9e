"""Links in the pages lead somewhere; what lists of tests name is there."""

import re

import pytest
from conftest import ROOT


@pytest.mark.parametrize("page", sorted((ROOT / "docs").glob("*.md")), ids=lambda path: path.stem)
def test_links_and_pictures_lead_to_files(page):
    text = page.read_text(encoding="utf-8")
    for target in re.findall(r"\]\(([^)#\s]+)(?:#[^)]*)?\)", text):
        assert target.startswith("https://") or (page.parent / target).exists(), target


def listed(name):
    lines = (ROOT / "tests" / name).read_text(encoding="utf-8").splitlines()
    return [line for line in lines if line and not line.startswith("#")]


@pytest.mark.parametrize("name", ["fast.txt", "nojit.txt"])
def test_what_is_listed_is_there_and_named_once(name):
    lines = listed(name)
    assert len(set(lines)) == len(lines)
    for line in lines:
        path, *names = line.partition("[")[0].split("::")
        assert (ROOT / path).exists(), line
        text = (ROOT / path).read_text(encoding="utf-8") if names else ""
        assert all(re.search(rf"^ *(def|class) {word}\b", text, flags=re.M) for word in names), line
