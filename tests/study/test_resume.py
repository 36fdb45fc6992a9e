"""A run that was killed goes on to the same result: every model and every part of a scene that remembers something."""

import json
import resource
import shutil
from contextlib import contextmanager

import numpy as np
import pytest
from blend_model import arm_scene, files_in, use_blend_model
from run_folders import timeless

from rbfmuscle.models import MODEL_NAMES
from rbfmuscle.run import stream_run
from rbfmuscle.sim.scene.motion import Motion
from rbfmuscle.sim.scene.phantom import phantom_scene
from rbfmuscle.study.files import writer as writing
from rbfmuscle.study.files.checkpoint import NAME, read_checkpoint, write_checkpoint
from rbfmuscle.study.files.resume import OtherRunError
from rbfmuscle.study.files.saved import SavedRun
from rbfmuscle.validation import SceneWarning, SolveError, UsageError


@pytest.fixture(autouse=True)
def keep_every_frame(monkeypatch):
    monkeypatch.setattr(writing, "KEEPING_SHARE", np.inf)


def small_scene(muscles=1, **parts):
    """Some muscles of the phantom through five frames, two of them in the same pose."""
    scene = phantom_scene(spacing=6.0)
    scene.muscles = scene.muscles[:muscles]
    small = {"model.centres": 80, "model.samples": 300, "model.resolution": 16}
    scene.motion = Motion([{"hip.flexion": np.radians(angle)} for angle in (0.0, 3.0, 6.0, 6.0, 4.0)])
    chosen = {"output.report": False, "output.preview": False, **parts}
    model = chosen.pop("model", "rbf")
    return scene.with_options({"model": model, **(small if model == "rbf" else {}), **chosen})


def killed(scene, folder, at, **options):
    """A folder as a kill after so many frames leaves it: what is on the disk at that moment."""

    def copy(done, total):
        if done == at:
            shutil.copytree(folder, folder.with_name("killed"), dirs_exist_ok=True)

    stream_run(scene, folder, progress=copy, pictures=False, **options)
    return folder.with_name("killed")


def assert_same(one, other):
    assert files_in(one) == files_in(other)
    for name in files_in(one):
        assert timeless(one / name) == timeless(other / name), name


VARIANTS = {
    **{name: {"model": name} for name in MODEL_NAMES},
    "velocity": {"model": "pbd", "model.prediction": "velocity"},
    "marching": {"model.surface": "marching"},
    "inside": {"model.inside": 150},
    "sliding": {"sliding.bones": True, "muscles": 3},
    "kept overlap": {"contact.initial": "keep", "output.surfaces": {"format": "ply"}},
}


@pytest.mark.parametrize("variant", VARIANTS)
def test_resumed_run_is_the_unbroken_one(variant, tmp_path):
    scene = small_scene(**VARIANTS[variant])
    left = killed(scene, tmp_path / "whole", 2)
    assert SavedRun(left).frames == [0, 1]
    assert not (left / "surfaces" / "extensor_0002.vtp").exists()
    seen = []
    stream_run(scene, left, resume=True, pictures=False, progress=lambda done, total: seen.append(done))
    assert seen == list(range(3, len(scene.motion) + 1))
    assert_same(tmp_path / "whole", left)


def test_contracting_muscle_resumes_in_the_midst_of_its_activation(tmp_path):
    scene = small_scene(activation=[0.0, 0.2, 0.4, 0.6, 0.6])
    left = killed(scene, tmp_path / "whole", 2)
    stream_run(scene, left, resume=True, pictures=False)
    assert_same(tmp_path / "whole", left)


class TestBlend:
    """What is about folders, with a model that costs nothing."""

    @pytest.fixture(autouse=True)
    def blend(self, monkeypatch):
        use_blend_model(monkeypatch)

    @pytest.mark.parametrize("at", [1, 2, 3])
    def test_killed_after_any_frame(self, at, tmp_path):
        left = killed(arm_scene(), tmp_path / "whole", at)
        stream_run(arm_scene(), left, resume=True)
        assert_same(tmp_path / "whole", left)

    def test_interrupted_and_resumed(self, tmp_path):
        def stop(done, total):
            if done == 2:
                raise KeyboardInterrupt

        with pytest.raises(KeyboardInterrupt):
            stream_run(arm_scene(), tmp_path / "left", progress=stop)
        assert SavedRun(tmp_path / "left").frames == [0, 1]
        stream_run(arm_scene(), tmp_path / "left", resume=True)
        stream_run(arm_scene(), tmp_path / "whole")
        assert_same(tmp_path / "whole", tmp_path / "left")

    def test_checkpoints_that_are_left_out_cost_their_frames_only(self, tmp_path, monkeypatch):
        monkeypatch.setattr(writing, "KEEPING_SHARE", 1e-9)
        left = killed(arm_scene(), tmp_path / "whole", 3)
        assert read_checkpoint(left / NAME)["files"]["last"] == 0
        stream_run(arm_scene(), left, resume=True)
        assert_same(tmp_path / "whole", left)

    def test_files_of_a_frame_that_was_under_way_are_written_again(self, tmp_path):
        left = killed(arm_scene(), tmp_path / "whole", 2)
        (left / "surfaces" / "biceps_0002.vtp").write_text("<VTKFile")
        with open(left / "poses.csv", "a", encoding="utf-8") as file:
            file.write("2,upper,1.0,0.")
        with open(left / "surfaces.pvd", "a", encoding="utf-8") as file:
            file.write("<DataSet")
        stream_run(arm_scene(), left, resume=True)
        assert_same(tmp_path / "whole", left)

    def test_finished_run_and_empty_folder(self, tmp_path):
        stream_run(arm_scene(), tmp_path / "a")
        before = {name: (tmp_path / "a" / name).read_bytes() for name in files_in(tmp_path / "a")}
        assert stream_run(arm_scene(), tmp_path / "a", resume=True)["status"] == "complete"
        assert {name: (tmp_path / "a" / name).read_bytes() for name in files_in(tmp_path / "a")} == before
        stream_run(arm_scene(), tmp_path / "b", resume=True)
        assert_same(tmp_path / "a", tmp_path / "b")

    @pytest.mark.parametrize(
        "changed, message",
        [
            ({"end": 30}, "motion ramp elbow.flexion to is 20.0 there and 30.0 here"),
            ({"units": "m"}, 'units is "mm" there and "m" here'),
        ],
    )
    @pytest.mark.parametrize("complete", [True, False])
    def test_other_scene_is_refused(self, changed, message, complete, tmp_path):
        left = killed(arm_scene(), tmp_path / "whole", 2)
        folder = tmp_path / "whole" if complete else left
        with pytest.raises(OtherRunError, match=f"^{folder} holds a run of another scene .*: {message}"):
            stream_run(arm_scene(**changed), folder, resume=True)

    def test_other_vertices_and_versions_are_refused(self, tmp_path):
        left = killed(arm_scene(), tmp_path / "whole", 2)
        other = arm_scene()
        other.muscles[0].attachments[0].vertices[0] += 1
        with pytest.raises(UsageError, match="attached vertices"):
            stream_run(other, left, resume=True)
        info = json.loads((left / "run.json").read_text())
        info["versions"]["numpy"] = "1.0"
        (left / "run.json").write_text(json.dumps(info))
        with pytest.raises(UsageError, match=r"begun with numpy 1\.0, and this is"):
            stream_run(arm_scene(), left, resume=True)

    @pytest.mark.parametrize("name", ["surfaces/biceps_0000.vtp", "poses.csv", "bones/fore_0001.vtp"])
    def test_damaged_file_starts_anew(self, name, tmp_path):
        left = killed(arm_scene(), tmp_path / "whole", 2)
        (left / name).write_text("")
        with pytest.warns(SceneWarning, match="damaged or missing"):
            stream_run(arm_scene(), left, resume=True)
        assert_same(tmp_path / "whole", left)

    def test_damaged_checkpoint_starts_anew(self, tmp_path):
        left = killed(arm_scene(), tmp_path / "whole", 2)
        data = bytearray((left / NAME).read_bytes())
        data[len(data) // 2] ^= 255
        (left / NAME).write_bytes(bytes(data))
        stream_run(arm_scene(), left, resume=True)
        assert_same(tmp_path / "whole", left)

    def test_run_json_that_is_none_is_one_line(self, tmp_path):
        (tmp_path / "run.json").write_text("{}")
        with pytest.raises(UsageError, match="run without --resume"):
            stream_run(arm_scene(), tmp_path, resume=True)

    @pytest.mark.parametrize("limit", [900, 1500, 4000, 9000])
    def test_disk_that_takes_no_more_leaves_whole_frames(self, limit, tmp_path):
        """The kernel refuses every byte of a file beyond a limit: tables and meshes end at any place."""
        scene = arm_scene(end=40, step=2)
        stream_run(scene, tmp_path / "whole")
        with file_limit(limit), pytest.raises((SolveError, UsageError)):
            stream_run(scene, tmp_path / "left")
        if (tmp_path / "left" / "run.json").exists():
            kept = SavedRun(tmp_path / "left")
            for frame in kept.frames:
                assert len(kept.surface("biceps", frame)[0])
            assert {row.frame for row in kept.metrics} <= set(kept.frames)
            assert (tmp_path / "left" / "surfaces.pvd").read_text().endswith("</VTKFile>\n")
        stream_run(scene, tmp_path / "left", resume=True)
        assert_same(tmp_path / "whole", tmp_path / "left")


@contextmanager
def file_limit(size):
    """No file of this process may grow beyond so many bytes."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def test_checkpoint_keeps_every_kind_exactly(tmp_path):
    state = {"a": (1, [2.5, None], {"x": np.arange(3.0) / 3.0}), "b": float("inf"), "c": np.array([], bool)}
    write_checkpoint(tmp_path / "c.npz", state)
    found = read_checkpoint(tmp_path / "c.npz")
    assert type(found["a"]) is tuple and found["a"][:2] == (1, [2.5, None]) and found["b"] == float("inf")
    np.testing.assert_array_equal(found["a"][2]["x"], state["a"][2]["x"])
    assert found["c"].dtype == bool and read_checkpoint(tmp_path / "d.npz") is None
