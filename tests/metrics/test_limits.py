"""The limits that a run is held to, row by row, and the sentence that says which muscles keep to
them.
"""

import numpy as np
import pytest
import trimesh
from blend_model import arm_scene, use_blend_model

from rbfmuscle.metrics.quantities import ALL, QUANTITIES, Row, unit_text
from rbfmuscle.metrics.rows import joint_gaps
from rbfmuscle.metrics.summary import (
    LIMITS,
    Summary,
    default_limit,
    describe_verdict,
    exceeded,
    parse_limits,
)
from rbfmuscle.output.saved import SavedRun
from rbfmuscle.run import simulate, stream_run
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
    "euler": (2, 0),
    "bowing": (1.03, 1.04),
    "end_gap": (25.0, 25.1),
    "unfitted_fraction": (0.9, 1.0),
    "tunnelled": (0, 1),
    "bone_overlap": (0.0, 0.06),
    "joint_gap": (5.0, 5.1),
    "bones_left_out": (0, 1),
}


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
    limits = {name: default_limit(name, arm_scene(units=units)) for name in LIMITS}
    # A muscle that is straight and in no bone at rest; other quantities are the same in both
    # frames.
    rest = {"bowing": 1.0, "penetration_max": 0.0, "bone_penetration_max": 0.0}
    allowed, beyond = (
        {quantity: [rest.get(quantity, scale * v), scale * v]} for v in TABLE[quantity]
    )
    assert set(TABLE) == set(LIMITS) and exceeded(facts(allowed, units=units), limits) == []
    assert "every muscle is within all limits" in describe_verdict(
        facts(allowed, units=units), limits
    )
    ((muscle, name, worst, limit, _),) = exceeded(facts(beyond, units=units), limits)
    assert (muscle, name, limit) == (
        "psoas",
        quantity,
        pytest.approx(scale * LIMITS[quantity].value),
    )
    assert worst == pytest.approx(scale * TABLE[quantity][1])
    said = describe_verdict(facts(beyond, units=units), limits)
    frame = said.partition("at frame ")[2].split()[0]
    assert LIMITS[quantity].remedy.replace("FRAME", frame) in said


@pytest.mark.parametrize(
    ("values", "kept"),
    [
        # A thin muscle may have a larger rest error, unless a limit is asked for.
        ({"rest_error_rms": [0.95], "thickness": [9.9]}, True),
        ({"rest_error_rms": [0.95], "thickness": [10.1]}, False),
        ({"rest_error_rms": [1.05], "thickness": [9.9]}, False),
        # One that bows at rest may do so a little more.
        ({"bowing": [1.05, 1.07]}, True),
        ({"bowing": [1.05, 1.09]}, False),
        ({"bowing": [1.0, 1.031]}, False),
        ({"volume_error": [np.nan]}, False),
    ],
)
def test_exceptions_from_limits(values, kept):
    limits = {"rest_error_rms": 0.6, "bowing": 1.03, "volume_error": 1.0}
    assert (exceeded(facts(values), limits) == []) == kept
    assert "thickness" not in values or exceeded(facts(values), {"rest_error_rms": 0.9})


def test_the_worst_by_its_limit_is_named_first_and_bones_are_named_too():
    values = {"penetration_max": [0.2], "volume_error": [1e-6]}
    table = facts(values, teres={"flicker": [0.0, 3.0]}, **{ALL: {"joint_gap": [0.0, 8.0]}})
    said = describe_verdict(table, {name: limit.value for name, limit in LIMITS.items()})
    assert said.startswith(
        "1 of 3 muscles is within all limits; psoas, teres are not. Worst: psoas, volume"
    )
    assert (
        "; teres, flicker 3 mm at frame 1 (limit 0.5); the bones, joint that opens 8 mm at frame 1"
        in said
    )
    assert [said.count(LIMITS[name].remedy) for name in ("flicker", "joint_gap")] == [1, 1]


def test_limits_of_the_command_line_follow_the_unit():
    limits = parse_limits("all", arm_scene(units="m"))
    assert limits["penetration_max"] == pytest.approx(0.0001) and limits["volume_error"] == 1e-9
    assert parse_limits("flicker=2,euler", arm_scene()) == {"flicker": 2.0, "euler": 2.0}
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
    assert simulate(arm_scene(end=10)).values("biceps", name)[0] < least
    info = stream_run(scene, tmp_path, pictures=False)  # a warning by default
    found = {row[1]: row[2] for row in info["beyond"]}
    assert found[name] > least and LIMITS[name].title in info["verdict"]
    assert SavedRun(tmp_path).info["verdict"] == info["verdict"]
    with pytest.raises(LimitExceededError, match=name) as caught:
        stream_run(scene, tmp_path, fail_on="all", pictures=False)
    assert caught.value.exit_code == 6


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
