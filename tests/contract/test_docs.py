"""The documentation names every page, and its links lead somewhere."""

import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
sys.path.insert(0, str(DOCS))
import gallery  # noqa: E402


def listed():
    """Pages in the toctrees of the index."""
    text = (DOCS / "index.md").read_text(encoding="utf-8")
    trees = re.findall(r"```\{toctree\}\n(.*?)```", text, flags=re.S)
    return [line for tree in trees for line in tree.splitlines() if line and not line.startswith(":")]


def test_index_names_every_page_once():
    names = listed()
    assert len(names) == len(set(names))
    assert {name for name in names if "/" not in name} == set(gallery.pages(ROOT))


@pytest.mark.parametrize("page", sorted(DOCS.glob("*.md")), ids=lambda path: path.stem)
def test_links_and_pictures_lead_to_files(page):
    text = page.read_text(encoding="utf-8")
    for target in re.findall(r"\]\(([^)#\s]+)(?:#[^)]*)?\)", text):
        assert target.startswith("https://") or (page.parent / target).exists(), target


def test_scene_reference_holds_every_key_with_its_default(tmp_path):
    from rbfmuscle.scene.file import SceneFile

    (tmp_path / "docs" / "gallery").mkdir(parents=True)
    gallery.write_scene_reference(tmp_path)
    text = (tmp_path / "docs" / "gallery" / "scene_reference.md").read_text(encoding="utf-8")
    for table in SceneFile.model_json_schema()["$defs"].values():
        assert all(f"| `{key}` |" in text for key in table["properties"])
    assert "| `substep_angle` | number, at most 90, above 0 | `2.0` |" in text
    assert '`greedy`, `fitted` | `"greedy"` |' in text
    assert "| `method` | `pbd`, " in text


def test_reference_holds_every_public_name(tmp_path):
    import rbfmuscle

    (tmp_path / "docs").mkdir()
    gallery.write_reference(tmp_path, rbfmuscle)
    text = (tmp_path / "docs" / "gallery" / "reference.md").read_text(encoding="utf-8")
    for name in set(rbfmuscle.__all__) - {"__version__"}:
        assert f"## {name}\n" in text


def test_pages_build_without_warnings(tmp_path):
    """The pages alone; the gallery, which takes minutes, is made by `make docs`."""
    pytest.importorskip("sphinx")
    pytest.importorskip("myst_parser")
    pytest.importorskip("furo")
    shutil.copytree(DOCS, tmp_path / "docs", ignore=shutil.ignore_patterns("_build", "gallery"))
    (tmp_path / "docs" / "gallery").mkdir()
    (tmp_path / "docs" / "gallery" / "index.md").write_text("# Gallery\n", encoding="utf-8")
    done = subprocess.run(
        [sys.executable, "-m", "sphinx", "-W", "--keep-going", "-q", "-b", "html", "docs", "html"],
        cwd=tmp_path, capture_output=True, text=True, timeout=600, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-3000:]
    html = (tmp_path / "html" / "index.html").read_text(encoding="utf-8")
    assert not re.findall(
        r'(?:src|href)="https?://(?!www\.sphinx-doc|pradyunsg|github)[^"]*\.(?:js|css)"', html
    )
