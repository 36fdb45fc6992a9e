"""Findings and limits: each figure in a message is that of the quantity it names, in the unit it names."""

import re

import numpy as np
import pytest
import trimesh
from blend_model import arm_scene

import rbfmuscle as rm
from rbfmuscle.scene.check import check_extents, check_scene
from rbfmuscle.validation import MeshError


class TestFindings:
    def test_overlap_names_number_fraction_and_depth(self):
        """An egg of 26 by 5 by 5 mm, pushed down into two boxes whose tops lie 3 mm above the axis."""
        scene = arm_scene()
        mesh = scene.muscles[0].mesh
        mesh.apply_translation([0, 0, -5.0])
        x, _, z = mesh.vertices.T
        held = np.concatenate([a.vertices for a in scene.muscles[0].attachments])
        free = np.setdiff1d(np.arange(len(z)), held)
        for bone, side in (("upper", x < 0), ("fore", x > 0)):
            low, high = scene.bones[0 if bone == "upper" else 1].mesh.bounds
            inside = free[np.all((mesh.vertices[free] > low) & (mesh.vertices[free] < high), axis=1)]
            (note,) = [f for f in check_scene(scene) if f"inside bone '{bone}'" in f.message]
            deepest = np.minimum(mesh.vertices[inside] - low, high - mesh.vertices[inside]).min(axis=1).max()
            assert len(inside) > 5 and side[inside].all()
            share = 100.0 * len(inside) / len(z)
            assert note.message.startswith(f"{len(inside)} free vertices ({share:.2g} %) start inside")
            told = float(re.search(r"up to (\S+) mm deep", note.message)[1])
            assert told == pytest.approx(deepest, rel=5e-3)

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
