"""The lists of tests that take little time, or run without the compiler: all there, and something of every package."""

import re

import pytest
from conftest import ROOT


def listed(name):
    lines = (ROOT / "tests" / name).read_text(encoding="utf-8").splitlines()
    return [line for line in lines if line and not line.startswith("#")]


@pytest.mark.parametrize("name", ["fast.txt", "nojit.txt"])
def test_what_is_listed_is_there_and_named_once(name):
    lines = listed(name)
    assert len(set(lines)) == len(lines)
    for line in lines:
        path, *names = line.split("::")
        assert (ROOT / path).exists(), line
        text = (ROOT / path).read_text(encoding="utf-8") if names else ""
        assert all(re.search(rf"^ *(def|class) {word}\b", text, flags=re.M) for word in names), line


def test_quick_tests_are_of_every_package():
    packages = {path.relative_to(ROOT / "tests").parts[0] for path in (ROOT / "tests").rglob("test_*.py")}
    assert {line.split("/")[1] for line in listed("fast.txt")} == packages
