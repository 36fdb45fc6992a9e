"""Bones of several shells: for contact a bone is solid to its outer surface, one side for all."""

import numpy as np
import pytest
import trimesh
from conftest import samples

from rbfmuscle.bones.sdf import BoneSDF
from rbfmuscle.geometry.solids import outer_surface
from rbfmuscle.scene.bone import Bone, BoneDistance
from rbfmuscle.scene.meshes.read import prepare_mesh

FACETING = 0.05  # a ball of radius 20 with 2562 vertices lies up to 0.024 inside the sphere
ASKED = np.array([[0.0, 0, 0], [13, 0, 0], [0, 11, 0], [0, -25, 0], [0, 0, -13]])
RIGHT = np.array([-20.0, -7, -9, 5, -7])


def ball(radius, centre=(0, 0, 0), *, inward=False, level=4):
    mesh = trimesh.creation.icosphere(level, radius)
    mesh.apply_translation(centre)
    if inward:
        mesh.invert()
    return mesh


def together(*shells):
    return trimesh.util.concatenate(shells)


def sharing_a_vertex():
    """An inner shell that ends in a vertex of the outer one, merged as files have it."""
    outer, inner = ball(20), ball(12, (0, 0, 8))
    inner.vertices[np.argmax(inner.vertices[:, 2])] = outer.vertices[
        np.argmax(outer.vertices[:, 2])
    ]
    both = together(outer, inner)
    both.merge_vertices()
    return both


def open_inside():
    """An outer shell about half of an inner one."""
    half = ball(12)
    half.update_faces(half.triangles_center[:, 0] < 6)
    return together(ball(20), half)


def soup():
    """Two balls that overlap, each triangle with vertices of its own."""
    mesh = together(ball(20), ball(12, (0, 0, 15)))
    return trimesh.Trimesh(
        mesh.triangles.reshape(-1, 3), np.arange(3 * len(mesh.faces)).reshape(-1, 3), process=False
    )


SHELLS = {
    "hole": together(ball(20), ball(12, inward=True)),
    "outward": together(ball(20), ball(12)),
    "all inward": together(ball(20, inward=True), ball(12, inward=True)),
    "inner first": together(ball(12, inward=True), ball(20)),
    "touching": together(ball(20), ball(12, (0, 0, 7.999), inward=True)),
    "sharing a vertex": sharing_a_vertex(),
    "four deep": together(ball(20), ball(16, inward=True), ball(12), ball(6, level=3)),
    "open inside": open_inside(),
    "overlapping": together(ball(20), ball(12, (0, 0, 15), inward=True), ball(5, level=3)),
    "soup": soup(),
}


@pytest.mark.parametrize("kind", SHELLS)
def test_a_bone_is_solid_to_its_outer_surface_for_all(kind):
    mesh = SHELLS[kind]
    field = BoneSDF.from_mesh(mesh)
    bone, probe = Bone("femur", mesh), BoneDistance("femur", mesh)
    for distance in (bone.distances, probe.signed, field.distance):
        np.testing.assert_allclose(distance(ASKED), RIGHT, atol=FACETING)
    points = np.random.default_rng(0).uniform(-28, 28, (samples(5000), 3))
    inside = bone.distances(points) < 0
    np.testing.assert_array_equal(probe.inside(points), inside)
    np.testing.assert_array_equal(bone.nearest(points)[0] < 0, inside)
    np.testing.assert_array_equal(field.distance(points) < 0, inside)


def test_what_is_ignored_or_joined_is_said_and_beside_stays():
    sesamoid = ball(5, (0, 40, 0), level=3)
    for shells, words in (
        ((ball(20), ball(12, inward=True)), "2 nested shells, the inner one is ignored"),
        ((ball(20), ball(12), ball(6)), "3 nested shells, the 2 inner ones are ignored"),
        ((ball(20), ball(12), sesamoid), "3 shells, the inner one is ignored"),
        ((ball(20), ball(12, (0, 0, 15))), "2 parts overlap, joined"),
    ):
        mesh = together(*shells)
        read = prepare_mesh(mesh.vertices, mesh.faces, context="a", name="b", may_be_open=True)
        assert any(words in note for note in read.notes), read.notes
    beside = together(ball(20), ball(12, inward=True), sesamoid)
    read = prepare_mesh(beside.vertices, beside.faces, context="a", name="b", may_be_open=True)
    assert read.mesh.volume == pytest.approx(ball(20).volume + sesamoid.volume, rel=1e-9)
    assert Bone("foot", read.mesh).distances([[0, 40, 0]]) == pytest.approx(-5, abs=FACETING)


def test_union_of_overlapping_parts_has_the_volume_of_two_balls_less_their_lens():
    away, radius = 15.0, 20.0
    mesh = together(ball(radius, level=5), ball(radius, (away, 0, 0), level=5))
    vertices, faces, _ = outer_surface(mesh.vertices, mesh.faces)
    union = trimesh.Trimesh(vertices, faces, process=False)
    lens = np.pi / 12 * (4 * radius + away) * (2 * radius - away) ** 2
    assert union.is_watertight
    # 10242 vertices: the balls hold 0.06 % less than spheres.
    assert union.volume == pytest.approx(2 * 4 / 3 * np.pi * radius**3 - lens, rel=2e-3)


def test_one_shell_and_its_vertices_stay_as_they_are():
    mesh = ball(20)
    vertices, faces, notes = outer_surface(mesh.vertices, mesh.faces)
    np.testing.assert_array_equal(vertices, mesh.vertices)
    np.testing.assert_array_equal(faces, mesh.faces)
    assert notes == []
