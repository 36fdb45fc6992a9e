"""From points to a muscle: the surface is near the one that was sampled, closed, and a scene takes it."""

import json

import numpy as np
import pytest
import trimesh
from command_line import call

from rbfmuscle.implicit.reconstruction import reconstruct_surface
from rbfmuscle.sim.formats.points import read_points
from rbfmuscle.sim.scene.meshes import read_mesh
from rbfmuscle.study.measure.mesh_distance import MeshDistance
from rbfmuscle.validation import MeshError


@pytest.fixture(scope="module")
def spindle():
    """A flat spindle: its mesh, 220 points and their true normals."""
    mesh = trimesh.creation.icosphere(subdivisions=4).apply_scale([30.0, 10.0, 4.0])
    points, faces = trimesh.sample.sample_surface_even(mesh, 220, seed=2)
    return mesh, np.asarray(points), np.asarray(mesh.face_normals[faces])


def apart(mesh, vertices):
    return np.sqrt((MeshDistance(mesh.vertices, mesh.faces).unsigned(vertices) ** 2).mean())


def test_error_without_normals_is_little_more_than_with_the_true_ones(spindle):
    """Twice as much here: on a smooth ellipsoid true normals tell much that the points do not."""
    mesh, points, normals = spindle
    found, known = (
        reconstruct_surface(points, resolution=40),
        reconstruct_surface(points, normals, resolution=40),
    )
    assert np.einsum("ij,ij->i", found.normals, normals).min() > 0.0
    assert apart(mesh, found.vertices) < min(2.5 * apart(mesh, known.vertices), 0.1)
    closed = trimesh.Trimesh(found.vertices, found.faces, process=False)
    assert closed.is_watertight and closed.euler_number == 2 and closed.volume > 0


def test_repeats_are_left_out(spindle):
    _, points, normals = spindle
    found = reconstruct_surface(np.r_[points, points[:5] + 1e-9], np.r_[normals, normals[:5]], resolution=24)
    assert len(found.points) == len(points)


@pytest.mark.parametrize("kind", ["xyz", "npy", "ply", "with normals"])
def test_points_are_read(tmp_path, spindle, kind):
    _, points, normals = spindle
    path = tmp_path / f"cloud.{kind if kind != 'with normals' else 'xyz'}"
    if kind == "npy":
        np.save(path, points)
    elif kind == "ply":
        trimesh.PointCloud(points).export(path)
    elif kind == "xyz":
        path.write_text("# x y z\n" + "\n".join(f"{x:.9g} {y:.9g} {z:.9g}" for x, y, z in points))
    else:
        np.savetxt(path, np.c_[points, 2.0 * normals])
    where, given = read_points(path)
    assert np.abs(where - points).max() < 1e-5
    assert (given is None) is (kind != "with normals")
    assert given is None or np.abs(given - normals).max() < 1e-9


def test_command_makes_a_mesh_that_a_scene_takes(tmp_path, spindle, capsys):
    mesh, points, _ = spindle
    np.savetxt(tmp_path / "scan.xyz", points)
    code, said, _ = call(
        capsys, "surface", tmp_path / "scan.xyz", "-o", tmp_path / "muscle.ply", "--resolution", "32"
    )
    assert code == 0 and "normals found" in said
    read = read_mesh(tmp_path / "muscle.ply")
    assert read.closed and read.mesh.volume == pytest.approx(mesh.volume, rel=0.03)  # 32 cells
    code, said, _ = call(
        capsys, "surface", tmp_path / "scan.xyz", "-o", tmp_path / "m.ply", "--resolution", "24", "--json"
    )
    assert code == 0 and json.loads(said)["points"] == len(points)


def test_wrong_files_are_answered_in_one_line(tmp_path, spindle, capsys):
    with pytest.raises(MeshError, match="no such file"):
        read_points(tmp_path / "nothing.xyz")
    (tmp_path / "a.xyz").write_text("1 2 3\n4 five 6\n")
    with pytest.raises(MeshError, match=r"not readable as points .line 2: .*'five'"):
        read_points(tmp_path / "a.xyz")
    (tmp_path / "c.xyz").write_text("# three\n1 2 3\n\n4 5\n")
    with pytest.raises(MeshError, match="line 4 has 2 numbers, those before it 3"):
        read_points(tmp_path / "c.xyz")
    (tmp_path / "b.xyz").write_text("1 2 3\n4 nan 6\n")
    with pytest.raises(MeshError, match="point 1 is not finite"):
        read_points(tmp_path / "b.xyz")
    np.savetxt(tmp_path / "flat.xyz", np.c_[np.random.default_rng(0).uniform(size=(40, 2)), np.zeros(40)])
    code, _, problem = call(capsys, "surface", tmp_path / "flat.xyz", "-o", tmp_path / "m.ply")
    assert code in (2, 4) and problem.count("\n") == 1 and "flat.xyz" in problem
    trimesh.PointCloud(spindle[1]).export(tmp_path / "cloud.ply")
    with pytest.raises(MeshError, match="rbfmuscle surface"):
        read_mesh(tmp_path / "cloud.ply")
    with pytest.raises(MeshError, match="rbfmuscle surface makes a mesh of points"):
        read_mesh(tmp_path / "a.xyz")
