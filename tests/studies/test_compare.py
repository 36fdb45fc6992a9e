"""Comparing models: what is measured alike, what lands in tables and report, and how it fails."""

import csv
import html
import json
import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from blend_model import BlendMuscle, arm_scene

from rbfmuscle.metrics.summary import Exceedance, Unmeasured
from rbfmuscle.models import build_model
from rbfmuscle.recording import Run
from rbfmuscle.scene.phantom import phantom_scene
from rbfmuscle.studies.compare import (
    DEEPER,
    MEASURES,
    Comparison,
    _values,
    best_models,
    compare,
    describe,
    muscles_beyond,
    shown,
)
from rbfmuscle.validation import UsageError


def test_what_does_not_count_is_a_tie():
    found = {
        name: {"all": {"rest_error_rms": e}} for name, e in (("a", 0.0), ("b", 0.01), ("c", 0.5))
    }
    assert best_models(found, "rest_error_rms", "mm") == ["a", "b"]
    assert best_models(found, "rest_error_rms", "m") == ["a"]
    found = {
        name: {"all": {"distance_rms": 1.0, "bowing": s}} for name, s in (("a", 1.0), ("b", 0.9))
    }
    assert (
        best_models(found, "distance_rms", "mm")
        == best_models({"a": found["a"]}, "bowing", "mm")
        == []
    )
    assert best_models(found, "bowing", "mm") == ["a"]  # which is perfect at 1
    known = SimpleNamespace(models=["a"], results=found)
    assert (_values(known, "bowing"), _values(known, "flicker")) == ([1.0], [])
    table = SimpleNamespace(measures={name: replace(m, unit="mm") for name, m in MEASURES.items()})
    values = (
        ("return_rms", 0.009),
        ("return_rms", 0.011),
        ("distance_rms", 0.4),
        ("distance_max", 0.4),
    )
    assert [shown(table, *value) for value in values] == ["0 mm", "0.011 mm", "0.4 mm", "0.4 mm"]


@pytest.fixture(scope="module")
def compared(tmp_path_factory):
    """Two models of two muscles of the phantom, four poses to 18 degrees."""
    folder = tmp_path_factory.mktemp("compare")
    scene = phantom_scene(step=6.0, spacing=4.0).with_options(frames="0:4")
    scene.muscles = [scene.muscle(name) for name in ("extensor", "adductor_posterior")]
    table = compare(
        scene, folder, models=["rbf", "pbd"], settings={"rbf:model.centres": 100}, pictures=False
    )
    return folder, table


class TestComparison:
    def test_values_are_those_of_the_runs(self, compared):
        folder, table = compared
        assert (table.models, table.frames, table.poses) == (["rbf", "pbd"], 4, [0, 1, 3])
        for model in table.models:
            saved, found = Run.load(folder / model), table.results[model]
            assert len(saved.frames) == 4
            for quantity in ("volume_error", "bone_penetration_max", "rest_error_rms"):
                each = [saved.series(muscle, quantity)[1] for muscle in saved.muscles]
                assert abs(found["all"][quantity]) == max(abs(values).max() for values in each)
            walls = {
                name: saved.series(name, "time_frame")[1][1:] for name in ("all", *saved.muscles)
            }
            assert all(found[name]["time_frame"] == np.median(wall) for name, wall in walls.items())
            assert found["all"]["time_frame_p95"] == np.percentile(walls["all"], 95)
            assert set(MEASURES) - set(found["all"]) <= {
                "distance_rms",
                "distance_max",
                "length_rms",
                "moment_arm_rms",
                "flicker",
                "unfitted_fraction",
                "rest_error_at_overlap",
            }
            # Both models depend on the sub-steps that they in fact take, PBD more.
            assert found["all"]["step_rms"] > 1e-6
            assert 0 <= found["all"]["return_rms"] < 1.5
        steps = [table.results[name]["all"]["step_rms"] for name in ("rbf", "pbd")]
        assert steps[1] > 1.5 * steps[0]
        assert Run.load(folder / "rbf").info.scene.muscles[0].model.centres == 100

    def test_files_hold_the_table_and_the_page_begins_with_the_answer(self, compared):
        folder, table = compared
        kept = json.loads((folder / "comparison.json").read_text(encoding="utf-8"))
        assert Comparison.model_validate(kept) == table
        lines = (folder / "comparison.csv").read_text(encoding="utf-8").splitlines()
        for row in csv.DictReader(lines):
            assert (
                float(row["value"]) == table.results[row["model"]][row["muscle"]][row["quantity"]]
            )
        text = (folder / "report.html").read_text(encoding="utf-8")
        answer = html.escape(table.answer, quote=False)
        kept = {name: verdict_count(Run.load(folder / name)) for name in table.models}
        assert answer.startswith(
            f"Muscles within all limits: {kept['rbf']} of 2 (RBF), {kept['pbd']} of 2 (PBD, 3 "
        )
        assert table.within == kept and kept["pbd"] < 2
        times = [table.results[name]["all"]["time_frame"] for name in table.models]
        quick = table.labels[table.models[int(np.argmin(times))]]
        ratio = f"{max(times) / min(times):.2g}"
        assert f"{quick} is the quickest: " in answer and f" takes {ratio} times as" in answer
        assert answer in text
        assert text.index(answer) < text.index("<table")
        assert all(MEASURES[quantity].title in text for quantity in table.results["pbd"]["all"])

    def test_depth_at_rest_is_not_held_against_a_model(self, compared):
        """PBD keeps what overlaps at rest; only what is deeper than that counts."""
        folder, table = compared
        for model in table.models:
            for muscle in Run.load(folder / model).muscles:
                found = table.results[model][muscle]
                deepest = max(found["penetration_max"], found["bone_penetration_max"])
                beyond = max(0.0, deepest - found["initial_overlap"])
                assert found[DEEPER] == pytest.approx(beyond)
        pbd = table.results["pbd"]["all"]
        assert pbd[DEEPER] < max(pbd["penetration_max"], pbd["bone_penetration_max"])

    def test_statistics_are_those_of_the_frames(self, compared):
        folder, _ = compared
        lines = (folder / "statistics.csv").read_text(encoding="utf-8").splitlines()
        rows = list(csv.DictReader(lines))
        assert {row["model"] for row in rows} == {"rbf", "pbd"}
        for row in rows:
            quantity, _, about = row["quantity"].partition(":")
            run = Run.load(folder / row["model"])
            values = run.series(row["muscle"], quantity, about or None)[1]
            assert float(row["mean"]) == pytest.approx(values.mean())
            assert float(row["sd"]) == pytest.approx(values.std(), abs=1e-12)
        arms = [row for row in rows if row["quantity"] == "moment_arm:hip.flexion"]
        assert len(arms) == 4 and {row["unit"] for row in arms} == {"mm"}

    def test_differences_of_length_and_arm_are_over_the_frames(self, compared):
        folder, table = compared
        rbf, pbd = (Run.load(folder / name) for name in ("rbf", "pbd"))
        for muscle in rbf.muscles:
            apart = rbf.series(muscle, "length")[1] - pbd.series(muscle, "length")[1]
            found = table.results["pbd"][muscle]
            assert found["length_rms"] == pytest.approx(np.sqrt((apart**2).mean()))
            assert found["moment_arm_rms"] > 0 and table.unknowns["pbd"][muscle]
        assert 0 < table.results["rbf"]["all"]["time_one_thread"] < 60


def verdict_count(run):
    """The number of muscles within all limits, as the verdict of a run says it."""
    words = run.verdict.split()
    return len(run.muscles) if words[:2] == ["every", "muscle"] else int(words[0])


def test_the_sentences_name_what_is_beyond_limits_and_the_best_and_the_quickest():
    found = {
        name: {"one": {}, "two": {}, "all": {"time_frame": time}}
        for name, time in (("a", 3.0), ("b", 2.0), ("c", 5.0))
    }
    beyond = {
        "a": {"all": {"one"}, "volume_error": {"one"}, "bowing": {"one"}},
        "b": {"all": {"one", "two"}, "volume_error": {"one"}, "self_crossings": {"one", "two"}},
        "c": {"all": {"one", "two"}, "bone_overlap": {"all"}},
    }
    labels = {"a": "A", "b": "B", "c": "C"}
    text = describe(found, labels, beyond)
    assert text.startswith(
        "Muscles within all limits: 1 of 2 (A), 0 of 2 (B), 0 of 2 (C). Beyond limits, A: volume "
        "error (one), bowing (one). Beyond limits, B: self-crossing triangles (one, two), volume "
        "error (one). Beyond limits, C: bones in each other (the bones). By the limits A is the "
        "best. B is the quickest: A takes 1.5 times as long, C takes 2.5 times as long. "
    )
    assert "The comparison does not show which shape is right" in text
    same = describe(found, labels, beyond | {"b": beyond["a"]})
    assert "By the limits A and B are equal. " in same
    alone = describe({"a": found["a"]}, labels, {"a": beyond["a"]})
    assert alone.endswith("volume error (one), bowing (one).")


def test_muscles_beyond_are_named_by_quantity_and_the_bones_beside_them():
    run = SimpleNamespace(
        info=SimpleNamespace(
            beyond=[
                Exceedance("one", "moment_arm_jump:hip.flexion", 12.0, 10.0, 3),
                Exceedance("all", "bone_overlap", 1.0, 0.0, 3),
            ],
            not_measured=[Unmeasured("two", "bowing"), Unmeasured("all", "joint_gap")],
        )
    )
    found = muscles_beyond(run)
    assert found == {
        "all": {"one", "two"},
        "moment_arm_jump": {"one"},
        "bone_overlap": {"all"},
        "bowing": {"two"},
    }
    text = describe({"a": {"one": {}, "two": {}, "all": {}}}, {"a": "A"}, {"a": found})
    assert "moment arm that jumps within 5 degrees (one)" in text


class TestFailure:
    def test_names_and_keys_are_checked_before_anything_runs(self, tmp_path):
        for models, settings, words in (
            (["rbf", "pdb"], {}, "did you mean 'pbd'"),
            (["rbf"], {}, "two or more"),
            (["rbf", "rbf"], {}, "two or more"),
            (["rbf", "pbd"], {"xpbd:model.sweeps": 2}, "not compared"),
            (["rbf", "rbf-converged"], {}, "unknown model"),
            (["rbf", "pbd"], {"pbd:motion.step": 1}, "same motion"),
        ):
            with pytest.raises(UsageError, match=words):
                compare(arm_scene(), tmp_path, models=models, settings=settings)
        assert not list(tmp_path.iterdir())

    def test_a_model_that_fails_leaves_the_others(self, tmp_path, monkeypatch):
        def build(muscle, scene):
            return (BlendMuscle if muscle.model == "xpbd" else build_model)(muscle, scene)

        monkeypatch.setattr(BlendMuscle, "fail_at", 1)
        monkeypatch.setattr("rbfmuscle.models.build_model", build)
        table = compare(arm_scene(), tmp_path, models=["pbd", "arap-pbd", "xpbd"], pictures=False)
        assert table.models == ["pbd", "arap-pbd"] and "planted" in table.failed["xpbd"]
        assert "xpbd did not finish" in (tmp_path / "report.html").read_text(encoding="utf-8")
        assert not math.isnan(table.results["pbd"]["all"]["volume_error"])
