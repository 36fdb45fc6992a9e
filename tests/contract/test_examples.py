"""Every example runs from its own folder, in an empty one, and passes the check that ends it."""

import ast
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT / "docs"))
from gallery import EXAMPLES  # noqa: E402

# Scripts that are no pages of the gallery.
OTHERS = {"pictures", "paper_experiments", "contact_pictures"}


def test_every_script_is_a_page_of_the_gallery():
    found = {path.stem for path in (ROOT / "examples").glob("*.py")}
    assert found - OTHERS == set(EXAMPLES)


@pytest.mark.parametrize("name", EXAMPLES)
def test_example_begins_with_a_title_and_ends_with_a_check(name):
    tree = ast.parse((ROOT / "examples" / f"{name}.py").read_text(encoding="utf-8"))
    assert ast.get_docstring(tree).startswith("# ")
    assert any(isinstance(node, ast.Assert) for node in tree.body[-3:])


@pytest.mark.parametrize("name", EXAMPLES)
def test_example_passes_its_own_check(name, tmp_path):
    done = subprocess.run(
        [sys.executable, f"{name}.py", str(tmp_path)], cwd=ROOT / "examples", env=dict(os.environ),
        capture_output=True, text=True, timeout=600, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-2000:]
