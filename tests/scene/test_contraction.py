"""Keys of contraction, activation along a motion, tendon, and the law of the fibres."""

import numpy as np
import pytest
from contraction_scenes import MUSCLE, spindle_scene

from rbfmuscle.models import build_model
from rbfmuscle.scene.activation.contraction import SETTLING, STEP, Activations, resolve_contraction
from rbfmuscle.validation import SceneError


def scene(**keys):
    return spindle_scene(frames=4, spacing=6.0, **keys)


def test_fibres_of_a_mesh_are_slack_pull_or_yield_by_the_law():
    made = scene(fibre_stretch_at_rest=1.25, tendon={"length": 100.0, "strain": 0.05}, model="pbd")
    fibres = build_model(made.muscle(MUSCLE), made).fibres
    belly = ~fibres.at_tendon
    assert belly.any() and fibres.at_tendon.any()
    rows = (0.0, (0.8, 1.0), 0.0), (0.5, (0.6, 0.7), 0.025), (1.0, (0.4, 0.4), 0.05)
    for activation, (low, high), strain in rows:
        fibres.activate(activation)
        assert fibres.lower[belly] == pytest.approx(low) and fibres.upper[belly] == pytest.approx(
            high
        )
        assert (fibres.active[belly] == activation).all() and (fibres.active[~belly] == 0.0).all()
        assert (fibres.lower[~belly] == 1.0).all() and fibres.upper[~belly] == pytest.approx(
            1.0 + strain
        )


def test_sub_steps_follow_activation_and_settle_where_bones_stand_still():
    made = scene(activation=[0.0, 0.55])
    activations = Activations(made.muscles, made.motion)
    here = made.motion.frames[0]
    assert activations.refine(0, [here]) == ([here], [])
    stops, values = activations.refine(4, [here])
    steps = [value[MUSCLE] for value in values]
    assert len(stops) == len(values) + 1
    assert max(np.diff([0.0, *steps])) <= STEP + 1e-12
    assert steps[-SETTLING - 1 :] == pytest.approx([0.55] * (SETTLING + 1))


def test_tendon_is_measured_from_the_attachments_or_from_one():
    made = scene(tendon={"length": 60.0})
    muscle = made.muscle(MUSCLE)
    x = np.asarray(muscle.mesh.vertices)[:, 0]
    held = np.zeros(len(x), bool)
    held[np.concatenate([a.vertices for a in muscle.attachments])] = True
    tendon = resolve_contraction(muscle).tendon
    assert tendon[held].all()
    assert np.abs(x[tendon & ~held]).min() == pytest.approx(100.0, abs=6.0)  # an edge of the mesh
    one = resolve_contraction(scene(tendon={"length": 60.0, "at": "origin"}).muscle(MUSCLE)).tendon
    assert np.array_equal(one, tendon & (x < 0))


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ({"activation": 1.2}, "from 0 to 1"),
        ({"activation": float("nan")}, "from 0 to 1"),
        ({"activation": "full"}, "got 'full'"),
        ({"activation": {"at": 1}}, "from 0 to 1"),
        ({"tendon": {"length": 400.0}}, "covers all"),
        ({"tendon": {"length": 0.01}}, "make it longer"),
        ({"tendon": {"length": 5.0, "at": "insertoin"}}, "did you mean 'insertion'"),
        ({"fibre_strech_at_rest": 0.5}, "did you mean 'fibre_stretch_at_rest'"),
    ],
)
def test_wrong_keys_are_one_line(keys, words):
    with pytest.raises(SceneError, match=words) as caught:
        scene(**keys).validate()
    assert "\n" not in str(caught.value) and MUSCLE in str(caught.value)


def test_fibres_that_leave_the_muscle_are_refused():
    made = scene()
    made.muscle(MUSCLE).fibres = [line + [0, 0, 80.0] for line in made.muscle(MUSCLE).fibres]
    with pytest.raises(SceneError, match="leaves the muscle"):
        made.validate()
