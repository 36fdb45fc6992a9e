"""Findings and limits: each figure in a message is that of the quantity it names, in the unit it names."""

import numpy as np
import pytest
import trimesh

import rbfmuscle as rm
from rbfmuscle.scene.check import check_extents
from rbfmuscle.validation import MeshError


class TestFindings:
    @pytest.mark.parametrize(("factor", "remedy"), [(1e-3, 1000.0), (100.0, 0.01), (1e3, 0.001)])
    def test_remedy_of_a_wrong_unit_makes_the_size_it_says(self, factor, remedy):
        scene = rm.Scene(units="mm").add_bone(
            "rod", trimesh.creation.box((300.0 * factor, 1 * factor, 1 * factor))
        )
        with pytest.raises(MeshError) as caught:
            check_extents(scene)
        size = factor * np.linalg.norm([300.0, 1.0, 1.0])
        text = str(caught.value)
        assert f"is {size:.4g} mm across" in text
        assert f"({remedy:g} times the present one would make it {size * remedy:.4g} mm)" in text
