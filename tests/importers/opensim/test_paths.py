"""Fitted paths: the fit itself, the file that OpenSim takes, and the command."""

import re
from xml.etree import ElementTree

import numpy as np
import pytest
from command_line import call

from rbfmuscle.cli.paths import parse_ranges, parse_targets
from rbfmuscle.scene.joints import exponents
from rbfmuscle.scene.objects import Motion
from rbfmuscle.scene.phantom import phantom_scene
from rbfmuscle.simulation.contact_pairs import find_contact_pairs
from rbfmuscle.studies.paths import (
    SHIFT,
    FittedPath,
    Samples,
    _reached,
    _tour,
    fit_path,
    report_fits,
    sample_muscles,
    write_paths,
)
from rbfmuscle.validation import SolveError, UsageError


def smooth(q):
    """A length over two coordinates, and its arms."""
    x, y = q.T
    length = 100 + 20 * np.sin(x) - 8 * np.cos(0.7 * y) + 5 * x * y
    return length, np.stack([-(20 * np.cos(x) + 5 * y), -(5.6 * np.sin(0.7 * y) + 5 * x)], axis=1)


def made(count=60):
    values = np.random.default_rng(3).uniform([-0.5, 0.2], [1.2, 0.9], (count, 2))
    return values, *smooth(values)


def test_fit_holds_at_poses_that_it_has_not_seen():
    path = fit_path("m", ("a.x", "b.y"), *made())
    held = np.random.default_rng(4).uniform([-0.5, 0.2], [1.2, 0.9], (200, 2))
    length, arms = smooth(held)
    assert np.sqrt(np.mean((path.length(held) - length) ** 2)) < 1e-3
    assert np.sqrt(np.mean((path.arms(held) - arms) ** 2)) < 1e-2


@pytest.mark.parametrize("unit", [1e-3, 0.1])
def test_fit_over_a_shift_does_not_depend_on_the_unit(unit):
    """A rotation and a shift [mm], with noise that no polynomial fits, in another unit."""
    rng = np.random.default_rng(6)
    turn, shift = rng.uniform([-0.5, -30.0], [1.2, 30.0], (80, 2)).T
    lengths = 300.0 + 20.0 * np.sin(turn) + 0.3 * shift + rng.normal(scale=2.0, size=80)
    arms = np.stack([-20.0 * np.cos(turn), np.full(80, -0.3)], axis=1)
    arms = arms + rng.normal(scale=[2.0, 0.05], size=arms.shape)

    def length(unit):
        values = np.stack([turn, unit * shift], axis=1)
        radian = np.array([1.0, unit * SHIFT])
        given = values, unit * lengths, arms * [unit, 1.0]
        path = fit_path("m", ("a.turn", "a.shift"), *given, radian=radian)
        return path.length(values) / unit

    np.testing.assert_allclose(length(unit), length(1.0), rtol=1e-9)


def test_file_is_in_metres_with_terms_in_the_order_of_opensim(tmp_path):
    assert exponents(2, 2).tolist() == [[0, 0], [0, 1], [0, 2], [1, 0], [1, 1], [2, 0]]
    turning = {"ankle.angle": True, "rail.s": False}
    path = FittedPath("soleus", ("ankle.angle", "rail.s"), 1, np.array([300.0, 2.0, -40.0]))
    write_paths(tmp_path / "p.xml", [path], 1000.0, turning, {"rail.s": "/jointset/r/t"})
    root = ElementTree.parse(tmp_path / "p.xml").getroot()
    item = root.find(".//FunctionBasedPath")
    assert item.get("name") == "/forceset/soleus"
    assert item.find("coordinate_paths").text.split() == [
        "/jointset/ankle/angle",
        "/jointset/r/t",
    ]
    assert [float(x) for x in root.find(".//coefficients").text.split()] == pytest.approx(
        [0.3, 2.0, -0.04]
    )


def test_opensim_loads_the_file_and_gives_the_same_numbers(tmp_path):
    # By a module of the package: this folder alone would pass for a namespace package of its name.
    pytest.importorskip("opensim.simulation")
    osim = pytest.importorskip("opensim")
    path = fit_path("m", ("a.x", "b.y"), *made())
    write_paths(tmp_path / "p.xml", [path], 1000.0, {"a.x": True, "b.y": True}, {})
    model = osim.Model()
    parent = model.getGround()
    coordinates = []
    for joint, name in (("a", "x"), ("b", "y")):
        body = osim.Body(f"body_{name}", 1.0, osim.Vec3(0), osim.Inertia(1))
        pin = osim.PinJoint(joint, parent, body)
        pin.updCoordinate().setName(name)
        model.addBody(body)
        model.addJoint(pin)
        parent = body
    muscle = osim.Millard2012EquilibriumMuscle("m", 100.0, 0.05, 0.1, 0.0)
    muscle.addNewPathPoint("p", model.getGround(), osim.Vec3(0))
    muscle.addNewPathPoint("q", parent, osim.Vec3(0.1))
    model.addForce(muscle)
    model.finalizeConnections()
    processor = osim.ModelProcessor(model)
    processor.append(osim.ModOpReplacePathsWithFunctionBasedPaths(str(tmp_path / "p.xml")))
    model = processor.process()
    state = model.initSystem()
    muscle = osim.Muscle.safeDownCast(model.getForceSet().get("m"))
    coordinates = [model.getCoordinateSet().get(name) for name in "xy"]
    for values in ([0.0, 0.5], [0.9, 0.3]):
        for coordinate, value in zip(coordinates, values):
            coordinate.setValue(state, value)
        model.realizePosition(state)
        q = np.array([values])
        assert muscle.getLength(state) == pytest.approx(path.length(q)[0] / 1000, rel=1e-12)
        arms = [muscle.computeMomentArm(state, coordinate) for coordinate in coordinates]
        assert arms == pytest.approx(path.arms(q)[0] / 1000, rel=1e-6)


@pytest.fixture(scope="module")
def scene():
    found = phantom_scene(model="pbd", spacing=6.0)
    found.muscles = [found.muscle("abductor")]
    return found


RANGES = {
    "hip.flexion": (0.0, 0.4),
    "hip.adduction": (-0.1, 0.1),
    "hip.internal_rotation": (-0.1, 0.1),
}


def test_a_pose_has_one_length_whatever_was_sampled_before():
    scene = phantom_scene(spacing=6.0)
    scene.muscles = [scene.muscle("abductor")]
    ranges = {"hip.flexion": (0.0, 0.4)}
    ranges |= {name: (0.0, 0.0) for name in ("hip.adduction", "hip.internal_rotation")}
    (three,) = sample_muscles(scene, ranges, samples=3)
    (one,) = sample_muscles(scene, ranges, samples=1)
    # Sobol's sequence is scrambled for its whole length: the same points first, whatever the count.
    np.testing.assert_allclose(one.values, three.values[:1], rtol=1e-12)
    # One pose by two ways differs by up to 0.01 mm; an arm is a difference of two over 4 degrees.
    assert np.abs(one.lengths - three.lengths[:1]).max() < 0.02
    assert np.abs(one.arms - three.arms[:1]).max() < 0.5


def test_a_coordinate_is_held_at_a_value_and_no_other_is_sampled(scene):
    flexion = {"hip.flexion": (0.0, 0.3)}
    held = {name: (0.0, 0.0) for name in ("hip.adduction", "hip.internal_rotation")}
    (straight,) = sample_muscles(scene, flexion | held, samples=2)
    (apart,) = sample_muscles(scene, flexion | held | {"hip.adduction": (0.2, 0.2)}, samples=2)
    assert straight.coordinates == apart.coordinates == ("hip.flexion",)
    np.testing.assert_array_equal(straight.values, apart.values)
    # The abductor is 0.2 rad times its moment arm longer.
    assert (apart.lengths - straight.lengths > 2.0).all()
    with pytest.raises(UsageError, match="cannot be held"):
        sample_muscles(scene, {"hip.flexon": (0.0, 0.0)}, samples=2)


def test_all_coordinates_without_a_range_are_named_at_once(scene):
    missing = r"without a range: hip\.adduction, hip\.internal_rotation;"
    with pytest.raises(UsageError, match=missing):
        sample_muscles(scene, {}, samples=2)


def test_bones_are_sought_along_all_poses_and_at_the_corners_of_the_ranges():
    scene = phantom_scene(spacing=6.0)
    poses = [{"hip.flexion": 0.0, "hip.adduction": 0.0}] * 90
    poses += [{"hip.flexion": 1.0, "hip.adduction": 0.0}]
    found = _reached(scene, poses, {"hip.flexion": (0.0, 1.0), "hip.adduction": (-0.3, 0.3)})
    for pose in (poses[0], poses[-1], {"hip.flexion": 1.0, "hip.adduction": -0.3}):
        alone = scene.with_options()
        alone.motion = Motion([pose])
        for key, box in find_contact_pairs(alone).items():
            assert (found[key][0] <= box[0] + 1e-9).all() and (found[key][1] >= box[1] - 1e-9).all()


def test_poses_are_gone_through_on_a_short_way():
    values = np.random.default_rng(2).uniform(-1.0, 2.0, (60, 3))
    order = _tour(values, np.zeros(3), np.full(3, 3.0))
    assert sorted(order) == list(range(60))

    def way(order):
        return np.linalg.norm(np.diff(values[order], axis=0), axis=1).sum()

    assert way(order) < 0.5 * way(range(60))
    assert np.linalg.norm(values[order[0]]) == np.linalg.norm(values, axis=1).min()


def test_an_interrupt_keeps_the_poses_that_are_done(scene):
    held = {name: (0.0, 0.0) for name in ("hip.adduction", "hip.internal_rotation")}
    found = []

    def interrupt(done, total):
        assert total == 20  # of one coordinate
        if done == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        sample_muscles(scene, {"hip.flexion": (0.0, 0.3), **held}, progress=interrupt, found=found)
    (kept,) = found
    assert kept.values.shape == (3, 1) and np.isfinite(kept.arms).all()


@pytest.mark.parametrize(
    ("count", "ends"),
    [
        (12, r"paths from 12 poses are in \S+, moment arms wrong by up to \S+ mm RMS"),
        (3, "too few"),
    ],
)
def test_an_interrupted_command_writes_the_paths_of_these_poses(
    tmp_path, capsys, monkeypatch, count, ends
):
    def sample(scene, given, *, samples, fibres, progress, found):
        values, lengths, arms = made(count)
        for k in range(count):
            progress(k + 1, 20)
        names = ("hip.flexion", "hip.adduction")
        found.append(Samples("abductor", names, values, lengths, arms))
        raise KeyboardInterrupt

    monkeypatch.setattr("rbfmuscle.studies.paths.sample_muscles", sample)
    code, _, err = call(capsys, "paths", "phantom", "-o", tmp_path / "out")
    assert code == 130 and re.search(f"interrupted; .*{ends}", err)
    assert (tmp_path / "out" / "paths.xml").exists() == (count == 12)


def test_what_did_not_settle_is_an_error_after_the_paths_are_written(tmp_path, capsys, monkeypatch):
    def sample(scene, given, *, found, **options):
        found.append(Samples("abductor", ("hip.flexion", "hip.adduction"), *made(40), unsettled=2))
        return found

    monkeypatch.setattr("rbfmuscle.studies.paths.sample_muscles", sample)
    code, out, err = call(capsys, "paths", "phantom", "-o", tmp_path / "out")
    assert code == 5 and "did not settle: abductor at 2 poses" in err
    assert "abductor: order" in out and (tmp_path / "out" / "paths.xml").exists()


def test_each_fibre_is_sampled_as_a_path_of_its_own(scene):
    fibres = sample_muscles(scene, RANGES, samples=1, fibres=6)
    (muscle,) = sample_muscles(scene, RANGES, samples=1)
    assert [found.muscle for found in fibres] == [f"abductor_{k}" for k in range(1, 7)]
    arms = np.array([found.arms[0] for found in fibres])
    # The muscle is 25 mm thick, and its centreline among its fibres.
    assert (np.abs(arms - muscle.arms[0]) < 25.0).all()
    assert np.abs(arms.mean(axis=0) - muscle.arms[0]).max() < 5.0


def test_poses_that_fail_are_left_out_and_too_many_are_refused(tmp_path, scene):
    values, lengths, arms = made(20)
    lengths[3] = arms[4] = np.nan
    found = Samples("m", ("hip.flexion", "hip.adduction"), values, lengths, arms)
    assert "2 poses could not be solved" in report_fits(scene, [found], tmp_path)[1][0]
    lengths[:15] = np.nan
    with pytest.raises(SolveError, match="15 of 20 poses failed"):
        report_fits(scene, [found], tmp_path)


def test_ranges_are_checked(scene):
    assert parse_ranges(scene, ["flexion=0:90"])["hip.flexion"] == pytest.approx((0.0, np.pi / 2))
    assert parse_ranges(scene, ["flexion=90"])["hip.flexion"] == pytest.approx((np.pi / 2,) * 2)
    for text in (
        "flexion",
        "flexion=1:",
        "flexion=1:2:3",
        "flexion=9:1",
        "flexion=nan",
        "flexion=a:b",
        "flexion=0:inf",
        "foo=0:1",
    ):
        with pytest.raises(UsageError, match="--range"):
            parse_ranges(scene, [text])


def test_names_of_the_opensim_model_are_checked(scene):
    given = ["flexion=hip_r/hip_flexion_r", "hip.adduction=hip_r/add"]
    assert parse_targets(scene, given) == {
        "hip.flexion": "/jointset/hip_r/hip_flexion_r",
        "hip.adduction": "/jointset/hip_r/add",
    }
    wrong = (["flexion"], ["flexion=a"], ["flexion=a b/c"], ["foo=a/b"])
    for texts in (*wrong, ["flexion=a/b", "adduction=a/b"]):
        with pytest.raises(UsageError, match="--coordinate"):
            parse_targets(scene, texts)
