"""Label volumes as other programs write them: overlaps, layers, floating point, no directions."""

import nibabel
import nrrd
import numpy as np
import pytest
from command_line import call

from rbfmuscle.importers.guess.guess import guess_scene
from rbfmuscle.importers.volumes import (
    LAYER,
    LabelVolume,
    label_surface,
    read_labels,
    read_names,
    write_surfaces,
)
from rbfmuscle.validation import MeshError, UsageError

SHAPE = (30, 26, 40)
SPACING = 2.0


def ball(centre, radius):
    grid = np.stack(np.indices(SHAPE), axis=-1)
    return np.linalg.norm(grid - np.array(centre), axis=-1) < radius


NRRD_HEAD = {
    "space": "right-anterior-superior",
    "space directions": np.diag([SPACING] * 3),
    "space origin": np.zeros(3),
}
FEMUR = ball((14, 12, 8), 6.2)
PELVIS = ball((14, 12, 28), 7.2)
MUSCLE = ball((14, 12, 18), 7.6)


def write_nifti(path, data, *, codes=(0, 2), unit="mm", slope=None):
    path.parent.mkdir(parents=True, exist_ok=True)
    image = nibabel.Nifti1Image(data, np.diag([SPACING, SPACING, SPACING, 1.0]))
    image.set_qform(image.affine if codes[0] else None, codes[0])
    image.set_sform(image.affine if codes[1] else None, codes[1])
    image.header.set_xyzt_units(unit)
    if slope:
        image.header.set_slope_inter(slope, 0.0)
    nibabel.save(image, path)
    return path


def write_masks(folder, masks):
    for name, mask in masks.items():
        write_nifti(folder / f"{name}.nii.gz", mask.astype(np.uint8))
    return folder


def by_name(volume):
    return {volume.name(label): volume.mask(label) for label in volume.values().tolist()}


def test_masks_that_overlap_are_kept_whole_and_their_overlap_is_said(tmp_path):
    masks = {"femur": FEMUR, "gluteus_maximus": MUSCLE, "pelvis": PELVIS, "soleus": MUSCLE & FEMUR}
    volume = read_labels(write_masks(tmp_path / "m", masks))
    found = by_name(volume)
    assert found.keys() == masks.keys()
    for name, mask in masks.items():
        np.testing.assert_array_equal(found[name], mask)
    count, least = int((MUSCLE & PELVIS).sum()), int(min(MUSCLE.sum(), PELVIS.sum()))
    share = f"{100 * count / least:.3g} %"
    said = [note for note in volume.notes if "gluteus_maximus" in note and "pelvis" in note]
    assert len(said) == 1 and f"in {count} voxels ({share}" in said[0] and "both kept" in said[0]
    for label in volume.values().tolist():
        surface = label_surface(volume, label)
        # Voxels of a small ball are coarse: a hundredth of the volume.
        assert surface.mesh.volume == pytest.approx(
            masks[surface.name].sum() * SPACING**3, rel=1e-2
        )


@pytest.mark.parametrize("place", [0, 3])
def test_layers_of_segments_are_read_with_names_and_empty_ones_are_named(tmp_path, place):
    layers = np.zeros((2, *SHAPE), np.uint8)
    layers[0][FEMUR] = 1
    layers[0][PELVIS] = 2
    layers[1][MUSCLE] = 1
    rows = [*(SPACING * np.eye(3)).tolist()]
    rows.insert(place, [np.nan] * 3)
    kinds = ["domain"] * 3
    kinds.insert(place, "list")
    header = {
        "space": "right-anterior-superior",
        "space directions": np.array(rows),
        "space origin": [5.0, 6, 7],
        "kinds": kinds,
    }
    for k, (name, layer, value) in enumerate(
        [("femur", 0, 1), ("pelvis", 0, 2), ("gluteus_maximus", 1, 1), ("sartorius", 1, 2)]
    ):
        header |= {f"Segment{k}_Name": name, f"Segment{k}_Layer": str(layer)}
        header |= {f"Segment{k}_LabelValue": str(value)}
    file = tmp_path / "s.seg.nrrd"
    nrrd.write(str(file), np.moveaxis(layers, 0, place), header)
    volume = read_labels(file)
    found = by_name(volume)
    for name, mask in {"femur": FEMUR, "pelvis": PELVIS, "gluteus_maximus": MUSCLE}.items():
        np.testing.assert_array_equal(found[name], mask)
    assert volume.affine[:3, 3].tolist() == [5, 6, 7]
    assert "1 named labels have no voxel: sartorius" in volume.notes
    assert any("gluteus_maximus" in note and "overlap" in note for note in volume.notes)


@pytest.mark.parametrize(
    ("values", "kind", "slope"),
    [
        ((3.0000458, 5.9999995, 9.00002), np.float32, None),
        ((2.9999542, 5.9998, 9.0), np.float64, None),
        ((30, 60, 90), np.int16, 0.1),
    ],
)
def test_labels_in_floating_point_are_rounded_not_cut(tmp_path, values, kind, slope):
    data = np.zeros(SHAPE, kind)
    for mask, value in zip((MUSCLE, FEMUR, PELVIS), values):
        data[mask] = value
    volume = read_labels(write_nifti(tmp_path / "a.nii.gz", data, slope=slope))
    assert volume.values().tolist() == [3, 6, 9]
    np.testing.assert_array_equal(volume.mask(6), FEMUR & ~PELVIS)
    assert any("rounded" in note for note in volume.notes)


def test_values_between_labels_are_refused_with_one_of_them(tmp_path):
    data = np.where(PELVIS, 9.0, 3.0 * FEMUR)
    data[14, 12, 8] = 1.5
    with pytest.raises(MeshError, match=r"1 voxels between whole numbers, as 1\.5;"):
        read_labels(write_nifti(tmp_path / "a.nii", data))


def test_no_directions_are_said_and_both_formats_are_taken_alike(tmp_path):
    data = np.where(PELVIS, 2, FEMUR).astype(np.int16)
    data[ball((22, 18, 28), 4)] = 3  # without a mirror plane
    plain = write_nifti(tmp_path / "a.nii.gz", data, codes=(0, 0), unit="unknown")
    nrrd.write(str(tmp_path / "b.nrrd"), data, {"spacings": [SPACING] * 3})
    volumes = [read_labels(plain), read_labels(tmp_path / "b.nrrd")]
    np.testing.assert_allclose(volumes[0].affine, volumes[1].affine)
    np.testing.assert_allclose(volumes[0].affine, np.diag([SPACING, SPACING, SPACING, 1]))
    for volume in volumes:
        assert not volume.directed
        assert any("states no directions" in note and "RAS" in note for note in volume.notes)
        assert any("no unit of length: mm" in note for note in volume.notes)
    stated = read_labels(write_nifti(tmp_path / "c.nii.gz", data))
    assert stated.directed and stated.notes == []


def test_empty_masks_are_counted_and_named_and_the_scene_and_check_repeat_it(tmp_path, capsys):
    masks = {"femur_right": FEMUR, "hip_right": PELVIS, "gluteus_maximus_right": MUSCLE}
    none = {f"{name}_left": np.zeros(SHAPE, bool) for name in ("femur", "hip")}
    folder = write_masks(tmp_path / "masks", masks | none)
    for name in masks:
        image = nibabel.load(folder / f"{name}.nii.gz")
        write_nifti(folder / f"{name}.nii.gz", np.asarray(image.dataobj), unit="unknown")
    code, out, _ = call(capsys, "new", folder, "-o", tmp_path / "o")
    words = "2 of 5 masks are empty: femur_left, hip_left"
    assert code == 0 and out.count(words) == 1
    scene = (tmp_path / "o" / "scene.toml").read_text()
    assert words in scene and "surfaces of masks, in its frame: right, forward, up (RAS)" in scene
    _, out, _ = call(capsys, "check", tmp_path / "o" / "scene.toml")
    assert words in out and "no unit of length: mm taken" in out


def test_what_lies_in_a_folder_of_masks_and_is_none_is_said_or_refused(tmp_path):
    folder = write_masks(tmp_path, {"femur": FEMUR, "pelvis": PELVIS})
    (folder / "._femur.nii.gz").write_bytes(b"what one system leaves for another")
    write_nifti(folder / "whole.nii.gz", (FEMUR + 2 * PELVIS).astype(np.uint8))
    volume = read_labels(folder)
    assert by_name(volume).keys() == {"femur", "pelvis", "whole"}
    assert "hidden files are not read: ._femur.nii.gz" in volume.notes
    assert "whole.nii.gz has 2 labels and is taken for one mask of them all" in volume.notes
    write_nifti(folder / "ct.nii.gz", np.where(FEMUR, 900, -1000).astype(np.int16))
    with pytest.raises(MeshError, match=r"ct.nii.gz: labels from -1000 to 900, .* take it out"):
        read_labels(folder)


def test_two_labels_of_one_name_have_two_names_and_that_is_said(tmp_path):
    folder = write_masks(tmp_path / "m", {"femur": FEMUR, "pelvis": PELVIS})
    nrrd.write(str(folder / "femur.nrrd"), FEMUR.astype(np.uint8), NRRD_HEAD)
    meshes, _, notes, _ = write_surfaces(read_labels(folder), tmp_path)
    assert {file.stem for file in meshes.iterdir()} == {"femur", "femur_2", "pelvis"}
    assert "several labels are named femur: one of them is femur_2 here" in notes


def test_a_header_beside_its_voxels_is_read_and_lost_voxels_are_said(tmp_path):
    nrrd.write(str(tmp_path / "labels.nhdr"), (FEMUR + 2 * PELVIS).astype(np.uint8), NRRD_HEAD)
    volume = read_labels(tmp_path / "labels.nhdr")
    np.testing.assert_array_equal(volume.mask(1), FEMUR)
    (tmp_path / "labels.raw.gz").unlink()
    with pytest.raises(MeshError, match="no readable NRRD volume"):
        read_labels(tmp_path / "labels.nhdr")


def test_a_volume_with_two_places_says_which_counts(tmp_path):
    path = write_nifti(tmp_path / "labels.nii.gz", (FEMUR + 2 * PELVIS).astype(np.uint8))
    assert not read_labels(path).notes
    image = nibabel.load(path)
    moved = image.affine.copy()
    moved[:3, 3] += 3.0, 0.0, 4.0
    image.set_qform(moved, 1)
    nibabel.save(image, tmp_path / "two.nii.gz")
    volume = read_labels(tmp_path / "two.nii.gz")
    np.testing.assert_allclose(volume.affine, np.diag([SPACING, SPACING, SPACING, 1.0]))
    assert volume.notes == ["its sform counts, from which its qform is up to 5 mm off"]


def test_voxels_that_are_no_numbers_are_counted(tmp_path):
    labels = FEMUR + 2.0 * PELVIS
    labels[labels == 0.0] = np.nan
    path = write_nifti(tmp_path / "labels.nii.gz", labels.astype(np.float32))
    count = f"{int(np.isnan(labels).sum()):,} of {labels.size:,} voxels are not finite"
    with pytest.raises(MeshError, match=count):
        read_labels(path)


def test_holes_that_hold_other_labels_stay_and_others_are_filled():
    labels = ball((14, 12, 20), 10).astype(np.uint16)
    labels[ball((14, 12, 24), 3)] = 2
    labels[13:15, 11:13, 14:16] = 0
    inner, own = int((labels == 2).sum()), int((labels == 1).sum())
    surface = label_surface(LabelVolume(labels, np.eye(4), {}, "x.nii"), 1, pieces=True)
    assert "holes of 8 voxels filled" in surface.notes
    assert f"holes of {inner} voxels hold other labels and stay" in surface.notes
    assert surface.mesh.volume == pytest.approx(own + 8, rel=1e-2)


def test_a_label_cut_off_by_the_scan_has_a_cap_that_is_said_and_holds_nothing(tmp_path):
    k = np.indices(SHAPE)[2]
    belly = (np.hypot(*(np.indices(SHAPE)[:2] - np.array([14, 12])[:, None, None, None])) < 5.2) & (
        k < 25
    )
    surface = label_surface(LabelVolume(belly.astype(np.uint16), np.eye(4), {}, "x.nii"), 1)
    assert any("cut off where the scan ends" in note for note in surface.notes)
    assert surface.mesh.is_watertight
    low = surface.mesh.vertices[:, 2] < 0.2
    assert surface.capped[low].all() and not surface.capped[surface.mesh.vertices[:, 2] > 2].any()
    whole = label_surface(LabelVolume(MUSCLE.astype(np.uint16), np.eye(4), {}, "x.nii"), 1)
    assert not whole.capped.any() and whole.notes == []
    # A label that only touches the end is round there.
    touching = ball((14, 12, 7), 7.4).astype(np.uint16)
    assert label_surface(LabelVolume(touching, np.eye(4), {}, "x.nii"), 1).notes == []


def test_nothing_is_attached_where_the_scan_ends(tmp_path):
    i, j, k = np.indices(SHAPE)
    round_ = np.hypot(i - 9, j - 12)
    labels = np.zeros(SHAPE, np.uint16)
    labels[(round_ < 4.2) & (k < 18)] = 1
    labels[(round_ < 5.2) & (k > 20)] = 2
    labels[(np.hypot(i - 18, j - 12) < 4.2) & (k < 36)] = 3  # cut off beside the femur's own end
    source = write_nifti(tmp_path / "a.nii", labels)
    (tmp_path / "n.csv").write_text("1,femur\n2,pelvis\n3,gluteus_maximus\n")
    volume = read_labels(source, names=tmp_path / "n.csv")
    folder, capped, notes, _ = write_surfaces(volume, tmp_path)
    assert any("gluteus_maximus: cut off where the scan ends" in note for note in notes)
    on_cap = np.flatnonzero(capped["gluteus_maximus"])
    assert len(on_cap) > 8
    for caps in (None, capped):
        guess = guess_scene(folder, "mm", tmp_path, capped=caps)
        held = [np.isin(hold.vertices, on_cap).sum() for hold in guess.muscles[0].holds]
        assert (sum(held) > 0) == (caps is None)


def test_a_layer_is_a_label_of_its_own():
    layers = np.zeros((2, *SHAPE), np.uint16)
    layers[0][FEMUR], layers[1][FEMUR] = 4, 4
    volume = LabelVolume(layers, np.eye(4), {}, "x.nrrd")
    assert volume.values().tolist() == [4, 4 + LAYER]
    assert [volume.name(label) for label in volume.values()] == ["label_4", "label_4_layer_2"]


QUOTED = '"{}","{}"\n'


@pytest.mark.parametrize(
    ("name", "line"),
    [
        ("excel.csv", "{};{}\n"),
        ("quoted.csv", QUOTED),
        ("numbers.csv", "{}.0,{},1,2\n"),
        ("columns.txt", "  {}  {}   128 174 128 255\n"),
        ("slicer.ctbl", "{} {} 241 214 145 255\n"),
        ("tab.tsv", "{}\t{}\t0\n"),
    ],
)
@pytest.mark.parametrize("coding", ["utf-8", "utf-8-sig", "utf-16"])
def test_tables_of_names_are_read_as_programs_write_them(tmp_path, name, line, coding):
    labels = {3: "gluteus_maximus", 6: "Präparat", 9: "pelvis"}
    text = "# index name\nlabel,name\n" + "".join(line.format(*row) for row in labels.items())
    (tmp_path / name).write_bytes(text.encode(coding))
    assert read_names(tmp_path / name) == labels
    turned = "".join(f"{label},{number}\n" for number, label in labels.items())
    (tmp_path / name).write_text(turned, encoding="utf-8")
    assert read_names(tmp_path / name) == labels


def test_a_quoted_name_keeps_its_comma_and_a_second_name_is_refused(tmp_path):
    table = tmp_path / "names.csv"
    table.write_text(QUOTED.format(3, "gluteus maximus, left"))
    assert read_names(table) == {3: "gluteus maximus, left"}
    table.write_text("3,femur\n6,tibia\n3,pelvis\n")
    with pytest.raises(UsageError, match="label 3 has two names, 'femur' and 'pelvis'"):
        read_names(table)


@pytest.mark.parametrize("name", ["scan.mha", "pair.img", "series.dcm"])
def test_files_that_are_no_volume_are_not_called_folders(tmp_path, name, capsys):
    (tmp_path / name).write_bytes(b"ObjectType = Image\n")
    code, _, said = call(capsys, "new", tmp_path / name, "--labels", "names.csv")
    assert code == 2 and "give a folder" in said and ".nrrd" in said
