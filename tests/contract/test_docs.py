"""What pages say of the scene file is what the library takes; `docs/check.py` reads the rest."""

import re
import sys
import tomllib

from conftest import ROOT

from pbd_baseline.rest import PBDOptions
from rbfmuscle.muscle.rest import RBFOptions
from rbfmuscle.scene.file import SceneFile

sys.path.insert(0, str(ROOT / "docs"))
import gallery


def test_scene_page_names_every_key_and_its_example_is_read():
    text = "".join((ROOT / f"docs/{name}.md").read_text() for name in ("scene_file", "contraction"))
    schemas = [table.model_json_schema() for table in (SceneFile, RBFOptions, PBDOptions)]
    tables = [table for schema in schemas for table in (schema, *schema.get("$defs", {}).values())]
    keys = {key for table in tables for key in table.get("properties", {})}
    assert {key for key in keys if not re.search(rf"\b{key}\b", text)} == set()
    example = re.search(r"```toml\n(.*?)```", text, flags=re.S).group(1)
    assert SceneFile.model_validate(tomllib.loads(example)).muscle[0].name == "gluteus_maximus"


def test_reference_of_the_scene_file_names_every_table_and_its_keys(tmp_path):
    (tmp_path / "docs" / "gallery").mkdir(parents=True)
    gallery.write_scene_reference(tmp_path)
    text = (tmp_path / "docs" / "gallery" / "scene_reference.md").read_text(encoding="utf-8")
    tables = re.findall(r"\(#(\w+)\)", text)
    assert {"bonetable", "muscletable"} <= set(tables)
    assert set(tables) <= {name.lower() for name in re.findall(r"^## (\w+)", text, flags=re.M)}
    assert '| `model` | string or table of any | `"rbf"` |' in text
