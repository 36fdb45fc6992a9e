"""The limits that a run is held to, row by row, and the sentence that says which muscles keep to
them.
"""

import numpy as np
import pytest
import trimesh
from blend_model import arm_scene, use_blend_model

from rbfmuscle.cli.report import verdict_lines
from rbfmuscle.display.report import write_report
from rbfmuscle.metrics.quantities import ALL, QUANTITIES, Row, unit_text
from rbfmuscle.metrics.rows import joint_gaps
from rbfmuscle.metrics.summary import (
    LIMITS,
    NEEDS,
    OF_SCENE,
    Limits,
    Summary,
    exceeded,
    parse_limits,
    shown_number,
    unmeasured,
)
from rbfmuscle.metrics.verdict import describe_verdict, judge
from rbfmuscle.recording import Run, simulate, stream_run
from rbfmuscle.run.data import RunData
from rbfmuscle.scene.check import check_scene, stated_doubts
from rbfmuscle.scene.options import GuessTable
from rbfmuscle.validation import LimitExceededError, UsageError

# Of issue and docs, in millimetres: what is just allowed, and what is not.
TABLE = {
    "volume_error": (1e-9, 1.1e-9),
    "penetration_max": (0.1, 0.11),
    "bone_penetration_max": (0.3, 0.31),
    "initial_overlap": (0.3, 0.31),
    "rest_error_rms": (0.6, 0.61),
    "flicker": (0.5, 0.51),
    "self_crossings": (0, 1),
    "components": (1, 2),
    "euler_characteristic": (2, 0),
    "bowing": (1.03, 1.04),
    "end_gap": (25.0, 25.1),
    "unfitted_fraction": (0.9, 1.0),
    "solver_residual": (1e-4, 1.1e-4),
    "solid_volume_error": (0.02, 0.021),
    "neighbour_overlap_max": (0.5, 0.51),
    "tunnelled": (0, 1),
    "bone_overlap": (0.0, 0.06),
    "joint_gap": (5.0, 5.1),
    "missing_bones": (0, 1),
    "tendon_depth": (0.3, 0.31),
    "articular_share": (0.5, 0.51),
    "moment_arm_jump": (10.0, 10.1),
    "moment_arm_reversal": (5.0, 5.1),
    "roughness_beyond_path": (0.5, 0.51),
    "doubtful_guesses": (0, 1),
}


def said_of(table, limits, missing_bones=()):
    """The verdict on a table in sentences."""
    return describe_verdict(judge(table, limits), table, missing_bones)


def facts(values, *, units="mm", muscle="psoas", **others):
    """Table of a run in which a muscle has these values, frame by frame, and another none."""
    summary = Summary()
    rows = [(muscle, values), ("other", {"components": [1.0]}), *others.items()]
    for name, quantities in rows:
        for quantity, series in quantities.items():
            unit = unit_text(QUANTITIES[quantity][0], units)
            summary.add(
                Row(k, "", 0.0, name, quantity, value, unit) for k, value in enumerate(series)
            )
    return summary.table()


@pytest.mark.parametrize("units", ["mm", "m"])
@pytest.mark.parametrize("quantity", TABLE)
def test_each_row_of_the_table_is_kept_up_to_its_limit_and_broken_beyond(quantity, units):
    scale = 0.001 if units == "m" and QUANTITIES[quantity][0] == "length" else 1.0
    limits = parse_limits(None, arm_scene(units=units))
    # A muscle that is guessed, straight and in no bone at rest.
    at_rest = {"guessed": [1.0], "bowing_at_rest": [1.0], "initial_overlap": [0.0]}
    allowed, beyond = (at_rest | {quantity: [scale * v]} for v in TABLE[quantity])
    assert set(TABLE) == set(LIMITS) and exceeded(facts(allowed, units=units), limits) == []
    said = said_of(facts(allowed, units=units), limits)
    assert said.startswith("every muscle is within all limits that were measured")
    ((muscle, name, worst, limit, _),) = exceeded(facts(beyond, units=units), limits)
    assert (muscle, name.partition(":")[0], limit) == (
        "psoas",
        quantity,
        pytest.approx(scale * LIMITS[quantity].value),
    )
    assert worst == pytest.approx(scale * TABLE[quantity][1])
    said = said_of(facts(beyond, units=units), limits)
    frame = said.partition("at frame ")[2].split()[0]
    limit_kind = LIMITS[quantity]
    is_mesh = quantity != "unfitted_fraction"
    remedy = (is_mesh and limit_kind.mesh_remedy) or limit_kind.remedy
    assert remedy.replace("FRAME", frame) in said
    # A mesh muscle has no centres to raise; one with a level set has.
    assert not is_mesh or "centres" not in said
    of_level_set = said_of(facts(beyond | {"unfitted_fraction": [0.0]}, units=units), limits)
    assert not is_mesh or limit_kind.remedy.replace("FRAME", frame) in of_level_set


@pytest.mark.parametrize(
    ("values", "kept"),
    [
        # A thin muscle may have a larger rest error.
        ({"rest_error_rms": [0.95], "thickness": [9.9]}, True),
        ({"rest_error_rms": [0.95], "thickness": [10.1]}, False),
        ({"rest_error_rms": [1.05], "thickness": [9.9]}, False),
        # One that is bowed at rest may be a little more so, whatever it is in the first frame.
        ({"bowing_at_rest": [1.05], "bowing": [1.07]}, True),
        ({"bowing_at_rest": [1.05], "bowing": [1.07, 1.09]}, False),
        ({"bowing_at_rest": [1.0], "bowing": [1.031]}, False),
        ({"bowing_at_rest": [1.0], "bowing": [1.05, 1.06]}, False),
        # Only a guess is at fault where a muscle ends away from its bone.
        ({"end_gap": [24.0], "guessed": [1.0], "length": [250.0]}, True),
        ({"end_gap": [24.0], "guessed": [1.0], "length": [230.0]}, False),
        ({"end_gap": [40.0], "guessed": [0.0], "length": [230.0]}, True),
        ({"volume_error": [np.nan]}, False),
    ],
)
def test_exceptions_from_limits(values, kept):
    assert (exceeded(facts(values), parse_limits("all", arm_scene())) == []) == kept
    # Of a limit that is asked for there are none, were it the default itself.
    for quantity, default in (("rest_error_rms", 0.6), ("bowing", 1.03), ("end_gap", 20.0)):
        asked = parse_limits(f"{quantity}={default}", arm_scene())
        assert quantity not in values or exceeded(facts(values), asked)


def test_what_was_not_measured_is_within_no_limit():
    scene = arm_scene()
    values = {name: [LIMITS[name].value] for name in LIMITS if name not in OF_SCENE}
    values |= {"length": [300.0]}
    whole = {ALL: {name: [0.0] for name in OF_SCENE}}
    implicit = ["flicker"]
    implicit += [name for name, need in NEEDS.items() if need == "unfitted_fraction"]
    mesh = {name: series for name, series in values.items() if name not in implicit}

    def table(muscle=values, other=values, scene_values=whole):
        summary = Summary()
        for name, quantities in {"psoas": muscle, "teres": other, **scene_values}.items():
            for quantity, (value,) in quantities.items():
                summary.add([Row(0, "", 0.0, name, quantity, value, "1")])
        return summary.table()

    def found(fail_on, *muscles, **parts):
        return unmeasured(table(*muscles, **parts), parse_limits(fail_on, scene))

    assert found(None) == found("all") == found(None, other=mesh) == []
    lacking = {name: series for name, series in values.items() if name != "rest_error_rms"}
    assert found(None, lacking) == [("psoas", "rest_error_rms")]
    assert found("rest_error_rms=9", lacking, lacking)[0] == ("psoas", "rest_error_rms")
    assert found(None, scene_values={}) == [(ALL, name) for name in OF_SCENE]
    # What is asked for by name has to be measured of some muscle.
    for asked in ("flicker", "flicker=1", "all,flicker=1"):
        assert found(asked, mesh) == [] and found(asked, mesh, mesh) == [(ALL, "flicker")]
    assert found("all", mesh, mesh) == []
    assert found("moment_arm=50") == [(ALL, "moment_arm")]
    said = said_of(table(lacking), parse_limits(None, scene))
    assert said == (
        "every muscle is within all limits that were measured in every frame. Not measured: "
        "rest_error_rms of psoas"
    )
    assert "Not measured" not in said_of(table(), parse_limits(None, scene))
    none = {ALL: Summary().table()}  # of a run that stopped before its first frame
    assert said_of(none, parse_limits(None, scene)) == "nothing was measured"


def test_the_worst_by_its_limit_is_named_first_and_bones_are_named_too():
    values = {"penetration_max": [0.2], "volume_error": [1e-6]}
    table = facts(values, teres={"flicker": [0.0, 3.0]}, **{ALL: {"joint_gap": [0.0, 8.0]}})
    said = said_of(table, parse_limits(None, arm_scene()))
    assert said.startswith(
        "0 of 3 muscles are within all limits; psoas, teres are not. Worst: psoas, volume"
    )
    assert "; penetration_max of other, teres; " in said
    assert (
        "; teres, flicker 3 mm at frame 1 (limit 0.5); the bones, joint that opens 8 mm at frame 1"
        in said
    )
    assert said.count(LIMITS["joint_gap"].remedy) == 1
    assert said.count("look at that frame: rbfmuscle render RUN --frame") == 1


def test_a_value_beyond_its_limit_is_shown_however_small():
    said = said_of(
        facts({"rest_error_rms": [0.0097]}), parse_limits("rest_error_rms=0.001", arm_scene())
    )
    assert "rest error 0.0097 mm at frame 0 (limit 0.001)" in said


def test_a_value_just_beyond_its_limit_does_not_look_like_it():
    said = said_of(
        facts({"rest_error_rms": [0.5004]}), parse_limits("rest_error_rms=0.5", arm_scene())
    )
    assert "rest error 0.5004 mm at frame 0 (limit 0.5)" in said


@pytest.mark.parametrize(
    ("value", "unit", "shown"),
    [
        (12.3456, "mm", "12.3 mm"),
        (1234.5, "mm", "1234 mm"),
        (99_999.0, "1", "99999"),
        (100_000.0, "", "1e+05"),
        (0.009, "mm", "< 0.01 mm"),
        (0.01, "mm", "0.01 mm"),
        (9e-13, "m", "< 1e-12 m"),
        (0.25, "s", "250 ms"),
        (-0.25, "s", "-250 ms"),
        (1.0, "s", "1 s"),
        (0.0, "mm", "0 mm"),
        (None, "mm", "–"),
        (np.nan, "mm", "–"),
    ],
)
def test_numbers_are_shown_with_three_digits_and_their_unit(value, unit, shown):
    assert shown_number(value, unit) == shown


def test_limits_of_the_command_line_follow_the_unit():
    limits = parse_limits("all,flicker=2", arm_scene(units="m"))
    assert limits.values["penetration_max"] == pytest.approx(0.0001)
    assert limits.values["volume_error"] == 1e-9 and limits.values["flicker"] == 2.0
    assert limits.fail_on == {name: 2.0 if name == "flicker" else None for name in LIMITS}
    asked = parse_limits("flicker=2,euler_characteristic,length=9", arm_scene())
    assert asked.fail_on == {"flicker": 2.0, "euler_characteristic": None, "length": 9.0}
    assert asked.failing() == Limits(
        {"flicker": 2.0, "euler_characteristic": 2.0, "length": 9.0}, asked.fail_on
    )
    for text in ("penetration", "length", "volume_error=abc", "volume_error=-1"):
        with pytest.raises(UsageError):
            parse_limits(text, arm_scene())


@pytest.mark.parametrize(
    ("shift", "name", "least"), [(-2.5, "initial_overlap", 0.3), (40.0, "end_gap", 25.0)]
)
def test_overlap_and_ends_away_from_bones_are_seen_in_a_run(
    shift, name, least, monkeypatch, tmp_path
):
    use_blend_model(monkeypatch)
    scene = arm_scene(end=10)  # its muscle moved down, into the bones, or up, away from them
    scene.muscles[0].mesh.apply_translation([0.0, 0.0, shift])
    scene = scene.with_options({"contact.initial": "keep"})
    scene.muscles[0].attachments[0].guess = GuessTable(confidence=0.9)
    assert simulate(arm_scene(end=10)).values("biceps", name)[0] < least
    info = stream_run(scene, tmp_path, pictures=False)  # a warning by default
    found = {row.quantity: row.value for row in info.beyond}
    assert found[name] > least and LIMITS[name].title in info.verdict
    assert Run.load(tmp_path).info.verdict == info.verdict
    with pytest.raises(LimitExceededError, match=name) as caught:
        stream_run(scene, tmp_path, fail_on="all", pictures=False)
    assert caught.value.exit_code == 6


def test_an_end_that_is_stated_to_lie_away_from_its_bone_is_a_doubt(monkeypatch, tmp_path):
    use_blend_model(monkeypatch)
    scene = arm_scene(end=10)
    assert stated_doubts(scene) == []
    scene.muscles[0].mesh.apply_translation([0.0, 0.0, 40.0])
    info = stream_run(scene, tmp_path, pictures=False)
    assert "end_gap" not in {row.quantity for row in info.beyond}
    said = ". Doubtful: biceps: an end lies"
    lines = list(verdict_lines(Run.load(tmp_path)))
    assert said in info.verdict
    assert lines[lines.index("doubtful:") + 1].startswith("  biceps: an end lies")
    # Frames are 10 degrees apart.
    assert [doubt.muscle for doubt in info.doubts] == ["biceps", ALL]
    assert RunData.load(tmp_path).info.doubts == info.doubts
    (warning,) = [f for f in check_scene(scene) if "an end lies" in f.message]
    assert (warning.level, warning.place) == ("warning", "biceps")
    with pytest.raises(LimitExceededError, match="end_gap"):
        stream_run(scene, tmp_path, fail_on="end_gap", pictures=False)
    write_report(tmp_path, pictures=False)
    assert said.strip(". ") in (tmp_path / "report.html").read_text()
    scene.muscles[0].attachments[0].guess = GuessTable(confidence=0.9)
    assert stated_doubts(scene) == []  # it counts


def test_a_report_names_what_is_wrong_with_the_bones(monkeypatch, tmp_path):
    use_blend_model(monkeypatch)
    scene = arm_scene(end=10)
    scene.missing_bones = ["patella"]
    stream_run(scene, tmp_path, pictures=False)
    write_report(tmp_path, pictures=False)
    page = (tmp_path / "report.html").read_text()
    assert "bones left out (patella) 1 at frame 0 (limit 0)" in page


def test_rest_is_measured_whatever_frames_are_asked_for(monkeypatch, tmp_path):
    use_blend_model(monkeypatch)
    rest = ("rest_error_rms", "rest_error_max", "initial_overlap", "end_gap", "bowing_at_rest")
    whole, part = (simulate(arm_scene(), frames=frames) for frames in (None, "1:2"))
    for name in (*rest, "thickness"):
        assert len(part.values("biceps", name)) == 1
        assert part.values("biceps", name) == whole.values("biceps", name)
    assert part.info.not_measured == [] and "Not measured" not in part.verdict
    for name in rest[:3]:  # the model shows the input mesh
        stream_run(arm_scene(), tmp_path, frames="1:2", fail_on=f"{name}=0.5", pictures=False)


def test_a_limit_that_cannot_be_measured_fails(monkeypatch, tmp_path):
    use_blend_model(monkeypatch)
    with pytest.raises(LimitExceededError, match="not measured: moment_arm"):
        stream_run(arm_scene(end=0), tmp_path, fail_on="moment_arm=50", pictures=False)
    info = Run.load(tmp_path).info
    assert info.fail_on == {"moment_arm": 50.0} and info.limits["moment_arm"] == 50.0
    assert info.not_measured == [(ALL, "moment_arm")]
    assert info.verdict.endswith("Not measured: moment_arm")


def test_a_joint_that_opens_is_measured_and_one_that_is_apart_at_rest_is_not():
    scene = arm_scene()
    scene.joints.clear()
    # Far from where the bones meet.
    scene.add_joint("elbow", "upper", "fore", (0, 0, 30), {"flexion": (0, -1, 0)})
    rest = 4.0  # between the ends of the boxes
    (_, parent, child, closed), (*_, opened) = joint_gaps(scene, [0, 2])
    assert (parent, child, closed) == ("upper", "fore", 0.0)
    turned = trimesh.transformations.rotation_matrix(np.radians(-20.0), [0, 1, 0], [0, 0, 30.0])
    corners = trimesh.transform_points(scene.bones[1].mesh.vertices, turned)
    gaps = np.linalg.norm(corners[:, None] - np.asarray(scene.bones[0].mesh.vertices), axis=2)
    assert opened == pytest.approx(gaps.min() - rest) and opened > 5.0
    scene.bones[1].mesh.apply_translation([20.0, 0.0, 0.0])
    assert joint_gaps(scene, [0, 2]) == []
