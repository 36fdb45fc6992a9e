"""The phantom: known volumes, closed meshes, no overlap but at attachments."""

import numpy as np
import pytest
import trimesh

from rbfmuscle.scene.attachments import signed_distances
from rbfmuscle.scene.check import bone_collisions
from rbfmuscle.scene.phantom import HEAD_RADIUS, MUSCLES, SOCKET_RADIUS, phantom_scene
from rbfmuscle.scene.phantom_shapes import Tube


@pytest.fixture(scope="module")
def scene():
    return phantom_scene()


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


class TestScene:
    def test_meshes_are_closed_outward_and_small(self, scene):
        for item in [*scene.bones, *scene.muscles]:
            assert item.mesh.is_watertight and item.mesh.volume > 0 and item.mesh.body_count == 1
            assert len(item.mesh.vertices) < 10_000 and item.notes == []

    def test_bones_are_a_femur_and_a_hip_bone_with_its_ring(self, scene):
        assert scene.bone("femur").mesh.euler_number == 2
        assert scene.bone("pelvis").mesh.euler_number == 0  # the obturator foramen
        litres = {bone.name: bone.mesh.volume / 1000 for bone in scene.bones}
        assert litres == pytest.approx({"pelvis": 413, "femur": 502}, rel=0.01)

    def test_ball_in_socket(self, scene):
        gap = signed_distances(np.asarray(scene.bone("femur").mesh.vertices), scene.bone("pelvis").mesh).min()
        assert gap == pytest.approx(SOCKET_RADIUS - HEAD_RADIUS, abs=0.5)  # meshes of 3.5 mm cells
        assert bone_collisions(scene) == []

    def test_muscles_touch_bones_only_where_they_are_attached(self, scene):
        for muscle in scene.muscles:
            points = np.asarray(muscle.mesh.vertices)
            free = np.ones(len(points), dtype=bool)
            for attachment in muscle.attachments:
                assert len(attachment.vertices) >= 20
                free[attachment.vertices] = False
            depth = np.min([signed_distances(points, bone.mesh) for bone in scene.bones], axis=0)
            assert depth[free].min() > 0, muscle.name
            assert depth.min() > -0.45, muscle.name

    def test_check_finds_nothing_wrong(self, scene):
        assert [finding for finding in scene.check() if finding.level != "note"] == []

    def test_pair_of_neighbours_has_a_small_gap(self, scene):
        first, second = (scene.muscle(f"adductor_{side}").mesh for side in ("anterior", "posterior"))
        gap = signed_distances(np.asarray(first.vertices), second).min()
        assert 0.5 < gap < 2.0

    def test_fibres_lie_inside(self, scene):
        for muscle in scene.muscles:
            for line in muscle.fibres:
                assert line.shape == (15, 3)
                assert signed_distances(line, muscle.mesh).max() < 0.5  # chords of a mesh of 3 mm
