"""The shape at rest against the input mesh: known answers, and overlaps with bones apart."""

import numpy as np
import pytest
import toy_scene as toy
from blend_model import BlendMuscle, arm_scene, use_blend_model

from rbfmuscle.geometry.mesh_distance import MeshDistance
from rbfmuscle.metrics.metrics import bone_overlap, rest_errors, surface_distance
from rbfmuscle.recording import simulate
from rbfmuscle.scene.bone import BoneDistance
from rbfmuscle.simulation.frame import ModelSurface

HERE = {"bone": np.eye(4)}


def test_distance_of_two_boxes_is_the_root_of_the_mean_of_both_mean_squares():
    one, other = toy.box_mesh((0, 0, 0), (8, 8, 8)), toy.box_mesh((-1, 0, 0), (8, 8, 8))
    there, back = MeshDistance(one.vertices, one.faces), MeshDistance(other.vertices, other.faces)
    rms, worst = surface_distance(there.vertices, there.faces, back.vertices, back.faces)
    # From the shared sides nothing; from the face at 0 to that at -1 one, where no edge is nearer.
    moved = np.array(other.vertices)[other.vertices[:, 0] < -1e-6]
    face = np.array(one.vertices)[np.abs(one.vertices[:, 0]) < 1e-6]
    inner = np.minimum(face[:, 1:], 8 - face[:, 1:]).min(axis=1)
    squares = [
        np.square(np.minimum(inner, 1.0)).sum() / len(one.vertices),
        np.square(moved[:, 0]).sum() / len(other.vertices),
    ]
    assert len(moved) > 20 and worst == pytest.approx(1.0)
    assert rms == pytest.approx(np.sqrt(np.mean(squares)))


def test_rest_error_leaves_out_what_is_near_an_overlap_and_counts_it_apart():
    mesh = toy.box_mesh((0, 0, 0), (80, 4, 4))
    given = MeshDistance(mesh.vertices, mesh.faces)
    bulged = np.array(mesh.vertices)
    top = bulged[:, 2] > 4 - 1e-6
    bulged[top & (bulged[:, 0] < 5), 2] += 3.0  # beside the overlap
    bulged[top & (bulged[:, 0] > 50), 2] += 0.5
    shown = MeshDistance(bulged, mesh.faces)
    found = rest_errors(shown, given, np.array([[0.0, 2.0, 4.0]]), 10.0)
    assert found["rest_error_at_overlap"] == pytest.approx(3.0)
    assert found["rest_error_max"] == pytest.approx(0.5)
    everywhere = rest_errors(shown, given, np.zeros((0, 3)), 10.0)
    assert everywhere["rest_error_max"] == pytest.approx(3.0)
    assert "rest_error_at_overlap" not in everywhere
    assert everywhere["rest_error_rms"] > found["rest_error_rms"] > 0.1
    # Nothing is far from an overlap everywhere: then there is no value, which a limit names.
    assert "rest_error_rms" not in rest_errors(shown, given, given.vertices, 10.0)


def test_overlap_with_a_bone_is_found_by_the_vertices_of_either_but_not_where_it_is_held():
    muscle = toy.box_mesh((0, 0, 0), (40, 20, 20))
    given = MeshDistance(muscle.vertices, muscle.faces)
    bone = [BoneDistance("bone", toy.box_mesh((10, 5, 18), (20, 15, 30)))]
    places, deepest = bone_overlap(given, np.zeros(0, int), bone, HERE, 0.02)
    assert deepest == pytest.approx(2.0)
    assert len(places) and (np.abs(places[:, 2] - 19) <= 1.0 + 1e-9).all()
    held = np.flatnonzero(given.vertices[:, 2] > 20 - 1e-6)
    assert bone_overlap(given, held, bone, HERE, 0.02)[1] == 0.0
    narrow = [BoneDistance("bone", toy.box_mesh((11, 6, 17), (13, 8, 30)))]  # between its vertices
    assert bone_overlap(given, np.zeros(0, int), narrow, HERE, 0.02)[1] == pytest.approx(3.0)


def test_a_muscle_that_bends_away_from_an_overlap_is_no_scanned_shape(monkeypatch):
    """What moves far from an overlap is an error, whatever moved it."""

    class Bent(BlendMuscle):
        def surface(self, contacts):
            shown = super().surface(contacts)
            vertices = shown.vertices + [0.0, 0.0, 4.0] * (np.abs(shown.vertices[:, :1]) < 12)
            return ModelSurface(vertices, shown.faces, shown.quantities)

    use_blend_model(monkeypatch)
    monkeypatch.setattr("rbfmuscle.models.build_model", Bent)
    scene = arm_scene(end=10)
    # The end of the bone in the muscle, 15 from where it bends.
    scene.bones[0].mesh.apply_translation([-10.0, 0.0, 2.5])
    run = simulate(scene.with_options({"contact.initial": "keep"}))
    assert run.values("biceps", "input_overlap")[0] > 0.1
    assert run.values("biceps", "rest_error_max")[0] > 1.0
    assert "rest_error_rms" in {row.quantity for row in run.info.beyond}
