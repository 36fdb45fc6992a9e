"""The kernel study on a mesh of known shape, and its command."""

import json
import tomllib
import warnings

import numpy as np
import pytest
import trimesh
from command_line import call

import rbfmuscle as rm
from rbfmuscle.geometry.mesh_distance import MeshDistance
from rbfmuscle.geometry.surfaces import mesh_hash
from rbfmuscle.geometry.threads import thread_count, threads_limited
from rbfmuscle.implicit.field import RBFField
from rbfmuscle.implicit.placement import sample_surface
from rbfmuscle.implicit.selection import SPAN
from rbfmuscle.studies import kernels
from rbfmuscle.studies.kernels import (
    ENDS,
    STEP,
    KernelRow,
    KernelStudy,
    ReferenceSurface,
    at_end,
    describe,
    reach_error,
    recommend,
    write_page,
)
from rbfmuscle.validation import MeshError, UsageError


@pytest.fixture(scope="module")
def ellipsoid():
    return trimesh.creation.icosphere(subdivisions=3).apply_scale([40.0, 18.0, 12.0])


@pytest.fixture(scope="module")
def study(ellipsoid):
    kernels = ["linear", "cubic", "gaussian", "matern_52"]
    return rm.study_kernels(ellipsoid, kernels=kernels, centres=[40, 80], resolution=32, units="mm")


def test_the_sentence_names_those_alike_and_that_the_most_centres_were_best():
    def row(kernel, centres, rms):
        times = {"fit_time": 1.0, "evaluation_time": 1.0}
        return KernelRow(kernel=kernel, centres=centres, rms=rms, condition=1e3, **times)

    rows = [row("cubic", 80, 1.0), row("quintic", 80, 1.02), row("cubic", 40, 3.0)]
    text = describe(rows)
    assert "errors of cubic, quintic are within 5 % of the least" in text
    assert text.endswith("More centres may lower the error further.")
    assert "More centres" not in describe(rows[:2])
    assert "More centres" not in describe([row("cubic", 80, 1.0), row("cubic", 40, 0.5)])


def test_rows_are_ranked_and_more_centres_err_less(study):
    good = [row.rms for row in study.rows if not row.unfit]
    assert good == sorted(good) and len(study.rows) == 8
    assert all(row.unfit for row in study.rows[len(good) :])
    error = {(row.kernel, row.centres): row.rms for row in study.rows}
    for kernel in ("linear", "cubic", "matern_52"):
        assert error[kernel, 80] < error[kernel, 40]
    assert error["cubic", 80] < 0.6 * error["linear", 80]


def test_numbers_are_those_of_the_surface(study, ellipsoid):
    for row, surface in zip(study.rows, study.surfaces, strict=True):
        if surface is None:
            assert row.unfit
            continue
        vertices, faces = surface
        assert 0 < row.rms <= row.hausdorff
        volume = trimesh.Trimesh(vertices, faces, process=False).volume
        assert row.volume_error == pytest.approx(volume / ellipsoid.volume - 1.0, abs=1e-9)
        # The implicit form x^2/a^2 + ... = 1 is met where the row says so.
        radius = np.sqrt(((vertices / [40.0, 18.0, 12.0]) ** 2).sum(axis=1))
        assert np.abs(radius - 1.0).max() * 12.0 <= row.hausdorff + 0.2
        if (
            row.epsilon
        ):  # the shape parameter is per spacing, about the root of the area of each centre
            spacing = row.shape / row.epsilon
            assert 0.5 < spacing / np.sqrt(ellipsoid.area / row.centres) < 1.5


def test_lines_to_paste_give_the_row(study):
    row = next(row for row in study.rows if row.kernel == "matern_52")
    table = tomllib.loads(row.toml())["muscle"]["model"]
    assert table["kernel"] == "matern_52" and table["centres"] == row.centres
    assert table["epsilon"] == pytest.approx(row.epsilon, rel=1e-5)
    assert "condition = 1e+10" in row.model_copy(update={"bound": 1e10}).toml()


def test_a_study_on_several_threads_is_that_of_one():
    ball = trimesh.creation.icosphere(3, 10.0).apply_scale([2.0, 1.0, 1.0])
    asked = {"kernels": ["cubic", "gaussian"], "centres": [30], "resolution": 24}
    rows = {}
    threads = thread_count()
    filters = list(warnings.filters)
    for count in (1, threads):
        with threads_limited(count):
            rows[count] = {
                (row.kernel, row.centres): row for row in rm.study_kernels(ball, **asked).rows
            }
    assert warnings.filters == filters
    for key, row in rows[1].items():
        same = rows[threads][key]
        assert row.unfit == same.unfit and row.epsilon == pytest.approx(same.epsilon, rel=1e-9)
        if not row.unfit:
            assert row.rms == pytest.approx(same.rms, rel=1e-6)
            assert same.fit_time > 0.0 and same.evaluation_time > 0.0


def row(kernel, rms, milliseconds, *, condition=1e6, epsilon=0.0, unfit=""):
    return KernelRow(
        kernel=kernel,
        centres=80,
        rms=rms,
        fit_time=milliseconds * 1e-3,
        evaluation_time=0.0,
        condition=condition,
        epsilon=epsilon,
        unfit=unfit,
    )


@pytest.mark.parametrize(
    ("rows", "wanted"),
    [
        (
            [row("multiquadric", 0.1407, 20.0), row("cubic", 0.143, 2.0), row("linear", 0.4, 1.0)],
            "cubic",
        ),
        ([row("quintic", 0.10, 20.0), row("cubic", 0.14, 2.0)], "quintic"),  # really better
        ([row("a", 0.14, 2.0, epsilon=0.2), row("b", 0.14, 2.2)], "b"),  # no parameter to choose
        ([row("a", 0.14, 2.0, epsilon=0.2), row("b", 0.14, 2.4)], "a"),  # quicker
        ([row("a", 0.14, 2.0, condition=1e8), row("b", 0.14, 2.0)], "b"),  # better conditioned
        ([row("a", 0.14, 1.0, condition=1e12), row("b", 0.14, 2.0)], "b"),  # sound
        ([row("gaussian", 0.05, 1.0, unfit="9 sheets"), row("cubic", 0.15, 2.0)], "cubic"),
        ([row("gaussian", 0.05, 1.0, unfit="9 sheets")], None),
    ],
)
def test_the_quickest_of_those_alike_is_recommended(rows, wanted):
    found = recommend(rows)
    assert (found and found.kernel) == wanted


def test_wrong_requests_are_answered(ellipsoid):
    for wrong in ({"centres": [4]}, {"kernels": ["cubics"]}):
        with pytest.raises(UsageError):
            rm.study_kernels(ellipsoid, **wrong)
    for wrong in ({"error": -1.0}, {"error": np.nan}):
        with pytest.raises(UsageError):
            reach_error(ellipsoid, **wrong)
    with pytest.raises(MeshError):
        rm.study_kernels((np.full((3, 3), np.nan), np.array([[0, 1, 2]])))


def test_command_ranks_and_prints(tmp_path, capsys):
    words = [
        "phantom",
        "--muscles",
        "adductor_posterior",
        "--kernels",
        "cubic,matern_52",
        "--centres",
        "60",
    ]
    code, out, _ = call(capsys, "kernels", *words, "--resolution", "40", "-o", tmp_path / "new/k")
    assert code == 0 and "use " in out.lower() and "[muscle.model]" in out
    rows = json.loads((tmp_path / "new/k/kernels.json").read_text(encoding="utf-8"))["rows"]
    assert {row["kernel"] for row in rows} == {"cubic", "matern_52"}
    page = tmp_path / "new/k/kernels.html"
    first = page.read_text(encoding="utf-8")
    digest = mesh_hash(*_muscle("adductor_posterior"))
    assert f"mesh {digest[:12]}" in first and f"rbfmuscle {rm.__version__}, 20" in first
    page.unlink()
    assert call(capsys, "report", page.parent)[0] == 0
    assert page.read_text(encoding="utf-8") == first


def test_a_study_in_python_writes_what_the_command_does(tmp_path, ellipsoid):
    asked = {"kernels": ["cubic"], "centres": [30], "resolution": 16}
    (row,) = rm.study_kernels(ellipsoid, tmp_path / "out", **asked).rows
    kept = json.loads((tmp_path / "out/kernels.json").read_text(encoding="utf-8"))["rows"]
    assert kept[0]["rms"] == row.rms and (tmp_path / "out/kernels.html").exists()
    (tmp_path / "other").mkdir()
    (tmp_path / "other/notes.txt").write_text("mine")
    with pytest.raises(UsageError, match=r"notes\.txt"):
        rm.study_kernels(ellipsoid, tmp_path / "other", **asked)


def _muscle(name):
    mesh = rm.phantom_scene().muscle(name).mesh
    return mesh.vertices, mesh.faces


def test_rows_that_err_more_than_the_coarsest_kernel_are_unfit():
    rows = [row("linear", 0.4, 1.0), row("buhmann", 0.9, 1.0), row("cubic", 0.1, 1.0)]
    kernels._refuse_coarse(rows)
    assert [one.unfit for one in rows] == ["", "an error of 0.9, beyond that of linear, 0.4", ""]


def test_slender_muscles_are_looked_at_with_finer_cells(ellipsoid):
    """With 128 cells along it a spindle of 40 times its width is three cells thick."""
    rod = trimesh.creation.icosphere(subdivisions=4).apply_scale([200.0, 5.0, 5.0])
    assert ReferenceSurface(np.array(rod.vertices), np.asarray(rod.faces)).resolution == 320
    assert ReferenceSurface(ellipsoid.vertices, ellipsoid.faces).resolution == 128


@pytest.fixture(scope="module")
def egg(ellipsoid):
    """An ellipsoid of which no two parts are alike, so that rounding chooses nothing."""
    x, y, z = (ellipsoid.vertices / 20.0).T
    shape = (
        ellipsoid.vertices
        * (1.0 + 0.1 * np.sin(x + 2.0 * y + 0.4) + 0.05 * np.cos(3.0 * z - x))[:, None]
    )
    return trimesh.Trimesh(shape, ellipsoid.faces, process=False)


@pytest.fixture(scope="module")
def found(egg):
    return reach_error(egg, 0.1, kernels=["cubic", "linear"])


def test_the_error_is_reached_by_the_surface_itself(found, egg):
    assert found.reached and found.error <= 0.1 and found.row.kernel == "cubic"
    sample = sample_surface(egg.vertices, egg.faces, found.row.centres, placement="greedy")
    surface = RBFField.fit_hermite(sample.points, sample.normals).surface(resolution=96)
    points = trimesh.sample.sample_surface(egg, 3000, seed=5)[0]
    there = MeshDistance(np.asarray(surface.vertices), np.asarray(surface.faces)).unsigned(points)
    assert np.sqrt((there**2).mean()) < 0.1 * 1.05  # one way, by other points and another grid


def test_a_number_four_per_cent_smaller_was_seen_to_fail(found):
    count = found.row.centres
    below = [t for t in found.tried if t.kernel == "cubic" and t.centres < count]
    assert below and all(t.error > 0.1 for t in below)
    assert count - max(t.centres for t in below) <= max(1, STEP * count)


def test_command_with_an_error_says_what_to_paste(tmp_path, ellipsoid, capsys, monkeypatch):
    ellipsoid.export(tmp_path / "muscle.ply")
    words = [tmp_path / "muscle.ply", "-o", tmp_path / "new/out"]
    words += ["--kernels", "cubic"]
    code, said, _ = call(capsys, "kernels", *words, "--error", "0.4", "--units", "mm")
    assert code == 0 and "reaches" in said and "mm RMS" in said
    facts = json.loads((tmp_path / "new/out/error.json").read_text(encoding="utf-8"))["muscle"]
    assert facts["reached"] and facts["error"] <= 0.4
    table = tomllib.loads(facts["toml"])["muscle"]["model"]
    assert table["kernel"] == "cubic" and table["centres"] == facts["row"]["centres"]
    monkeypatch.setattr(kernels, "MOST", 24)
    code, said, _ = call(capsys, "kernels", *words, "--error", "1e-5")
    assert code == 0 and "is not reached; the best, cubic, 24 centres" in said


def test_page_has_curves_of_epsilon_flags_its_ends_and_folds_unfit_rows(tmp_path, ellipsoid):
    study = rm.study_kernels(ellipsoid, kernels=["gaussian", "cubic"], centres=[30], resolution=24)
    (gaussian,) = (row for row in study.rows if row.kernel == "gaussian")
    shapes, errors = np.array(gaussian.trials).T
    assert (np.diff(shapes) > 0).all() and len(shapes) > 20 and (errors > 0).all()
    best = shapes[errors.argmin()]
    assert errors[np.abs(shapes - gaussian.shape).argmin()] <= 1.5 * errors.min()
    assert SPAN[0] <= best <= SPAN[1]
    assert at_end(SPAN[0]) and at_end(SPAN[1]) and not at_end(1.0)
    rows = [row.model_copy(update={"surface": "m"}) for row in study.rows]
    rows[0].shape = SPAN[1]
    planted = {"surface": "m", "unfit": "open", "kernel": "planted"}
    rows.append(gaussian.model_copy(update=planted))
    meshes = {"m": "0" * 64}
    write_page(tmp_path, KernelStudy(units="mm", version="1", date="2", meshes=meshes, rows=rows))
    page = (tmp_path / "kernels.html").read_text(encoding="utf-8")
    assert ENDS in page and "Error against epsilon: m" in page
    assert page.index("Fitted rows of m") < page.index("Unfit rows of m") < page.rindex("planted")
