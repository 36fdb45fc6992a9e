"""Scenes made in Python are those that the command line writes."""

from pathlib import Path

import numpy as np
import pytest
from command_line import call

import rbfmuscle as rm
from rbfmuscle.importers.opensim.scene import import_osim

ROOT = Path(__file__).parents[2]


def test_scene_from_meshes_is_the_one_that_new_writes(tmp_path, capsys):
    meshes = ROOT / "examples" / "meshes"
    before = sorted(meshes.iterdir())
    scene = rm.Scene.from_meshes(meshes)
    assert call(capsys, "new", meshes, "-o", tmp_path)[0] == 0
    assert scene == rm.Scene.load(tmp_path / "scene.toml")
    assert scene.path is None and sorted(meshes.iterdir()) == before
    assert all(Path(part.source).is_file() for part in (*scene.bones, *scene.muscles))
    assert scene.guesses and rm.Scene.load(scene.save(tmp_path / "again.toml")) is not None
    with pytest.raises(rm.UsageError, match="units"):
        rm.Scene.from_meshes(meshes, units="inch")


def test_scene_from_labels_is_the_one_that_new_writes(tmp_path, capsys):
    nibabel = pytest.importorskip("nibabel")
    at = np.stack(np.meshgrid(*[np.arange(n) for n in (40, 40, 130)], indexing="ij"), axis=-1)
    labels = np.zeros(at.shape[:3], np.int16)
    beside = np.linalg.norm(at[..., :2] - [14, 20], axis=-1)
    labels[(beside < 6) & (at[..., 2] > 4) & (at[..., 2] < 62)] = 1
    labels[(beside < 6) & (at[..., 2] > 66) & (at[..., 2] < 126)] = 2
    egg = (at - [25, 20, 66]) / [5, 5, 40]
    labels[(labels == 0) & ((egg**2).sum(axis=-1) < 1.0)] = 3
    image = nibabel.Nifti1Image(labels, np.diag([3.0, 3.0, 3.0, 1.0]))
    image.header.set_xyzt_units("mm")
    nibabel.save(image, tmp_path / "leg.nii.gz")
    names = tmp_path / "names.csv"
    names.write_text("1,tibia\n2,femur\n3,vastus_lateralis\n")
    scene = rm.Scene.from_labels(tmp_path / "leg.nii.gz", labels=names)
    assert capsys.readouterr() == ("", "")  # progress is the command's
    words = ("new", tmp_path / "leg.nii.gz", "--labels", names, "-o", tmp_path / "out")
    code, _, said = call(capsys, *words)
    assert code == 0 and "surfaces: label 3 of 3" in said
    written = rm.Scene.load(tmp_path / "out" / "scene.toml")
    assert scene.name == "leg" and scene.path is None
    assert (scene.bones, scene.joints, scene.notes) == (
        written.bones,
        written.joints,
        written.notes,
    )
    assert [muscle.attachments for muscle in scene.muscles] == [
        muscle.attachments for muscle in written.muscles
    ]


def test_scene_from_an_opensim_model_keeps_its_notes():
    model = ROOT / "tests" / "data" / "muscles.osim"
    found = import_osim(model)
    scene = rm.Scene.from_osim(model)
    assert scene.muscles == found.scene.muscles and scene.muscles
    assert scene.notes == found.notes
    assert rm.Scene.from_osim(model, muscles=False).muscles == []
