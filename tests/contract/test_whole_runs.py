"""Whole runs of small scenes give what they gave: what differs is a change of behaviour, and is
reviewed as one.
"""

import numpy as np
import pytest
from kept import TOLERANCE, check_kept, differences, digest
from whole_runs import SCENES, measure

# An RBF muscle's solve ends where an iteration moves no node by more than 2e-5 of its size: a
# rounding error may take or save one iteration.
SETTLED = 1e-4


@pytest.fixture(scope="module", autouse=True)
def cold_cache(tmp_path_factory):
    """What a cache keeps (fields, weights, numbers of centres) is found anew, so that its faults
    show.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("RBFMUSCLE_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.mark.parametrize("name", SCENES)
def test_run_gives_what_is_kept(name):
    check_kept(name, measure(name), tolerance=SETTLED if "rbf" in name else TOLERANCE)


def test_planted_difference_is_found():
    kept, found = {"a": [{"x": 1.0}, {"x": None}]}, {"a": [{"x": 1.0 + 1e-7}, {"x": None}]}
    ((value, place),) = differences(kept, found).values()
    assert value == pytest.approx(1e-7) and place.split() == ["a", "0", "x"]
    for other in ({"a": [{"x": 1.0}]}, {"b": []}, {"a": [{"x": None}, {"x": None}]}):
        with pytest.raises(AssertionError, match=r"is kept|are kept"):
            differences(kept, other)
    for k, found in enumerate(([np.nan, 2.0, 3.0], [1.0, np.nan, 3.0], [1.0, 2.0, np.nan])):
        ((value, place),) = differences({"x": [1.0, 2.0, 3.0]}, {"x": found}).values()
        assert value == np.inf and place.split() == ["x", str(k)]


def test_digest_tells_one_number_of_many_its_place_and_its_sign():
    plain = np.arange(40.0).reshape(8, 5)
    for change in (lambda a: a.T, lambda a: -a, lambda a: a[::-1], lambda a: a + 1e-6 * (a == 7.0)):
        assert digest(change(plain)) != pytest.approx(digest(plain), rel=1e-9, abs=1e-9)
