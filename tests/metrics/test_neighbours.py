"""Overlap and gaps of shown surfaces of muscles against known answers: balls and boxes."""

import itertools

import igl
import numpy as np
import pytest
import toy_scene as toy
import trimesh

from rbfmuscle.geometry.mesh_distance import MeshDistance
from rbfmuscle.metrics.metrics import MuscleMeasures
from rbfmuscle.metrics.neighbours import InputNeighbours, NeighbourMeasures, Shown
from rbfmuscle.metrics.summary import exceeded, parse_limits
from rbfmuscle.recording import simulate
from rbfmuscle.scene.check import check_scene
from rbfmuscle.scene.phantom import phantom_scene
from rbfmuscle.simulation.frame import ModelSurface
from rbfmuscle.simulation.frame_loop import simulate_frames


def pair(one, other, units="mm"):
    """Measures of two muscles "one" and "other" of these meshes."""
    muscles = [toy.muscle("one", one, []), toy.muscle("other", other, [])]
    return NeighbourMeasures(InputNeighbours(muscles, units)), {"one": one, "other": other}


def shown(meshes, **moved):
    """The meshes as they are shown, each where it is at rest or moved by (4, 4) or a vector."""
    found = {}
    for name, mesh in meshes.items():
        motion = np.asarray(moved.get(name, np.zeros(3)), float)
        rest = np.array(mesh.vertices)
        vertices = trimesh.transform_points(rest, motion) if motion.ndim == 2 else rest + motion
        found[name] = Shown(MeshDistance(vertices, mesh.faces), rest)
    return found


def boxes(overlap=0.0):
    """Two boxes beside each other along x, 10 wide."""
    return toy.box_mesh((0, 0, 0), (10, 10, 10)), toy.box_mesh(
        (10 - overlap, 0, 0), (20 - overlap, 10, 10)
    )


def test_box_pushed_into_another_overlaps_by_as_much_and_pulled_off_leaves_a_gap():
    measures, meshes = pair(*boxes())
    at_rest = measures.measure(0, shown(meshes))
    assert (
        at_rest["one"] == at_rest["other"] == {"neighbour_overlap_max": 0.0, "neighbour_gap": 0.0}
    )
    pressed = measures.measure(1, shown(meshes, other=(-2.0, 0.7, 0.7)))
    assert pressed["one"]["neighbour_overlap_max"] == pytest.approx(2.0)
    apart = measures.measure(2, shown(meshes, other=(3.0, 0, 0)))
    assert apart["one"] == pytest.approx({"neighbour_overlap_max": 0.0, "neighbour_gap": 3.0})
    (row,) = measures.table()
    assert (row["muscles"], row["overlap_frame"], row["gap_frame"]) == (["one", "other"], 1, 2)
    assert (row["overlap_max"], row["gap"]) == (pytest.approx(2.0), pytest.approx(3.0))


def test_sliding_along_a_neighbour_opens_no_gap():
    measures, meshes = pair(*boxes())
    # Less than a twentieth of the side is beside it no more.
    slid = measures.measure(0, shown(meshes, other=(0, 0.4, 0)))["one"]
    assert slid["neighbour_overlap_max"] < 1e-9 and slid["neighbour_gap"] < 0.5


@pytest.mark.parametrize("units", ["mm", "m"])
def test_what_overlaps_at_rest_counts_apart_and_only_where_it_does(units):
    scale = 1.0 if units == "mm" else 0.001
    balls = [trimesh.creation.icosphere(4, 10.0) for _ in range(2)]
    balls[1].apply_translation([19.0, 0, 0])
    for ball in balls:
        ball.apply_scale(scale)
    measures, meshes = pair(*balls, units=units)
    # Facets lie within 0.03 of a ball of radius 10.
    near = pytest.approx(1.0 * scale, abs=0.06 * scale)
    assert measures.input.deepest("one") == near and measures.input.deepest("other") == near
    at_rest = measures.measure(0, shown(meshes))["other"]["neighbour_overlap_max"]
    assert at_rest == pytest.approx(0.0, abs=1e-12)
    deeper = measures.measure(0, shown(meshes, other=np.array((-2.0, 0, 0)) * scale))["one"]
    assert deeper["neighbour_overlap_max"] == pytest.approx(2.0 * scale, abs=0.05 * scale)
    # The other one turned about its middle: its other side did not overlap at rest.
    turn = trimesh.transformations.rotation_matrix(np.pi, (0, 0, 1), [19.0 * scale, 0, 0])
    turned = measures.measure(0, shown(meshes, other=turn))["other"]
    assert turned["neighbour_overlap_max"] == near


def test_overlap_is_that_of_a_literal_search_and_the_same_for_both_orders():
    rng = np.random.default_rng(4)
    balls = [trimesh.creation.icosphere(3, 10.0) for _ in range(2)]
    for ball in balls:
        ball.vertices *= 1.0 + 0.05 * rng.normal(size=(len(ball.vertices), 1))
    balls[1].apply_translation([25.0, 0, 0])
    deepest = 0.0
    there = balls[1].copy().apply_translation([-10.0, 1.0, 0])
    for one, other in ((balls[0], there), (there, balls[0])):
        distance = trimesh.proximity.signed_distance(other, one.vertices)
        deepest = max(deepest, distance.max())
    for order in ((0, 1), (1, 0)):
        measures, meshes = pair(*(balls[k] for k in order))
        moved = {("one", "other")[order.index(1)]: (-10.0, 1.0, 0)}
        found = measures.measure(0, shown(meshes, **moved))
        assert found["one"]["neighbour_overlap_max"] == pytest.approx(deepest)
        assert found["one"] == found["other"]


def test_every_run_measures_neighbours_and_its_verdict_counts_them():
    scene = phantom_scene(end=36.0, step=12.0)
    scene.muscles = [scene.muscle(name) for name in ("extensor", "abductor")]
    scene.neighbours = None
    run = simulate(scene, model="pbd")
    for name in ("extensor", "abductor"):
        values = run.values(name, "neighbour_overlap_max")
        assert len(values) == 4 and values[0] < 0.1 and values[-1] > 1.0
        assert len(run.values(name, "neighbour_overlap_rest")) == 1
        assert len(run.values(name, "neighbour_gap")) == 4
    beyond = exceeded(run.info.muscles, parse_limits(None, run.scene))
    assert {row.muscle for row in beyond if row.quantity == "neighbour_overlap_max"} == {
        "extensor",
        "abductor",
    }
    assert "overlap with another muscle" in run.verdict
    (row,) = run.info.neighbours
    assert row["overlap_max"] == pytest.approx(max(run.values("extensor", "neighbour_overlap_max")))


def test_what_is_cut_away_in_the_drawing_stays_an_overlap_of_the_material():
    """A model that shows its muscles smaller than they are, so that they do not meet."""

    class Trimmed(toy.ToyMuscle):
        def surface(self, contacts):
            middle = self.x.mean(axis=0)
            return ModelSurface(middle + 0.8 * (self.x - middle), self.faces, {})

    made, fields = toy.neighbour_scene([{}, {"press": 4.0}], gap=0.2, neighbours=None)
    models = [Trimmed(muscle, made, sweeps=4, reach=2.0) for muscle in made.muscles]
    measures = MuscleMeasures(made, {model.name: model.material_mesh() for model in models})
    frames = simulate_frames(made, models, bone_sdfs=fields)
    rest, pressed = (measures.measure(frame)["lower"] for frame in frames)
    assert rest["material_overlap_max"] == pressed["neighbour_overlap_max"] == 0.0
    assert pressed["material_overlap_max"] > 0.2
    # The ends are farthest from the middle, 30 along it.
    assert rest["shown_shift_max"] == pytest.approx(6.0, abs=0.3)
    assert 0.5 < rest["shown_shift_rms"] < 2.0


def test_check_lists_muscles_whose_meshes_overlap():
    made, _ = toy.neighbour_scene([{}], gap=-1.0, neighbours=None)
    (said,) = [f for f in check_scene(made) if f.place == "lower and upper"]
    assert said.level == "note" and "overlap by 0.998 mm, " in said.message
    inside = [
        np.count_nonzero(igl.signed_distance(a.vertices, b.vertices, b.faces)[0] < 0.0)
        for a, b in itertools.permutations([muscle.mesh for muscle in made.muscles])
    ]
    assert f"{sum(inside)} vertices" in said.message
    apart, _ = toy.neighbour_scene([{}], gap=1.0, neighbours=None)
    assert not [f for f in check_scene(apart) if f.place == "lower and upper"]
