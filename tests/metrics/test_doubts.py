"""Doubts about a run: what a reader should know though no limit holds it."""

import numpy as np
import pytest
from toy_scene import box_mesh

from rbfmuscle.metrics.quantities import ALL, Row
from rbfmuscle.metrics.summary import Summary
from rbfmuscle.metrics.verdict import measured_doubts, published_band
from rbfmuscle.scene.scene import Scene

FLEXION = "hip.flexion"


def doubts(values, *, muscle="iliacus", rows=(), others=0.0, step=2.0):
    """What is said of a muscle with these moment arms in flexion from 0 by ``step`` degrees."""
    scene = Scene("hip", units="mm")
    for bone, high in (("pelvis", 1.0), ("femur", 0.0)):
        scene.add_bone(bone, box_mesh((0, 0, high - 1.0), (1, 1, high)))
    axes = {"flexion": (1, 0, 0), "adduction": (0, 1, 0)}
    scene.add_joint("hip", "pelvis", "femur", (0, 0, 0), axes)
    angles = step * np.arange(len(values))
    arms = [
        Row(k, FLEXION, float(a), muscle, "moment_arm", float(v), "mm")
        for k, (a, v) in enumerate(zip(angles, values))
    ]
    path = {k: {FLEXION: np.radians(a), "hip.adduction": others * k} for k, a in enumerate(angles)}
    rough = (
        [arms[0]._replace(quantity="length_roughness", value=0.01)] if arms and step <= 2.0 else []
    )
    summary = Summary()
    summary.add([*rows, *arms, *rough])
    return measured_doubts(scene, summary.table(), [*arms, *rough], path)


def test_a_moment_arm_that_leaves_the_published_band_is_a_doubt():
    angles = 2.0 * np.arange(20)
    band = published_band("iliacus", FLEXION)
    inside = np.interp(angles, band.angle, 0.5 * (band.least + band.greatest))
    assert doubts(inside) == []
    low = np.interp(angles, band.angle, band.least)
    (said,) = doubts(np.where(angles >= 30, low - 12.0, inside))
    assert said.muscle == "iliacus" and "leaves the published band in 5 of 20 frames" in said.text
    # Of a muscle without a band nothing is said, nor of frames in which another coordinate moved.
    assert doubts(inside - 50.0, muscle="extensor") == []
    (said,) = doubts(inside - 50.0, others=0.1)
    assert "in 1 of 1 frames" in said.text


def test_moment_arms_without_a_value_and_steps_too_long_to_see_a_jump_are_doubts():
    (said,) = doubts([3.0, np.nan, np.nan, 4.0], muscle="extensor")
    assert said == ("extensor", said.text) and "not defined in 2 of 4 frames" in said.text
    # Where no moment arm has a value, the step is not why roughness is not measured.
    (said,) = doubts([np.nan] * 4, muscle="extensor", step=5.0)
    assert said == ("extensor", said.text) and "not defined in 4 of 4 frames" in said.text
    (said,) = doubts([3.0] * 4, muscle="extensor", step=5.0)
    assert said.muscle == ALL and "not measured" in said.text
    assert "three frames or more, at most 2 degrees apart, that span 4 degrees" in said.text


@pytest.mark.parametrize(("moved", "said"), [(0.4, False), (12.0, True)])
def test_a_muscle_that_is_moved_out_of_a_bone_at_rest_is_a_doubt_about_the_scan(moved, said):
    values = {"rest_error_at_overlap": moved, "input_overlap": 13.0}
    rows = [Row(0, FLEXION, 0.0, "iliacus", name, v, "mm") for name, v in values.items()]
    found = doubts([], rows=rows)
    assert bool(found) == said
    assert not said or "13 mm deep in a bone at rest; near there it is moved 12 mm" in found[0].text
