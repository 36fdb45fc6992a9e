"""The cache of distance fields on disk."""

import os
import pickle
import time

import numpy as np
import pytest
import trimesh

from rbfmuscle import cache
from rbfmuscle.bones import sdf
from rbfmuscle.bones.sdf import BoneSDF
from rbfmuscle.cache import SUFFIX, cache_path, content_key, load_arrays, store_arrays


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


def test_regions_that_are_alike_share_a_field_that_covers_both(ball, builds):
    region = np.array([[1.0, -9.0, -30.0], [24.0, 9.5, 3.0]])
    near = region + np.array([[0.2, 0.1, -50.0], [60.0, -0.2, 0.1]])  # and far beyond the bone
    fields = [BoneSDF.from_mesh(ball, region=region)]
    once = len(builds)
    fields.append(BoneSDF.from_mesh(ball, region=near))
    assert len(builds) == once
    np.testing.assert_array_equal(*(field.distance(POINTS) for field in fields))
    grown = sdf._stepped_region(sdf._region_steps(region, ball.vertices), ball.vertices)
    inner = np.clip(region, *ball.bounds)
    assert (grown[0] <= inner[0]).all() and (grown[1] >= inner[1]).all()
    assert np.abs(grown - inner).max() <= 2.0 * 40.0 / sdf.REGION_PARTS + 1e-9
    BoneSDF.from_mesh(ball, region=region + 5.0)
    assert len(builds) > once


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
    np.testing.assert_allclose(*(field.distance(POINTS) for field in fields), atol=1e-9 * 20.0)
