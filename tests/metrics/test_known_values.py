"""Every quantity of a frame against a known answer: a box of a muscle, stretched by a tenth."""

from types import SimpleNamespace

import numpy as np
import pytest
import toy_scene as toy
from tendon_scene import END, arm

from rbfmuscle.metrics.centreline import Centreline
from rbfmuscle.metrics.metrics import MuscleMeasures
from rbfmuscle.scene.objects import Attachment
from rbfmuscle.scene.scene import Scene
from rbfmuscle.simulation.frame import Event, FibreLines, Frame, ModelSurface

STRETCH = 1.1


def box_scene():
    """A box of 40 by 20 by 20 between two bones, and a third one 2 deep in its upper side."""
    scene = Scene("box", units="mm")
    places = {
        "trunk": ((-10, 0, 0), (-1, 20, 20)),
        "limb": ((60, 0, 0), (70, 20, 20)),
        "plate": ((10, 4, 18), (20, 16, 30)),
    }
    for name, (low, high) in places.items():
        scene.add_bone(name, toy.box_mesh(low, high))
    scene.add_joint("slide", "trunk", "limb", (0, 0, 0), {"bend": (0, -1, 0)})
    scene.add_joint("still", "trunk", "plate", (0, 0, 0), {"bend": (0, -1, 0)})
    mesh = toy.box_mesh((0, 0, 0), (40, 20, 20))
    x = mesh.vertices[:, 0]
    scene.add_muscle("box", mesh, attach=toy.held(trunk=x < 1e-6, limb=x > 40 - 1e-6))
    scene.set_motion(ramp={"slide.bend": {"to": 2.0, "step": 1.0}})
    return scene


def stretched(scene, index=0, *, lift=0.0):
    """The frame of a stretched box, its shown surface ``lift`` above the material."""
    mesh = scene.muscles[0].mesh
    material = np.array(mesh.vertices) * [STRETCH, 1.0, 1.0]
    pose = np.eye(4)
    pose[0, 3] = 40.0 * (STRETCH - 1.0)
    poses = {"trunk": np.eye(4), "plate": np.eye(4), "limb": pose}
    given = {
        "solver_penetration_max": 0.5,
        "lifted_penetration_max": 0.25,
        "solver_residual": 1e-5,
        "condition": 7.0,
        "time_fit": 0.5,
    }
    faces = np.array(mesh.faces)
    surface = ModelSurface(material + [0.0, 0.0, lift], faces, given)
    events = [Event(index, "box", "plate", 3, "unresolved"), Event(index, "box", "", 9, "halved")]
    times = {"box": {"time_predict": 1.0, "time_solve": 2.0, "time_frame": 4.0}}
    carried = {"box": (material, faces)}
    return Frame(index, {}, poses, {"box": surface}, carried, events, times, 5.0)


@pytest.fixture(scope="module")
def scene():
    return box_scene()


def measures_of(scene):
    (muscle,) = scene.muscles
    material = np.array(muscle.mesh.vertices), np.array(muscle.mesh.faces)
    return MuscleMeasures(scene, {muscle.name: material})


@pytest.fixture(scope="module")
def found(scene):
    return measures_of(scene).measure(stretched(scene))["box"]


def test_volume_and_length_grow_by_a_tenth(found):
    assert found["volume"] == pytest.approx(1.1 * 16_000.0)
    assert found["volume_error"] == pytest.approx(0.1)
    assert found["length"] == pytest.approx(44.0)
    assert (found["components"], found["euler_characteristic"], found["self_crossings"]) == (
        1,
        2,
        0,
    )


def test_depths_are_those_of_the_plate(scene, found):
    vertices = stretched(scene).surfaces["box"].vertices
    low, high = np.array([10, 4, 18]), np.array([20, 16, 30])
    depth = np.minimum(vertices - low, high - vertices).min(axis=1)
    assert found["penetration_max"] == pytest.approx(2.0)
    assert found["penetration_fraction"] == pytest.approx(np.mean(depth > 0.0))
    # Its lower side is 2 below the muscle's upper one.
    assert found["bone_penetration_max"] == pytest.approx(2.0)


def test_strain_is_the_root_of_the_mean_square_of_the_edges_changes(scene, found):
    mesh = scene.muscles[0].mesh
    sides = np.diff(np.array(mesh.vertices)[mesh.edges_unique], axis=1)[:, 0]
    before, after = (np.linalg.norm(sides * s, axis=1) for s in (1.0, [STRETCH, 1.0, 1.0]))
    wanted = np.sqrt(np.mean((after / before - 1.0) ** 2))
    assert found["edge_strain_rms"] == pytest.approx(wanted) and 0.03 < wanted < 0.1


def test_what_the_model_says_and_what_is_counted_comes_through(found):
    assert (found["solver_penetration_max"], found["lifted_penetration_max"]) == (0.5, 0.25)
    assert (found["solver_residual"], found["condition"], found["time_fit"]) == (1e-5, 7.0, 0.5)
    assert found["tunnelled"] == 3.0
    assert (found["time_solve"], found["time_frame"]) == (3.0, 4.0)
    # The limb's end is 20 from it at rest, the trunk's 1.
    assert found["end_gap"] == pytest.approx(20.0)
    assert found["neighbour_overlap_max"] == found["neighbour_gap"] == 0.0


def test_flicker_is_the_change_of_the_distance_between_frames_in_turn(scene):
    measures = measures_of(scene)
    lifts = {0: 0.1, 1: 0.4, 2: 0.3, 6: 2.0}
    rows = [measures.measure(stretched(scene, k, lift=h))["box"] for k, h in lifts.items()]
    assert [row.get("flicker") for row in rows] == [
        None,
        pytest.approx(0.3),
        pytest.approx(0.1),
        None,  # four frames later
    ]
    assert [row["shown_shift_max"] for row in rows] == pytest.approx(list(lifts.values()))
    # The lift moves two sides of six, and the edge of the others by less than it.
    assert 0.1 < rows[-1]["shown_shift_rms"] < 2.0


def test_stretch_of_fibres_is_in_percentiles(scene):
    frame = stretched(scene)
    stretch = np.linspace(0.8, 1.2, 101)
    none = np.zeros((101, 2, 3))
    frame.fibres = {"box": FibreLines(none, stretch, none[:, :, 0])}
    found = measures_of(scene).measure(frame)["box"]
    values = [found[f"fibre_stretch_{name}"] for name in ("p05", "p50", "p95")]
    assert values == pytest.approx([0.82, 1.0, 1.18])


def test_tendons_are_part_of_the_length_and_of_that_of_the_shortest_path(scene, found):
    frame = stretched(scene)
    frame.tendons = {"limb": SimpleNamespace(points=np.array([[0.0, 0, 0], [0, 7, 0]]))}
    longer = measures_of(scene).measure(frame)["box"]
    assert found["path_length"] == pytest.approx(found["length"] / found["bowing"])
    for name in ("length", "path_length"):
        assert longer[name] == pytest.approx(found[name] + 7.0)


def test_depth_of_a_tendon_is_that_of_its_deepest_point_between_the_ends():
    scene = arm()
    mesh = scene.muscles[0].mesh
    material, faces = np.array(mesh.vertices), np.array(mesh.faces)
    poses = {name: np.eye(4) for name in ("trunk", "limb", END)}
    # The trunk's radius is 8, its facets lie 0.02 deeper.
    points = np.array([[0, 0, 50], [0, -6, 30], [0, -7, 20], [0, -20, 10], [0, -1, 50]], float)
    frame = Frame(0, {}, poses, {}, {"strap": (material, faces)}, [], {"strap": {}}, 0.0)
    frame.tendons = {END: SimpleNamespace(points=points)}
    found = measures_of(scene).measure(frame)["strap"]
    assert found["tendon_depth"] == pytest.approx(2.0, abs=0.03)
    frame.tendons = {}
    assert measures_of(scene).measure(frame)["strap"]["tendon_depth"] == 0.0


def test_tendons_of_one_end_count_by_the_areas_of_their_patches():
    mesh = toy.box_mesh((0, 0, 0), (40, 20, 20))
    x, y = mesh.vertices[:, 0], mesh.vertices[:, 1]
    near = Attachment("limb", np.flatnonzero((x > 40 - 1e-6) & (y < 6)))
    far = Attachment("limb", np.flatnonzero((x > 40 - 1e-6) & (y >= 6)))
    held = [Attachment("trunk", np.flatnonzero(x < 1e-6)), near, far]
    muscle = SimpleNamespace(name="box", mesh=mesh, attachments=held)
    line = Centreline(muscle, [], np.array(mesh.vertices), np.array(mesh.faces))
    # One body holds all, so the first attachment is the origin.
    names = ["narrow", "wide"]
    line.ends[1] = [
        (name, points, areas) for name, (_, points, areas) in zip(names, line.ends[1], strict=True)
    ]
    tendons = {
        name: SimpleNamespace(points=np.array([[0.0, 0, 0], [length, 0, 0], [length, 3.0, 0]]))
        for name, length in (("narrow", 7.0), ("wide", 27.0))
    }
    share = [areas.sum() for _, _, areas in line.ends[1]]
    assert share[0] < 0.6 * share[1]
    wanted = (10.0 * share[0] + 30.0 * share[1]) / sum(share)
    assert line.tendon_length(tendons) == pytest.approx(wanted)
    assert line.tendon_length({}) == 0.0
