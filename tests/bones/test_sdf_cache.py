"""The cache of distance fields on disk."""

import numpy as np
import pytest
import trimesh

from rbfmuscle.bones import sdf
from rbfmuscle.bones.sdf import BoneSDF
from rbfmuscle.cache import SUFFIX, cache_path


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv("RBFMUSCLE_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.fixture
def ball():
    return trimesh.creation.icosphere(3, 20.0)


@pytest.fixture
def builds(monkeypatch):
    """Number of fields built from their meshes, as a list that grows."""
    found, build = [], sdf.build_cells
    monkeypatch.setattr(sdf, "build_cells", lambda *a, **k: found.append(1) or build(*a, **k))
    return found


POINTS = np.random.default_rng(0).uniform(-25.0, 25.0, (2000, 3))


def test_second_field_comes_from_the_cache_and_is_the_same(ball, builds, folder):
    first, second = BoneSDF.from_mesh(ball), BoneSDF.from_mesh(ball)
    assert len(builds) == 1
    assert cache_path() == folder
    np.testing.assert_array_equal(first.distance(POINTS), second.distance(POINTS))
    for name in ("spacing", "error", "closed", "notes", "memory"):
        assert getattr(first, name) == getattr(second, name)
    # Another mesh or other options are other entries.
    BoneSDF.from_mesh(ball, tolerance=0.005)
    BoneSDF.from_mesh(ball, region=[[0.0, 0, 0], [25, 25, 25]])
    ball.vertices[0, 0] += 1e-9
    BoneSDF.from_mesh(ball)
    assert len(builds) >= 4
    assert len(list(folder.glob("*" + SUFFIX))) == 4


DAMAGES = {
    "cut": lambda content: content[: len(content) // 2],
    "flipped": lambda content: content[:500] + bytes([content[500] ^ 0xFF]) + content[501:],
    "text": lambda content: b"not an archive",
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_damaged_entry_is_rebuilt(ball, builds, folder, damage):
    expected = BoneSDF.from_mesh(ball).distance(POINTS)
    (entry,) = folder.glob("*.npz")
    entry.write_bytes(DAMAGES[damage](entry.read_bytes()))
    for _ in range(2):
        np.testing.assert_array_equal(BoneSDF.from_mesh(ball).distance(POINTS), expected)
        assert len(builds) == 2


def test_entry_of_another_mesh_is_not_believed(ball, builds, folder):
    BoneSDF.from_mesh(ball)
    (entry,) = folder.glob("*.npz")
    other = trimesh.creation.box((10.0, 10.0, 10.0))
    BoneSDF.from_mesh(other)
    (second,) = set(folder.glob("*.npz")) - {entry}
    second.write_bytes(entry.read_bytes())
    assert BoneSDF.from_mesh(other).distance(np.zeros((1, 3)))[0] == pytest.approx(-5.0, abs=0.1)
    assert len(builds) == 3


def test_cache_that_cannot_be_written_does_no_harm(ball, folder, caplog):
    folder.write_text("a file where the folder should be")
    field = BoneSDF.from_mesh(ball)
    assert field.distance(np.zeros((1, 3)))[0] < -19.0
    assert "cannot be written" in caplog.text
