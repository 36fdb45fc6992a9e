"""Comparing models: what is measured alike, what lands in tables and report, and how it fails."""

import csv
import json
import math

import numpy as np
import pytest
from blend_model import BlendMuscle, arm_scene

from rbfmuscle import compare
from rbfmuscle.compare import compare_models
from rbfmuscle.experiments.comparison import MEASURES, best_models, describe
from rbfmuscle.metrics.metrics import surface_distance
from rbfmuscle.models import model_title
from rbfmuscle.output.saved import SavedRun
from rbfmuscle.scene.phantom import phantom_scene
from rbfmuscle.validation import SolveError, UsageError


def results(**models):
    return {name: {"all": values} for name, values in models.items()}


class TestAnswer:
    def test_says_what_the_first_keeps_at_which_price_and_who_comes_near(self):
        found = results(
            rbf={"penetration_max": 0.0, "bone_penetration_max": 0.031, "time_frame": 0.074},
            pbd={"penetration_max": 3.17, "time_frame": 0.02, "distance_rms": 31.0},
            settled={"penetration_max": 3.2, "time_frame": 1.406, "distance_rms": 5.71},
        )
        labels = {"rbf": "RBF", "pbd": "PBD, 3 sweeps as in the paper", "settled": "PBD, converged"}
        text = describe(found, labels, "mm")
        assert text.startswith("RBF keeps out of bones (0.031 mm) at 3.7 times the time of PBD, 3 sweeps")
        assert "PBD, converged, comes within 5.7 mm RMS of it at 19 times its time" in text
        turned = describe({name: found[name] for name in ("pbd", "rbf")}, labels, "mm")
        assert "stands in bones (3.2 mm) at 0.27 times the time of RBF" in turned

    def test_what_does_not_count_is_a_tie(self):
        found = results(a={"rest_error_rms": 0.0}, b={"rest_error_rms": 0.01}, c={"rest_error_rms": 0.5})
        assert best_models(found, "rest_error_rms", "mm") == ["a", "b"]
        assert best_models(found, "rest_error_rms", "m") == ["a"]


@pytest.fixture(scope="module")
def compared(tmp_path_factory):
    """Two models on the phantom, four poses to 18 degrees."""
    folder = tmp_path_factory.mktemp("compare")
    scene = phantom_scene(step=6.0).with_options(frames="0:4")
    table = compare_models(scene, folder, ["rbf", "pbd"], settings={"rbf:model.centres": 100}, pictures=False)
    return folder, table


class TestComparison:
    def test_values_are_those_of_the_runs(self, compared):
        folder, table = compared
        assert (table["models"], table["frames"], table["poses"]) == (["rbf", "pbd"], 4, [0, 1, 3])
        for model in table["models"]:
            saved, found = SavedRun(folder / model), table["results"][model]
            assert len(saved.frames) == 4
            for quantity in ("volume_error", "bone_penetration_max", "rest_error_rms"):
                each = [saved.series(muscle, quantity)[1] for muscle in saved.muscles]
                assert abs(found["all"][quantity]) == max(abs(values).max() for values in each)
            wall = saved.series("all", "time_frame")[1][1:]
            assert found["all"]["time_frame"] == np.median(wall)
            missing = set(MEASURES) - set(found["all"]) - {"distance_rms", "distance_max", "flicker"}
            assert not missing
        assert SavedRun(folder / "rbf").info["scene"]["muscles"][0]["model"]["centres"] == 100

    def test_laws(self, compared):
        found = compared[1]["results"]
        for model in found:
            assert abs(found[model]["all"]["volume_error"]) < 1e-6
            assert found[model]["all"]["components"] == 1
            assert 0 <= found[model]["all"]["return_rms"] < 1.5
        assert found["pbd"]["all"]["rest_error_rms"] < 1e-9 < found["rbf"]["all"]["rest_error_rms"]

    def test_distances_belong_to_the_first(self, compared):
        folder, table = compared
        assert "distance_rms" not in table["results"]["rbf"]["all"]
        pbd = table["results"]["pbd"]
        assert pbd["all"]["distance_rms"] == max(v["distance_rms"] for k, v in pbd.items() if k != "all")
        runs = [SavedRun(folder / name) for name in ("rbf", "pbd")]
        there = [
            surface_distance(*runs[0].surface("extensor", k), *runs[1].surface("extensor", k))
            for k in (0, 1, 3)
        ]
        assert pbd["extensor"]["distance_max"] == max(worst for _, worst in there)
        assert 0 < pbd["all"]["distance_rms"] <= pbd["all"]["distance_max"]

    def test_tables_agree(self, compared):
        folder, table = compared
        with open(folder / "comparison.json", encoding="utf-8") as file:
            assert json.load(file) == json.loads(json.dumps(table))
        with open(folder / "comparison.csv", encoding="utf-8", newline="") as file:
            rows = list(csv.DictReader(file))
        for row in rows:
            assert float(row["value"]) == table["results"][row["model"]][row["muscle"]][row["quantity"]]

    def test_page_begins_with_the_answer_and_holds_every_measure(self, compared):
        folder, table = compared
        text = (folder / "report.html").read_text(encoding="utf-8")
        assert table["answer"].startswith("RBF keeps out of bones") and table["answer"] in text
        assert "No pictures: they were switched off." in text and text.index(table["answer"]) < text.index(
            "<table"
        )
        assert all(MEASURES[quantity].title in text for quantity in table["results"]["pbd"]["all"])


def test_pictures_show_every_model(tmp_path):
    compare_models(arm_scene(), tmp_path, ["pbd", "arap-volume"])
    text = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert '"panels":["PBD, 3 sweeps as in the paper","arap-volume"]' in text


class TestFailure:
    def test_names_and_keys_are_checked_before_anything_runs(self, tmp_path):
        for models, settings, words in (
            (["rbf", "pdb"], {}, "did you mean 'pbd'"),
            (["rbf"], {}, "two or more"),
            (["rbf", "rbf"], {}, "two or more"),
            (["rbf", "pbd"], {"xpbd:model.sweeps": 2}, "not compared"),
            (["rbf", "rbf-converged"], {}, "unknown model"),
        ):
            with pytest.raises(UsageError, match=words):
                compare_models(arm_scene(), tmp_path, models, settings=settings)
        assert not list(tmp_path.iterdir())

    def test_a_model_that_fails_leaves_the_others(self, tmp_path, monkeypatch):
        """The third model of three gives up in its run; it is named, and the others are compared."""
        from rbfmuscle.models import build_model

        class GivesUp(BlendMuscle):
            def solve(self, contacts):
                raise SolveError("planted failure")

        def build(muscle, scene):
            return GivesUp(muscle, scene) if muscle.model == "xpbd" else build_model(muscle, scene)

        monkeypatch.setattr("rbfmuscle.models.build_model", build)
        table = compare_models(arm_scene(), tmp_path, ["pbd", "arap-pbd", "xpbd"], pictures=False)
        assert table["models"] == ["pbd", "arap-pbd"] and "planted" in table["failed"]["xpbd"]
        assert "xpbd did not finish" in (tmp_path / "report.html").read_text(encoding="utf-8")
        assert not math.isnan(table["results"]["pbd"]["all"]["volume_error"])


def test_labels_say_what_ran():
    scene = arm_scene()
    settings = {"pbd:model.iterations": 7}
    variants = compare._variants(scene, ["rbf", "pbd", "xpbd-converged"], {})
    assert [model_title(variant.muscles[0]) for variant in variants.values()] == [
        "RBF", "PBD, 3 sweeps as in the paper", "XPBD, converged"
    ]  # fmt: skip
    assert variants["xpbd-converged"].muscles[0].model == "xpbd-converged"
    many = compare._variants(scene, ["rbf", "pbd"], settings)["pbd"]
    assert model_title(many.muscles[0]) == "PBD, 7 sweeps"
