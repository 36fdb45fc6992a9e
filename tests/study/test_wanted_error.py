"""The fewest centres for a wanted error: reached on unseen points, near the fewest there are, told where it is not."""

import json
import tomllib
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from command_line import call

from rbfmuscle.implicit.kernels.table import get_kernel
from rbfmuscle.study.experiment.wanted_error import FEWEST, reach_error
from rbfmuscle.study.experiment.wanted_files import write_wanted
from rbfmuscle.study.measure.mesh_distance import MeshDistance
from rbfmuscle.validation import UsageError


@pytest.fixture(scope="module")
def ellipsoid():
    return trimesh.creation.icosphere(subdivisions=3).apply_scale([40.0, 18.0, 12.0])


@pytest.fixture(scope="module")
def found(ellipsoid):
    return reach_error(ellipsoid, 0.3, kernels=["cubic", "linear"], placement="even")


def test_the_error_is_reached_by_the_surface_itself(found, ellipsoid):
    from rbfmuscle.implicit.field import RBFField
    from rbfmuscle.implicit.placement.sampling import sample_surface

    assert found.reached and found.error <= 0.3 and found.row["kernel"] == "cubic"
    sample = sample_surface(ellipsoid.vertices, ellipsoid.faces, found.row["centres"], placement="even")
    surface = RBFField.fit_hermite(sample.points, sample.normals).surface(resolution=64)
    points = ellipsoid.sample(3000, seed=5)
    there = MeshDistance(np.asarray(surface.vertices), np.asarray(surface.faces)).unsigned(points)
    assert np.sqrt((there**2).mean()) < 0.3 * 1.05  # one way, by other points and another grid


def test_no_smaller_number_was_seen_to_serve(found):
    """All numbers below the chosen one that were tried fail, each of the sixteen next to it among them."""
    count = found.row["centres"]
    below = [t for t in found.tried if t["kernel"] == "cubic" and t["centres"] < count]
    assert below and all(t["error"] > 0.3 for t in below)
    assert {count - step for step in range(1, 17)} <= {t["centres"] for t in below} | set(range(FEWEST))


def test_a_coarser_kernel_is_given_up_after_one_fit(found):
    assert sum(t["kernel"] == "linear" for t in found.tried) == 1 and get_kernel("linear").smoothness == 0


def test_rows_that_broke_leave_a_file_that_every_reader_takes(found, tmp_path):
    """Their error is infinite, which JSON does not know."""
    broken = replace(found, tried=[{"kernel": "gaussian", "centres": 20, "error": np.inf}])
    write_wanted({"muscle": broken}, tmp_path)
    text = (tmp_path / "error.json").read_text()
    facts = json.loads(text, parse_constant=lambda word: pytest.fail(f"{word} is no JSON"))
    assert facts["muscle"]["tried"][0]["error"] is None and facts["muscle"]["reached"]


def test_what_cannot_be_reached_names_the_best(ellipsoid):
    found = reach_error(ellipsoid, 1e-4, kernels=["cubic"], placement="even", most=30)
    assert not found.reached and found.row["centres"] == 30 and found.error > 1e-4


@pytest.mark.parametrize(
    "wrong", [{"error": -1.0}, {"error": np.nan}, {"error": 0.1, "most": 5}, {"error": 0.1, "placement": "x"}]
)
def test_wrong_requests_are_answered(ellipsoid, wrong):
    with pytest.raises(UsageError):
        reach_error(ellipsoid, **wrong)


def test_command_says_what_to_paste(tmp_path, ellipsoid, capsys):
    ellipsoid.export(tmp_path / "muscle.ply")
    arguments = [
        str(tmp_path / "muscle.ply"),
        "-o",
        str(tmp_path / "out"),
        "--kernels",
        "cubic",
        "--placement",
        "even",
    ]
    code, said, _ = call(capsys, "kernels", *arguments, "--error", "0.4", "--units", "mm")
    assert code == 0 and "reaches" in said and "mm RMS on unseen points" in said
    facts = json.loads((tmp_path / "out" / "error.json").read_text())["muscle"]
    assert facts["reached"] and facts["error"] <= 0.4
    table = tomllib.loads(facts["toml"])["muscle"]["model"]
    assert table["kernel"] == "cubic" and table["centres"] == facts["row"]["centres"]
    code, said, _ = call(capsys, "kernels", *arguments, "--error", "1e-5", "--most", "24")
    assert code == 0 and "is not reached; the best, cubic with 24 centres" in said
    code, _, problem = call(capsys, "kernels", *arguments, "--error", "0.4", "--error-max", "2")
    assert code == 2 and "one of --error" in problem
