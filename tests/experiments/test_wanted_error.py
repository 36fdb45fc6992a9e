"""The fewest centres for a wanted error: reached on unseen points, near the fewest there are, told where it is not."""

import json
import tomllib

import numpy as np
import pytest
import trimesh
from command_line import call

from rbfmuscle.experiments import wanted_error
from rbfmuscle.experiments.wanted_error import STEP, reach_error
from rbfmuscle.implicit.field import RBFField
from rbfmuscle.implicit.kernels.table import get_kernel
from rbfmuscle.implicit.placement.sampling import sample_surface
from rbfmuscle.metrics.mesh_distance import MeshDistance
from rbfmuscle.validation import UsageError


@pytest.fixture(scope="module")
def ellipsoid():
    return trimesh.creation.icosphere(subdivisions=3).apply_scale([40.0, 18.0, 12.0])


@pytest.fixture(scope="module")
def found(ellipsoid):
    return reach_error(ellipsoid, 0.1, kernels=["cubic", "linear"], placement="greedy")


def test_the_error_is_reached_by_the_surface_itself(found, ellipsoid):
    assert found.reached and found.error <= 0.1 and found.row["kernel"] == "cubic"
    sample = sample_surface(ellipsoid.vertices, ellipsoid.faces, found.row["centres"], placement="greedy")
    surface = RBFField.fit_hermite(sample.points, sample.normals).surface(resolution=96)
    points = trimesh.sample.sample_surface(ellipsoid, 3000, seed=5)[0]
    there = MeshDistance(np.asarray(surface.vertices), np.asarray(surface.faces)).unsigned(points)
    assert np.sqrt((there**2).mean()) < 0.1 * 1.05  # one way, by other points and another grid


def test_a_number_four_per_cent_smaller_was_seen_to_fail(found):
    count = found.row["centres"]
    below = [t for t in found.tried if t["kernel"] == "cubic" and t["centres"] < count]
    assert below and all(t["error"] > 0.1 for t in below)
    assert count - max(t["centres"] for t in below) <= max(1, STEP * count)


def test_a_coarser_kernel_is_given_up_after_one_fit(found):
    assert sum(t["kernel"] == "linear" for t in found.tried) == 1 and get_kernel("linear").smoothness == 0


def test_what_cannot_be_reached_names_the_best(ellipsoid, monkeypatch):
    monkeypatch.setattr(wanted_error, "MOST", 30)
    found = reach_error(ellipsoid, 1e-4, kernels=["cubic"], placement="greedy")
    assert not found.reached and found.row["centres"] == 30 and found.error > 1e-4


@pytest.mark.parametrize("wrong", [{"error": -1.0}, {"error": np.nan}, {"error": 0.1, "placement": "x"}])
def test_wrong_requests_are_answered(ellipsoid, wrong):
    with pytest.raises(UsageError):
        reach_error(ellipsoid, **wrong)


def test_command_says_what_to_paste(tmp_path, ellipsoid, capsys, monkeypatch):
    ellipsoid.export(tmp_path / "muscle.ply")
    words = [tmp_path / "muscle.ply", "-o", tmp_path / "out", "--kernels", "cubic", "--placement", "greedy"]
    code, said, _ = call(capsys, "kernels", *words, "--error", "0.4", "--units", "mm")
    assert code == 0 and "reaches" in said and "mm RMS" in said
    facts = json.loads((tmp_path / "out" / "error.json").read_text(encoding="utf-8"))["muscle"]
    assert facts["reached"] and facts["error"] <= 0.4
    table = tomllib.loads(facts["toml"])["muscle"]["model"]
    assert table["kernel"] == "cubic" and table["centres"] == facts["row"]["centres"]
    monkeypatch.setattr(wanted_error, "MOST", 24)
    code, said, _ = call(capsys, "kernels", *words, "--error", "1e-5")
    assert code == 0 and "is not reached; the best, cubic, 24 centres" in said
