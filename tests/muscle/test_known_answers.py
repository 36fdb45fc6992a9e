"""Scenes with answers in closed form, the measures of their errors, and what the models make of
them.
"""

from importlib import import_module

import numpy as np
import pytest

study = import_module("known_answers")  # the script in benchmarks

# What the page of accuracy promises: shares of the closed form, at a refinement that runs in a
# second.
FINE_RBF = {"name": "rbf", "centres": 600, "nodes": 300}


class TestStretchedBar:
    @pytest.mark.parametrize(
        ("model", "stretch", "spacing", "radius", "path"),
        [
            # Shorter than 0.975, 1 - (π r / L)² for held ends, it buckles (Euler's critical load).
            ({**FINE_RBF, "slack_ratio": 1.0}, 0.98, 1.5, 0.01, 0.003),
            # A slack bar that is pushed shortens more where its held ends do not keep it from
            # thickening.
            ({**FINE_RBF, "slack_ratio": 1.6}, 1.2, 1.5, 0.01, 0.003),
            ({"name": "arap-volume"}, 1.2, 2.0, np.inf, 0.001),
        ],
    )
    def test_radius_and_path_are_those_of_an_even_stretch(
        self, model, stretch, spacing, radius, path
    ):
        found = study.stretched(stretch, model, spacing)
        assert abs(found["radius_ends"]) < 0.01
        assert abs(found["radius"]) < radius
        assert abs(found["path"]) < path

    def test_rbf_comes_nearer_with_more_nodes(self):
        models = ({**FINE_RBF, "nodes": nodes} for nodes in (60, 600))
        coarse, fine = (abs(study.stretched(1.3, model, 2.0)["radius_ends"]) for model in models)
        assert fine < 0.6 * coarse


class TestBentBar:
    def test_path_arc_and_radius(self):
        # Slack fibres on the inside of the bend would let the middle line become shorter.
        found = study.bent({**FINE_RBF, "slack_ratio": 1.0}, 2.0)
        assert max(abs(found["path"]), abs(found["arc"])) < 0.006 and abs(found["radius"]) < 0.01
        # Mesh models need to settle.
        settled = {"name": "pbd", "fibre_exponent": 0.0, "iterations": 1000}
        assert abs(study.bent(settled, 4.0)["path"]) < 0.006
        assert study.bent({"name": "pbd"}, 4.0)["path"] > 0.05


class TestWrappedStrip:
    @pytest.mark.parametrize("over", ["cylinder", "sphere"])
    def test_rbf(self, over):
        found = study.wrapped(over, FINE_RBF, 1.5)
        assert abs(found["path"]) < 0.003
        assert abs(found["radius"]) < 0.012
        if over == "cylinder":
            assert -0.5 < found["contact"] < 0.0
