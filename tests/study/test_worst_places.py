"""Worst places on shapes whose thickness, gap and radius are known."""

import numpy as np
import pytest
import trimesh

from rbfmuscle.study.measure.worst_places import PLACES, worst_places


def places(mesh, distance, *, cell, count=60):
    points, faces = trimesh.sample.sample_surface_even(mesh, 3000, seed=0)
    centres = trimesh.sample.sample_surface_even(mesh, count, seed=1)[0]
    arrays = np.asarray(mesh.vertices, dtype=float), np.asarray(mesh.faces)
    normals = np.asarray(mesh.face_normals[faces])
    return worst_places(
        np.asarray(points), normals, distance(np.asarray(points)), arrays, np.asarray(centres), cell=cell
    )


def near(point):
    return lambda points: np.exp(-((points - point) ** 2).sum(axis=1) / 4.0)


def test_a_thin_sheet_is_a_rim_or_too_thin_for_the_grid():
    slab = trimesh.creation.box([40.0, 20.0, 1.0])
    first = places(slab, near([10.0, 0.0, 0.5]), cell=0.1)[0]
    assert first["thickness"] == pytest.approx(1.0) and first["gap"] is None
    assert first["cause"].startswith("rim: 1 thick") and "centres 1 apart" in first["remedy"]
    assert np.linalg.norm(np.array(first["point"]) - [10.0, 0.0, 0.5]) < 1.5
    coarse = places(slab, near([10.0, 0.0, 0.5]), cell=2.0)[0]
    assert coarse["cause"].startswith("grid: 1 thick, cells of 2") and "cells of 0.5" in coarse["remedy"]


def test_a_narrow_gap_is_a_fold():
    # an inverted L and its neighbour, one part: two blocks joined at one end, 1 apart
    blocks = [trimesh.creation.box([30.0, 10.0, 10.0]).apply_translation([0, 0, z]) for z in (-5.5, 5.5)]
    both = trimesh.util.concatenate(blocks)
    first = places(both, near([5.0, 0.0, 0.5]), cell=0.1)[0]
    assert first["gap"] == pytest.approx(1.0) and first["cause"].startswith("fold: 1 wide")


def test_a_sharp_bend_has_its_radius():
    rod = trimesh.creation.capsule(60.0, 3.0, count=[64, 64])
    ends = rod.vertices[np.argmax(rod.vertices[:, 2])]
    first = places(rod, near(ends), cell=0.1, count=20)[0]
    assert first["radius"] == pytest.approx(3.0, rel=0.3) and first["cause"].startswith("bend")


def test_places_lie_apart_and_come_by_size():
    ball = trimesh.creation.icosphere(subdivisions=4, radius=20.0)
    found = places(ball, lambda p: np.abs(p[:, 0]) + np.abs(p[:, 1]), cell=0.1)
    assert len(found) == PLACES
    size = [place["distance"] for place in found]
    assert size == sorted(size, reverse=True)
    at = np.array([place["point"] for place in found])
    apart = np.linalg.norm(at[:, None] - at[None], axis=2)[np.triu_indices(PLACES, 1)]
    assert apart.min() > 1.4 * min(place["spacing"] for place in found)
