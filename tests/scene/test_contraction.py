"""Keys of contraction, activation along a motion, tendon, and the law of the fibres."""

import numpy as np
import pytest
from blend_model import arm_scene
from contraction_scenes import MUSCLE, spindle_scene

from rbfmuscle.models import build_model
from rbfmuscle.scene.activation import (
    SETTLING,
    STEP,
    Activations,
    activation_curve,
    contraction_keys,
    make_contraction,
)
from rbfmuscle.scene.frames import slice_motion
from rbfmuscle.scene.objects import Motion, Muscle
from rbfmuscle.scene.scene import Scene, require_complete
from rbfmuscle.validation import SceneError


def scene(**keys):
    return spindle_scene(frames=4, spacing=6.0, **keys)


def test_fibres_of_a_mesh_are_slack_pull_or_yield_by_the_law():
    made = scene(
        fibre_stretch_at_rest=1.25, tendon_region={"length": 100.0, "strain": 0.05}, model="pbd"
    )
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
    made = scene(tendon_region={"length": 60.0})
    muscle = made.muscle(MUSCLE)
    x = np.asarray(muscle.mesh.vertices)[:, 0]
    held = np.zeros(len(x), bool)
    held[np.concatenate([a.vertices for a in muscle.attachments])] = True
    tendon = make_contraction(muscle).tendon
    assert tendon[held].all()
    assert np.abs(x[tendon & ~held]).min() == pytest.approx(100.0, abs=6.0)  # an edge of the mesh
    one = make_contraction(
        scene(tendon_region={"length": 60.0, "at": "origin"}).muscle(MUSCLE)
    ).tendon
    assert np.array_equal(one, tendon & (x < 0))


@pytest.mark.parametrize(
    ("keys", "words"),
    [
        ({"activation": 1.2}, "from 0 to 1"),
        ({"activation": float("nan")}, "from 0 to 1"),
        ({"activation": "full"}, "got 'full'"),
        ({"activation": {"at": 1}}, "unknown key 'at'"),
        ({"tendon_region": {"length": 400.0}}, "covers all"),
        ({"tendon_region": {"length": 0.01}}, "make it longer"),
        ({"tendon_region": {"length": 5.0, "at": "insertoin"}}, "did you mean 'insertion'"),
        ({"fibre_strech_at_rest": 0.5}, "did you mean 'fibre_stretch_at_rest'"),
    ],
)
def test_wrong_keys_are_one_line(keys, words):
    with pytest.raises(SceneError, match=words) as caught:
        require_complete(scene(**keys))
    assert "\n" not in str(caught.value) and MUSCLE in str(caught.value)


def test_fibres_that_leave_the_muscle_are_refused():
    made = scene()
    made.muscle(MUSCLE).fibres = [line + [0, 0, 80.0] for line in made.muscle(MUSCLE).fibres]
    with pytest.raises(SceneError, match="leaves the muscle"):
        require_complete(made)


STO = """activations
nRows=3
inDegrees=no
endheader
time\tother\t/forceset/m/activation
1.0\t1\t0.0
2.0\t1\t0.5
4.0\t1\t0.0
"""


def curve(activation, **motion):
    """Activation in the frames of a motion of five."""
    muscle = Muscle("m", None, contraction=contraction_keys({"activation": activation}, muscle="m"))
    return activation_curve(muscle, Motion([{}] * 5, **motion))


class TestOverTime:
    TIMES = (0.5, 1.5, 2.0, 3.0, 9.0)

    def test_at_frames_of_the_whole_motion(self):
        given = {"frames": [1, 3], "values": [0.2, 1.0]}
        assert curve(given) == pytest.approx([0.2, 0.2, 0.6, 1.0, 1.0])
        keys = contraction_keys({"activation": given}, muscle="m")
        part = slice_motion(Motion([{}] * 5), slice(1, None, 2))
        assert activation_curve(Muscle("m", None, contraction=keys), part) == pytest.approx(
            [0.2, 1.0]
        )

    def test_at_times_and_from_a_file_alike(self, tmp_path):
        expected = [0.0, 0.25, 0.5, 0.25, 0.0]
        table = {"times": [1.0, 2.0, 4.0], "values": [0.0, 0.5, 0.0]}
        (tmp_path / "a.sto").write_text(STO)
        assert curve(table, times=self.TIMES) == pytest.approx(expected)
        assert curve({"file": str(tmp_path / "a.sto")}, times=self.TIMES) == pytest.approx(expected)
        other = {"file": str(tmp_path / "a.sto"), "column": "other"}
        assert curve(other, times=self.TIMES) == pytest.approx([1.0] * 5)

    @pytest.mark.parametrize(
        ("given", "words"),
        [
            ({"frames": [0, 1], "values": [1]}, "frames has 2 numbers and values 1"),
            ({"frames": [1, 1], "values": [1, 1]}, "frames must increase"),
            ({"frames": [0], "times": [0], "values": [1]}, "one of frames, times and file"),
            ({"values": [1]}, "one of frames, times and file"),
            ({"frames": [0], "values": [1.2]}, "less than or equal to 1"),
            ({"frame": [0], "values": [1]}, "did you mean 'frames'"),
            ({"file": "a.sto", "column": "forcset/m"}, "no column 'forcset/m', did you mean"),
            ({"file": "b.sto"}, "b.sto column 'm': .*1.5"),
            ({"file": "nowhere.sto"}, "nowhere.sto: cannot read it"),
        ],
    )
    def test_wrong_tables_are_named(self, tmp_path, given, words):
        (tmp_path / "a.sto").write_text(STO)
        (tmp_path / "b.sto").write_text(STO.replace("0.5", "1.5"))
        if "file" in given:
            given = given | {"file": str(tmp_path / given["file"])}
        with pytest.raises(SceneError, match=f"muscle 'm' activation.*{words}"):
            curve(given)

    def test_time_needs_a_motion_with_times(self):
        made = scene(activation={"times": [0, 1], "values": [0, 1]})
        with pytest.raises(SceneError, match="goes by time, and the motion has none"):
            require_complete(made)

    def test_a_saved_scene_has_the_same_curve(self, tmp_path):
        made = arm_scene()
        given = {"activation": {"frames": [0, 1], "values": [0, 1]}}
        made.muscles[0].contraction = contraction_keys(given, muscle="biceps")
        again = Scene.load(made.save(tmp_path / "s.toml"))
        mine, image = (activation_curve(one.muscles[0], one.motion) for one in (made, again))
        assert np.array_equal(mine, image) and mine.max() > 0.5
