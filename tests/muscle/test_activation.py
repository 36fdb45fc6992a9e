"""RBF muscles that contract: beside finite elements, and laws."""

import numpy as np
import pytest
from contraction_scenes import spindle_scene

from rbfmuscle.muscle.muscle import RBFMuscle
from rbfmuscle.muscle.options import RBFOptions

INSIDE = {"name": "rbf", "centres": 300, "nodes": 300}
TENDON = {"length": 100.0, "strain": 0.08}


def test_fibres_through_a_unit_area_are_those_of_the_belly_over_its_girth():
    scene = spindle_scene(model=INSIDE, tendon=TENDON)
    model = RBFMuscle(scene.muscles[0], scene, RBFOptions(centres=150, nodes=600))
    x = np.abs(model.solid.quad_points[:, 0])
    middle, tendon = (
        np.average(model.law.density[there], weights=model.solid.weights[there])
        for there in (x < 10.0, (x > 90.0) & (x < 120.0))
    )
    assert middle == pytest.approx(1.0, abs=0.1)
    # Radii of 15 and 9 mm; a cell is 10 mm wide.
    assert tendon == pytest.approx((15.0 / 9.0) ** 2, rel=0.1)
