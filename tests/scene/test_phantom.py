"""The phantom: known volumes, closed meshes, no overlap but at attachments."""

import numpy as np
import pytest
import trimesh

from rbfmuscle.scene.phantom import MUSCLES, phantom_scene
from rbfmuscle.scene.phantom_shapes import Tube


class TestTube:
    def test_straight_tube_with_fullness_two_is_an_ellipsoid(self):
        tube = Tube(
            points=((0, 0, -30), (0, 1e-9, 0), (0, 0, 30)), radius=1, width=12, thickness=7, fullness=2
        )
        assert tube.volume == pytest.approx(4 / 3 * np.pi * 12 * 7 * 30)
        vertices, _, _ = tube.mesh(3.0)
        assert (vertices / [12, 7, 30])[:, 2].max() == pytest.approx(1)
        rim = np.linalg.norm(vertices / [12, 7, 30], axis=1)
        turned = np.linalg.norm(vertices / [7, 12, 30], axis=1)
        assert min(np.abs(rim - 1).max(), np.abs(turned - 1).max()) < 1e-9

    @pytest.mark.parametrize("name", MUSCLES)
    def test_mesh_volume_converges_to_the_closed_form(self, name):
        tube = MUSCLES[name]
        errors = []
        for spacing in (6.0, 3.0, 1.5):
            vertices, faces, _ = tube.mesh(spacing)
            mesh = trimesh.Trimesh(vertices, faces, process=False)
            assert mesh.is_watertight and mesh.euler_number == 2
            errors.append(1 - mesh.volume / tube.volume)
        assert 0 < errors[2] < 0.005  # an inscribed polyhedron, edges of 1.5 mm
        assert errors[0] / errors[1] > 3 and errors[1] / errors[2] > 3  # second order, 4 in the limit


def test_check_finds_nothing_wrong():
    assert [finding for finding in phantom_scene().check() if finding.level != "note"] == []
