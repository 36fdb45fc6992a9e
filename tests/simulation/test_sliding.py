"""Neighbouring muscles that slide: surfaces, virtual edges, and what the frame loop makes of them."""

import igl
import numpy as np
import pytest
import trimesh
from toy_scene import ToyMuscle, attach, bone, box, ellipsoid, joint, muscle, scene, sphere

from rbfmuscle.scene.joints.joint import rotation_about
from rbfmuscle.scene.options import SlidingOptions
from rbfmuscle.simulation.frame_loop import FrameLoop, simulate_frames
from rbfmuscle.simulation.neighbour_surface import DEEPER, NeighbourSurface
from rbfmuscle.simulation.neighbours import pairs as links
from rbfmuscle.simulation.neighbours.pairs import MOST
from rbfmuscle.simulation.sliding import sliding_pairs
from rbfmuscle.simulation.substeps import SubSteps
from rbfmuscle.validation import SceneError


class _Mesh:
    """The part of a model that a surface reads."""

    def __init__(self, mesh):
        self.vertices, self.faces = np.array(mesh.vertices), np.array(mesh.faces)
        self.contact_bone = np.full(len(self.vertices), -1)

    def contact_points(self):
        return self.vertices

    def material_mesh(self):
        return self.vertices, self.faces


def _ball(radius=10.0):
    return _Mesh(trimesh.creation.icosphere(subdivisions=3, radius=radius))


def test_distances_of_a_long_flat_surface_are_exact_wherever_they_are_asked():
    """Three extents, so that no axis of the cells can stand for another."""
    mesh = trimesh.creation.icosphere(subdivisions=2)
    mesh.vertices = mesh.vertices * [24.0, 9.0, 4.0]
    surface = NeighbourSurface(_Mesh(mesh), reach=1.5)
    rng = np.random.default_rng(7)
    points = mesh.vertices + rng.normal(scale=0.3, size=mesh.vertices.shape)
    index, distance, _, _ = surface.query(points, np.ones(len(points), dtype=bool), 1.5)
    assert index.tolist() == list(range(len(points)))
    squared = igl.point_mesh_squared_distance(points, surface.vertices, surface.faces)[0]
    assert (
        np.mean(np.abs(np.abs(distance) - np.sqrt(squared)) < 1e-9) > 0.95
    )  # the rest is nearer to another ring


def test_surface_distance_agrees_with_the_sphere():
    surface = NeighbourSurface(_ball(), reach=3.0)
    points = np.random.default_rng(0).normal(size=(500, 3))
    points *= np.random.default_rng(1).uniform(8, 14, (500, 1)) / np.linalg.norm(
        points, axis=1, keepdims=True
    )
    exact = np.linalg.norm(points, axis=1) - 10.0
    index, distance, normal, nearest = surface.query(points, np.ones(500, dtype=bool), 3.0)
    # The triangles lie up to 0.06 below the sphere.
    assert np.allclose(distance, exact[index], atol=0.08)
    squared = igl.point_mesh_squared_distance(points[index], surface.vertices, surface.faces)[0]
    np.testing.assert_allclose(np.abs(distance), np.sqrt(squared), atol=1e-9)
    assert set(np.flatnonzero(exact < 2.9)) <= set(index)
    assert (
        np.einsum("ij,ij->i", normal, points[index] / np.linalg.norm(points[index], axis=1)[:, None]).min()
        > 0.99
    )
    assert np.linalg.norm(surface.vertices[nearest] - points[index], axis=1).max() < 3.0 + 2 * surface.edge


def test_surface_follows_the_model_and_asks_only_what_it_is_asked():
    model = _ball()
    surface = NeighbourSurface(model, reach=3.0)
    turn = rotation_about([1, 2, 3], 1.0, np.array([50.0, 0, 0]))
    model.vertices = model.vertices @ turn[:3, :3].T + turn[:3, 3]
    surface.refresh()
    points = (np.array([[11.0, 0, 0], [0, 9, 0], [0, 0, 12]])) @ turn[:3, :3].T + turn[:3, 3]
    index, distance, _, _ = surface.query(points, np.array([True, True, False]), 3.0)
    assert index.tolist() == [0, 1]
    assert np.allclose(distance, [1, -1], atol=0.08)


def test_surface_far_away_or_empty_answers_nothing():
    surface = NeighbourSurface(_ball(), reach=3.0)
    for points in (np.array([[100.0, 0, 0]]), np.zeros((0, 3)), np.array([[0.0, 0, 0]])):
        assert len(surface.query(points, np.ones(len(points), dtype=bool), 3.0)[0]) == 0


def test_side_and_distance_around_a_sharp_rim_are_those_of_the_mesh():
    """Beside the rim of a lens the normals of its two sides disagree."""
    lens = trimesh.creation.icosphere(subdivisions=3, radius=10.0)
    lens.apply_scale((1.0, 1.0, 0.25))
    surface = NeighbourSurface(_Mesh(lens), reach=4.0)
    rng = np.random.default_rng(3)
    angle, away = rng.uniform(0, 2 * np.pi, 600), rng.uniform(9.0, 13.0, 600)
    points = np.column_stack([away * np.cos(angle), away * np.sin(angle), rng.uniform(-3, 3, 600)])
    index, distance, normal, _ = surface.query(points, np.ones(600, dtype=bool), 4.0)
    exact, _, foot, _ = igl.signed_distance(points[index], lens.vertices, lens.faces)
    assert len(index) > 500 and (exact < 0.0).any()
    assert np.array_equal(distance < 0.0, exact < 0.0)
    # The nearest point is looked for around the nearest vertex, which on long triangles may be another's.
    assert np.allclose(distance, exact, atol=0.2)
    way = (points[index] - foot) * np.sign(exact)[:, None]
    far = exact > 1.0
    assert (np.einsum("ij,ij->i", normal[far], way[far]) > 0.0).all()


def test_a_folded_triangle_makes_no_point_outside_deep():
    model = _ball()
    surface = NeighbourSurface(model, reach=6.0)
    corner = int(model.vertices[:, 0].argmax())
    model.vertices = model.vertices.copy()
    # A vertex that was driven out through the rim it belongs to: its triangles are turned inside out.
    model.vertices[corner] = (10.0, 3.0 * surface.edge, 0.0)
    surface.refresh()
    points = np.array([12.0, 0, 0]) + np.random.default_rng(2).normal(scale=2.0, size=(300, 3))
    points = points[np.linalg.norm(points, axis=1) > 10.6]
    _, distance, _, _ = surface.query(points, np.ones(len(points), dtype=bool), 6.0)
    assert distance.min() > -0.5 * surface.edge


def test_nothing_is_deeper_than_the_muscle_is_thick_or_than_is_asked_for():
    for reach, low, high in ((50.0, 8.5, 10.0), (4.0, 4.0, 4.0)):
        surface = NeighbourSurface(_ball(10.0), reach=reach)
        radius = (surface.deepest - surface.edge) / DEEPER
        # The normals of its triangles tilt those at the corners where six meet five.
        assert radius.min() > low - 1e-9 and radius.max() < high + 1e-9


def _neighbours(angles, gap=1.0, *, sliding, order=(0, 1), belly=4.0):
    """Two long muscles side by side; one end of the upper hangs on an arm that turns it into the lower."""
    fields = {"trunk": sphere(1.0, (0, 0, -60)), "arm": box((1, 1, 1), (60, 0, -40))}
    muscles = []
    for k, name in enumerate(("lower", "upper")):
        mesh = ellipsoid((30, belly, belly), (0, 0, (2 * belly + gap) * k), subdivisions=3)
        far = "arm" if name == "upper" else "trunk"
        ends = [attach(mesh, "trunk", lambda v: v[:, 0] < -25), attach(mesh, far, lambda v: v[:, 0] > 25)]
        muscles.append(muscle(name, mesh, ends))
    made = scene(
        [bone(n, f) for n, f in fields.items()],
        [joint("hinge", "trunk", "arm", (-30, 0, 0), press=(0, 1, 0), lift=(0, -1, 0), roll=(1, 0, 0))],
        [muscles[k] for k in order],
        [{f"hinge.{name}": np.radians(a) for name, a in angle.items()} for angle in angles],
        sliding=sliding,
    )
    return made, fields


def _run(angles, sliding, **options):
    made, fields = _neighbours(angles, sliding=sliding, **options)
    parts = {m.name: ToyMuscle(m, made, sweeps=4, reach=2.0) for m in made.muscles}
    return list(simulate_frames(made, parts, fields=fields)), parts


def _overlap(parts):
    """Deepest free point of either muscle in the other."""
    deepest = 0.0
    for one, two in (("lower", "upper"), ("upper", "lower")):
        points = parts[one].x[parts[one].contact_bone < 0]
        distance = igl.signed_distance(points, parts[two].x, parts[two].faces)[0]
        deepest = max(deepest, -distance.min())
    return deepest


PRESS = [{"press": a} for a in (0, 4)]


def test_without_sliding_muscles_overlap():
    _, parts = _run(PRESS, None)
    assert _overlap(parts) > 0.25


def test_pressed_muscles_do_not_overlap():
    frames, parts = _run(PRESS, SlidingOptions())
    assert _overlap(parts) < 0.1
    assert "time_sliding" in frames[-1].times["upper"]


def test_planes_ask_for_little_in_one_sub_step_however_deep_the_overlap():
    made, fields = _neighbours(PRESS, gap=-3.0, sliding=SlidingOptions())
    parts = {m.name: ToyMuscle(m, made, sweeps=4, reach=2.0) for m in made.muscles}
    with FrameLoop(made, parts, fields=fields) as loop:
        assert _overlap(parts) > 2.5
        for links in loop._sliding.links.values():
            for link in links:
                link.update()
                assert link.push.gap.min() == -MOST
        for coordinates in made.motion.frames[::-1]:
            loop.advance(coordinates)
    # What keeps them near asks for half a millimetre at the same time.
    assert _overlap(parts) < 0.2


def test_both_are_cut_where_only_one_sees_that_they_meet():
    """Held points take no contact: where one muscle's lie in the other, this one alone sees it."""
    made, fields = _neighbours(PRESS, sliding=SlidingOptions())
    parts = {m.name: ToyMuscle(m, made, sweeps=4, reach=2.0) for m in made.muscles}
    with FrameLoop(made, parts, fields=fields) as loop:
        for coordinates in made.motion.frames:
            loop.advance(coordinates)
        (one,), (other,) = (loop._sliding.links[name] for name in ("lower", "upper"))
        assert one.back is other and other.back is one
        low, high = one.meeting()
        assert np.all(low <= one.zone[0]) and np.all(high >= other.zone[1])
        one.zone = None
        point = 0.5 * (other.zone[0] + other.zone[1])[None]
        assert np.isfinite(one.cut(point)).all() and len(one.points())
        other.zone = None
        assert one.meeting() is None and np.isinf(one.cut(point)).all() and not len(one.points())


def test_each_muscle_takes_its_own_sub_steps_and_all_meet_at_the_frame():
    path = [{"hinge.press": np.radians(angle)} for angle in (0, 5)]
    made, fields = _neighbours([{"press": 5}], sliding=SlidingOptions())
    parts = {m.name: ToyMuscle(m, made, sweeps=4, reach=2.0) for m in made.muscles}
    with FrameLoop(made, parts, fields=fields) as loop:
        # As for a muscle that cannot meet the arm: nothing that moves is its own.
        loop._together.cuts["lower"] = SubSteps(made, made.muscles[0])
        for coordinates in path:
            work = loop.advance(coordinates).work
    assert work["lower"].substeps == 1 < work["upper"].substeps
    assert _overlap(parts) < 0.1
    _, fine = _run([{"press": a} for a in np.linspace(0, 5, 11)], SlidingOptions())
    for name in parts:
        assert np.sqrt(np.square(parts[name].x - fine[name].x).sum(axis=1).mean()) < 0.1


def test_pairs_say_how_they_overlap_and_come_apart(monkeypatch):
    pressed, parts = _run(PRESS, SlidingOptions())
    assert list(pressed[-1].neighbours) == [("lower", "upper")]
    overlap, _ = pressed[-1].neighbours["lower", "upper"]
    # The judge measures faces, the loop interpolated vertex normals: a tenth of a millimetre apart.
    assert overlap == pytest.approx(_overlap(parts), abs=0.1)
    assert pressed[0].neighbours["lower", "upper"][1] == 0.0
    monkeypatch.setattr(links, "RELEASE", 0.1)
    lifted, _ = _run([{"lift": a} for a in (0, 6, 12)], SlidingOptions())
    gaps = [frame.neighbours["lower", "upper"][1] for frame in lifted]
    assert gaps[0] == 0.0 and 0.5 < gaps[1] < gaps[2]


def test_muscles_far_apart_are_told_by_their_boxes_alone():
    near, far = NeighbourSurface(_ball(), reach=3.0), NeighbourSurface(_ball(), reach=3.0)
    assert not near.apart(far, 3.0)
    far.reach_box = far.reach_box + [0, 0, 30.0]
    assert near.apart(far, 3.0)


def test_both_give_way():
    _, parts = _run(PRESS, SlidingOptions())
    _, alone = _run(PRESS, None)
    for name in ("lower", "upper"):
        assert np.linalg.norm(parts[name].x - alone[name].x, axis=1).max() > 0.1


def test_linked_points_keep_near_their_neighbour(monkeypatch):
    monkeypatch.setattr(links, "RELEASE", 50.0)
    lift = [{"lift": a} for a in (0, 2, 4, 6)]
    frames, _ = _run(lift, SlidingOptions())
    apart, _ = _run(lift, SlidingOptions(threshold=1e-3))
    # Linked are points nearer than 2 mm and half an edge of 2.4.
    assert 2.0 < frames[0].surfaces["upper"].quantities["sliding_gap_max"] < 3.2
    # Free to 0.5 mm beyond the gap at rest; curved surfaces and one linearisation a sub-step leave some tenths.
    assert frames[-1].surfaces["upper"].quantities["sliding_gap_max"] < 4.2
    assert frames[-1].neighbours["lower", "upper"][1] < 1.0
    assert apart[-1].surfaces["upper"].quantities["sliding_gap_max"] == 0.0
    held, loose = (f[-1].surfaces["upper"].vertices[:, 2].mean() for f in (frames, apart))
    assert held < loose - 0.05


def test_what_is_pulled_away_hard_is_let_go(monkeypatch):
    lift = [{"lift": a} for a in (0, 10, 20)]
    monkeypatch.setattr(links, "STRIP", 0.1)
    monkeypatch.setattr(links, "RELEASE", 0.01)
    frames, parts = _run(lift, SlidingOptions())
    _, alone = _run(lift, None)
    monkeypatch.setattr(links, "RELEASE", 50.0)
    _, held = _run(lift, SlidingOptions())
    # Linked points were nearer than 3.31 where they were expected; settling moves them by some tenths.
    assert frames[-1].surfaces["upper"].quantities["sliding_gap_max"] < 3.6
    away = [np.sqrt(np.square(one["upper"].x - alone["upper"].x).sum(axis=1).mean()) for one in (parts, held)]
    # Those near the hinge, which move little, stay linked.
    assert away[0] < 0.7 * away[1]


def test_neighbours_may_join():
    meet = [{"press": a} for a in (0, 6)]
    joined, _ = _run(meet, SlidingOptions(), gap=4.0)
    assert joined[0].surfaces["upper"].quantities["sliding_gap_max"] == 0.0
    assert joined[-1].surfaces["upper"].quantities["sliding_gap_max"] > 0.0


def test_sliding_along_the_neighbour_is_free():
    roll = [{"roll": a} for a in (0, 10, 20)]
    frames, parts = _run(roll, SlidingOptions())
    _, alone = _run(roll, None)
    assert frames[-1].surfaces["upper"].quantities["sliding_speed"] > 0.1
    moved = np.linalg.norm(parts["upper"].x - alone["upper"].x, axis=1)
    assert np.sqrt((moved**2).mean()) < 1.0


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_result_does_not_depend_on_order_or_run(order):
    _, first = _run(PRESS, SlidingOptions())
    _, again = _run(PRESS, SlidingOptions(), order=order)
    for name in ("lower", "upper"):
        assert np.array_equal(first[name].x, again[name].x)


def test_mirrored_neighbours_give_mirrored_results():
    made, fields = _neighbours([{}], sliding=SlidingOptions(), gap=-1.0)
    parts = {m.name: ToyMuscle(m, made) for m in made.muscles}
    made.motion.frames[:] = [{}, {"hinge.press": 1e-9}]
    list(simulate_frames(made, parts, fields=fields))
    middle = 0.5 * (parts["lower"].rest[:, 2].mean() + parts["upper"].rest[:, 2].mean())
    mirrored = parts["lower"].x * [1, 1, -1] + [0, 0, 2 * middle]
    from scipy.spatial import cKDTree

    # Icospheres are symmetric in z; the planes of the two sides are found alike.
    assert cKDTree(mirrored).query(parts["upper"].x)[0].max() < 0.02


def test_cut_is_midway_between_overlapping_muscles():
    from rbfmuscle.simulation.contact import BoneContacts
    from rbfmuscle.simulation.sliding import Sliding
    from rbfmuscle.simulation.stepper import MuscleStepper

    made, fields = _neighbours([{}], sliding=SlidingOptions(), gap=-2.0)
    steppers = []
    for part in [ToyMuscle(m, made) for m in made.muscles]:
        contacts = BoneContacts(list(fields), list(fields.values()), contact_bone=part.contact_bone)
        steppers.append(MuscleStepper(part, contacts, made))
    sliding = Sliding(made, steppers)
    for stepper in steppers:
        sliding.measure(stepper)
    points = np.array([[0, 0, 2.5], [0, 0, 3.0], [0, 0, 3.5], [1, 1, 3.0], [0, 0, -4.5], [0, 30, 0]])
    lower, upper = (stepper.contacts.nearest(points) for stepper in steppers)
    assert np.allclose(lower[:3], [0.5, 0.0, -0.5], atol=0.1)
    assert np.allclose(lower[:4], -upper[:4], atol=1e-12)
    assert lower[4] > 4.0
    step = 1e-5
    value, gradient = steppers[0].contacts.cuts[0].cut_with_gradient(points[:4])
    ahead = steppers[0].contacts.cuts[0].cut(points[:4] + [0, 0, step])
    # Normals are interpolated, distances are to flat triangles.
    assert np.allclose((ahead - value) / step, gradient[:, 2], atol=0.1)
    # What a coarse surface has to leave outside: all of the neighbour that lies in it, and nothing far from there.
    met = steppers[0].contacts.neighbour_points()
    upper, lower = (stepper.model for stepper in steppers[::-1])
    inside = upper.x[igl.signed_distance(upper.x, lower.x, lower.faces)[0] < 0]
    assert len(inside) > 10
    assert np.isin(inside.view("f8,f8,f8"), np.ascontiguousarray(met).view("f8,f8,f8")).all()
    low, high = steppers[0].contacts.cuts[0].meeting()
    assert np.all((met > low) & (met < high))
    assert high[2] < upper.x[:, 2].max() + 6.5


def test_points_near_a_bone_may_be_held_there(monkeypatch):
    monkeypatch.setattr(links, "RELEASE", 50.0)
    fields = {"plate": box((20, 20, 1), (0, 0, -6.0)), "arm": box((1, 1, 1), (60, 0, 20))}
    mesh = ellipsoid((25, 4, 4), subdivisions=3)
    ends = [attach(mesh, "plate", lambda v: v[:, 0] < -20), attach(mesh, "arm", lambda v: v[:, 0] > 20)]

    def lifted(sliding):
        made = scene(
            [bone(n, f) for n, f in fields.items()],
            [joint("hinge", "plate", "arm", (-25, 0, 0), lift=(0, -1, 0))],
            [muscle("strap", mesh, ends)],
            [{"hinge.lift": np.radians(a)} for a in (0, 6)],
            sliding=sliding,
        )
        part = ToyMuscle(made.muscles[0], made)
        near = fields["plate"].distance(part.rest) < 2.0
        list(simulate_frames(made, [part], fields=fields))
        return fields["plate"].distance(part.x[near & (part.contact_bone < 0)]).max()

    assert lifted(None) > 3.5
    assert lifted(SlidingOptions(bones=True)) < 3.2


def test_pairs_name_who_slides_and_unknown_names_are_refused():
    _, parts = _run(PRESS, SlidingOptions(pairs=[["lower", "upper"]]))
    assert _overlap(parts) < 0.1
    with pytest.raises(SceneError, match="unknown muscle 'uper', known: lower, upper"):
        _run([{}], SlidingOptions(pairs=[["lower", "uper"]]))


def test_pairs_whose_swept_boxes_do_not_meet_cost_nothing():
    frames, _ = _run([{"press": a} for a in (0, 2)], SlidingOptions(), gap=80.0)
    assert "sliding_gap_max" not in frames[-1].surfaces["upper"].quantities


@pytest.mark.parametrize("order", [("trunk", "arm"), ("arm", "trunk")])
def test_who_slides_does_not_depend_on_the_order_of_bones(order):
    """Two muscles of the trunk 40 mm apart: however an arm that one also hangs on swings, they meet or they do not."""
    fields = {"trunk": sphere(1.0, (0, 0, -60)), "arm": box((1, 1, 1), (60, 0, -40))}
    meshes = [ellipsoid((30, 4, 4), (0, 0, z)) for z in (0.0, 40.0)]
    ends = [[attach(mesh, "trunk", lambda v: np.abs(v[:, 0]) > 25)] for mesh in meshes]
    frames = [{"hinge.press": np.radians(angle)} for angle in range(0, 120, 5)]
    made = scene(
        [bone(name, fields[name]) for name in order],
        [joint("hinge", "trunk", "arm", (-30, 0, 0), press=(0, 1, 0))],
        [muscle(name, mesh, end) for name, mesh, end in zip(("near", "far"), meshes, ends)],
        frames,
        sliding=SlidingOptions(),
    )
    assert sliding_pairs(made, ["near", "far"], 5.0) == set()
    assert sliding_pairs(made, ["near", "far"], 35.0) == {frozenset(("near", "far"))}
