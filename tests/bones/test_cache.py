"""The cache of arrays on disk."""

import os
import pickle
import time

import numpy as np
import pytest
import trimesh
from conftest import samples

from rbfmuscle import cache
from rbfmuscle.bones import rounded
from rbfmuscle.bones.sdf import BoneSDF
from rbfmuscle.cache import SUFFIX, cache_path, content_key, load_arrays, store_arrays
from rbfmuscle.geometry.frames import RestFrame


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.setenv("RBFMUSCLE_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.fixture
def ball():
    return trimesh.creation.icosphere(3, 20.0)


@pytest.fixture
def builds(monkeypatch):
    """Number of bones rounded from their meshes, as a list that grows."""
    found, fill = [], rounded._fill
    monkeypatch.setattr(rounded, "_fill", lambda *given: found.append(1) or fill(*given))
    return found


BOX = np.array([[-25.0] * 3, [25.0] * 3])
FRAME = RestFrame(np.random.default_rng(0).normal(size=(50, 3)) * [30.0, 20, 10])


def nodes(mesh, *, region=BOX, spacing=3.0):
    return rounded.round_bone(BoneSDF.from_mesh(mesh), FRAME, spacing, region).nodes


def test_a_bone_rounded_again_comes_from_the_cache_and_is_the_same(ball, builds, folder):
    first, second = nodes(ball), nodes(ball)
    assert len(builds) == 1
    assert cache_path() == folder
    np.testing.assert_array_equal(first, second)
    # Another mesh or other options are other entries.
    nodes(ball, spacing=4.0)
    nodes(ball, region=BOX + 1.0)
    ball.vertices[0, 0] += 1e-9
    nodes(ball)
    assert len(builds) == 4
    assert len(list(folder.glob("*" + SUFFIX))) == 4


@pytest.mark.parametrize(
    ("platform", "variable", "place"),
    [
        ("linux", "XDG_CACHE_HOME", "rbfmuscle/sdf"),
        ("win32", "LOCALAPPDATA", "rbfmuscle/Cache/sdf"),
        ("darwin", "HOME", "Library/Caches/rbfmuscle/sdf"),
    ],
)
def test_cache_lies_where_the_platform_keeps_caches(
    monkeypatch, tmp_path, platform, variable, place
):
    monkeypatch.delenv("RBFMUSCLE_CACHE", raising=False)
    monkeypatch.setenv(variable, str(tmp_path))
    monkeypatch.setattr("sys.platform", platform)
    assert cache_path() == tmp_path / place


POINTS = np.random.default_rng(0).uniform(-25.0, 25.0, (samples(2000), 3))
DAMAGES = {
    "cut": lambda content: content[: len(content) // 2],
    "flipped": lambda content: content[:500] + bytes([content[500] ^ 0xFF]) + content[501:],
    "text": lambda content: b"not an archive",
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_damaged_entry_is_rebuilt(ball, builds, folder, damage):
    expected = nodes(ball)
    (entry,) = folder.glob("*.npz")
    entry.write_bytes(DAMAGES[damage](entry.read_bytes()))
    for _ in range(2):
        np.testing.assert_array_equal(nodes(ball), expected)
        assert len(builds) == 2


def test_entry_of_another_mesh_or_with_other_fields_is_not_believed(ball, builds, folder):
    nodes(ball)
    (entry,) = folder.glob("*.npz")
    other = trimesh.creation.box((10.0, 10.0, 10.0))
    expected = nodes(other)
    (second,) = set(folder.glob("*.npz")) - {entry}
    second.write_bytes(entry.read_bytes())
    np.testing.assert_array_equal(nodes(other), expected)
    assert len(builds) == 3
    store_arrays(second.name[: -len(SUFFIX)], {"others": np.zeros(3)})
    np.testing.assert_array_equal(nodes(other), expected)
    assert len(builds) == 4


def test_cache_that_cannot_be_written_does_no_harm(ball, folder, caplog):
    folder.write_text("a file where the folder should be")
    assert len(nodes(ball)) > 0
    assert "cannot be written" in caplog.text


def test_what_was_not_used_for_longest_is_removed_first(folder, monkeypatch):
    vertices, faces = np.zeros((3, 3)), np.zeros((1, 3), dtype=int)
    keys = [content_key(vertices, faces, (k,)) for k in range(5)]
    values = np.zeros(1000)
    for key in keys[:3]:
        store_arrays(key, {"values": values})
    entries = {key: folder / (key + SUFFIX) for key in keys}
    for age, key in ((300, keys[0]), (200, keys[1]), (100, keys[2])):
        os.utime(entries[key], (time.time() - age,) * 2)
    left = folder / (keys[3] + cache.PART)
    left.write_bytes(b"half")
    assert load_arrays(keys[0]) is not None  # which is now the one used last
    monkeypatch.setattr(cache, "MOST_BYTES", 3.5 * entries[keys[0]].stat().st_size)
    store_arrays(keys[3], {"values": values})
    assert [entries[key].exists() for key in keys] == [True, False, True, True, False]
    assert left.exists()  # another process may be writing it
    os.utime(left, (time.time() - 2.0 * cache.ABANDONED,) * 2)
    store_arrays(keys[4], {"values": values})
    assert [entries[key].exists() for key in keys] == [True, False, False, True, True]
    assert not left.exists()
    monkeypatch.setattr(cache, "MOST_BYTES", 1)
    store_arrays(keys[1], {"values": values})
    assert [*folder.iterdir()] == [entries[keys[1]]]


def test_field_can_be_pickled(ball):
    field = BoneSDF.from_mesh(ball)
    pose = trimesh.transformations.rotation_matrix(0.3, [1, 2, 3], [4, 5, 6])
    expected = field.distance(POINTS, pose)
    again = pickle.loads(pickle.dumps(field))
    np.testing.assert_array_equal(again.distance(POINTS, pose), expected)


def test_field_does_not_depend_on_the_numbering_of_its_mesh(ball):
    x, y, z = np.array(ball.vertices).T / 20.0
    ball.vertices += np.stack([x**2 + y, y**2 + 0.5 * z, z**2], axis=1)  # without any symmetry
    rng = np.random.default_rng(2)
    order = rng.permutation(len(ball.vertices))
    faces = np.argsort(order)[np.asarray(ball.faces)][rng.permutation(len(ball.faces))]
    fields = [BoneSDF.from_mesh(mesh) for mesh in (ball, (ball.vertices[order], faces))]
    np.testing.assert_allclose(*(field.distance(POINTS) for field in fields), atol=1e-12)
