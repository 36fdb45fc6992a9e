"""Neighbouring muscles that slide: surfaces, virtual edges, and what the frame loop makes of
them."""

from types import SimpleNamespace

import igl
import numpy as np
import pytest
import toy_scene as toy
import trimesh

from rbfmuscle.scene.joints.joint import rotation_about
from rbfmuscle.scene.options import SlidingOptions
from rbfmuscle.simulation import sliding_pair as links
from rbfmuscle.simulation.contact import BoneContacts, BonesInReach
from rbfmuscle.simulation.frame_loop import FrameLoop, simulate_frames
from rbfmuscle.simulation.neighbour_surface import NeighbourSurface
from rbfmuscle.simulation.sliding import Sliding, sliding_pairs
from rbfmuscle.simulation.stepper import MuscleStepper
from rbfmuscle.validation import SceneError


def _model(mesh):
    """The part of a model that a surface reads."""
    vertices, faces = np.array(mesh.vertices), np.array(mesh.faces)
    return SimpleNamespace(
        vertices=vertices,
        attached_bone=np.full(len(vertices), -1),
        contact_points=lambda: vertices,
        material_mesh=lambda: (vertices, faces),
    )


@pytest.mark.parametrize(
    ("scale", "subdivisions", "reach", "share"),
    [([10, 10, 10], 3, 3.0, 1.0), ([24, 9, 4], 2, 1.5, 0.95), ([10, 10, 2.5], 3, 4.0, 0.9)],
)
def test_distances_are_those_of_the_triangles(scale, subdivisions, reach, share):
    """A ball, three extents, and a lens, beside whose rim the normals of two sides disagree."""
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions)
    mesh.vertices = mesh.vertices * np.array(scale)
    surface = NeighbourSurface(_model(mesh), reach=reach)
    rng = np.random.default_rng(7)
    points = np.tile(mesh.vertices, (3, 1)) * rng.uniform(0.85, 1.4, (3 * len(mesh.vertices), 1))
    index, distance, normal, nearest = surface.query(points, reach)
    exact, _, foot, _ = igl.signed_distance(points, surface.vertices, surface.faces)
    assert set(np.flatnonzero(np.abs(exact) < 0.95 * reach)) <= set(index)
    exact, way = exact[index], (points - foot)[index] * np.sign(exact[index])[:, None]
    assert np.array_equal(distance < 0.0, exact < 0.0) and (exact < 0.0).any()
    # What is left is nearer to another ring of triangles than the one looked at.
    assert (np.abs(distance - exact) < 1e-9).mean() >= share and np.allclose(
        distance, exact, atol=0.2
    )
    if share == 1.0:  # a ball
        outward = points[index] / np.linalg.norm(points[index], axis=1, keepdims=True)
        assert np.einsum("ij,ij->i", normal, outward).min() > 0.99
    far = exact > 1.0
    assert (np.einsum("ij,ij->i", normal[far], way[far]) > 0.0).all()
    assert (
        np.linalg.norm(surface.vertices[nearest] - points[index], axis=1).max()
        < reach + 2 * surface.edge
    )


def test_surface_follows_the_model_and_asks_only_what_it_is_asked():
    model = _model(toy.ellipsoid((10, 10, 10), subdivisions=3))
    surface = NeighbourSurface(model, reach=3.0)
    for points in (np.array([[100.0, 0, 0]]), np.zeros((0, 3)), np.zeros((1, 3))):
        assert len(surface.query(points, 3.0)[0]) == 0
    turn = rotation_about([1, 2, 3], 1.0, np.array([50.0, 0, 0]))
    model.vertices[:] = model.vertices @ turn[:3, :3].T + turn[:3, 3]
    surface.refresh()
    points = (np.array([[11.0, 0, 0], [0, 9, 0], [0, 0, 12]])) @ turn[:3, :3].T + turn[:3, 3]
    index, distance, _, _ = surface.query(points, np.array([3.0, 3.0, 1.5]))
    assert index.tolist() == [0, 1]
    assert np.allclose(distance, [1, -1], atol=0.08)


def _run(angles, sliding, **options):
    made, fields = toy.neighbour_scene(angles, sliding=sliding, **options)
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
    return _run(PRESS, SlidingOptions())


def test_pressed_muscles_do_not_overlap_and_both_give_way(pressed):
    _, alone = _run(PRESS, None)
    assert _overlap(alone) > 0.25
    frames, parts = pressed
    assert _overlap(parts) < 0.1
    assert "time_sliding" in frames[-1].times["upper"]
    for name in ("lower", "upper"):
        assert np.linalg.norm(parts[name].x - alone[name].x, axis=1).max() > 0.1


@pytest.mark.parametrize("gap", [1.0, 5.0])
def test_restored_loop_goes_on_to_the_bit(monkeypatch, gap):
    """Linked from the start, or linked after the snapshot; what is pulled away is released."""
    monkeypatch.setattr(links, "RELEASE", 0.1)
    made, fields = toy.neighbour_scene([{}], gap, sliding=SlidingOptions(bones=True))
    parts = toy.neighbour_parts(made)
    loop = FrameLoop(made, parts.values(), bone_sdfs=fields)
    angles = [{"press": 2}, {"press": 9}, {"press": 9, "roll": 4}, {"lift": 8}]
    stops = [{f"hinge.{name}": np.radians(a) for name, a in angle.items()} for angle in angles]

    def go(stops):
        """What frames show, and the neighbours that act in them."""
        frames = [loop.advance(stop) for stop in stops]
        planes = [len(stepper.contacts.neighbours) for stepper in loop.steppers]
        return [(f.surfaces, f.neighbours, f.events, f.index) for f in frames], planes

    go(stops[:1])
    state = loop.snapshot()
    first, planes = go(stops[1:])
    assert first[0][1] and first[0][1] != first[1][1] and first[-1][1] != first[1][1]
    for _ in range(2):
        loop.restore(state)
        again, there = go(stops[1:])
        assert there == planes
        for (shown, *rest), (wanted, *others) in zip(again, first):
            assert rest == others
            for name in parts:
                np.testing.assert_array_equal(shown[name].vertices, wanted[name].vertices)
    loop.restore(state)
    before = sum(len(stepper.contacts.beside) for stepper in loop.steppers)
    assert before == (2 if gap == 1.0 else 0)


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_result_does_not_depend_on_order_or_run_or_named_pairs(pressed, order):
    _, again = _run(PRESS, SlidingOptions(pairs=[["lower", "upper"]]), order=order)
    for name in ("lower", "upper"):
        assert np.array_equal(pressed[1][name].x, again[name].x)
    with pytest.raises(SceneError, match="unknown muscle 'uper'"):
        _run([{}], SlidingOptions(pairs=[["lower", "uper"]]))


def test_pairs_say_how_they_overlap_and_come_apart(monkeypatch, pressed):
    frames, parts = pressed
    assert list(frames[-1].neighbours) == [("lower", "upper")]
    overlap, _ = frames[-1].neighbours["lower", "upper"]
    # The judge measures faces, the loop interpolated vertex normals: a tenth of a millimetre apart.
    assert overlap == pytest.approx(_overlap(parts), abs=0.1)
    assert frames[0].neighbours["lower", "upper"][1] == 0.0
    monkeypatch.setattr(links, "RELEASE", 0.1)
    lifted, _ = _run([{"lift": a} for a in (0, 6, 12)], SlidingOptions())
    gaps = [frame.neighbours["lower", "upper"][1] for frame in lifted]
    assert gaps[0] == 0.0 and 0.5 < gaps[1] < gaps[2]


def test_linked_points_keep_near_their_neighbour(monkeypatch):
    monkeypatch.setattr(links, "RELEASE", 50.0)
    lift = [{"lift": a} for a in (0, 2, 4, 6)]
    frames, _ = _run(lift, SlidingOptions())
    apart, _ = _run(lift, SlidingOptions(threshold=1e-3))
    # Free to 0.5 mm beyond the gap at rest; curved surfaces and one linearisation a sub-step leave
    # some tenths.
    assert frames[-1].neighbours["lower", "upper"][1] < 1.0
    assert ("lower", "upper") not in apart[-1].neighbours
    held, loose = (f[-1].surfaces["upper"].vertices[:, 2].mean() for f in (frames, apart))
    assert held < loose - 0.05


def test_what_is_pulled_away_hard_is_let_go(monkeypatch):
    lift = [{"lift": a} for a in (0, 10)]
    monkeypatch.setattr(links, "STRIP", 0.1)
    monkeypatch.setattr(links, "RELEASE", 0.01)
    _, parts = _run(lift, SlidingOptions())
    _, alone = _run(lift, None)
    monkeypatch.setattr(links, "RELEASE", 50.0)
    _, held = _run(lift, SlidingOptions())
    away = [
        np.sqrt(np.square(one["upper"].x - alone["upper"].x).sum(axis=1).mean())
        for one in (parts, held)
    ]
    # Those near the hinge, which move little, stay linked.
    assert away[0] < 0.7 * away[1]


@pytest.mark.parametrize("met", [True, False])
def test_neighbours_may_join(monkeypatch, met):
    """Apart at rest, and linked from when they met: then the one that is lifted is held."""
    monkeypatch.setattr(links, "RELEASE", 50.0)
    path = [{"press": 0}, *([{"press": 6}] if met else []), {"lift": 6}]
    _, joined = _run(path, SlidingOptions(), gap=4.0)
    _, alone = _run(path, None, gap=4.0)
    moved = np.linalg.norm(joined["upper"].x - alone["upper"].x, axis=1).max()
    assert moved > 0.05 if met else moved < 1e-9


def test_sliding_along_the_neighbour_is_free():
    roll = [{"roll": a} for a in (0, 10)]
    _, parts = _run(roll, SlidingOptions())
    _, alone = _run(roll, None)
    moved = np.linalg.norm(parts["upper"].x - alone["upper"].x, axis=1)
    assert np.sqrt((moved**2).mean()) < 1.0


def test_drawn_surfaces_yield_by_half_of_their_overlap():
    made, fields = toy.neighbour_scene([{}], sliding=SlidingOptions(), gap=-0.6)
    steppers = []
    for part in [toy.ToyMuscle(m, made) for m in made.muscles]:
        bones = BonesInReach(list(fields), list(fields.values()))
        contacts = BoneContacts(bones, part.attached_bone)
        steppers.append(MuscleStepper(part, contacts, made))
    Sliding(made, steppers).finish_frame()
    for stepper, other in (steppers, steppers[::-1]):
        points = stepper.model.x
        found = stepper.contacts.excess(points)
        depth = -igl.signed_distance(points, other.model.x, other.model.faces)[0]
        assert np.allclose(found, np.maximum(0.5 * (links.CLEAR + depth), 0.0), atol=0.02)
        assert found.max() > 0.3 and (found == 0.0).any()
        assert np.all(stepper.contacts.excess(points - 100.0) == 0.0)


def test_nearest_vertices_are_found_from_where_they_were():
    model = _model(toy.ellipsoid((10, 6, 4), subdivisions=3))
    surface, rng = NeighbourSurface(model, reach=3.0), np.random.default_rng(5)
    points = surface.vertices * rng.uniform(0.9, 1.2, (len(surface.vertices), 1))
    start = surface.nearest(points, 3.0)
    turn = rotation_about([1, 2, 3], 0.2, np.zeros(3))
    model.vertices[:] = model.vertices @ turn[:3, :3].T
    surface.refresh()
    found, wanted = surface.query(points, 2.0, start), surface.query(points, 2.0)
    np.testing.assert_array_equal(found[0], wanted[0])
    # A way over edges may end beside the nearest vertex.
    assert (found[3] == wanted[3]).mean() > 0.99
    assert np.abs(found[1] - wanted[1]).max() < 0.2


def test_points_near_a_bone_may_be_held_there(monkeypatch):
    monkeypatch.setattr(links, "RELEASE", 50.0)
    fields = {"plate": toy.box((20, 20, 1), (0, 0, -6.0)), "arm": toy.box((1, 1, 1), (60, 0, 20))}
    mesh = toy.ellipsoid((25, 4, 4), subdivisions=3)
    ends = [
        toy.attach(mesh, b, lambda v, k=k: k * v[:, 0] > 20) for b, k in (("plate", -1), ("arm", 1))
    ]

    def lifted(sliding):
        hinge = toy.joint("hinge", "plate", "arm", (-25, 0, 0), lift=(0, -1, 0))
        frames = [{"hinge.lift": np.radians(a)} for a in (0, 6)]
        made = toy.scene(
            fields, [hinge], [toy.muscle("strap", mesh, ends)], frames, sliding=sliding
        )
        part = toy.ToyMuscle(made.muscles[0], made)
        near = fields["plate"].distance(part.rest) < 2.0
        list(simulate_frames(made, [part], bone_sdfs=fields))
        return fields["plate"].distance(part.x[near & (part.attached_bone < 0)]).max()

    assert lifted(None) > 3.5
    assert lifted(SlidingOptions(bones=True)) < 3.2


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_who_slides_does_not_depend_on_the_order_of_bones(order):
    press = [{"press": a} for a in range(0, 120, 5)]
    made, _ = toy.neighbour_scene(press, gap=32.0, sliding=SlidingOptions())
    made.bones = [made.bones[k] for k in order]
    made.muscles[1].attachments.pop()
    assert sliding_pairs(made, ["lower", "upper"], 5.0) == set()
    assert sliding_pairs(made, ["lower", "upper"], 35.0) == {frozenset(("lower", "upper"))}


def _spike_into_a_belly(sliding):
    """How deep a thin muscle that an arm holds has come into a coarse belly below it."""
    fields = {"trunk": toy.sphere(1.0, (0, 0, -60)), "arm": toy.box((1, 1, 1), (60, 0, 40))}
    belly = toy.ellipsoid((30, 9, 9), subdivisions=2)
    spike = toy.ellipsoid((1.5, 1.5, 15), (3, 0, 25), subdivisions=3)
    muscles = [
        toy.muscle("belly", belly, [toy.attach(belly, "trunk", lambda v: np.abs(v[:, 0]) > 24)]),
        toy.muscle("spike", spike, [toy.attach(spike, "arm", lambda v: np.abs(v[:, 2] - 25) > 3)]),
    ]
    hinge = toy.joint("hinge", "trunk", "arm", (-30, 0, 0), press=(0, 1, 0))
    frames = [{"hinge.press": np.radians(angle)} for angle in range(0, 9, 2)]
    made = toy.scene(fields, [hinge], muscles, frames, sliding=sliding)
    parts = toy.neighbour_parts(made)
    list(simulate_frames(made, parts.values(), bone_sdfs=fields))
    return -igl.signed_distance(parts["spike"].x, parts["belly"].x, parts["belly"].faces)[0].min()


def test_a_coarse_muscle_gives_way_to_a_thin_end_that_a_bone_drives_into_it():
    assert _spike_into_a_belly(None) > 3.0
    assert _spike_into_a_belly(SlidingOptions()) < 0.6
