"""Muscles that touch: which do, and what the frame loop makes of them."""

import igl
import numpy as np
import pytest
import toy_scene as toy
import trimesh

from pbd_baseline.settling import MovingSurface
from rbfmuscle.scene.options import NeighbourOptions
from rbfmuscle.simulation.frame_loop import FrameLoop, simulate_frames
from rbfmuscle.simulation.neighbours import connected, find_links

pytestmark = pytest.mark.numeric


@pytest.mark.parametrize(
    ("scale", "subdivisions", "reach", "share"),
    [([10, 10, 10], 3, 3.0, 1.0), ([24, 9, 4], 2, 1.5, 0.95), ([10, 10, 2.5], 3, 4.0, 0.9)],
)
def test_distances_are_those_of_the_triangles(scale, subdivisions, reach, share):
    """A ball, three extents, and a lens, beside whose rim the normals of two sides disagree."""
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions)
    vertices = mesh.vertices * np.array(scale)
    surface = MovingSurface(vertices, mesh.faces, reach)
    rng = np.random.default_rng(7)
    points = np.tile(vertices, (3, 1)) * rng.uniform(0.85, 1.4, (3 * len(vertices), 1))
    nearest = np.tile(np.arange(len(vertices)), 3)
    columns, shares = np.empty((len(points), 3), dtype=np.int64), np.empty((len(points), 3))
    normal = np.empty((len(points), 3))
    distance = surface.ask(points, nearest, columns, shares, normal)
    exact, _, foot, _ = igl.signed_distance(points, vertices, mesh.faces)
    known = np.isfinite(distance)
    assert known[np.abs(exact) < 0.95 * reach].all()
    assert np.array_equal(distance[known] < 0.0, exact[known] < 0.0) and (exact < 0.0).any()
    # What is left is nearer to another ring of triangles than the one looked at.
    error = np.abs(distance - exact)[known]
    assert (error < 1e-9).mean() >= share and error.max() < 0.2
    found = np.einsum("nk,nka->na", shares, vertices[columns])[known]
    # Below a corner several places are as near.
    away = np.linalg.norm(found - foot[known], axis=1)[exact[known] > 0.0]
    assert (away < 1e-6).mean() >= share - 0.01
    if share == 1.0:  # a ball
        outward = points / np.linalg.norm(points, axis=1, keepdims=True)
        assert np.einsum("ij,ij->i", normal, outward)[known].min() > 0.99


def _run(angles, neighbours, **options):
    made, fields = toy.neighbour_scene(angles, neighbours=neighbours, **options)
    parts = toy.neighbour_parts(made)
    return list(simulate_frames(made, parts.values(), bone_sdfs=fields)), parts


def _overlap(parts):
    """Deepest free point of either muscle in the other."""
    deepest = 0.0
    for one, two in (("lower", "upper"), ("upper", "lower")):
        points = parts[one].x[parts[one].attached_bone < 0]
        distance = igl.signed_distance(points, parts[two].x, parts[two].faces)[0]
        deepest = max(deepest, -distance.min())
    return deepest


PRESS = [{"press": a} for a in (0, 4)]


@pytest.fixture(scope="module")
def pressed():
    return _run(PRESS, NeighbourOptions())


def test_pressed_muscles_do_not_overlap_and_both_give_way(pressed):
    _, alone = _run(PRESS, None)
    assert _overlap(alone) > 0.25
    _, parts = pressed
    assert _overlap(parts) < 0.1
    for name in ("lower", "upper"):
        assert np.linalg.norm(parts[name].x - alone[name].x, axis=1).max() > 0.1


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_result_does_not_depend_on_order_or_run_or_named_pairs(pressed, order):
    _, again = _run(PRESS, NeighbourOptions(pairs=[["lower", "upper"]]), order=order)
    for name in ("lower", "upper"):
        np.testing.assert_allclose(pressed[1][name].x, again[name].x, rtol=0.0, atol=6e-8)


@pytest.mark.parametrize("gap", [1.0, 5.0])
def test_loop_returns_to_rest_to_the_bit(gap):
    """In touch from the start, or later."""
    made, fields = toy.neighbour_scene([{}], gap, neighbours=NeighbourOptions())
    parts = toy.neighbour_parts(made)
    loop = FrameLoop(made, parts.values(), bone_sdfs=fields)
    angles = [{"press": 2}, {"press": 9}, {"press": 9, "roll": 4}, {"lift": 8}]
    stops = [{f"hinge.{name}": np.radians(a) for name, a in angle.items()} for angle in angles]

    def go(stops):
        return [(f.surfaces, f.events, f.index) for f in map(loop.advance, stops)]

    first = go(stops)
    for _ in range(2):
        loop.return_to_rest()
        for (shown, *rest), (wanted, *others) in zip(go(stops), first):
            assert rest == others
            for name in parts:
                np.testing.assert_array_equal(shown[name].vertices, wanted[name].vertices)


def test_muscles_that_stay_apart_are_solved_apart():
    made, _ = toy.neighbour_scene(PRESS, 60.0, neighbours=NeighbourOptions())
    assert find_links(made, ["lower", "upper"]) == []
    near, _ = toy.neighbour_scene(PRESS, 1.0, neighbours=NeighbourOptions())
    assert find_links(near, ["lower", "upper"]) == [(0, 1)]
    near.neighbours = NeighbourOptions(pairs=[])
    assert find_links(near, ["lower", "upper"]) == []
    near.neighbours = None
    assert find_links(near, ["lower", "upper"]) == []


def test_groups_are_what_links_join():
    assert connected(6, [(0, 4), (2, 5), (4, 1)]) == [[0, 1, 4], [2, 5], [3]]
    assert connected(2, []) == [[0], [1]]
