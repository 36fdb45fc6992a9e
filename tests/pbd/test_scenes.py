"""The mesh models in the frame loop: the phantom, and the real hip where it is present."""

import runpy
import sys
from pathlib import Path

import numpy as np
import pytest

from rbfmuscle.models import build_model
from rbfmuscle.scene.phantom import phantom_scene
from rbfmuscle.simulation.frame_loop import simulate_frames

METHODS = ["pbd", "pbd-paper", "xpbd", "arap-pbd", "arap-volume", "arap-interleaved"]
EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "paper_experiments.py"


def run(scene, name):
    """Yield, frame by frame, the models with edge ratios of each: dict of muscle to (model, ratios)."""
    models = [build_model(muscle, scene, name) for muscle in scene.muscles]
    rest = {model.name: edge_lengths(model) for model in models}
    for _ in simulate_frames(scene, models, surfaces=False):
        yield {model.name: (model, edge_lengths(model) / rest[model.name]) for model in models}


def edge_lengths(model):
    edges = model.rest.topology.edges
    points = model.contact_points()
    return np.linalg.norm(points[edges[:, 0]] - points[edges[:, 1]], axis=1)


@pytest.mark.parametrize("name", METHODS)
def test_phantom_flexes_with_its_volume_and_out_of_its_bones(name):
    scene = phantom_scene(model=name, end=90, step=10)
    for state in run(scene, name):
        for muscle, (model, _) in state.items():
            assert np.isfinite(model.contact_points()).all(), muscle
            assert model.penetration <= 0.5, muscle
            if name != "arap-interleaved":
                assert abs(model.volume() / model.rest.volume.rest - 1) <= 1e-3, muscle


def test_hip_flexes_within_the_promised_figures(hip_scene):
    scene = hip_scene.with_options(frames="0:46:1")
    for state in run(scene, "pbd"):
        for muscle, (model, ratios) in state.items():
            assert model.penetration <= 0.5, muscle
            assert abs(model.volume() / model.rest.volume.rest - 1) <= 1e-3, muscle
            low, high = np.quantile(ratios, [0.01, 0.99])
            # slack fibres shorten to 1 / 1.6 of their length, and edges to 0.6 of that before they are hard
            assert low >= 0.375 and high <= 2.5, (muscle, low, high)


def test_example_with_the_papers_experiments_runs(hip_data, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", [str(EXAMPLE), "--muscle", "gluteus_medius"])
    runpy.run_path(str(EXAMPLE), run_name="__main__")
    table = capsys.readouterr().out
    assert table.count("flexion by 2") == 4
