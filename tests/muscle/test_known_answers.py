"""Scenes with answers in closed form, the measures of their errors, and what the models make of them."""

import math
from pathlib import Path

import numpy as np
import pytest
import trimesh
from conftest import benchmark_script
from peers.known_answers import observed_order, path_length, richardson, section
from peers.known_scenes import (
    BENT_BAR,
    DRUM_RADIUS,
    ROUND_BAR,
    STRIPS,
    bent_bar,
    stretched_bar,
    wrapped_path,
    wrapped_strip,
)

from rbfmuscle.scene.motion import bone_poses

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module")
def study():
    """The script that prints the tables."""
    return benchmark_script("known_answers")


def end_pose(scene, bone):
    return bone_poses(scene, scene.motion.frames[-1])[bone]


class TestScenes:
    @pytest.mark.parametrize("bar", [ROUND_BAR, BENT_BAR, *STRIPS.values()])
    def test_volume_of_the_mesh_approaches_the_closed_form(self, bar):
        errors = []
        for spacing in (2.0, 1.0, 0.5):
            mesh = trimesh.Trimesh(*bar.mesh(spacing), process=False)
            assert mesh.is_watertight
            errors.append(mesh.volume / bar.volume - 1.0)
        # A polygon inscribed in a circle lacks area by the square of its side.
        assert -0.02 < errors[-1] < 0.0
        assert observed_order((2.0, 1.0, 0.5), errors) > 1.5

    def test_mesh_has_no_slivers_and_no_handedness(self):
        vertices, faces = ROUND_BAR.mesh(2.0)
        sides = np.linalg.norm(vertices[faces] - vertices[np.roll(faces, 1, axis=1)], axis=2)
        assert (sides.max(axis=1) / sides.min(axis=1)).max() < 3.0
        mirrored = vertices * [1, -1, 1]
        nearest = np.linalg.norm(mirrored[:, None] - vertices[None, :60], axis=2).min(axis=0)
        assert nearest.max() < 1e-9

    def test_pull_is_straight(self):
        scene = stretched_bar(1.3, spacing=4.0)
        pose = end_pose(scene, "insertion")
        end = pose @ [0.5 * ROUND_BAR.length, 0, 0, 1]
        assert end[0] == pytest.approx(0.8 * ROUND_BAR.length, abs=1e-6)
        # Half of the pull squared over the distance of the joint's centre, 2e6 mm.
        assert abs(end[2]) < 1e-3
        assert abs(pose[0, 2]) < 1e-4

    def test_ends_of_the_bent_bar_lie_on_an_arc_of_its_length(self):
        pose = end_pose(bent_bar(60.0, spacing=4.0), "insertion")
        radius, turn = BENT_BAR.length / math.radians(60), math.radians(60)
        end = pose @ [0.5 * BENT_BAR.length, 0, 0, 1]
        wanted = [radius * math.sin(turn) - 0.5 * BENT_BAR.length, 0, radius * (math.cos(turn) - 1)]
        assert np.allclose(end[:3], wanted, atol=1e-9)
        assert np.allclose(pose[:3, 0], [math.cos(turn), 0, -math.sin(turn)], atol=1e-12)

    @pytest.mark.parametrize("over", ["cylinder", "sphere"])
    def test_strip_touches_the_bone_at_its_top_at_rest(self, over):
        scene = wrapped_strip(20.0, over=over, spacing=3.0)
        away = np.abs(scene.bones[0].mesh.vertices[:, 2].max() - scene.muscles[0].mesh.vertices[:, 2].min())
        assert away < 1e-9
        assert [f.level for f in scene.check() if f.level != "note"] == []

    def test_sphere_holds_its_strip_in_the_middle(self, study):
        turn = math.radians(study.TURNS["sphere"])
        bar = STRIPS["sphere"]
        assert math.tan(turn / 2) < (DRUM_RADIUS + bar.thickness) / (bar.length / 2)

    def test_path_over_a_thin_strip_is_the_arc(self):
        from dataclasses import replace

        added, lifted = wrapped_path(1.2, bar=replace(STRIPS["cylinder"], thickness=1e-9))
        assert added == pytest.approx(1.2 * DRUM_RADIUS)
        assert lifted == pytest.approx(DRUM_RADIUS)


class TestMeasures:
    def test_section_of_a_box(self):
        box = trimesh.creation.box(extents=(2, 3, 5))
        box.apply_translation((1, 2, 3))
        area, centroid = section(box.vertices, box.faces, (1.3, 0, 0), (1, 0, 0))
        assert area == pytest.approx(15)
        assert np.allclose(centroid, [1.3, 2, 3])
        area, centroid = section(box.vertices, box.faces, (1.3, 0, 0), (-2, 0, 0))
        assert area == pytest.approx(15)
        assert np.allclose(centroid, [1.3, 2, 3])

    def test_section_beside_the_mesh_is_empty(self):
        box = trimesh.creation.box()
        area, centroid = section(box.vertices, box.faces, (9, 0, 0), (1, 0, 0))
        assert area == 0.0
        assert np.isnan(centroid).all()

    def test_order_and_limit_of_a_known_sequence(self):
        sizes = np.array([4.0, 3.0, 2.0, 1.0])
        values = 7.0 - 0.3 * sizes**1.7
        assert observed_order(sizes, values - 7.0) == pytest.approx(1.7)
        order, limit = richardson(sizes, values)
        assert order == pytest.approx(1.7)
        assert limit == pytest.approx(7.0)

    def test_sequences_without_an_order_say_so(self):
        assert math.isnan(observed_order([2, 1], [0.1, 0.0]))
        assert np.isnan(richardson([4, 2, 1], [1.0, 2.0, 1.0])).all()
        assert np.isnan(richardson([4, 2, 1], [1.0, 1.0, 1.0])).all()

    def test_path_length_of_a_square(self):
        assert path_length(np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0.0]])) == pytest.approx(2.0)


# What the page of accuracy promises: shares of the closed form, at a refinement that runs in a second.
FINE_RBF = {"name": "rbf", "centres": 600, "nodes": 300}


class TestStretchedBar:
    @pytest.mark.parametrize(("stretch", "slack"), [(0.8, 1.0), (1.2, 1.6)])
    def test_rbf(self, study, stretch, slack):
        # A slack bar that is pushed shortens more where its held ends do not keep it from thickening.
        found = study.stretched(stretch, {**FINE_RBF, "slack": slack}, 1.5)
        assert abs(found["radius"]) < 0.01
        assert abs(found["radius_ends"]) < 0.01
        assert abs(found["path"]) < 0.003

    def test_rbf_comes_nearer_with_more_nodes(self, study):
        coarse, fine = (
            study.stretched(1.3, {**FINE_RBF, "nodes": nodes}, 2.0)["radius_ends"] for nodes in (60, 600)
        )
        assert abs(fine) < 0.6 * abs(coarse)

    def test_arap_volume(self, study):
        found = study.stretched(1.2, {"name": "arap-volume"}, 2.0)
        assert abs(found["radius_ends"]) < 0.01
        assert abs(found["path"]) < 0.001

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

    @pytest.mark.parametrize("over", ["cylinder", "sphere"])
    def test_pbd_needs_to_settle(self, study, over):
        settled = {"name": "pbd", "fibre_exponent": 0.0, "iterations": 150}
        assert abs(study.wrapped(over, settled, 3.0)["path"]) < 0.005
        assert study.wrapped(over, "pbd", 3.0)["path"] > 0.01
