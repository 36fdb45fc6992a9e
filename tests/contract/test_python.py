"""The Python interface as a user meets it: names, types, runs in memory and in folders,
notebooks."""

import ast
import gc
import importlib.util
import runpy
import subprocess
import sys
import types

import numpy as np
import pytest
import trimesh
from conftest import ROOT

import rbfmuscle as rm
from rbfmuscle.metrics.quantities import Row
from rbfmuscle.run.data import SceneMeshes, frame_caption

SCRIPT = ROOT / "tests" / "data" / "user_script.py"


@pytest.fixture(scope="module")
def run():
    scene = rm.phantom_scene(end=4.0, step=2.0, spacing=6.0)
    scene.muscles = [scene.muscle("abductor")]
    return rm.simulate(scene, model="pbd")


@pytest.fixture(scope="module")
def loaded(run, tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    run.save(folder, pictures=False)
    return rm.Run.load(folder)


def test_names_are_what_a_user_needs_and_types_know_them():
    assert dir(rm) == sorted(rm.__all__)
    tree = ast.parse((ROOT / "rbfmuscle" / "__init__.py").read_text(encoding="utf-8"))
    (block,) = [node for node in tree.body if isinstance(node, ast.If)]
    typed = {alias.asname: node.module for node in block.body for alias in node.names}
    assert typed == rm._HOME


def test_import_loads_nothing_heavy():
    heavy = ["numba", "pyvista", "vtk", "trimesh", "skimage", "scipy", "pydantic", "matplotlib"]
    code = f"import sys, rbfmuscle; print([name for name in {heavy} if name in sys.modules])"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"


def test_user_script_runs(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", [str(SCRIPT), str(tmp_path)])
    runpy.run_path(str(SCRIPT), run_name="__main__")
    printed = capsys.readouterr().out
    assert printed.startswith("2 ['abductor'] True ")
    assert "3 nowhere.toml: no such scene file" in printed


def test_run_answers_as_a_container(run):
    assert len(run) == len(run.frames) == 3
    assert "abductor" in run and "abducter" not in run
    assert run.muscles == [muscle.name for muscle in run] == ["abductor"]
    assert {"volume_error", "penetration_max", "length"} <= set(run.quantities)
    with pytest.raises(
        rm.UsageError, match=r"unknown muscle 'abducter', did you mean 'abductor'\?"
    ):
        run["abducter"]
    with pytest.raises(rm.UsageError, match="frame 3 was not written; the run has 0 to 2"):
        run["abductor"].surface(3)


def test_run_that_is_loaded_is_the_run_that_was_saved(run, loaded, tmp_path):
    assert (len(loaded), loaded.muscles, loaded.verdict) == (3, run.muscles, run.verdict)
    for mine, other in zip(run.frames, loaded.frames, strict=True):
        assert other.coordinates == pytest.approx(mine.coordinates)
        np.testing.assert_array_equal(other.poses["femur"], mine.poses["femur"])
        assert list(other.surfaces) == ["abductor"]
    found, wanted = (each["abductor"].surface().vertices for each in (loaded, run))
    np.testing.assert_array_equal(wanted, run.frames[-1].surfaces["abductor"].vertices)
    np.testing.assert_allclose(found, wanted, rtol=1e-6)
    np.testing.assert_array_equal(
        loaded.values("abductor", "length"), run.values("abductor", "length")
    )
    assert "nope" not in loaded.frames[0].surfaces and loaded.save(loaded.directory) is None
    assert run.info.times["wall"] == run.info.times["wall"]
    loaded.save(tmp_path / "copy")
    assert len(rm.Run.load(tmp_path / "copy")) == 3
    with pytest.raises(rm.UsageError, match="holds no run"):
        rm.Run.load(tmp_path)


def test_run_in_memory_and_loaded_answer_alike(run, loaded):
    assert {name for name in dir(run) if name[0] != "_"} == {
        name for name in dir(loaded) if name[0] != "_"
    }
    assert (loaded.units, loaded.bones, loaded.colours) == (run.units, run.bones, run.colours)
    assert loaded.frame_numbers == run.frame_numbers == [0, 1, 2]
    assert loaded.metrics == run.metrics and loaded.events == run.events
    assert frame_caption(loaded, 1) == frame_caption(run, 1)
    for name in run.bones:
        for mine, other in zip(run.meshes.bone(name), loaded.meshes.bone(name), strict=True):
            np.testing.assert_allclose(other, mine, rtol=1e-6)  # files are in single precision


def test_surface_in_another_unit(run, loaded):
    for shown in (run, loaded):
        wanted = 1e-3 * shown["abductor"].surface(1).vertices
        np.testing.assert_allclose(shown["abductor"].surface(1, units="m").vertices, wanted)
        with pytest.raises(rm.UsageError, match="units must be m, cm or mm, got 'inch'"):
            shown["abductor"].surface(units="inch")


def test_show_takes_a_run_in_memory_and_a_loaded_one(run, loaded):
    for shown in (run, loaded):
        page = rm.show(shown)
        try:
            assert page.address.startswith("http://127.0.0.1:")
        finally:
            page.close()


def test_table_has_the_coordinates_of_each_row_whatever_is_installed(run, loaded, monkeypatch):
    monkeypatch.setitem(sys.modules, "pandas", types.SimpleNamespace(DataFrame=dict))
    for shown in (run, loaded):
        table = shown.table()
        assert len(table) == len(run.metrics)
        lengths = table[(table["quantity"] == "length") & (table["muscle"] == "abductor")]
        np.testing.assert_array_equal(lengths["value"], run.values("abductor", "length"))
        assert lengths["frame"].tolist() == [0, 1, 2] and set(lengths["unit"]) == {"mm"}
        (moved,) = [name for name, x in shown.coordinates.items() if np.ptp(x) > 0]
        np.testing.assert_allclose(lengths[moved], [0.0, 2.0, 4.0], atol=1e-12)  # degrees
        np.testing.assert_allclose(
            np.radians(shown.coordinates[moved]), [f.coordinates[moved] for f in run.frames]
        )
        arms = table[table["quantity"] == "moment_arm"]
        assert set(arms["coordinate"]) == {moved} and set(lengths["coordinate"]) == {""}


def test_values_are_of_known_names_and_moment_arms_of_one_coordinate(run, loaded):
    for one in (run, loaded):
        with pytest.raises(rm.UsageError, match="unknown muscle 'abducter', did you mean"):
            one.values("abducter", "length")
        with pytest.raises(rm.UsageError, match="'lenght' was not measured of 'abductor', did you"):
            one["abductor"].values("lenght")
        with pytest.raises(rm.UsageError, match="'length' has no coordinate"):
            one.values("abductor", "length", coordinate="hip.flexion")
    assert len(run.values("all", "time_frame")) == 3
    rows = [
        Row(k, f"hip.{name}", 0.0, "abductor", "moment_arm", 1.0 * k + (name == "b"), "mm")
        for name in "ab"
        for k in range(2)
    ]
    meshes = SceneMeshes(run.scene)
    two = rm.Run(run.info, [], rows, meshes)
    with pytest.raises(rm.UsageError, match=r"about hip\.a, hip\.b; name one with coordinate="):
        two.values("abductor", "moment_arm")
    assert two["abductor"].values("moment_arm", coordinate="hip.b").tolist() == [1.0, 2.0]
    with pytest.raises(rm.UsageError, match=r"no moment arm about 'hip\.c', did you mean"):
        two.values("abductor", "moment_arm", coordinate="hip.c")
    about_one = rm.Run(run.info, [], rows[:2], meshes)
    assert about_one.values("abductor", "moment_arm").tolist() == [0.0, 1.0]


def test_plot_shows_every_value(run):
    import matplotlib

    matplotlib.use("Agg")
    (line,) = run.plot("length").lines
    np.testing.assert_array_equal(line.get_ydata(), run.values("abductor", "length"))
    (arms,) = run.plot("moment_arm").lines
    np.testing.assert_allclose(arms.get_xdata(), [0.0, 2.0, 4.0], atol=1e-12)  # degrees
    np.testing.assert_array_equal(arms.get_ydata(), run.values("abductor", "moment_arm"))
    with pytest.raises(rm.UsageError, match=r"no moment arm about 'hip\.twist'"):
        run.plot("moment_arm", coordinate="hip.twist")
    with pytest.raises(rm.UsageError, match="did you mean 'length'"):
        run.plot("lenght")


@pytest.fixture(scope="module")
def studies():
    """What each study finds of a small scene, without a folder."""
    scene = rm.phantom_scene(end=2.0, step=2.0, spacing=6.0)
    scene.muscles = [scene.muscle("abductor")]
    return [
        rm.compare(scene, models=["pbd", "xpbd"], jobs=1, pictures=False),
        rm.sweep(scene.with_options(model="pbd"), settings={"contact.substep_angle": 1.0}, jobs=1),
        rm.study_kernels(scene, kernels=["cubic"], centres=[40], resolution=24, jobs=1),
    ]


@pytest.mark.parametrize("place", range(3))
def test_what_a_study_returns_is_a_table_that_is_saved_and_shown(
    studies, place, tmp_path, monkeypatch
):
    found = studies[place]
    table = found.table()
    assert len(table) and set(table.dtype.names) & {"value", "error_rms", "rms"}
    found.save(tmp_path / "out")
    found.save(tmp_path / "out")  # an earlier result is replaced
    names = {"compare": "comparison.csv", "sweep": "sweep.csv", "kernels": "kernels.csv"}
    lines = (tmp_path / "out" / names[found.command]).read_text(encoding="utf-8").splitlines()
    assert lines[0].split(",") == list(table.dtype.names) and len(lines) == len(table) + 1
    page = tmp_path / "out" / found.page
    opened = []
    monkeypatch.setattr("webbrowser.open", opened.append)
    assert opened == [] and found.show().read_bytes() == page.read_bytes()
    assert opened[0].startswith("file://") and page.is_file()
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "notes.txt").write_text("mine")
    with pytest.raises(rm.UsageError, match=r"notes\.txt"):
        found.save(tmp_path / "mine")


def test_runs_of_a_comparison_are_saved_with_it(studies, tmp_path):
    studies[0].save(tmp_path / "out")
    assert len(rm.Run.load(tmp_path / "out" / "xpbd")) == 2


def test_files_of_a_study_without_a_folder_go_with_it():
    ball = trimesh.creation.icosphere(2, 10.0)
    found = rm.study_kernels(ball, kernels=["cubic"], centres=[30], resolution=16)
    kept = found._folder
    assert kept.is_dir()
    del found
    gc.collect()
    assert not kept.parent.exists()


def test_a_grid_in_the_place_of_the_folder_and_an_old_name_are_named():
    with pytest.raises(rm.UsageError, match="grid by its name"):
        rm.sweep("phantom", {"model.nodes": [100]})
    with pytest.raises(AttributeError, match=r"rbfmuscle\.compare now"):
        _ = rm.compare_models
    with pytest.raises(rm.UsageError, match="jobs must be 1 or more"):
        rm.compare("phantom", jobs=0)


def test_no_public_name_is_that_of_a_module():
    """Importing the module would put it in the place of what is exported."""
    assert not [name for name in rm.__all__ if importlib.util.find_spec(f"rbfmuscle.{name}")]


def test_notebooks_show_a_small_picture(run, loaded):
    for shown in (run, loaded):
        html = shown._repr_html_()
        assert html.startswith("<figure><img ") and len(html) < 100_000 and "abductor" in html
