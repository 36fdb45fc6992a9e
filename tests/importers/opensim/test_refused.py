"""What a model says wrongly is refused in one line that names it; what is left out is noted."""

import re

import numpy as np
import pytest

from rbfmuscle.importers.opensim.read import read_osim
from rbfmuscle.validation import SceneError


def changed(path, *pairs):
    text = path.read_text(encoding="utf-8")
    for before, after in pairs:
        assert text.count(before) >= 1, before
        text = text.replace(before, after, 1)
    path.write_text(text)
    return path


KNEE_FRAME = "<socket_parent_frame>offset</socket_parent_frame>"
POLYNOMIAL = "<PolynomialFunction><coefficients>0.01 0 0</coefficients></PolynomialFunction>"
AXIS, ONE = "<coordinates>knee_angle</coordinates><axis>", "<coefficients>1 0</coefficients>"
FUNCTION = "<coupled_coordinates_function>"
COUPLER = "<LinearFunction><coefficients>0.1 0.02</coefficients></LinearFunction>"
LINEAR = f'<LinearFunction name="function">{ONE}</LinearFunction>'
HIP_ANGLE = '<Coordinate name="hip_angle"><range>-1 1</range></Coordinate>'
TWO = HIP_ANGLE.replace("hip", "two")
WRONG = [
    ('Version="40000"', 'Version="four"', "version 'four' is no number"),
    ("OpenSimDocument", "OtherDocument", "no OpenSim model"),
    (KNEE_FRAME, "", "CustomJoint 'knee': names no parent frame"),
    (
        "<socket_parent>/bodyset/thigh<",
        "<socket_parent>../offset<",
        "/knee/offset' is offset from itself",
    ),
    ("/bodyset/shank", "/bodyset/shnk", "no frame '/bodyset/shnk'"),
    (
        "PinJoint",
        "CantileverJoint",
        "CantileverJoint 'hip': ground to thigh: its kind is not in the table",
    ),
    ("PinJoint", "EllipsoidJoint", "EllipsoidJoint 'hip': radii_x_y_z: 'nan' is not finite"),
    (
        "<socket_child_frame>thigh<",
        "<socket_child_frame>/ground<",
        "PinJoint 'hip': joins body 'ground' to itself",
    ),
    (
        f"{AXIS}0 0 2",
        "<coordinates>slide</coordinates><axis>0 0 2",
        "'rotation1': follows 'slide', which",
    ),
    (f"{AXIS}0 0 2", f"{AXIS}0 0 0", "TransformAxis 'rotation1': its direction is zero"),
    (ONE, "<coefficients>1 2 0</coefficients>", "a linear function of 2 coordinates, 1 are named"),
    (f"{AXIS}1 0 0", "<coordinates/><axis>1 0 0", "a function of a coordinate, and none is named"),
    (f"<function>{POLYNOMIAL}\n      </function>", "", "a MultiplierFunction without a function"),
    (
        "PolynomialFunction",
        "GCVSpline",
        "TransformAxis 'translation1': a function 'GCVSpline' is not",
    ),
    (
        HIP_ANGLE,
        HIP_ANGLE + HIP_ANGLE.replace("hip", "two"),
        "a PinJoint has 1 coordinates, 2 are given",
    ),
    (
        "<range>-1 1</range>",
        "<range>-1</range>",
        "Coordinate 'hip_angle': range: 2 numbers are needed",
    ),
    (
        "<range>-2 0.2<",
        "<range>2 0.2<",
        "Coordinate 'knee_angle': its range '2 0.2' goes downwards",
    ),
    ("0 -0.4 0", "0 x 0", "is no list of numbers"),
    ("0 -0.4 0", "0 nan 0", "is not finite"),
    ("<scale_factors>1 1 -2<", "<scale_factors>1 1<", "Body 'thigh': Mesh 'm': scale_factors"),
    (COUPLER, "", "Constraint 'follow': has no function"),
    (">knee_angle</independent", "></independent", "Constraint 'follow': names no coordinates"),
    (">knee_angle</independent", ">nobody</independent", "names coordinate 'nobody'"),
    (COUPLER, "<SimmSpline><x>0 0</x><y>0 1</y></SimmSpline>", "x that increase, got 2 and 2"),
    ('<Body name="cap"/>', '<Body name="cap"/><Body name="cap"/>', "two bodies are named 'cap'"),
    (HIP_ANGLE, 2 * HIP_ANGLE, "PinJoint 'hip': two of its coordinates are named 'hip_angle'"),
    ("SpatialTransform", "TransformAxisSet", "is written as OpenSim 1 did"),
]


@pytest.mark.parametrize(("before", "after", "words"), WRONG)
def test_wrong_model_is_refused_in_one_line(small, before, after, words):
    text = small.read_text(encoding="utf-8")
    assert before in text
    small.write_text(text.replace(before, after))
    with pytest.raises(SceneError) as error:
        read_osim(small)
    message = str(error.value)
    assert words in message and message.startswith(str(small)) and "\n" not in message


THIGH = '<Body name="thigh">'


def noted(path):
    return " | ".join(read_osim(path).notes)


def test_what_is_not_taken_is_noted_once(small):
    assert "is scaled to nothing" not in noted(small) and "follows others" not in noted(small)
    text = noted(
        changed(
            small,
            ("<scale_factors>1 1 -2</scale_factors>", "<scale_factors>1 0 1</scale_factors>"),
            ("<length_units>meters", "<length_units>furlongs"),
            (
                '<Coordinate name="slide"/>',
                '<Coordinate name="slide"><locked>true</locked></Coordinate>',
            ),
            (
                "<range>-1 1</range>",
                "<prescribed>true</prescribed><default_value>0.25</default_value>",
            ),
            ('<Mesh name="n">', '<Sphere name="ball"/><Mesh name="n">'),
        )
    )
    for words in (
        "is scaled to nothing",
        "'furlongs'",
        "'slide' is locked",
        "'hip_angle' is prescribed",
    ):
        assert text.count(words) == 1, words
    for words in ("'ball' is a Sphere", "mesh 'wedge.obj' is hidden"):
        assert text.count(words) == 1, words
    rail, point = read_osim(small).doubts
    assert rail.startswith("PointOnLineConstraint 'rail' is not taken")
    assert "point 'b' is on its path for" in point


@pytest.mark.parametrize(
    "switch", ["<isEnforced>false</isEnforced>", "<isDisabled>true</isDisabled>"]
)
def test_coupler_that_is_switched_off_couples_nothing(small, switch):
    assert [c.coordinate for c in read_osim(small).couplings] == ["cap_joint.slide"]
    assert not read_osim(changed(small, (FUNCTION, switch + FUNCTION))).couplings


@pytest.mark.parametrize(
    ("before", "start", "end", "name"),
    [
        ("<BodySet", "<ComponentSet><objects>", "</objects></ComponentSet><BodySet", "offset"),
        ("<BodySet", "<components>", "</components><BodySet", "offset"),
        (THIGH, THIGH + "<components>", "</components>", "/bodyset/thigh/offset"),
        (THIGH, THIGH + "<components>", "</components>", "../../bodyset/thigh/offset"),
    ],
)
def test_a_frame_is_the_same_wherever_it_stands(small, before, start, end, name):
    joints = read_osim(small).joints
    text = small.read_text(encoding="utf-8")
    frame = re.search(r"<PhysicalOffsetFrame.*?</PhysicalOffsetFrame>", text, flags=re.S)[0]
    inner = frame.replace(">/bodyset/thigh<", ">..<") if before == THIGH else frame
    text = text.replace(frame, "").replace(before, start + inner + end, 1)
    small.write_text(text.replace(KNEE_FRAME, KNEE_FRAME.replace("offset", name)))
    for one, other in zip(joints, read_osim(small).joints, strict=True):
        assert (one.name, one.parent, one.child) == (other.name, other.parent, other.child)
        for place in ("parent_frame", "child_frame"):
            np.testing.assert_allclose(getattr(one, place), getattr(other, place), atol=1e-15)
