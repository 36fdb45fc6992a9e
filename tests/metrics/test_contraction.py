"""What is measured of muscles that contract, on shapes whose answer is known."""

import numpy as np
import pytest
from contraction_scenes import MUSCLE, SPINDLE, spindle_scene

import rbfmuscle as rm
from rbfmuscle.metrics.centreline import MuscleAtRest
from rbfmuscle.metrics.contraction import ContractionStudy, pennation


def test_pennation_is_the_angle_to_the_axis_whichever_way_fibres_are_numbered():
    angle = np.radians(25.0)
    line = np.outer(np.arange(4.0), [np.cos(angle), np.sin(angle), 0.0])
    lines = np.stack([line, line[::-1]])
    assert pennation(lines, np.ones((2, 3), bool), np.eye(3)[0]) == pytest.approx(25.0)


def test_fibres_of_the_spindle_at_rest_and_shortened():
    scene = spindle_scene(spacing=5.0, tendon={"length": 100.0})
    muscle = scene.muscle(MUSCLE)
    vertices, faces = np.asarray(muscle.mesh.vertices), np.asarray(muscle.mesh.faces)
    study = ContractionStudy(MuscleAtRest(muscle, scene.joints, vertices, faces))
    poses = {bone.name: np.eye(4) for bone in scene.bones}
    rest = study.measure(vertices, poses)
    # Whole segments of 20 mm count, none that tendon reaches.
    assert SPINDLE.belly_length - 45.0 < rest["fibre_length"] < SPINDLE.belly_length + 5.0
    assert rest["fibre_stretch"] == pytest.approx(1.0)
    assert rest["pennation"] < 8.0
    short = study.measure(vertices * [0.8, 1.0, 1.0], poses)
    assert 0.8 <= short["fibre_stretch"] < 0.82  # fibres lean a little
    muscle.fibres = None  # nothing is known of them then
    assert (
        ContractionStudy(MuscleAtRest(muscle, scene.joints, vertices, faces)).measure(vertices, poses) == {}
    )
    assert short["fibre_length"] / rest["fibre_length"] == pytest.approx(short["fibre_stretch"], rel=5e-3)


def test_run_reports_what_contracts():
    run = rm.simulate(
        spindle_scene(spacing=5.0, frames=2, model="arap-volume", tendon={"length": 100.0, "strain": 0.08})
    )
    assert run.values(MUSCLE, "activation") == pytest.approx([0.0, 0.5, 1.0])
    for quantity, sign in (
        ("fibre_length", -1),
        ("fibre_stretch", -1),
        ("csa_max", 1),
        ("belly_thickness", 1),
    ):
        assert sign * (np.diff(run.values(MUSCLE, quantity))[-1]) > 0.0, quantity
    assert run.values(MUSCLE, "csa_place") == pytest.approx([0.5] * 3, abs=0.02)
    assert {row.unit for row in run.metrics if row.quantity == "csa_max"} == {"mm^2"}
