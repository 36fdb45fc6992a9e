"""The mesh models in the frame loop: the real hip, where it is present."""

import runpy
import sys
from pathlib import Path

import numpy as np

from rbfmuscle.models import build_models
from rbfmuscle.simulation.frame_loop import simulate_frames

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "paper_experiments.py"


def edge_lengths(model):
    i, j = model.rest.topology.edges.T
    points = model.contact_points()
    return np.linalg.norm(points[i] - points[j], axis=1)


def test_hip_flexes_within_the_promised_figures(hip_scene):
    scene = hip_scene.with_options(frames="0:46:1", model="pbd")
    models = build_models(scene)
    rest = [edge_lengths(model) for model in models]
    for _ in simulate_frames(scene, models, surfaces=False):
        for model, lengths in zip(models, rest, strict=True):
            assert model.penetration <= 0.5, model.name
            assert abs(model.volume() / model.rest.volume.rest - 1) <= 1e-3, model.name
            low, high = np.quantile(edge_lengths(model) / lengths, [0.01, 0.99])
            # slack fibres shorten to 1 / 1.6 of their length, and edges to 0.6 of that before they are hard
            assert low >= 0.375 and high <= 2.5, (model.name, low, high)


def test_example_with_the_papers_experiments_runs(hip_data, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", [str(EXAMPLE), "--muscle", "gluteus_medius"])
    runpy.run_path(str(EXAMPLE), run_name="__main__")
    assert capsys.readouterr().out.count("flexion by 2") == 4
