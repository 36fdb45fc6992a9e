"""Checks that every public function shares: what passes is returned whole, what does not is told
with its place.
"""

import numpy as np
import pytest

from pbd_baseline.rest import PBDOptions
from rbfmuscle import validation
from rbfmuscle.cli.app import one_line
from rbfmuscle.muscle.rest import RBFOptions
from rbfmuscle.scene.options import Table
from rbfmuscle.validation import (
    MeshError,
    check_mesh,
    check_points,
    check_positive,
    check_values,
    check_vectors,
    did_you_mean,
    shown,
    shown_path,
)

CODES = {
    "RBFMuscleError": 1,
    "UsageError": 2,
    "SceneError": 3,
    "MeshError": 4,
    "SolveError": 5,
    "LimitExceededError": 6,
    "MissingDependencyError": 7,
}
NOT_FINITE = [np.insert(np.zeros((4, 3)), 3, value, axis=0) for value in (np.nan, np.inf, -np.inf)]
TETRAHEDRON = np.vstack([np.zeros(3), np.eye(3)]), [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]


def test_exit_codes_are_those_promised():
    errors = {name: kind for name, kind in vars(validation).items() if hasattr(kind, "exit_code")}
    assert {name: kind.exit_code for name, kind in errors.items()} == CODES


def test_what_passes_comes_back_as_contiguous_doubles():
    points = check_points(np.asfortranarray(np.arange(12, dtype=np.int32).reshape(4, 3)))
    assert points.dtype == np.float64 and points.flags.c_contiguous
    np.testing.assert_array_equal(points, np.arange(12).reshape(4, 3))
    assert check_points(np.zeros((0, 3))).shape == (0, 3)
    assert check_vectors(np.ones((2, 3)), 2).shape == (2, 3)
    assert check_values([1, 2], 2).tolist() == [1.0, 2.0] and check_positive("0.5", name="x") == 0.5
    vertices, faces = check_mesh(*TETRAHEDRON)
    assert (
        vertices.dtype == np.float64
        and faces.dtype == np.int64
        and faces.tolist() == TETRAHEDRON[1]
    )


@pytest.mark.parametrize(
    ("check", "words", "wrong"),
    [
        (
            check_points,
            r"must have shape \(n, 3\)",
            [np.zeros(s) for s in ((3,), (2, 2), (1, 3, 3))],
        ),
        (check_points, "points must be finite, row 3 is", NOT_FINITE),
        (lambda given: check_values(given[:, 1], 5), "values must be finite, row 3 is", NOT_FINITE),
        (lambda given: check_vectors(given, 3), r"one row a point \(3\), got 2", [np.ones((2, 3))]),
        (
            lambda given: check_values(given, 2),
            r"must have shape \(2,\)",
            [[1.0], [[1.0, 2.0]], 1.0],
        ),
        (lambda given: check_values(given, 2), "must be an array of numbers", [["a", "b"]]),
        (
            lambda given: check_positive(given, name="x"),
            "x must be a positive",
            [0.0, -1.0, np.nan, np.inf],
        ),
    ],
)
def test_what_is_of_another_kind_is_refused(check, words, wrong):
    for given in wrong:
        with pytest.raises(ValueError, match=words):
            check(given)


@pytest.mark.parametrize(
    ("vertices", "faces", "words"),
    [
        (TETRAHEDRON[0], [[0, 1, 4]], "point outside its 4 vertices"),
        (TETRAHEDRON[0], [[0, 1, -1]], "point outside its 4 vertices"),
        (TETRAHEDRON[0], [[0, 1, 2, 3]], r"faces of rod must have shape \(m, 3\), got \(1, 4\)"),
        (TETRAHEDRON[0], np.zeros((0, 3), int), r"rod is empty \(4 vertices, 0 faces\)"),
        (np.zeros((4, 2)), TETRAHEDRON[1], r"vertices of rod must have shape \(n, 3\)"),
    ],
)
def test_meshes_that_are_none_are_refused(vertices, faces, words):
    with pytest.raises(MeshError, match=words):
        check_mesh(vertices, faces, name="rod")


def test_nearest_name_or_all_names():
    assert did_you_mean("GAUSIAN", ["cubic", "gaussian"]) == "did you mean 'gaussian'?"
    assert did_you_mean("zzz", ["cubic", "linear"]) == "known: cubic, linear"
    assert did_you_mean("zzz", []) == "there are none"
    for count, more in ((40, ""), (41, " and 1 more"), (43, " and 3 more")):
        names = [f"n{k:02d}" for k in range(count)]
        assert did_you_mean("zzz", names) == "known: " + ", ".join(names[:40]) + more


def test_messages_show_values_whole_up_to_a_length():
    assert shown("x" * 80) == "x" * 80 and shown("x" * 81) == f"{65 * 'x'} ... {10 * 'x'}"
    assert (
        shown_path("x" * 400) == "x" * 400
        and len(shown_path("x" * 401)) == 400
        and shown(2.5) == "2.5"
    )
    assert one_line("a\n b") == "a b" and [len(one_line(n * "x")) for n in (1000, 1001)] == [
        1000,
        995,
    ]
    assert shown(10**5000) == "a int too long to show"


def test_every_default_of_an_option_is_a_value_that_may_be_given():
    """pydantic takes defaults on trust."""
    kinds, tried = [Table, PBDOptions, RBFOptions], 0
    for kind in kinds:
        kinds += [new for new in kind.__subclasses__() if new not in kinds]
        ours = kind.__module__.startswith(("rbfmuscle.", "pbd_baseline."))
        if ours and not any(field.is_required() for field in kind.model_fields.values()):
            try:
                made = kind()
            except ValueError:  # a table that says by itself that it cannot be empty
                continue
            given = {name: value for name, value in made.model_dump().items() if value is not None}
            assert kind.model_validate(given) == made
            tried += 1
    assert tried >= 8
