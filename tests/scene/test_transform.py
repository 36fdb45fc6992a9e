"""Scale, mirror and transform of a mesh: known answers, and a mirrored scene against its own."""

import numpy as np
import pytest
import trimesh
from blend_model import arm_files

import rbfmuscle as rm
from rbfmuscle.scene.meshes.read import MeshTransform
from rbfmuscle.scene.scene import Scene
from rbfmuscle.validation import SceneError

TURN = trimesh.transformations.rotation_matrix(0.7, [1.0, 2.0, -0.5], [3.0, 1.0, 2.0])


def placed(points, **keys):
    return MeshTransform.build(keys, context="").points(np.array(points, dtype=float))


class TestPoints:
    def test_turns_about_x_then_y_then_z_then_the_shift(self):
        """Quarter turns: y goes to z by x, z to x by y, x to y by z."""
        turned = placed(np.eye(3), transform={"rotate": [90, 90, 90], "translate": [1, 2, 3]})
        expected = [[0, 0, -1], [0, 1, 0], [1, 0, 0]]
        assert np.allclose(turned, np.array(expected) + [1, 2, 3], atol=1e-15)

    def test_scale_then_mirror_then_transform(self):
        keys = {"scale": 2.0, "mirror": "x", "transform": {"translate": [10, 0, 0]}}
        assert placed([[1, 2, 3]], **keys).tolist() == [[8, 4, 6]]

    def test_a_matrix_may_shear(self):
        matrix = np.eye(4)
        matrix[0, 1] = 2.0
        assert placed([[1, 2, 3]], transform=matrix).tolist() == [[5, 2, 3]]

    @pytest.mark.parametrize(
        ("value", "words"),
        [
            ([[1, 0], [0, 1]], "4 rows of 4"),
            (np.ones((4, 4)).tolist(), "0, 0, 0, 1 in its last row"),
            (np.diag([1, 1, 0, 1]).tolist(), "flat"),
            ({"rotat": [0, 0, 1]}, "did you mean 'rotate'"),
            ({"rotate": [0, 0]}, "rotate"),
        ],
    )
    def test_what_is_no_transform_is_refused(self, value, words):
        with pytest.raises(SceneError, match=rf"bone 'a': transform: .*{words}"):
            Scene("s").add_bone("a", trimesh.creation.box((9, 9, 9)), transform=value)


def test_transformed_bone_is_the_bone_of_a_transformed_file(tmp_path):
    mesh = trimesh.creation.capsule(60.0, 9.0)
    mesh.export(tmp_path / "a.ply", vertex_normal=False)
    read = rm.Scene("s").add_bone("a", tmp_path / "a.ply", transform=TURN).bones[0].mesh
    stored = trimesh.load(tmp_path / "a.ply", process=False)
    there = rm.Scene("s").add_bone("a", stored.apply_transform(TURN)).bones[0].mesh
    assert np.abs(read.vertices - there.vertices).max() < 1e-12
    assert np.array_equal(read.faces, there.faces)


# The mirror image of a turn is about the opposite of the mirrored axis.
IMAGE = [
    *((f'"{name}.ply"', f'"{name}.ply"\nmirror = "z"') for name in ("upper", "fore", "biceps")),
    ("[0, -1, 0]", "[0, 1, 0]"),
]


@pytest.fixture
def pair(tmp_path):
    """The arm, and its mirror image about z = 0."""
    one = arm_files(tmp_path, end=30, step=15)
    text = one.read_text()
    for old, new in IMAGE:
        assert old in text
        text = text.replace(old, new)
    other = tmp_path / "image.toml"
    other.write_text(text)
    return Scene.load(one), Scene.load(other)


class TestMirroredScene:
    def test_meshes_and_attachments_are_those_of_the_files(self, pair):
        one, other = pair
        for mine, image in zip(one.bones + one.muscles, other.bones + other.muscles):
            assert np.array_equal(mine.mesh.vertices * [1, 1, -1], image.mesh.vertices)
            assert image.mesh.volume == pytest.approx(mine.mesh.volume, rel=1e-12)
        for mine, image in zip(one.muscles[0].attachments, other.muscles[0].attachments):
            assert np.array_equal(mine.vertices, image.vertices)

    # The RBF model takes centres and samples in the order of coordinates, and these are mirrored:
    # 2 % of the muscle's thickness is what their choice changes.
    @pytest.mark.parametrize(("model", "tolerance"), [("arap-volume", 1e-9), ("rbf", 0.2)])
    def test_shapes_are_mirrored(self, pair, model, tolerance):
        one, other = (rm.simulate(scene, model=model)["biceps"] for scene in pair)
        mine, image = one.surface(-1), other.surface(-1)
        away = trimesh.proximity.closest_point(mine, image.vertices * [1, 1, -1])[1]
        assert away.max() < tolerance
