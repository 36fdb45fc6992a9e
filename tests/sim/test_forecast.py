"""Memory and time foretold: counts against what is then built, and how they add up; speed itself is not tested."""

import subprocess
import sys

import numpy as np
import pytest
from conftest import ROOT
from plan_check import corrected, corrections, remade

from rbfmuscle.model.cost import dense_count
from rbfmuscle.models import MODEL_NAMES, build_model, estimate_model
from rbfmuscle.sim.distance.sdf import BoneSDF
from rbfmuscle.sim.loop.contact import BoneContacts
from rbfmuscle.sim.plan.forecast import FieldCost, MuscleCost, estimate_field, forecast, side_by_side
from rbfmuscle.sim.plan.rates import _bumpy_sphere, measure_rates, scales
from rbfmuscle.sim.scene.phantom import phantom_scene

RATES = {"call": 1e-6, "visit": 1e-9, "query": 1e-6}


@pytest.fixture(scope="module")
def scene():
    return phantom_scene()


@pytest.fixture(autouse=True)
def own_cache(tmp_path, monkeypatch):
    monkeypatch.setenv("RBFMUSCLE_CACHE", str(tmp_path))


@pytest.mark.parametrize("part", [1.0, 0.5])
def test_field_has_the_foretold_cells_and_memory(scene, part):
    mesh = scene.bones[1].mesh
    low, high = mesh.bounds
    box = np.array([[*low[:2], high[2] - part * (high[2] - low[2])], high])
    cost = estimate_field(mesh, box)
    assert not cost.kept
    field = BoneSDF.from_mesh(mesh, region=box)
    # A tenth: blocks are counted at 4,000 random places.
    assert cost.cells == pytest.approx(field.fine_cells, rel=0.1)
    assert cost.memory == pytest.approx(field.memory, rel=0.1)
    assert estimate_field(mesh, box).kept


def test_rbf_muscle_has_the_foretold_surface_and_matrix(scene):
    from rbfmuscle.model import cost

    muscle = scene.muscles[1]
    foretold = estimate_model(muscle, scene, RATES)
    model = build_model(muscle, scene)
    assert foretold.carried == len(model.carried_mesh()[0])
    assert foretold.shown == len(model.drawer.shown.rest)
    hanging = model.rest.columns.nbytes + model.rest.shares.nbytes
    assert len(model.rest.columns) * cost.HANGING_BYTES == hanging
    unknowns = cost._unknowns(model.options, len(model.points))
    assert unknowns == 4 * len(model.points)
    assert foretold.memory > hanging + model.solver.inverse.nbytes


def test_what_a_surface_takes_while_it_is_made_grows_with_the_matrix_of_the_fit(scene):
    from rbfmuscle.model.cost import estimate_muscle
    from rbfmuscle.model.options import RBFOptions

    working = [
        estimate_muscle(
            scene.muscles[0], scene, RATES, RBFOptions(centres=count, resolution=48, placement="fitted")
        ).working
        for count in (100, 200, 400)
    ]
    # Twice the centres are twice the unknowns, and a matrix and its factor four times as large.
    assert (working[2] - working[1]) / (working[1] - working[0]) == pytest.approx(4.0, rel=0.05)
    assert working[1] - working[0] == pytest.approx(2 * 8 * (800**2 - 400**2), rel=0.05)


def test_more_centres_cells_and_iterations_take_more(scene):
    from rbfmuscle.model.cost import estimate_muscle
    from rbfmuscle.model.options import RBFOptions

    plain = estimate_muscle(scene.muscles[0], scene, RATES, RBFOptions(centres=150))
    many = estimate_muscle(scene.muscles[0], scene, RATES, RBFOptions(centres=600))
    assert many.show > plain.show and many.memory > 4 * plain.memory and many.build > plain.build
    coarse, fine = (
        estimate_muscle(scene.muscles[0], scene, RATES, RBFOptions(centres=150, resolution=n))
        for n in (48, 96)
    )
    assert fine.shown == pytest.approx(4 * coarse.shown, abs=4) and fine.show > coarse.show
    twice = estimate_muscle(scene.muscles[0], scene, RATES, RBFOptions(centres=150, iterations=16))
    assert plain.step < twice.step < 2 * plain.step
    unwatched = scene.copy()
    unwatched.detect = None
    watched = estimate_muscle(scene.muscles[0], scene, RATES, RBFOptions(centres=150))
    assert estimate_muscle(scene.muscles[0], unwatched, RATES, RBFOptions(centres=150)).step < watched.step


@pytest.mark.parametrize("nodes", [150, 300])
def test_an_inside_has_the_foretold_contact_points_and_memory(scene, nodes):
    changed = scene.with_options({"model.inside": nodes})
    plain, foretold = (estimate_model(made.muscles[1], made, RATES) for made in (scene, changed))
    model = build_model(changed.muscles[1], changed)
    solid = model.interior
    solid.settle(BoneContacts([], [], contact_bone=solid.owner))
    arrays = (solid.columns, solid.shares, solid.slopes_at, solid.inverse, solid.matrix, solid.response)
    # A third: cells are whole numbers, so nodes are fewer than asked for; centres are left out.
    assert sum(array.nbytes for array in arrays) == pytest.approx(foretold.memory, rel=0.33)
    assert dense_count(changed.muscles[1], model.options) == pytest.approx(
        len(solid.points) - len(model.points), rel=0.05
    )
    assert foretold.step > plain.step * 0.5 and foretold.memory > plain.memory


def test_mesh_muscle_whose_weights_are_on_disk_is_built_sooner(scene):
    changed = scene.with_options(model="pbd")
    muscle = changed.muscles[1]
    anew = estimate_model(muscle, changed, RATES)
    assert anew.shown == anew.carried == len(muscle.mesh.vertices)
    build_model(muscle, changed)
    assert estimate_model(muscle, changed, RATES).build < 0.2 * anew.build


def test_tasks_are_taken_in_order_by_the_first_free_thread():
    assert side_by_side([3.0, 2.0], 1) == 5.0
    assert side_by_side([3.0, 2.0, 2.0, 1.0], 2) / side_by_side([4.0, 4.0], 2) == pytest.approx(1.0)
    assert side_by_side([1.0], 8) == 1.0


def test_time_and_memory_add_up(scene):
    bare = scene.with_options({"output.metrics": False, "output.surfaces": False}, frames="0:10:1")
    muscle = MuscleCost(build=2.0, step=0.1, show=0.5, memory=1e6, working=1e5, carried=10, shown=10)
    memory, time = forecast(
        bare,
        [FieldCost(1e6, 4e6, False)],
        [muscle],
        work=[{"substeps": 20, "solved": 5}],
        rates=RATES,
        resident=5e7,
        threads=1,
    )
    # No surfaces and no metrics: nothing is shown.
    assert time["frame"] == {"muscles": 0.2, "metrics": 0.0, "write": 0.0, "total": 0.2}
    assert time["build"]["muscles"] == 2.0 and time["build"]["metrics"] == 0.0
    assert time["total"] == pytest.approx(time["build"]["total"] + 10 * 0.2)
    assert (memory["fields"], memory["muscles"], memory["metrics"]) == (4e6, 1e6, 0.0)
    assert memory["peak"] > memory["total"] + 5e7


def test_rates_are_measured_on_a_closed_outward_mesh():
    import trimesh

    mesh = trimesh.Trimesh(*_bumpy_sphere(12), process=False)
    assert mesh.is_watertight and mesh.volume > 0
    rates = measure_rates()
    # How quick each is depends on the machine and on what else it does.
    assert all(0 < rate < np.inf for rate in rates.values())


def test_plan_loads_no_graphics_and_builds_nothing():
    code = (
        "import sys\n"
        "from rbfmuscle.models import estimate_model\n"
        "from rbfmuscle.sim.scene.phantom import phantom_scene\n"
        "from rbfmuscle.sim.plan.plan import plan_scene\n"
        "from rbfmuscle.sim.distance.sdf import BoneSDF\n"
        "BoneSDF.from_mesh = None\n"
        "plan_scene(phantom_scene(), estimate_model)\n"
        "print([m for m in sys.modules if m.split('.')[0] in ('vtk', 'vtkmodules', 'pyvista', 'matplotlib')])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, timeout=120, check=True
    )
    assert done.stdout.strip() == "[]", done.stderr


def test_scales_name_every_model_and_where_they_come_from():
    found = scales()
    assert set(found["models"]) == set(MODEL_NAMES)
    every = [found[part] for part in ("checks", "lines", "metrics", "write")]
    every += [*(v for row in found["models"].values() for v in row.values())]
    # Beyond a factor of twenty the counts of work themselves describe another program.
    assert all(0.05 < value < 20.0 for value in every)
    assert all(isinstance(found[key], str) and found[key] for key in ("command", "commit", "machine", "date"))


def test_scales_multiply_what_is_foretold(scene, monkeypatch):
    before = estimate_model(scene.muscles[0], scene, RATES)
    build, motion = scales()["models"]["rbf"].values()
    twice = {"build": 2 * build, "motion": 3 * motion}
    monkeypatch.setitem(scales()["models"], "rbf", twice)
    after = estimate_model(scene.muscles[0], scene, RATES)
    assert after.build == pytest.approx(2 * before.build)
    assert (after.step, after.show) == pytest.approx((3 * before.step, 3 * before.show))
    assert after.memory == before.memory


def test_scales_made_anew_agree_with_what_was_measured():
    """Runs that take twice what was foretold double the scale, those of other models stay; sums go along."""
    parts = {"checks": [2.0, 1.0], "lines": [1.0, 1.0], "metrics": [1.0, 1.0], "write": [1.0, 0.25]}
    row = {"build": [1.0, 2.0], "motion": [0.1, 0.4], **parts, "total": [27.0, 20.0]}
    rows = {"one: rbf": row, "two: rbf": {**row, "motion": [0.1, 0.1]}}
    found = corrections(rows)
    old = {"models": {"rbf": {"build": 1.5, "motion": 1.0}, "pbd": {"build": 1.2, "motion": 0.8}},
           "checks": 1.0, "lines": 3.0, "metrics": 0.7, "write": 2.0}  # fmt: skip
    new = remade(old, found)
    assert new["models"]["rbf"] == {"build": 3.0, "motion": 2.0}
    assert new["models"]["pbd"] == old["models"]["pbd"]
    assert [new[part] for part in parts] == [0.5, 3.0, 0.7, 0.5]
    after = corrected("one: rbf", row, 10, found)
    assert after["motion"] == pytest.approx([0.2, 0.4])
    # One second more of building, one less of checks, and in ten frames a second more of motion, 7.5 less of files.
    assert after["total"] == pytest.approx([27.0 + 1.0 - 1.0 + 1.0 - 7.5, 20.0])


def test_a_mesh_model_that_keeps_a_factor_takes_more_memory_than_one_that_does_not(scene):
    memory = {
        method: estimate_model(scene.with_options(model=method).muscles[0], scene, RATES).memory
        for method in ("pbd", "xpbd", "arap-pbd", "arap-volume")
    }
    assert 0 < memory["pbd"] == memory["xpbd"] < memory["arap-volume"]
