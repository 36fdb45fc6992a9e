"""What a release consists of: one version everywhere, every package and its files found."""

import re
import tomllib

from conftest import ROOT

import rbfmuscle

PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))


def test_one_version_everywhere():
    version = PROJECT["project"]["version"]
    assert rbfmuscle.__version__ == version
    citation = (ROOT / "CITATION.cff").read_text(encoding="utf-8")
    assert re.search(r"^version: (.+)$", citation, re.M).group(1) == version
    changes = (ROOT / "docs" / "changes.md").read_text(encoding="utf-8")
    assert re.search(r"^## (\S+)", changes, re.M).group(1) == version


def test_every_folder_with_modules_is_a_package():
    for top in ("rbfmuscle", "pbd_baseline"):
        assert (ROOT / top / "py.typed").exists()
        for folder in {path.parent for path in (ROOT / top).rglob("*.py")}:
            assert (folder / "__init__.py").exists(), folder


def test_typed_marker_templates_and_scripts_travel_with_the_packages():
    data = PROJECT["tool"]["setuptools"]["package-data"]
    for top in ("rbfmuscle", "pbd_baseline"):
        packed = {path for pattern in data[top] for path in (ROOT / top).glob(pattern)}
        every = (ROOT / top).rglob("*")
        files = {path for path in every if path.is_file() and "__pycache__" not in path.parts}
        assert packed == {path for path in files if path.suffix != ".py"}
