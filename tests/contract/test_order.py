"""Shapes depend on what a scene holds, not on the order in which it is written."""

from dataclasses import replace

import numpy as np
import pytest
import pyvista
import trimesh
from toy_scene import held

import rbfmuscle as rm
from rbfmuscle.geometry.frames import RestFrame, numbered_by_place
from rbfmuscle.geometry.lines import fibre_directions
from rbfmuscle.models import build_model
from rbfmuscle.scene.bone import Bone
from rbfmuscle.scene.joints import rotation_about
from rbfmuscle.scene.muscles import attachment_ends, ordered_muscle
from rbfmuscle.scene.objects import Attachment, Motion

pytestmark = pytest.mark.numeric


def renumbered(mesh, rng):
    """A mesh with its vertices, faces and corners in another order, and the new number of each
    vertex.
    """
    order = rng.permutation(len(mesh.vertices))
    place = np.argsort(order)
    faces = place[np.asarray(mesh.faces)]
    first = rng.integers(0, 3, (len(faces), 1))
    faces = np.take_along_axis(faces, (first + np.arange(3)) % 3, axis=1)
    faces = faces[rng.permutation(len(faces))]
    return trimesh.Trimesh(np.asarray(mesh.vertices)[order], faces, process=False), place


def three_bones():
    """Two muscles without any symmetry over a ball, each held by three bones."""
    scene = rm.Scene("elbow")
    scene.add_bone("trunk", trimesh.creation.icosphere(subdivisions=3, radius=15.0))
    for name, x in (("arm", 60.0), ("hand", 75.0)):
        box = trimesh.creation.box((10.0, 6.0, 30.0)).subdivide().subdivide()
        scene.add_bone(name, box.apply_translation([x, 20.0, 0.0]))
    scene.add_joint("hinge", "trunk", "arm", np.zeros(3), {"bend": [0, 0, -1]})
    scene.add_joint("wrist", "arm", "hand", np.array([68.0, 20, 0]), {"bend": [0, 0, -1]})
    for name, side in (("left", -1.0), ("right", 1.0)):
        mesh = trimesh.creation.icosphere(subdivisions=3).apply_scale([50.0, 7.0, 6.0])
        x, y, z = np.array(mesh.vertices).T
        bumps = np.stack(
            [0.1 * y + 0.002 * x**2, 0.01 * x + 0.05 * z, 0.1 * np.sin(x / 20.0) * y], axis=1
        )
        mesh.vertices = mesh.vertices + bumps + [0.0, 24.0, side * 8.0]
        ends = held(trunk=x < -40, arm=(x > 36) & (x < 43), hand=x >= 43)
        scene.add_muscle(name, mesh, attach=ends)
    scene.motion = Motion([{"hinge.bend": np.radians(a), "wrist.bend": 0.1} for a in (0, 6)])
    return scene


def shuffled(scene):
    """The same scene with everything in it in another order, and the vertices' new numbers by
    muscle.
    """
    rng = np.random.default_rng(5)
    other = scene.with_options()
    places = {}
    other.bones = [Bone(b.name, renumbered(b.mesh, rng)[0]) for b in reversed(scene.bones)]
    other.joints, other.muscles = scene.joints[::-1], other.muscles[::-1]
    for muscle in other.muscles:
        muscle.mesh, place = renumbered(muscle.mesh, rng)
        places[muscle.name] = place
        muscle.attachments = [
            replace(a, vertices=rng.permutation(place[a.vertices]))
            for a in muscle.attachments[::-1]
        ]
    return other, places


@pytest.mark.parametrize("model", ["rbf", "arap-volume"])
def test_shapes_and_arrays_of_files_do_not_depend_on_the_order_of_anything(model, tmp_path):
    scene = three_bones()
    other, places = shuffled(scene)
    runs, files = [], []
    for number, given in enumerate((scene, other)):
        run = rm.simulate(given, model)
        run.save(tmp_path / f"{number}", pictures=False)
        run.export(tmp_path / f"{number} exported", ["pvd"])
        runs.append(run)
        files.append([tmp_path / f"{number}/surfaces", tmp_path / f"{number} exported/pvd"])
    for name, place in places.items():
        # Surfaces keep the numbers of the input mesh.
        one, two = (run.frames[-1].surfaces[name].vertices for run in runs)
        size = np.ptp(one, axis=0).max()
        assert np.abs(one - two[place]).max() < 1e-9 * size
        for folder, again in zip(*files):
            for file in sorted(folder.glob(f"{name}_*.vtp")):
                first, second = pyvista.read(file), pyvista.read(again / file.name)
                assert first.point_data.keys() == second.point_data.keys()
                assert {"stretch", "bone_distance", "group"} <= set(first.point_data)
                for key, values in first.point_data.items():
                    # Of single precision; normals are sums over faces in another order.
                    scale = max(np.abs(values).max(), 1e-3)
                    assert np.abs(values - second.point_data[key][place]).max() < 1e-5 * scale, key
        assert file.name.endswith("0001.vtp")


def test_numbering_by_place_is_that_of_any_numbering_and_pose():
    mesh = three_bones().muscles[0].mesh
    other, _ = renumbered(mesh, np.random.default_rng(1))
    turn = rotation_about([1, 2, 3], 1.1, np.zeros(3))[:3, :3]
    places = []
    for vertices, faces in (
        (mesh.vertices, mesh.faces),
        (other.vertices, other.faces),
        (1e-3 * np.asarray(mesh.vertices) @ turn.T + 5.0, mesh.faces),
    ):
        order, ordered = numbered_by_place(np.asarray(vertices), np.asarray(faces))
        places.append((RestFrame(np.asarray(vertices)).local[order], ordered))
    for local, ordered in places[1:]:
        np.testing.assert_allclose(local, places[0][0], atol=2e-8)  # what is rounded to 1e-8
        np.testing.assert_array_equal(ordered, places[0][1])


def test_ends_are_the_bodies_farthest_apart_in_any_order():
    scene = three_bones()
    muscle, order = ordered_muscle(scene.muscles[0])
    np.testing.assert_array_equal(muscle.mesh.vertices, scene.muscles[0].mesh.vertices[order])
    for attachments in (muscle.attachments, muscle.attachments[::-1]):
        ends = attachment_ends(replace(muscle, attachments=attachments), scene.joints)
        bones = {frozenset(a.bone for a in end) for end in ends}
        assert bones == {frozenset({"trunk"}), frozenset({"arm", "hand"})}
    assert attachment_ends(replace(muscle, attachments=attachments[:1]), scene.joints) is None
    # On one body each attachment stands for itself.
    x = np.asarray(muscle.mesh.vertices)[:, 0]
    both = [Attachment("trunk", np.flatnonzero(where)) for where in (x < -40, x > 40)]
    first, last = attachment_ends(replace(muscle, attachments=both), scene.joints)
    assert {x[first[0].vertices].max() < 0, x[last[0].vertices].max() < 0} == {True, False}


@pytest.mark.parametrize("model", ["rbf", "pbd"])
def test_fibres_run_from_end_to_end_whatever_bones_lie_there(model):
    scene = three_bones()
    part = build_model(scene.muscles[0], scene, model)
    points, found = (
        (part.model.cells.points, part.model.fibres.direction)
        if model == "rbf"
        else (part.rest.vertices, part.rest.fibres)
    )
    belly = np.abs(points[:, 0]) < 25.0
    # By the rank of three bones they would turn about the second one's patch.
    assert np.abs(found[belly, 0]).min() > 0.8


def test_fibres_follow_lines_of_any_sense_and_the_fallback_where_there_is_no_direction():
    points = np.array([[0.0, 0, 0], [1.0, 0, 0], [9.0, 0, 0]])
    along = np.array([[0.0, 2.0, 0], [0.0, 0, 0], [0, 0, -1e-12]])
    unit = fibre_directions(points, along, None)
    assert unit.tolist() == [[0, 1, 0], [0, 0, 0], [0, 0, 0]]
    unit = fibre_directions(points, along, None, fallback=np.array([3.0, 0, 0]))
    assert unit.tolist() == [[0, 1, 0], [1, 0, 0], [1, 0, 0]]
    line = np.array([[0.0, 0, 0], [5, 0, 0], [10, 0, 0]])
    for lines in ([line], [line[:2], line[:0:-1]]):
        assert np.abs(fibre_directions(points, along, lines)[:, 0]).tolist() == [1, 1, 1]
