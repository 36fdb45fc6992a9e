"""The tension of active fibres by their length: known points, and a belly that is pulled long."""

import itertools

import numpy as np
import pytest
from contraction_scenes import MUSCLE, bar_scene, with_frames
from peers.known_scenes import Bar

import rbfmuscle as rm
from rbfmuscle.models import build_model
from rbfmuscle.muscle.activation import PEAK, descending_limb

BAR = Bar(length=200.0, width=10.0, thickness=10.0, dome=10.0)
RBF = {"name": "rbf", "centres": 200, "nodes": 150}


def test_tension_of_active_fibres_is_greatest_at_their_slack_length():
    """Half of it away they bear nothing (Zajac 1989): a straight line up, then a parabola."""
    scene = bar_scene(bar=BAR, spacing=5.0, model=RBF, fibre_stretch_at_rest=1.25)
    muscle = build_model(scene.muscles[0], scene, "rbf")
    fibres, weights = muscle.model.fibres, muscle.model.cells.weights
    density = fibres.active / np.average(fibres.active, weights=weights)
    lengths = {0.5: 0.0, 0.75: 0.5, 1.0: 1.0, 1.1: 0.96, 1.25: 0.75, 1.4: 0.36, 1.5: 0.0, 1.7: 0.0}
    for length, wanted in lengths.items():
        share = descending_limb(muscle.model, muscle.model.rest * (length / 1.25))
        bears = share * 2.0 * fibres.active * (length / 1.25 - fibres.content)
        # Of a bar all fibres run from end to end; the mean leaves out what its ends draw together.
        assert bears == pytest.approx(PEAK * density * wanted, rel=0.05, abs=1e-9 * PEAK)


def test_a_belly_beyond_its_slack_length_stays_even_and_has_one_shape_by_two_paths():
    scene = bar_scene(bar=BAR, spacing=5.0, model=RBF, activation=1.0)
    reached = []
    for pulls in ((0.0, -50.0), (0.0, -25.0, -75.0, -50.0)):  # mm, to a quarter more
        run = rm.simulate(with_frames(scene, pulls, BAR.length))
        assert run.values(MUSCLE, "solver_residual").max() < 1e-5
        first, *_, last = (frame.material_meshes[MUSCLE][0] for frame in run.frames)
        reached.append(last)
    rest, now = first, reached[0]
    parts = np.linspace(-60.0, 60.0, 7)
    stretch = [
        np.polyfit(rest[part, 0], now[part, 0], 1)[0]
        for part in ((rest[:, 0] >= a) & (rest[:, 0] < b) for a, b in itertools.pairwise(parts))
    ]
    assert np.ptp(stretch) < 0.02 and min(stretch) > 1.15
    # The mean stretch is that of the sub-step before.
    assert np.linalg.norm(reached[0] - reached[1], axis=1).max() < 0.1  # mm
