"""Every example runs from its own folder, in an empty one, and passes the check that ends it."""

import ast
import os
import re
import runpy
import shutil
import subprocess
import sys

import pytest
from command_line import call
from conftest import ROOT

sys.path.insert(0, str(ROOT / "docs"))
from gallery import EXAMPLES, find_example, read_example, run_example

# What a user runs, each in a process of its own: up to a minute each.
slow = pytest.mark.slow
# Scripts that are no pages of the gallery.
OTHERS = {"pictures", "contact_pictures"}


def test_every_script_and_notebook_is_a_page_of_the_gallery():
    found = [path for path in (ROOT / "examples").iterdir() if path.suffix in (".py", ".ipynb")]
    assert sorted(path.stem for path in found if path.stem not in OTHERS) == sorted(EXAMPLES)
    assert sum(path.suffix == ".ipynb" for path in found) == 2


@slow
@pytest.mark.parametrize("name", EXAMPLES)
def test_example_has_a_title_and_passes_the_check_that_ends_it(name, tmp_path):
    text, code = read_example(find_example(ROOT, name))
    assert text.startswith("# ")
    assert any(isinstance(node, ast.Assert) for node in ast.parse(code).body[-3:])
    done = run_example(find_example(ROOT, name), tmp_path)
    assert done.returncode == 0, done.stderr[-2000:]


def test_meshes_become_a_report_by_the_lines_of_the_readme(tmp_path, monkeypatch, capsys):
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    lines = re.findall(r"^rbfmuscle (.*examples/meshes[^#\n]*)", text, re.MULTILINE)
    assert [line.split()[0] for line in lines] == ["new", "check", "run"]
    kept = shutil.ignore_patterns("scene.toml", "attachments")
    shutil.copytree(ROOT / "examples" / "meshes", tmp_path / "examples" / "meshes", ignore=kept)
    monkeypatch.chdir(tmp_path)
    for line in lines:
        code, out, err = call(capsys, *line.split())
        assert code == 0, err
    assert "verdict: " in out
    assert "gluteus_maximus" in (tmp_path / "out" / "report.html").read_text(encoding="utf-8")


@slow
@pytest.mark.parametrize(
    ("page", "report"),
    [("README.md", "out/report.html"), ("docs/python.md", "hip_run/report.html")],
)
def test_python_of_a_page_runs_as_it_stands_and_prints_what_the_page_shows(page, report, tmp_path):
    text = (ROOT / page).read_text(encoding="utf-8")
    blocks = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    shutil.copytree(ROOT / "examples" / "meshes", tmp_path / "examples" / "meshes")
    done = subprocess.run(
        [sys.executable, "-c", "\n".join(blocks)],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=600,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    assert "True" in done.stdout.split()  # the surface is closed
    assert all(shown in done.stdout for shown in re.findall(r"```text\n(.*?)```", text, re.DOTALL))
    assert (tmp_path / report).exists()


@slow
def test_the_papers_experiments_run(hip_data, monkeypatch, capsys):
    script = str(ROOT / "benchmarks" / "paper_experiments.py")
    monkeypatch.setattr(sys, "argv", [script, "--muscle", "gluteus_medius"])
    runpy.run_path(script, run_name="__main__")
    assert capsys.readouterr().out.count("flexion by 2") == 4
