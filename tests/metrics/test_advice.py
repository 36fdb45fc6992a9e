"""Advice of verdicts, each followed on a case that has the fault: the value is then better."""

import numpy as np
import pytest
from blend_model import BlendMuscle, arm_scene
from tendon_scene import arm

from rbfmuscle.metrics.quantities import ALL
from rbfmuscle.metrics.summary import LIMITS
from rbfmuscle.recording import simulate
from rbfmuscle.scene.options import GuessTable
from rbfmuscle.scene.phantom import phantom_scene

LOOK = "look at that frame"


def shifted(height):
    """The arm with its muscle moved up, held as guessed."""
    scene = arm_scene(end=10)
    scene.muscles[0].mesh.apply_translation([0.0, 0.0, height])
    scene.muscles[0].attachments[0].guess = GuessTable(confidence=0.9)
    return scene.with_options({"contact.initial": "keep"})


def hinged(centre):
    """The arm about another centre; corners of its narrow forearm can be in the other bone."""
    scene = arm_scene()
    scene.bones[1].mesh.apply_scale([1.0, 0.5, 1.0])
    scene.joints.clear()
    scene.add_joint("elbow", "upper", "fore", centre, {"flexion": (0, -1, 0)})
    return scene


def guessed(sure):
    scene = arm_scene(end=10)
    doubtful = GuessTable(confidence=0.1, reason="held by the nearest bones")
    scene.muscles[0].attachments[0].guess = None if sure else doubtful
    return scene


def lacking(names):
    scene = arm_scene(end=10)
    scene.missing_bones = names
    return scene


# Quantity, muscle, scene with the fault, scene after its remedy.
MENDED = [
    ("initial_overlap", "biceps", shifted(-2.5), shifted(0.0)),
    ("end_gap", "biceps", shifted(40.0), shifted(0.0)),
    ("joint_gap", ALL, hinged((0, 0, 30)), hinged((0, 0, 0))),
    ("bone_overlap", ALL, hinged((0, 0, -20)), hinged((0, 0, 0))),
    ("doubtful_guesses", "biceps", guessed(False), guessed(True)),
    ("missing_bones", ALL, lacking(["patella"]), lacking([])),
]


@pytest.mark.parametrize(("quantity", "muscle", "fault", "mended"), MENDED)
def test_a_fault_of_the_scene_goes_once_its_remedy_is_followed(
    quantity, muscle, fault, mended, monkeypatch, recwarn
):
    monkeypatch.setattr("rbfmuscle.models.build_model", BlendMuscle)
    before, after = (simulate(scene) for scene in (fault, mended))
    assert LIMITS[quantity].remedy in before.verdict
    assert quantity in {row.quantity for row in before.info.beyond}
    assert quantity not in {row.quantity for row in after.info.beyond}
    worst = [np.abs(run.values(muscle, quantity)).max() for run in (before, after)]
    assert worst[1] < worst[0]


def test_via_points_moved_out_of_a_bone_take_a_tendon_out_of_it():
    depths = []
    for y in (0.0, -14.0):
        scene = arm(via=[{"bone": "limb", "point": [0.0, y, -30.0]}])
        scene.set_motion(waypoints=[{}])
        run = simulate(scene, frames="0:1")
        depths.append(run.values("strap", "tendon_depth")[0])
    assert depths[0] > LIMITS["tendon_depth"].value > depths[1]


def test_more_iterations_and_models_that_converge_lower_the_residual():
    scene = phantom_scene(end=12.0, step=12.0)
    scene.muscles = [scene.muscle("adductor_anterior")]

    def residual(model, settings):
        run = simulate(scene, model=model, settings=settings)
        return run.values("adductor_anterior", "solver_residual").max()

    few, many = (residual("rbf", {"model.iterations": n}) for n in (2, 200))
    assert many < 0.1 * few and many < LIMITS["solver_residual"].value < few
    assert residual("pbd-converged", {}) < 0.5 * residual("pbd", {})


def test_a_lower_activation_lowers_the_residual_of_a_muscle_that_contracts(hip_scene):
    scene = hip_scene.with_options()
    scene.muscles = [scene.muscle("gluteus_maximus")]
    keys = {"fibre_stretch_at_rest": 1.1, "tendon_region.length": 40}  # as in docs/contraction.md
    settings = {f"muscle.gluteus_maximus.{key}": value for key, value in keys.items()}
    runs = [
        simulate(scene, frames="0:1", settings=settings | {"activation": activation})
        for activation in (1.0, 0.3)
    ]
    assert LIMITS["solver_residual"].active_remedy in runs[0].verdict
    before, after = (run.values("gluteus_maximus", "solver_residual").max() for run in runs)
    assert after < 0.1 * before


def test_every_remedy_is_followed_by_a_test():
    # What is left is followed in tests/scene/test_guesses.py: a far end is not articular.
    followed = {quantity for quantity, *_ in MENDED} | {
        "tendon_depth",
        "solver_residual",
        "articular_share",
    }
    advised = {name for name, limit in LIMITS.items() if not limit.remedy.startswith(LOOK)}
    assert advised == followed
    for others in ("mesh_remedy", "active_remedy"):
        assert {name for name, limit in LIMITS.items() if getattr(limit, others)} <= followed
