"""Label volumes: positions, names, surfaces without steps, neighbours that share a face, and files
that are broken.
"""

import gzip
import json

import nibabel
import nrrd
import numpy as np
import pytest
from command_line import call
from conftest import ROOT
from scipy.spatial.transform import Rotation

from rbfmuscle.cli.new import _beside
from rbfmuscle.geometry.crossing import crossing_faces
from rbfmuscle.importers import volumes as surfaces
from rbfmuscle.importers.volumes import (
    LabelVolume,
    label_surface,
    read_labels,
    read_names,
    write_surfaces,
)
from rbfmuscle.validation import MeshError

RADIUS = 20.0


def ball_labels(spacing=(1.0, 1.0, 1.0), centre=(24.3, 25.1, 24.7), split=None):
    """Voxels of a ball of 20 mm; with a plane, its two halves are two labels."""
    counts = [round(50 / s) for s in spacing]
    grid = np.stack(
        np.meshgrid(*[np.arange(n) * s for n, s in zip(counts, spacing)], indexing="ij"), axis=-1
    )
    inside = np.linalg.norm(grid - centre, axis=-1) < RADIUS
    labels = inside.astype(np.int32)
    if split is not None:
        labels[inside & ((grid - centre) @ split > 0)] = 2
    return labels


def write_nifti(path, data, affine, unit="mm"):
    image = nibabel.Nifti1Image(data, affine)
    image.header.set_xyzt_units(unit)
    nibabel.save(image, path)
    return path


@pytest.mark.parametrize("spacing", [(1.0, 1.0, 1.0), (0.8, 0.8, 1.5)])
def test_surface_of_a_ball_is_the_ball(spacing):
    labels = ball_labels(spacing)
    volume = LabelVolume(labels, np.diag([*spacing, 1.0]), {1: "ball"}, "ball.nii")
    surface = label_surface(volume, 1)
    mesh = surface.mesh
    radius = np.linalg.norm(mesh.vertices - (24.3, 25.1, 24.7), axis=1)
    # A quarter of a millimetre is wanted of the leg at voxels of 1; the voxels themselves are 0.3
    # RMS off.
    assert np.sqrt(np.mean((radius - RADIUS) ** 2)) < 0.2
    assert mesh.is_watertight and mesh.euler_number == 2 and mesh.volume > 0
    assert mesh.volume == pytest.approx(surface.volume, rel=5e-3)
    outward = mesh.triangles_center - (24.3, 25.1, 24.7)
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    off = np.degrees(np.arccos(np.clip((mesh.face_normals * outward).sum(axis=1), -1, 1)))
    # Without steps: those of voxels are 31 degrees off RMS and up to 55.
    assert (
        np.sqrt(np.average(off**2, weights=mesh.area_faces)) < 7.0 and np.percentile(off, 99) < 22.0
    )


def test_neighbours_that_share_a_face_neither_overlap_nor_gape():
    direction = np.array([0.6, 0.64, 0.48])
    volume = LabelVolume(ball_labels(split=direction), np.eye(4), {}, "halves.nii")
    centre = np.array([24.3, 25.1, 24.7])
    heights = []
    for label in (1, 2):
        mesh = label_surface(volume, label).mesh
        place = mesh.vertices - centre
        inner = (
            np.linalg.norm(place - np.outer(place @ direction, direction), axis=1) < 0.7 * RADIUS
        )
        flat = inner & (np.abs(place @ direction) < 3.0)
        assert flat.sum() > 50
        heights.append(place[flat] @ direction)
    assert (
        np.abs(np.concatenate(heights)).max() < 1.0 / 3.0
    )  # of a voxel, on either side of the plane


OBLIQUE = Rotation.from_rotvec([0.3, -0.5, 0.4]).as_matrix()


@pytest.mark.parametrize("turn", [np.eye(3), OBLIQUE, OBLIQUE @ np.diag([-1.0, 1, 1])])
def test_directions_and_units_are_honoured(tmp_path, turn):
    labels = ball_labels(split=np.array([0.0, 0.0, 1.0])).astype(np.int16)
    affine = np.eye(4)
    affine[:3, :3], affine[:3, 3] = turn, [100.0, -50.0, 7.0]
    centre = affine[:3, :3] @ [24.3, 25.1, 24.7] + affine[:3, 3]
    files = [write_nifti(tmp_path / "a.nii.gz", labels, affine)]
    metres = affine.copy()
    metres[:3] *= 1e-3
    files.append(write_nifti(tmp_path / "b.nii", labels, metres, unit="meter"))
    spaces = {
        "left-posterior-superior": [-1, -1, 1],
        "left-anterior-superior": [-1, 1, 1],
        "RAS": [1, 1, 1],
    }
    for space, signs in spaces.items():
        there = np.diag(signs) @ affine[:3]
        header = {"space": space, "space directions": there[:, :3].T, "space origin": there[:, 3]}
        files.append(tmp_path / f"{space}.nrrd")
        nrrd.write(str(files[-1]), labels, header)
    for file in files:
        volume = read_labels(file)
        meshes = [label_surface(volume, label).mesh for label in (1, 2)]
        assert all(mesh.volume > 0 for mesh in meshes)
        both = sum(mesh.center_mass * mesh.volume for mesh in meshes) / sum(
            mesh.volume for mesh in meshes
        )
        assert both == pytest.approx(centre, abs=0.05)  # voxels of a ball are not quite symmetric
        above = (meshes[1].center_mass - meshes[0].center_mass) @ affine[:3, 2]
        assert above > 10.0


def test_thin_walls_do_not_go_through_themselves(monkeypatch):
    grid = np.stack(np.meshgrid(*[np.arange(56.0)] * 3, indexing="ij"), axis=-1) - 27.7
    x, y, z = np.moveaxis(grid, -1, 0)
    wall = (np.abs(z - 6.0 * np.sin(x / 5.0) * np.cos(y / 6.0)) < 1.105) & (np.hypot(x, y) < 22.0)
    volume = LabelVolume(wall.astype(np.int32), np.eye(4), {}, "wall.nii")
    surface = label_surface(volume, 1)
    mesh = surface.mesh
    assert mesh.is_watertight and mesh.euler_number == 2
    assert not any("triangles" in note for note in surface.notes)
    assert not crossing_faces(mesh.vertices, mesh.faces).any()
    assert mesh.volume == pytest.approx(wall.sum(), rel=5e-3)
    monkeypatch.setattr(surfaces, "UNTANGLE", 1)
    mesh = label_surface(volume, 1).mesh
    assert crossing_faces(mesh.vertices, mesh.faces).sum() > 0
    assert any("triangles go through others" in note for note in label_surface(volume, 1).notes)


def test_islands_and_holes_are_left_out_and_told():
    labels = ball_labels()
    labels[1:3, 1:3, 1:3], labels[22:26, 22:26, 22:26] = 1, 0
    surface = label_surface(LabelVolume(labels, np.eye(4), {}, "x.nii"), 1)
    island, hole = surface.notes
    assert (
        "1 islands of 8 voxels" in island and "64 voxels" in hole and surface.mesh.euler_number == 2
    )


def boxes(*corners, size=(12, 12, 22)):
    labels = np.zeros((60, 60, 60), np.uint8)
    for x, y, z in corners:
        labels[x : x + size[0], y : y + size[1], z : z + size[2]] = 1
    return labels


def test_label_that_is_thin_for_its_voxels_is_drawn_whole_or_says_its_share():
    """One voxel of thickness, a bar of one voxel between two boxes, and boxes that touch at an edge
    or a corner alone.
    """
    sheet, bridge = boxes((24, 14, 8), size=(1, 30, 40)), boxes((22, 18, 6), (22, 18, 33))
    bridge[27, 23, 28:33] = 1
    edge = boxes((22, 18, 6), (34, 30, 6))
    corner = boxes((22, 18, 6), (34, 30, 28))
    for labels, share in ((sheet, 1.0), (bridge, 1.0), (edge, 1.0), (corner, 0.5)):
        surface = label_surface(LabelVolume(labels, np.eye(4), {}, "x.nii"), 1)
        assert surface.mesh.is_volume and surface.mesh.body_count == 1
        assert surface.mesh.volume == pytest.approx(share * labels.sum(), rel=0.05)
        size = np.ptp(np.argwhere(labels), axis=0) + 1
        assert (surface.mesh.extents < size + 2).all()
    assert surface.notes == ["1 islands of 3168 voxels left out (50 %)"]


def test_unusable_labels_are_named_with_their_volume_and_reason(tmp_path, capsys):
    labels = boxes((22, 18, 6)).astype(np.int16)
    labels[40:44, 40:44, 5:45] = 2
    labels[5, 5, 5:20] = 3
    path = write_nifti(tmp_path / "leg.nii.gz", labels, np.eye(4))
    (tmp_path / "names.csv").write_text("1,femur\n2,pelvis\n3,gluteus_medius\n")
    code, _, said = call(capsys, "new", path, "--labels", tmp_path / "names.csv")
    assert code == 2
    assert "leg.nii.gz holds no muscle" in said and "'gluteus_medius' has 15 voxels" in said
    assert ".rbfmuscle" not in said


def test_names_from_files_header_and_tables(tmp_path):
    labels = ball_labels(split=np.array([1.0, 0, 0])).astype(np.int16)
    for value, name in ((1, "soleus"), (2, "tibia")):
        write_nifti(tmp_path / f"{name}.nii.gz", (labels == value).astype(np.uint8), np.eye(4))
    volume = read_labels(tmp_path)
    assert sorted(volume.names.values()) == ["soleus", "tibia"] and len(volume.values()) == 2
    header = {
        "space": "left-posterior-superior",
        "space directions": np.eye(3),
        "space origin": np.zeros(3),
    }
    header |= {"Segment0_Name": "femur", "Segment0_LabelValue": "2"}
    header |= {"Segment1_Name": "soleus", "Segment1_LabelValue": "1"}
    nrrd.write(str(tmp_path / "s.seg.nrrd"), labels, header)
    assert read_labels(tmp_path / "s.seg.nrrd").names == {2: "femur", 1: "soleus"}
    (tmp_path / "n.json").write_text(json.dumps({"1": "soleus", "2": "tibia"}))
    (tmp_path / "n.csv").write_text("1,soleus\n2,tibia\n")
    (tmp_path / "n.txt").write_text('# snap\n1 255 0 0 1 1 1 "soleus"\n2 0 255 0 1 1 1 "tibia"\n')
    for name in ("n.json", "n.csv", "n.txt"):
        assert read_names(tmp_path / name) == {1: "soleus", 2: "tibia"}


def _hostile(tmp_path):
    good = ball_labels(split=np.array([1.0, 0, 0])).astype(np.int16)
    eye = np.eye(4)
    yield write_nifti(tmp_path / "nan.nii", np.where(good > 0, np.nan, 0.0), eye), "not finite"
    yield write_nifti(tmp_path / "one.nii", (good > 0).astype(np.int16), eye), "only one label"
    yield write_nifti(tmp_path / "empty.nii", np.zeros_like(good), eye), "no voxel has a label"
    yield write_nifti(tmp_path / "four.nii", np.stack([good, good], axis=-1), eye), "three axes"
    data = bytearray(write_nifti(tmp_path / "zero.nii", good, eye).read_bytes())
    data[280:296] = bytes(16)  # the first row of the affine
    (tmp_path / "zero.nii").write_bytes(data)
    yield tmp_path / "zero.nii", "voxel"
    yield write_nifti(tmp_path / "metres.nii", good, np.diag([1e-3, 1e-3, 1e-3, 1])), "metres"
    yield write_nifti(tmp_path / "image.nii", good + 0.5, eye), "between whole numbers"
    many = np.arange(13**3, dtype=np.int16).reshape(13, 13, 13)
    yield write_nifti(tmp_path / "many.nii", many, eye), "at most 512"
    write_nifti(tmp_path / "whole.nii.gz", good, eye)
    data = (tmp_path / "whole.nii.gz").read_bytes()
    (tmp_path / "cut.nii.gz").write_bytes(data[: len(data) // 2])
    yield tmp_path / "cut.nii.gz", "no readable NIfTI"
    (tmp_path / "garbage.nii").write_bytes(b"\x01" * 400)
    yield tmp_path / "garbage.nii", "no readable NIfTI"
    (tmp_path / "garbage.nrrd").write_bytes(b"NRRD0004\n\n" + gzip.compress(b"x"))
    yield tmp_path / "garbage.nrrd", "no readable NRRD"
    write_nifti(tmp_path / "swapped.nii", good.astype(">i2").view("<i2"), eye)
    yield tmp_path / "swapped.nii", "swapped"


def test_hostile_volumes_end_in_one_line_and_code_4(tmp_path, capsys):
    for path, words in _hostile(tmp_path):
        code, out, err = call(capsys, "new", path, "-o", tmp_path / "out")
        assert code == 4 and out == "", (path.name, err)
        assert len(err.strip().splitlines()) == 1 and path.name in err and words in err, (
            path.name,
            err,
        )


def test_a_volume_larger_than_the_limit_is_refused_unread(tmp_path):
    header = nibabel.Nifti1Header()
    header.set_data_dtype(np.int32)
    header.set_data_shape((4000, 4000, 4000))
    with (tmp_path / "huge.nii").open("wb") as file:
        header.write_to(file)
    with pytest.raises(MeshError, match="bytes unpacked, at most"):
        read_labels(tmp_path / "huge.nii")


def test_scene_of_a_segmentation_lies_beside_it_and_is_in_its_unit(tmp_path, capsys):
    file = write_nifti(tmp_path / "a.nii.gz", np.ones((3, 3, 3), np.int16), np.eye(4))
    assert [_beside(file), _beside(tmp_path)] == [tmp_path / "a_scene", tmp_path / "scene"]
    for words, said in (
        ((file, "--units", "m"), "says its unit"),
        ((ROOT, "--labels", file), "folder of meshes"),
    ):
        code, _, err = call(capsys, "new", *words)
        assert code == 2 and said in err


def test_labels_of_one_name_are_each_a_mesh(tmp_path):
    labels = ball_labels(split=np.array([1.0, 0, 0])).astype(np.int16)
    labels[np.diff(labels, axis=1, prepend=0) > 0] = 0
    labels[:, :13][labels[:, :13] == 2] = 3
    # File names that differ in case alone are one on some systems.
    names = {1: "soleus_3", 2: "soleus", 3: "Soleus"}
    write_surfaces(LabelVolume(labels, np.eye(4), names, "a.nii"), tmp_path)
    found = sorted(path.name for path in (tmp_path / "meshes").iterdir())
    assert found == ["Soleus_2.ply", "soleus.ply", "soleus_3.ply"]
