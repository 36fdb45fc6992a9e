"""Runs in memory and to a folder: the same numbers, and what an interrupt, a failure or a limit
leaves.
"""

import html
import json

import numpy as np
import pytest
import trimesh
from blend_model import arm_scene, files_in, use_blend_model
from run_folders import timeless

from rbfmuscle.display.export import export_run
from rbfmuscle.display.report import redraw_run
from rbfmuscle.recording import Run, simulate, stream_run
from rbfmuscle.run import writer
from rbfmuscle.run.data import frame_caption
from rbfmuscle.validation import LimitExceededError, SceneWarning, SolveError, UsageError


@pytest.fixture(autouse=True)
def blend(monkeypatch):
    use_blend_model(monkeypatch)


class TestSimulate:
    def test_notes_of_the_motion_are_warned_of(self):
        scene = arm_scene(end=10)
        scene.motion.notes = ["times are not even"]
        with pytest.warns(SceneWarning, match="motion: times are not even"):
            simulate(scene)

    def test_progress_is_called_after_each_frame_or_shown(self, capsys):
        calls = []
        simulate(arm_scene(), progress=lambda *given: calls.append(given))
        assert calls == [(1, 3), (2, 3), (3, 3)] and capsys.readouterr().err == ""
        simulate(arm_scene(), progress=True)
        assert "arm: frame 3 of 3 (" in capsys.readouterr().err

    def test_bones_without_an_inside_are_named_in_the_verdict(self):
        scene, ball = arm_scene(end=4, step=2), trimesh.creation.icosphere(3, 10.0)
        plain = simulate(scene).verdict
        flat = trimesh.creation.box([20, 10, 1e-9]).subdivide()
        # A third of the ball's surface is missing.
        torn = trimesh.Trimesh(ball.vertices, ball.faces[ball.triangles_center[:, 2] > -10 / 3])
        for name, mesh, place in (("torn", torn, -40), ("flat", flat, 0), ("whole", ball, 40)):
            scene.add_bone(name, mesh.copy().apply_translation([place, 80, 0]))
        verdict = simulate(scene).verdict
        assert "Doubtful" not in plain
        assert "Doubtful: torn: " in verdict and "surface is missing" in verdict
        scene.bones = [bone for bone in scene.bones if bone.name != "torn"]
        verdict = simulate(scene).verdict
        assert "Doubtful: flat: it is flat" in verdict and "more" not in verdict

    @pytest.mark.parametrize("report", [True, False])
    def test_report_is_written_where_it_is_asked_for(self, report, tmp_path):
        stream_run(arm_scene(end=10), tmp_path, settings={"output.report": report}, pictures=False)
        assert (tmp_path / "report.html").exists() == report

    def test_units_change_nothing_but_units(self):
        big = simulate(arm_scene(units="mm"))
        rows = simulate(arm_scene(units="m")).metrics
        assert {r.unit for r in rows if r.quantity == "length"} == {"m"}
        for a, b in zip(
            *([r for r in found if r.muscle == "biceps"] for found in (big.metrics, rows))
        ):
            if not a.quantity.startswith("time"):
                assert a.value == pytest.approx(b.value)


class TestStream:
    def test_streamed_and_saved_folders_are_the_same_but_for_times(self, tmp_path):
        made = arm_scene(end=170, step=34)
        # Thinner than the upper bone, so that it is driven into it where the elbow closes.
        made.bones[1].mesh = trimesh.creation.box((40, 4, 4)).apply_translation([22, 0, 0])
        settings = {"contact.initial": "keep", "detect.tunnelling.action": "report"}
        with pytest.warns(SceneWarning, match="upper and fore"):
            stream_run(made, tmp_path / "streamed", settings=settings, frames="1:")
        with pytest.warns(SceneWarning, match="upper and fore"):
            simulate(made, settings=settings, frames="1:").save(tmp_path / "saved")
        names = files_in(tmp_path / "streamed")
        assert names == files_in(tmp_path / "saved") and "surfaces.pvd" in names
        for name in names:
            assert timeless(tmp_path / "streamed" / name) == timeless(tmp_path / "saved" / name), (
                name
            )
        assert ",bones_overlap" in (tmp_path / "saved" / "events.csv").read_text(encoding="utf-8")

    def test_failure_is_written_down(self, tmp_path, monkeypatch):
        use_blend_model(monkeypatch, fail_at=8)
        with pytest.raises(SolveError, match="planted"):
            stream_run(arm_scene(), tmp_path)
        saved = Run.load(tmp_path)
        assert saved.info.status == "failed" and "planted" in saved.info.message
        use_blend_model(monkeypatch, fail_at=8)
        with pytest.raises(SolveError, match="planted") as caught:
            simulate(arm_scene())
        assert 0 < len(caught.value.run.frames) == len(saved.frames) < 3

    def test_a_bug_is_never_recorded_as_an_interrupt(self, tmp_path):
        for error, status, said in (
            (ZeroDivisionError("planted"), "failed", "a bug: ZeroDivisionError: planted"),
            (MemoryError("planted"), "failed", "planted"),
            (KeyboardInterrupt(), "interrupted", "interrupted"),
        ):

            def fail(done, total, error=error):
                raise error

            with pytest.raises(type(error)):
                stream_run(arm_scene(), tmp_path, progress=fail)
            info = Run.load(tmp_path).info
            assert (info.status, info.message) == (status, said)

    def test_limit_exceeded_after_everything_is_written(self, tmp_path):
        with pytest.raises(LimitExceededError, match="biceps: length"):
            stream_run(arm_scene(), tmp_path, fail_on="length=3")
        assert Run.load(tmp_path).info.status == "complete"
        stream_run(arm_scene(), tmp_path, fail_on=["length=300", "components"])

    def test_second_run_leaves_nothing_of_the_first(self, tmp_path):
        stream_run(arm_scene(), tmp_path)
        info = stream_run(arm_scene(), tmp_path, frames=":1", settings={"output.surfaces": False})
        names = ["events.csv", "files.txt", "metrics.csv", "poses.csv", "run.json"]
        assert files_in(tmp_path) == names
        assert info.muscles["biceps"]["volume_error"]["worst"] < 1e-9

    def test_disk_that_fills_up_keeps_the_frames(self, tmp_path, monkeypatch):
        import rbfmuscle.run.writer as writer

        real, count = writer.write_vtp, []

        def full(path, *args, **kwargs):
            count.append(path)
            if len(count) > 5:
                raise OSError(28, "No space left on device")
            real(path, *args, **kwargs)

        monkeypatch.setattr(writer, "write_vtp", full)
        with pytest.raises(SolveError, match="frame 2: No space left"):
            stream_run(arm_scene(), tmp_path)
        assert Run.load(tmp_path).frame_numbers == [0, 1]


def test_light_bones_come_from_the_cache_the_second_time(monkeypatch, tmp_path):
    monkeypatch.setenv("RBFMUSCLE_CACHE", str(tmp_path))
    ball = trimesh.creation.icosphere(5)
    first = writer._light_mesh(ball.vertices, ball.faces)
    assert len(first[1]) <= writer.LIGHT < len(ball.faces)
    monkeypatch.delattr(writer, "simplified")
    for one, other in zip(first, writer._light_mesh(ball.vertices, ball.faces)):
        np.testing.assert_array_equal(one, other)


def test_frames_keep_the_numbers_of_the_motion(tmp_path):
    """In memory, in every table and file, and where a run was killed before it ended."""
    scene = arm_scene(end=60, step=10)
    scene.motion.times = [0.5 * k for k in range(7)]
    run = simulate(scene, frames="1::2")
    run.save(tmp_path / "run")
    saved = Run.load(tmp_path / "run")
    for each in (run, saved):
        assert each.info.scene.motion.whole == 7
        assert [frame.index for frame in each.frames] == [1, 3, 5]
        assert each.series("biceps", "volume")[0].tolist() == [1, 3, 5]
        assert each.series("all", "time")[1].tolist() == [0.5, 1.5, 2.5]
        assert each.frame(3).coordinates["elbow.flexion"] == pytest.approx(np.radians(30))
        assert frame_caption(each, 5) == "frame 5, 2.5 s, elbow.flexion 50°"
        with pytest.raises(UsageError, match="frame 2 was not written"):
            each.frame(2)
    redraw_run(tmp_path / "run", pictures=False)
    page = html.unescape((tmp_path / "run/report.html").read_text(encoding="utf-8"))
    assert "3 frames of the motion's 7" in page
    names = sorted(path.name for path in (tmp_path / "run/surfaces").iterdir())
    assert names == [f"biceps_{k:04d}.vtp" for k in (1, 3, 5)]
    exported = export_run(saved, "ply", output=tmp_path / "out", frames=slice(1, None))
    assert {"biceps_0003.ply", "biceps_0005.ply"} < {path.name for path in exported}
    path = tmp_path / "run/run.json"
    info = json.loads(path.read_text(encoding="utf-8"))
    planned = [entry["coordinates"] for entry in info["frames"]]
    path.write_text(json.dumps(info | {"status": "running", "planned": planned, "frames": []}))
    killed = Run.load(tmp_path / "run")
    assert killed.frame(3).coordinates["elbow.flexion"] == pytest.approx(np.radians(30))
