"""Scenes with answers in closed form, the measures of their errors, and what the models make of them."""

import math
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from conftest import benchmark_script
from peers.known_answers import observed_order, richardson
from peers.known_scenes import DRUM_RADIUS, STRIPS, wrapped_path


def test_volume_of_a_strip_and_path_over_the_drum_approach_the_closed_form():
    bar = STRIPS["cylinder"]
    errors = []
    for spacing in (2.0, 1.0, 0.5):
        mesh = trimesh.Trimesh(*bar.mesh(spacing), process=False)
        assert mesh.is_watertight
        errors.append(mesh.volume / bar.volume - 1.0)
    # A polygon inscribed in a circle lacks area by the square of its side.
    assert -0.02 < errors[-1] < 0.0
    assert observed_order((2.0, 1.0, 0.5), errors) > 1.5
    assert wrapped_path(1.2, bar=replace(bar, thickness=1e-9)) == pytest.approx(
        (1.2 * DRUM_RADIUS, DRUM_RADIUS)
    )


def test_order_and_limit_of_a_known_sequence():
    sizes = np.array([4.0, 3.0, 2.0, 1.0])
    values = 7.0 - 0.3 * sizes**1.7
    assert observed_order(sizes, values - 7.0) == pytest.approx(1.7)
    assert richardson(sizes, values) == pytest.approx((1.7, 7.0))
    assert math.isnan(observed_order([2, 1], [0.1, 0.0]))
    for values in ([1.0, 2.0, 1.0], [1.0, 1.0, 1.0]):
        assert np.isnan(richardson([4, 2, 1], values)).all()


# What the page of accuracy promises: shares of the closed form, at a refinement that runs in a second.
FINE_RBF = {"name": "rbf", "centres": 600, "nodes": 300}


@pytest.fixture(scope="module")
def study():
    """The script that prints the tables."""
    return benchmark_script("known_answers")


class TestStretchedBar:
    @pytest.mark.parametrize(
        ("model", "stretch", "spacing", "radius", "path"),
        [
            ({**FINE_RBF, "slack": 1.0}, 0.8, 1.5, 0.01, 0.003),
            # A slack bar that is pushed shortens more where its held ends do not keep it from thickening.
            ({**FINE_RBF, "slack": 1.6}, 1.2, 1.5, 0.01, 0.003),
            ({"name": "arap-volume"}, 1.2, 2.0, np.inf, 0.001),
        ],
    )
    def test_radius_and_path_are_those_of_an_even_stretch(self, study, model, stretch, spacing, radius, path):
        found = study.stretched(stretch, model, spacing)
        assert abs(found["radius_ends"]) < 0.01
        assert abs(found["radius"]) < radius
        assert abs(found["path"]) < path

    def test_rbf_comes_nearer_with_more_nodes(self, study):
        coarse, fine = (
            study.stretched(1.3, {**FINE_RBF, "nodes": nodes}, 2.0)["radius_ends"] for nodes in (60, 600)
        )
        assert abs(fine) < 0.6 * abs(coarse)

    def test_pbd_is_even_and_converges_with_the_mesh(self, study):
        coarse, fine = (study.stretched(1.2, "pbd", spacing) for spacing in (4.0, 2.0))
        assert abs(fine["radius_ends"]) < 0.65 * abs(coarse["radius_ends"])
        assert fine["waviness"] < 0.002


class TestBentBar:
    def test_rbf(self, study):
        # Slack fibres on the inside of the bend would let the middle line become shorter.
        found = study.bent({**FINE_RBF, "slack": 1.0}, 2.0)
        assert abs(found["path"]) < 0.006
        assert abs(found["arc"]) < 0.006
        assert abs(found["radius"]) < 0.01

    def test_mesh_models_need_to_settle(self, study):
        settled = {"name": "pbd", "fibre_exponent": 0.0, "iterations": 1000}
        assert abs(study.bent(settled, 4.0)["path"]) < 0.006
        assert study.bent({"name": "pbd"}, 4.0)["path"] > 0.05


class TestWrappedStrip:
    @pytest.mark.parametrize("over", ["cylinder", "sphere"])
    def test_rbf(self, study, over):
        found = study.wrapped(over, FINE_RBF, 1.5)
        assert abs(found["path"]) < 0.003
        assert abs(found["radius"]) < 0.01
        if over == "cylinder":
            assert -0.5 < found["contact"] < 0.0

    def test_pbd_needs_to_settle(self, study):
        settled = {"name": "pbd", "fibre_exponent": 0.0, "iterations": 150}
        assert abs(study.wrapped("cylinder", settled, 3.0)["path"]) < 0.005
        assert study.wrapped("cylinder", "pbd", 3.0)["path"] > 0.01
