"""Findings and limits: each figure in a message is that of the quantity it names, in the unit it names."""

import re

import numpy as np
import pytest
import trimesh
from blend_model import arm_scene

import rbfmuscle as rm
from rbfmuscle.scene.check import check_centre, check_extents, check_scene
from rbfmuscle.validation import MeshError, SceneError


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

    def test_distance_of_a_muscle_in_another_frame_is_that_of_the_boxes(self):
        scene = arm_scene()
        scene.muscles[0].mesh.apply_translation([0, 903.0, 0])
        gap = scene.muscles[0].mesh.bounds[0, 1] - max(bone.mesh.bounds[1, 1] for bone in scene.bones)
        up = max(
            0.0, scene.muscles[0].mesh.bounds[0, 2] - max(bone.mesh.bounds[1, 2] for bone in scene.bones)
        )
        with pytest.raises(MeshError, match=rf"lies {np.hypot(gap, up):.4g} mm away from all bones"):
            check_extents(scene)

    def test_distant_joint_centre_is_an_error_with_its_distance(self):
        scene = arm_scene()
        low, high = np.array([bone.mesh.bounds for bone in scene.bones]).transpose(1, 0, 2)
        centre = np.array([3.0, high.max(axis=0)[1] + 3e6, low.min(axis=0)[2] - 4e6])
        with pytest.raises(SceneError, match=r"joint 'elbow': centre .* lies 5e\+06 mm away from all bones"):
            check_centre(scene, "elbow", centre)
        check_centre(scene, "elbow", high.max(axis=0) + 1.0)
