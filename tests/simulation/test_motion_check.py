"""`check` looks ahead: held ends driven into bones, attachments taken apart or brought together too
far.
"""

import numpy as np
import pytest
from toy_scene import box_mesh, ellipsoid, held

import rbfmuscle as rm
from rbfmuscle.scene.objects import Motion
from rbfmuscle.simulation.motion_check import check_motion, motion_findings


def _scene(angles):
    """A post that stands still and an arm that turns about z past it, a strap from a far block to
    the arm.
    """
    scene = rm.Scene("post", units="mm")
    scene.add_bone("block", box_mesh([-60, -4, -4], [-50, 4, 4]))
    scene.add_bone("post", box_mesh([-4, 18, -10], [4, 26, 10]))
    scene.add_bone("arm", box_mesh([18, -3, -20], [24, 3, -14]))
    scene.add_joint("hinge", "block", "arm", (0, 0, 0), {"bend": (0, 0, 1)})
    strap = ellipsoid([36, 3, 3], [-14, 0, 0], subdivisions=3)
    x = strap.vertices[:, 0]
    scene.add_muscle("strap", strap, attach=held(block=x < -44, arm=x > 17))
    scene.motion = Motion([{"hinge.bend": np.radians(a)} for a in angles])
    return scene


def test_end_driven_into_a_bone_is_found_with_depth_and_frame():
    # The held end sits at radius 22 about z: at 90 degrees in the middle of the post, which spans
    # 18 to 26.
    scene = _scene(range(0, 91, 5))
    (one,) = (fault for fault in check_motion(scene) if not fault.rest)
    assert (one.muscle, *one.bones, one.frame) == ("strap", "arm", "post", 18)
    held = scene.muscles[0].mesh.vertices[scene.muscles[0].attachments[1].vertices]
    turned = held[:, [1, 0, 2]] * [-1, 1, 1]
    deepest = -min(rm.BoneSDF.from_mesh(scene.bones[1].mesh).distance(turned))
    assert one.value == pytest.approx(
        deepest, abs=0.2
    )  # the field's own error, and thinned vertices
    assert 14 <= one.first <= 18
    text = str(motion_findings(scene)[0])
    assert "strap" in text and "'post'" in text and "give it a tendon" in text
    assert check_motion(_scene(range(0, 41, 5))) == check_motion(_scene([0])) == []


@pytest.mark.parametrize(("far", "how"), [(45.0, "take apart"), (-40.0, "bring together")])
def test_ends_taken_apart_or_brought_together(far, how):
    scene = _scene([0])
    scene.joints.clear()
    scene.add_joint("slide", "block", "arm", (0, 0, 0), {"out": (1, 0, 0)}, type="slide")
    scene.motion = Motion([{"slide.out": far * k / 10} for k in range(11)])
    (one,) = check_motion(scene)
    assert one.frame == 10 and one.bones == ("block", "arm")
    assert one.value - one.rest == pytest.approx(far, rel=1e-9)
    assert how in str(motion_findings(scene)[0])


def test_slender_muscles_of_the_leg_are_named_with_what_is_wrong(leg_data):
    faults = check_motion(rm.Scene.load(leg_data / "slender.toml"))
    deepest = {(one.muscle, one.bones[1]): one.value for one in faults if not one.rest}
    # The README of the data says 16 mm.
    assert deepest["popliteus", "tibia"] == pytest.approx(16.0, abs=0.5)
    assert [one.muscle for one in faults if one.rest] == ["plantaris"]
