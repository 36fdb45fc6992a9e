"""RBF muscles pressed together: forces, symmetry, rings, sheets, and the gap asked of a muscle."""

import igl
import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree
from toy_scene import box_mesh, ellipsoid, held

import rbfmuscle as rm
from rbfmuscle.models import build_models
from rbfmuscle.scene.joints import rotation_about
from rbfmuscle.scene.objects import Motion
from rbfmuscle.scene.options import NeighbourOptions
from rbfmuscle.simulation.contact import BoneContacts, BonesInReach
from rbfmuscle.simulation.frame_loop import FrameLoop, simulate_frames
from rbfmuscle.simulation.touching import surface_points

pytestmark = pytest.mark.numeric
OPTIONS = {"centres": 150, "nodes": 150, "samples": 1200}


def _scene(muscles, frames, slides, model=None):
    """Muscles, each a mesh and masks of what holds its vertices, between bones that shift."""
    scene = rm.Scene("press", units="mm")
    scene.add_bone("floor", trimesh.creation.box([4, 4, 4]).apply_translation([0, 0, -200]))
    for name, axis in slides.items():
        far = -200.0 * np.array(axis, dtype=float)
        scene.add_bone(name, trimesh.creation.box([4, 4, 4]).apply_translation(far))
        scene.add_joint(f"of_{name}", "floor", name, (0, 0, 0), {"by": axis}, type="slide")
    for name, (mesh, ends) in muscles.items():
        scene.add_muscle(name, mesh, attach=held(**ends), model=model or {"name": "rbf", **OPTIONS})
    scene.motion = Motion([{f"of_{k}.by": v for k, v in frame.items()} for frame in frames])
    return scene


def _run(scene):
    models = build_models(scene)
    loop = FrameLoop(scene, models, surfaces=False)
    for frame in scene.motion.frames:
        loop.advance(frame)
    return loop, {model.name: model for model in models}


def _overlap(one, other):
    """Deepest of the free material of one muscle in another."""
    points = one.contact_points()[one.attached_bone < 0]
    vertices, faces = other.material_mesh()
    return max(0.0, -igl.signed_distance(points, np.array(vertices), np.array(faces))[0].min())


def _total_force(loop, axis):
    """Contact force of each muscle of a single group at each other one, along an axis, over 2 μ."""
    (group,) = loop.groups
    solids = [stepper.model.begin(stepper.contacts) for stepper in group.steppers]
    meeting = group.neighbours.find(solids)
    meeting.ask(solids)
    names = [stepper.name for stepper in group.steppers]
    found = {}
    for one, other, force in zip(
        meeting.one, meeting.other, meeting.force * (meeting.normal @ np.asarray(axis, float))
    ):
        key = names[one], names[other]
        found[key] = found.get(key, 0.0) + float(force)
    return found


BLOCK = 15.0


@pytest.fixture(scope="module")
def blocks():
    """Two blocks, one on the other, of which the upper is pressed down by 3 mm."""
    lower = box_mesh([-BLOCK, -BLOCK, -30], [BLOCK, BLOCK, -0.05])
    upper = box_mesh([-BLOCK, -BLOCK, 0.05], [BLOCK, BLOCK, 30])
    muscles = {
        "lower": (lower, {"floor": lower.vertices[:, 2] < -29}),
        "upper": (upper, {"press": upper.vertices[:, 2] > 29}),
    }
    frames = [{"press": -s} for s in (0.0, 1.0, 2.0, 3.0)]
    return _run(_scene(muscles, frames, {"press": (0, 0, 1)}))


def test_blocks_pressed_together_share_the_way_and_meet_in_a_plane(blocks):
    _, models = blocks
    lower, upper = (models[name].contact_points() for name in ("lower", "upper"))
    rest = models["lower"].model.points, models["upper"].model.points
    inner = [np.abs(points[:, :2]).max(axis=1) < 0.7 * BLOCK for points in rest]
    faces = [
        points[(np.abs(at[:, 2]) < 0.06) & some][:, 2]
        for points, at, some in zip((lower, upper), rest, inner)
    ]
    # The interface of two equal blocks goes half of the way, and both faces lie on it.
    assert len(faces[0]) > 20 and len(faces[1]) > 20
    for face in faces:
        assert face.mean() == pytest.approx(-1.5, abs=0.1) and face.std() < 0.1
    assert _overlap(models["lower"], models["upper"]) < 0.1
    assert _overlap(models["upper"], models["lower"]) < 0.1


def test_blocks_bulge_alike(blocks):
    _, models = blocks
    widths = [np.ptp(models[name].contact_points()[:, 0]) for name in ("lower", "upper")]
    assert widths[0] > 2 * BLOCK + 0.3 and widths[0] == pytest.approx(widths[1], abs=0.1)


def _borne(model, some=slice(None)):
    """Force (3,) that the springs of some held points exert on a muscle at rest, over 2 μ."""
    solid, state = model.model, model.state
    stretch = state.anchors - solid.embedding.some(solid.held).of(state.nodes)
    return (solid.springs[:, some] @ stretch[some]).sum(axis=0)


def test_forces_between_blocks_are_those_that_their_bones_feel(blocks):
    loop, models = blocks
    between = _total_force(loop, (0, 0, 1))
    pressed = between["upper", "lower"] - between["lower", "upper"]
    assert pressed > 0.0
    for name, sign in (("upper", 1.0), ("lower", -1.0)):
        assert sign * _borne(models[name])[2] == pytest.approx(-pressed, rel=0.01)


@pytest.mark.parametrize("model", ["rbf", "pbd"])
def test_blocks_pulled_apart_part_or_stay_together_and_bear_the_pull(model):
    lower = box_mesh([-BLOCK, -BLOCK, -30], [BLOCK, BLOCK, -0.05])
    upper = box_mesh([-BLOCK, -BLOCK, 0.05], [BLOCK, BLOCK, 30])
    muscles = {
        "lower": (lower, {"floor": lower.vertices[:, 2] < -29}),
        "upper": (upper, {"press": upper.vertices[:, 2] > 29}),
    }
    frames = [{"press": s} for s in (0.0, 0.5, 1.0, 1.5, 2.0)]
    gaps = {}
    for together in (False, True):
        options = {"model": "pbd"} if model == "pbd" else {}
        scene = _scene(muscles, frames, {"press": (0, 0, 1)}, **options)
        scene.neighbours = NeighbourOptions(together=together)
        loop, models = _run(scene)
        meshes = [np.array(models[name].material_mesh()[0]) for name in ("lower", "upper")]
        rest = [scene.muscle(name).mesh.vertices for name in ("lower", "upper")]
        if model == "rbf":
            rest = [models[name].rest.samples for name in ("lower", "upper")]
        below, above = (
            points[(np.abs(at[:, 2]) < 0.06) & (np.abs(at[:, :2]).max(axis=1) < 0.8 * BLOCK)][:, 2]
            for points, at in zip(meshes, rest)
        )
        gaps[together] = above.mean() - below.mean()
    assert gaps[False] == pytest.approx(2.1, abs=0.02)
    assert gaps[True] == pytest.approx(0.1, abs=0.05 if model == "rbf" else 0.25)
    if model == "rbf":
        between = _total_force(loop, (0, 0, 1))
        pulled = between["lower", "upper"] - between["upper", "lower"]
        assert pulled > 0.0
        for name, sign in (("upper", 1.0), ("lower", -1.0)):
            assert sign * _borne(models[name])[2] == pytest.approx(pulled, rel=0.01)


@pytest.mark.parametrize("model", ["rbf", "pbd"])
def test_muscle_held_to_a_bone_stays_there(model):
    block = box_mesh([-BLOCK, -BLOCK, 0.05], [BLOCK, BLOCK, 30])
    muscles = {"block": (block, {"press": block.vertices[:, 2] > 29})}
    frames = [{"press": s} for s in (0.0, 0.5, 1.0, 1.5, 2.0)]
    for stays in (False, True):
        options = {"model": "pbd"} if model == "pbd" else {}
        scene = _scene(muscles, frames, {"press": (0, 0, 1)}, **options)
        plate = trimesh.creation.box([60, 60, 4]).apply_translation([0, 0, -2])
        scene.add_bone("plate", plate)
        scene.neighbours = NeighbourOptions(bones=[["block", "plate"]] if stays else [])
        _, models = _run(scene)
        points = np.array(models["block"].contact_points())
        rest = models["block"].model.points if model == "rbf" else models["block"].rest.vertices
        face = (rest[:, 2] < 0.06) & (np.abs(rest[:, :2]).max(axis=1) < 0.8 * BLOCK)
        low = points[face][:, 2]
        near = 0.05 if model == "rbf" else 0.25  # of a mesh every third vertex or so is held
        assert low.mean() == pytest.approx(0.05 if stays else 2.05, abs=near)


def test_strip_over_a_cylinder_presses_on_it_by_its_tension_over_the_radius():
    """Pressure T / R along an arc of the angle 2 α sums up to 2 α T, for a tension T that pulls at
    the ends at angles α below the horizontal.
    """
    radius, half = 14.0, 45.0
    cylinder = trimesh.creation.cylinder(radius, 60.0, sections=48).subdivide().subdivide()
    points = np.array(cylinder.vertices)
    around = np.linalg.norm(points[:, :2], axis=1)
    side = around > radius - 1.0
    points[side, :2] *= (radius / around[side])[:, None]
    cylinder.vertices = points
    cylinder.apply_transform(rotation_about((1, 0, 0), np.pi / 2, np.zeros(3)))
    strip = box_mesh([-half, -8, radius + 0.05], [half, 8, radius + 5.05])
    x = strip.vertices[:, 0]
    muscles = {
        "cylinder": (cylinder, {"floor": np.abs(cylinder.vertices[:, 1]) > 12}),
        "strip": (strip, {"left": x < 4 - half, "right": x > half - 4}),
    }
    frames = [{"left": -s, "right": -s} for s in np.linspace(0.0, 8.0, 17)]
    loop, models = _run(_scene(muscles, frames, {"left": (0, 0, 1), "right": (0, 0, 1)}))
    strip = models["strip"]
    right = strip.model.points[strip.model.held][:, 0] > 0
    ends = [_borne(strip, which) for which in (right, ~right)]
    tension, angle = np.linalg.norm(ends[0]), np.arctan2(-ends[0][2], ends[0][0])
    assert np.degrees(angle) > 15.0
    assert np.abs(ends[0] * [-1, 1, 1] - ends[1]).max() < 0.01 * tension
    (group,) = loop.groups
    pressed = sum(float(force.sum()) for force in group.neighbours.state.forces.values())
    # The strip is 5 thick, and the cylinder yields.
    assert pressed == pytest.approx(2.0 * angle * tension, rel=0.04)
    between = _total_force(loop, (0, 0, 1))
    lifted = between.get(("strip", "cylinder"), 0.0) - between.get(("cylinder", "strip"), 0.0)
    assert lifted == pytest.approx(-ends[0][2] - ends[1][2], rel=0.01)
    assert _overlap(strip, models["cylinder"]) < 0.1 > _overlap(models["cylinder"], strip)


def _ring(order=(0, 1, 2), names="abc"):
    """Three ellipsoids around a point, each pressed inwards."""
    muscles, slides = {}, {}
    for k in order:
        turn = rotation_about((0, 0, 1), 2.0 * np.pi * k / 3.0, np.zeros(3))
        mesh = ellipsoid((8, 8, 25), (0, 9.4, 0), subdivisions=3)
        ends = np.abs(mesh.vertices[:, 2]) > 19
        mesh.apply_transform(turn)
        bone = f"bone_{k}"
        slides[bone] = tuple(turn[:3, 1].tolist())
        muscles[names[k]] = (mesh, {bone: ends})
    frames = [dict.fromkeys(slides, -s) for s in (0.0, 1.0, 2.0)]
    return _scene(muscles, frames, dict(sorted(slides.items())))


def test_three_muscles_in_a_ring_stay_apart_and_alike():
    loop, models = _run(_ring())
    assert len(loop.groups) == 1
    for one, other in (("a", "b"), ("b", "c"), ("c", "a")):
        assert _overlap(models[one], models[other]) < 0.15
    # A third of a turn takes each to the next.
    turn = rotation_about((0, 0, 1), 2.0 * np.pi / 3.0, np.zeros(3))[:3, :3]
    way = {name: model.contact_points().mean(axis=0) for name, model in models.items()}
    assert np.abs(turn @ way["a"] - way["b"]).max() < 0.05
    assert np.abs(turn @ way["b"] - way["c"]).max() < 0.05


def test_shown_surfaces_meet_between_muscles_that_touch():
    """Also where the level sets bulge beyond the material: half of the way each."""
    scene = _ring()
    loop = FrameLoop(scene, build_models(scene))
    for frame in scene.motion.frames:
        shown = loop.advance(frame).surfaces
    meshes = {name: (np.array(s.vertices), np.array(s.faces)) for name, s in shown.items()}
    for one, other in (("a", "b"), ("b", "c"), ("c", "a"), ("b", "a")):
        depth = -igl.signed_distance(meshes[one][0], *meshes[other])[0].min()
        assert depth < 0.1
    (group,) = loop.groups
    number = [stepper.name for stepper in group.steppers].index("a")
    # What bulges by a millimetre towards its neighbours goes back; what is far from them stays.
    model = group.steppers[number].model
    vertices = model.drawer.carry(model.state.nodes)
    faces = model.drawer.shown.faces
    normals = trimesh.Trimesh(vertices, faces, process=False).vertex_normals
    moved = group.neighbours.out_of_neighbours(number, vertices + normals)
    away = np.linalg.norm(moved, axis=1)
    touching = np.min(
        [igl.signed_distance(vertices, *meshes[name])[0] for name in ("b", "c")], axis=0
    )
    assert (away[touching < 0.2] > 0.2).all() and (away[touching > 3.0] == 0.0).all()
    assert (touching < 0.2).any()


def test_order_and_names_of_muscles_change_nothing():
    first = _run(_ring())[1]
    size = 60.0
    other = _run(_ring(order=(2, 0, 1), names="zxy"))[1]
    for one, two in zip("abc", "zxy"):
        moved = np.abs(first[one].contact_points() - other[two].contact_points()).max()
        assert moved < 1e-9 * size


def test_sheet_between_two_bellies_stays_in_the_middle():
    sheet = box_mesh([-20, -1.5, -20], [20, 1.5, 20])
    muscles = {"sheet": (sheet, {"floor": np.abs(sheet.vertices[:, 2]) > 18})}
    for name, side in (("left", -1.0), ("right", 1.0)):
        belly = ellipsoid((9, 8, 16), (0, 9.7 * side, 0), subdivisions=3)
        muscles[name] = (belly, {name: side * belly.vertices[:, 1] > 15})
    frames = [{"left": s, "right": -s} for s in (0.0, 1.0, 2.0)]
    loop, models = _run(_scene(muscles, frames, {"left": (0, 1, 0), "right": (0, 1, 0)}))
    middle = models["sheet"].contact_points()
    near = np.abs(models["sheet"].model.points[:, [0, 2]]).max(axis=1) < 8
    assert abs(middle[near][:, 1].mean()) < 0.05
    for side in ("left", "right"):
        assert _overlap(models["sheet"], models[side]) < 0.15
        assert _overlap(models[side], models["sheet"]) < 0.15
    # The forces of both sides hold each other the balance.
    between = _total_force(loop, (0, 1, 0))
    on_sheet = {
        side: between.get(("sheet", side), 0.0) - between.get((side, "sheet"), 0.0)
        for side in ("left", "right")
    }
    assert on_sheet["left"] > 0.0 and on_sheet["left"] == pytest.approx(
        -on_sheet["right"], rel=0.05
    )


def test_overlap_at_rest_is_kept_and_moves_nothing():
    muscles = {}
    for name, side in (("one", -1.0), ("other", 1.0)):
        mesh = ellipsoid((8, 8, 25), (0, 7.2 * side, 0), subdivisions=3)
        z = mesh.vertices[:, 2]
        muscles[name] = (mesh, {"floor": z < -19, "stretch": z > 19})
    scene = _scene(muscles, [{"stretch": 0.0}, {"stretch": 0.5}], {"stretch": (0, 0, 1)})
    _, models = _run(scene)
    assert _overlap(models["one"], models["other"]) > 1.0
    # Stretched, they part rather than press: what they do alone they do together.
    scene.neighbours = None
    _, alone = _run(scene)
    for name, model in models.items():
        moved = np.linalg.norm(model.contact_points() - alone[name].contact_points(), axis=1)
        assert moved.max() < 0.02


def test_gap_and_normal_are_those_of_the_surface_where_it_has_been_carried():
    """At rest, turned, and stretched along the normal, where the gap grows in proportion."""
    mesh = box_mesh([-20, -10, -10], [20, 10, 10])
    scene = _scene({"block": (mesh, {"floor": mesh.vertices[:, 0] < -19})}, [{}], {})
    (model,) = build_models(scene)
    contacts = BoneContacts(BonesInReach([], []), model.attached_bone)
    model.body()
    solid = model.begin(contacts)
    rng = np.random.default_rng(3)
    points = np.column_stack([rng.uniform(-6, 6, (40, 2)), rng.uniform(8.0, 11.0, 40)])
    places = (points - model._material.origin) @ model._material.turn.T
    turn = rotation_about((1, 2, 3), 0.7, np.zeros(3))[:3, :3]
    for matrix, factor in ((np.eye(3), 1.0), (turn, 1.0), (np.diag([1.0, 1.0, 1.5]), 1.5)):
        solid.nodes = model.model.rest @ matrix.T
        gap, normals, feet = solid.ask(np.ascontiguousarray(points @ matrix.T), places.copy())
        np.testing.assert_allclose(gap, factor * (points[:, 2] - 10.0), atol=0.1)
        normal = matrix[:, 2] / np.linalg.norm(matrix[:, 2])
        assert (normals @ normal).min() > 0.998
        found = feet.of(solid.nodes)
        np.testing.assert_allclose(found, (points * [1, 1, 0] + [0, 0, 10.0]) @ matrix.T, atol=0.06)


def test_attached_end_pushes_its_way_into_a_neighbour():
    """A block whose end a bone drives by 6 mm into a belly, which gives way."""
    belly = ellipsoid((8, 8, 25), (0, 0, 0), subdivisions=3)
    z, block = belly.vertices[:, 2], box_mesh([-4, -30, -4], [4, -8.5, 4])
    y = block.vertices[:, 1]
    muscles = {"belly": (belly, {"floor": np.abs(z) > 19}), "block": (block, {"push": y > -14})}
    scene = _scene(muscles, [{"push": t} for t in (0.0, 2.0, 4.0, 6.0)], {"push": (0, 1, 0)})
    _, models = _run(scene)
    end = models["block"].contact_points()[models["block"].attached_bone >= 0]
    vertices, faces = map(np.array, models["belly"].material_mesh())
    assert end[:, 1].max() > -3.5
    assert igl.signed_distance(end, vertices, faces)[0].min() > -1.0  # else 5.5


def test_points_that_meet_others_lie_closer_where_the_surface_bends():
    """A capsule: its caps bend in both directions, its side in one."""
    capsule = trimesh.creation.capsule(height=40.0, radius=5.0, count=[48, 48]).subdivide()
    points, normals = np.array(capsule.vertices), np.array(capsule.vertex_normals)
    chosen = surface_points(points, normals, 5.0, 0.15)
    away = cKDTree(points[chosen]).query(points)[0]
    assert away.max() <= 5.0
    caps = np.abs(points[:, 2] - 20.0) > 20.0
    # A chord of length d over an arc of radius r: the arc rises by d² / 8 r.
    assert (away[caps] ** 2 / (8.0 * 5.0)).max() < 0.15 + 1e-3
    count = np.count_nonzero(caps[chosen])
    density = [count / (4 * np.pi * 25), (len(chosen) - count) / (2 * np.pi * 5 * 40)]
    assert density[0] > 1.3 * density[1]
    even = surface_points(points, np.zeros_like(points), 5.0, np.inf)
    np.testing.assert_array_equal(surface_points(points, normals, 5.0, np.inf), even)


def test_attachments_side_by_side_that_bones_drive_together_give_way():
    muscles = {}
    for name, low, high in (("one", -10, -0.05), ("two", 0.05, 10)):
        mesh = box_mesh([low, -5, -30], [high, 5, 30])
        z = mesh.vertices[:, 2]
        muscles[name] = (mesh, {name: z < -26, "floor": z > 26})
    frames = [{"one": s, "two": -s} for s in (0.0, 0.25, 0.5)]
    _, models = _run(_scene(muscles, frames, {"one": (1, 0, 0), "two": (1, 0, 0)}))
    assert _overlap(models["one"], models["two"]) < 0.1 > _overlap(models["two"], models["one"])


def test_thin_rims_that_are_driven_onto_each_other_meet():
    """Two plates of 2 mm, one of which a bone drives edge on into the rim of the other."""
    low, high = box_mesh([-15, -30, -1], [15, -0.1, 1]), box_mesh([-15, 0.1, -1], [15, 30, 1])
    muscles = {
        "low": (low, {"floor": low.vertices[:, 1] < -26}),
        "high": (high, {"push": high.vertices[:, 1] > 26}),
    }
    scene = _scene(muscles, [{"push": -t} for t in (0.0, 0.5, 1.0, 1.5)], {"push": (0, 1, 0)})
    _, models = _run(scene)
    assert _overlap(models["low"], models["high"]) < 0.25 > _overlap(models["high"], models["low"])


def test_points_halfway_through_a_thin_muscle_are_pushed_back_to_their_side():
    mesh = box_mesh([-20, -10, -2], [20, 10, 2])
    scene = _scene({"sheet": (mesh, {"floor": mesh.vertices[:, 0] < -19})}, [{}], {})
    (model,) = build_models(scene)
    model.body()
    solid = model.begin(BoneContacts(BonesInReach([], []), model.attached_bone))
    points = np.array([[x, 0.0, z] for x in (-5.0, 0.0, 5.0) for z in (0.2, 0.5, 1.0, 1.5)])
    places = (points - model._material.origin) @ model._material.turn.T
    gap, normals, _ = solid.ask(points, places)
    assert gap.max() < 0.0 and normals[:, 2].min() > 0.99


def test_muscle_alone_is_the_same_with_neighbours_on_and_off():
    mesh = box_mesh([-20, -6, -6], [20, 6, 6])
    ends = {"floor": mesh.vertices[:, 0] < -18, "pull": mesh.vertices[:, 0] > 18}
    shapes = []
    for on in (True, False):
        scene = _scene({"bar": (mesh, ends)}, [{"pull": 0.0}, {"pull": 3.0}], {"pull": (1, 0, 0)})
        if not on:
            scene.neighbours = None
        models = build_models(scene)
        list(simulate_frames(scene, models, surfaces=False))
        shapes.append(models[0].contact_points())
    np.testing.assert_array_equal(*shapes)
