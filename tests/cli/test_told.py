"""What users are told: each figure of a line or page is that of the quantity it names, in the unit it names.

What turns a table into words is given one number for each fact that no other fact has, so that a figure taken from the
wrong place, or scaled wrongly, cannot hide.
"""

import html
import json
import re
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from blend_model import arm_files, arm_scene, use_blend_model
from command_line import call

import rbfmuscle as rm
from rbfmuscle.cli.plan import _lines as plan_lines
from rbfmuscle.metrics.summary import require_limits
from rbfmuscle.report.comparison_page import cell
from rbfmuscle.report.kernel_page import COLUMNS
from rbfmuscle.report.kernel_page import _row as kernel_row
from rbfmuscle.report.report import _cell as report_cell
from rbfmuscle.report.report import _facts, _stages, _summary, _verdict
from rbfmuscle.report.sweep_page import _cell as sweep_cell
from rbfmuscle.scene.check import check_centre, check_extents, check_scene
from rbfmuscle.validation import LimitExceededError, MeshError, SceneError


def texts(page):
    """Texts of the cells of a table, row by row."""
    rows = re.findall(r"<tr.*?</tr>", page, re.S)
    return [
        [html.unescape(re.sub(r"<.*?>", " ", c)).split() for c in re.findall(r"<t[hd].*?</t[hd]>", row, re.S)]
        for row in rows
    ]


class TestCommands:
    def test_plan_tells_each_figure_of_its_table(self):
        made = {
            "frames": 31, "substeps": 67,
            "muscles": [
                {"name": "strap", "model": "rbf", "points": "172 centres", "bones": ["arm", "trunk"],
                 "solved": 17, "carried": 14, "skipped": 0, "reason": "arm turns"},
                {"name": "fan", "model": "pbd", "points": "1201 vertices", "bones": [],
                 "solved": 0, "carried": 0, "skipped": 0, "reason": "none"},
            ],
            "fields": [{"bone": "arm", "share": 0.37, "triangles": 701}],
            "time": {"total": 43.0, "build": 5.9, "frame": 0.071},
        }  # fmt: skip
        assert plan_lines(made) == [
            "31 frames in 67 sub-steps",
            "muscle strap: rbf, 172 centres, can meet arm, trunk; solved in 17, carried in 14 frames (arm turns)",
            "muscle fan: pbd, 1201 vertices, can meet no bone; solved in 0 frames (none)",
            "field of arm: 37% of its box, 701 triangles",
            "expected time: 43 s without report, pictures and files; build and first frame 5.9 s, 71 ms per frame",
        ]

    def test_check_tells_the_volume_in_cubic_centimetres_and_what_is_held(self, tmp_path, capsys):
        path = arm_files(tmp_path)
        code, out, _ = call(capsys, "check", path)
        scene = rm.Scene.load(path)
        muscle = scene.muscles[0]
        assert code == 0 and f"{muscle.mesh.volume / 1000.0:.4g} cm3" in out
        held = ", ".join(f"{len(a.vertices)} on {a.bone}" for a in muscle.attachments)
        assert f"attached: {held}" in out and f"{len(scene.motion)} frames, lengths in mm" in out
        path.write_text(path.read_text().replace('units = "mm"', 'units = "cm"'))
        assert f"{muscle.mesh.volume:.4g} cm3" in call(capsys, "check", path)[1]

    def test_check_measures_the_fields_of_the_bones_where_it_is_asked(self, tmp_path, capsys):
        path = arm_files(tmp_path)
        assert "field of" not in call(capsys, "check", path)[1]
        code, out, _ = call(capsys, "check", path, "--fields")
        bones = [bone.name for bone in rm.Scene.load(path).bones]
        assert code == 0 and [name for name in bones if f"field of {name}: within" in out] == bones
        found = json.loads(call(capsys, "check", path, "--fields", "--json")[1])["fields"]
        assert list(found) == bones and all(
            0 <= f["error_rms"] <= f["error_max"] < 0.5 for f in found.values()
        )

    @pytest.mark.parametrize("report", [True, False])
    def test_run_names_the_report_where_there_is_one(self, tmp_path, monkeypatch, capsys, report):
        use_blend_model(monkeypatch)
        path, out = arm_files(tmp_path), tmp_path / "out"
        words = [
            "--set",
            f"output.report={str(report).lower()}",
            "--set",
            "output.surfaces=false",
            "--frames",
            "0:2",
        ]
        code, told, _ = call(capsys, "run", path, "-o", out, *words)
        assert code == 0 and (out / "report.html").exists() == report
        assert "2 frames in " in told and f"in {out}" in told
        assert (f"open {out / 'report.html'}" in told) == report


class TestFindings:
    def test_overlap_is_told_by_number_share_and_depth(self):
        """An egg of 26 by 5 by 5 mm, pushed down into two boxes whose tops lie 3 mm above the axis."""
        scene = arm_scene()
        mesh = scene.muscles[0].mesh
        mesh.apply_translation([0, 0, -5.0])
        x, _, z = mesh.vertices.T
        held = np.concatenate([a.vertices for a in scene.muscles[0].attachments])
        free = np.setdiff1d(np.arange(len(z)), held)
        for bone, side in (("upper", x < 0), ("fore", x > 0)):
            low, high = scene.bones[0 if bone == "upper" else 1].mesh.bounds
            inside = free[np.all((mesh.vertices[free] > low) & (mesh.vertices[free] < high), axis=1)]
            (note,) = [f for f in check_scene(scene) if f"inside bone '{bone}'" in f.message]
            deepest = np.minimum(mesh.vertices[inside] - low, high - mesh.vertices[inside]).min(axis=1).max()
            assert len(inside) > 5 and side[inside].all()
            share = 100.0 * len(inside) / len(z)
            assert note.message.startswith(f"{len(inside)} free vertices ({share:.2g} %) start inside")
            told = float(re.search(r"up to (\S+) mm deep", note.message)[1])
            assert told == pytest.approx(deepest, rel=5e-3)

    @pytest.mark.parametrize(("factor", "remedy"), [(1e-3, 1000.0), (100.0, 0.01), (1e3, 0.001)])
    def test_remedy_of_a_wrong_unit_makes_the_size_it_says(self, factor, remedy):
        scene = rm.Scene(units="mm").add_bone(
            "rod", trimesh.creation.box((300.0 * factor, 1 * factor, 1 * factor))
        )
        with pytest.raises(MeshError) as caught:
            check_extents(scene)
        size = factor * np.linalg.norm([300.0, 1.0, 1.0])
        text = str(caught.value)
        assert f"is {size:.4g} mm across" in text
        assert f"({remedy:g} times the present one would make it {size * remedy:.4g} mm)" in text

    def test_distance_of_a_muscle_in_another_frame_is_that_of_the_boxes(self):
        scene = arm_scene()
        scene.muscles[0].mesh.apply_translation([0, 903.0, 0])
        gap = scene.muscles[0].mesh.bounds[0, 1] - max(bone.mesh.bounds[1, 1] for bone in scene.bones)
        up = max(
            0.0, scene.muscles[0].mesh.bounds[0, 2] - max(bone.mesh.bounds[1, 2] for bone in scene.bones)
        )
        with pytest.raises(MeshError, match=rf"lies {np.hypot(gap, up):.4g} mm away from all bones"):
            check_extents(scene)

    def test_centre_far_away_is_told_with_its_distance(self):
        scene = arm_scene()
        low, high = np.array([bone.mesh.bounds for bone in scene.bones]).transpose(1, 0, 2)
        centre = np.array([3.0, high.max(axis=0)[1] + 3e6, low.min(axis=0)[2] - 4e6])
        with pytest.raises(SceneError, match=r"joint 'elbow': centre .* lies 5e\+06 mm away from all bones"):
            check_centre(scene, "elbow", centre)
        check_centre(scene, "elbow", high.max(axis=0) + 1.0)


class TestLimits:
    def test_what_exceeds_is_told_with_value_limit_and_frame(self):
        facts = {
            "strap": {
                "volume_error": {"worst": -0.0345, "worst_frame": 7},
                "penetration_max": {"worst": 0.5, "worst_frame": 3},
                "components": {"worst": 2.0, "worst_frame": 11},
            },
            "all": {"volume_error": {"worst": 9.0, "worst_frame": 1}},
        }
        limits = {"volume_error": 0.02, "penetration_max": 0.5, "components": 1.0}
        with pytest.raises(LimitExceededError) as caught:
            require_limits(facts, limits)
        assert str(caught.value) == (
            "strap: volume_error = -0.0345 > 0.02 at frame 7; strap: components = 2 > 1 at frame 11"
        )
        require_limits(facts, {"volume_error": 0.0345, "penetration_max": 0.5, "components": 2.0})

    def test_no_number_is_beyond_every_limit(self):
        with pytest.raises(LimitExceededError, match="nan"):
            require_limits({"strap": {"volume_error": {}}}, {"volume_error": 1.0})


class TestPages:
    def test_row_of_kernels_shows_each_quantity_in_its_column_and_unit(self):
        row = {name: 1.01 + 0.1 * k for k, name in enumerate(COLUMNS)}
        row |= {"kernel": "cubic", "note": "a <note>", "front": True, "centres": 80, "placement": None}
        shown = texts(kernel_row(row))[0]
        scale = {"volume, %": 100.0, "fit, ms": 1000.0, "20,000 values, ms": 1000.0}
        for (name, head), found in zip(COLUMNS.items(), shown, strict=True):
            if isinstance(row[name], float):
                assert found == [f"{row[name] * scale.get(head, 1.0):.3g}"], head
            else:
                assert " ".join(found) == ("" if row[name] is None else str(row[name])), head

    def test_cells_of_a_sweep_tell_times_in_milliseconds(self):
        assert sweep_cell("time_frame", 0.0123) == "12.3"
        assert sweep_cell("error_rms", 0.0123) == "0.0123"
        assert sweep_cell("error_rms", float("nan")) == ""

    def test_cells_of_a_comparison_have_their_unit(self):
        units = {"time_frame": "s", "volume_error": "1", "penetration_max": "mm", "components": "1"}
        table = {"measures": {name: {"unit": unit} for name, unit in units.items()}}
        assert cell(table, "time_frame", 0.0234) == "23.4 ms" and cell(table, "time_frame", 2.34) == "2.34 s"
        assert cell(table, "time_frame", 1.0) == "1 s" and cell(table, "time_frame", None) == "-"
        assert cell(table, "volume_error", 0.0123) == "1.2 %" and cell(table, "components", 3.0) == "3"
        assert texts(f"<tr><td>{cell(table, 'penetration_max', 1.234)}</td></tr>") == [[["1.23", "mm"]]]
        assert cell(table, "penetration_max", 0.009).startswith("0 ")  # below half of what counts

    def test_report_shows_each_muscles_figures_limits_and_frames(self):
        saved = SimpleNamespace(
            muscles=["strap", "fan"],
            frames=[0, 1, 2],
            info={
                "status": "complete", "message": "", "times": {"wall": 12.34}, "frame_time": {"median": 0.0567},
                "scene": {"muscles": [{"model": {"name": "rbf"}}, {"model": {"name": "pbd"}}]},
                "limits": {"penetration_max": 0.5, "volume_error": 0.01},
                "muscles": {
                    "strap": {
                        "penetration_max": {"worst": 0.61, "worst_frame": 7, "unit": "mm"},
                        "length": {"worst": 9.0, "min": 11.1, "max": 13.3, "unit": "mm"},
                        "volume_error": {"worst": -0.002, "worst_frame": 4, "unit": "1"},
                    },
                    "fan": {"penetration_max": {"worst": 0.0, "worst_frame": 0, "unit": "mm"}},
                },
                "stages": {"strap": {"time_solve": {"median": 0.0171, "p95": 0.0192}, "time_fit": None}},
                "work": {
                    "strap": {
                        "solved": 17, "carried": 14, "skipped": 3, "substeps": 41,
                        "reasons": {"carried": "its bones move as one", "solved": "femur against pelvis"},
                    }
                },
            },
        )  # fmt: skip
        assert "Beyond a limit: strap: penetration_max 0.61 (limit 0.5) at frame 7." in _verdict(saved)
        rows = {row[0][0]: row[1:] for row in texts(_summary(saved))[1:]}
        assert rows["penetration_max"] == [["0.61", "frame", "7"], ["0"], ["≤", "0.5"]]
        assert rows["length"] == [["11.1", "…", "13.3"], ["-"], []]
        assert rows["volume_error"] == [["-0.002", "frame", "4"], ["-"], ["≤", "0.01"]]
        work = [["17"], ["14"], ["3"], ["41"], ["femur", "against", "pelvis"]]
        titles = [["solved"], ["carried"], ["skipped"], ["substeps"], ["mostly", "for"]]
        stages = texts(_stages(saved))
        assert stages == [[[], ["solve"], ["fit"], *titles], [["strap"], ["17.1", "19.2"], ["-"], *work]]
        facts = dict(
            (name, html.unescape(value))
            for value, name in re.findall(r"<div><b>(.*?)</b><span>(.*?)</span></div>", _facts(saved))
        )
        assert facts["time a frame, median"] == "57 ms" and facts["whole run"] == "12.3 s"
        assert facts["model"] == "pbd, rbf" and facts["muscles"] == "2" and facts["frames"] == "3"
        saved.info["limits"]["penetration_max"] = 0.61
        assert "within every limit" in _verdict(saved)
        assert report_cell("time_frame", {"worst": 1.0, "median": 0.0345}).startswith("34.5 ms")
