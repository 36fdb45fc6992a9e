"""The RBF muscle against laws, on the embedded phantom and, where present, on the real hip."""

import warnings

import igl
import numpy as np
import pytest
import trimesh
from contraction_scenes import spindle_scene
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from rbfmuscle.implicit.field import wanted_derivatives
from rbfmuscle.implicit.kernels.table import KERNELS, get_kernel
from rbfmuscle.models import build_model
from rbfmuscle.muscle.muscle import RBFMuscle
from rbfmuscle.muscle.options import RBFOptions
from rbfmuscle.scene.objects import Motion
from rbfmuscle.scene.phantom import phantom_scene
from rbfmuscle.scene.scene import Scene
from rbfmuscle.simulation.frame_loop import FrameLoop, simulate_frames
from rbfmuscle.validation import NumericalWarning, SceneError, SolveError


@pytest.fixture
def hip(hip_data):
    """The real hip with one small muscle, quick to solve."""
    scene = Scene.load(hip_data / "flexion.toml")
    scene.muscles = [muscle for muscle in scene.muscles if muscle.name == "adductor_brevis"]
    return scene


def _carried(scene, degrees, coordinate="hip.flexion"):
    """Vertices carried by the first muscle at each angle."""
    scene.motion = Motion([{coordinate: np.radians(angle)} for angle in degrees])
    muscle = scene.muscles[0]
    model = build_model(muscle, scene, "rbf")
    return [frame.carried[muscle.name][0] for frame in simulate_frames(scene, [model], surfaces=False)]


def _distances(points, vertices, faces):
    squares = igl.point_mesh_squared_distance(np.array(points), np.array(vertices), np.array(faces))[0]
    return np.sqrt(squares)


def test_muscle_returns_to_rest(hip):
    there = list(range(0, 31, 5))
    carried = _carried(hip, [*there, *there[-2::-1], 0, 0, 0])
    rms = [
        np.sqrt(np.square(one - carried[0]).sum(axis=1).mean())
        for one in (carried[len(there) - 1], carried[-1])
    ]
    assert rms[0] > 2.0 and rms[1] <= 0.3


def _surface(turn=(0.0, 0.0, 0.0), shift=(0.0, 0.0, 0.0), scale=1.0, units="mm"):
    """One muscle of the phantom, flexed, in a scene that was moved and written in another unit, and its size."""
    scene = phantom_scene()
    scene.units, scene.muscles = units, scene.muscles[:1]
    scene.muscles[0].fibres = None
    rotation = Rotation.from_rotvec(turn).as_matrix()
    moved = np.vstack([np.column_stack([scale * rotation, shift]), [0, 0, 0, 1]])
    for thing in [*scene.bones, *scene.muscles]:
        thing.mesh.vertices = trimesh.transform_points(thing.mesh.vertices, moved)
    scene.joints = [joint.moved(moved) for joint in scene.joints]
    scene.motion = Motion([{"hip.flexion": np.radians(30.0)}])
    model = build_model(scene.muscles[0], scene, "rbf")
    (frame,) = simulate_frames(scene, [model])
    return frame.surfaces[model.name].vertices, np.ptp(model.rest.centres, axis=0).max()


@pytest.fixture(scope="module")
def plain():
    return _surface()


@pytest.mark.parametrize(
    ("turn", "scale", "units"),
    [([0.0, 0.0, 0.0], 1e-3, "m"), ([0.7, -1.9, 0.4], 1.0, "mm"), ([2.0, 0.3, 1.1], 0.1, "cm")],
)
def test_a_scene_that_is_moved_and_in_another_unit_gives_the_same_surface(plain, turn, scale, units):
    shift = scale * np.array([1e4, -4e3, 2e3])  # 10 m
    (surface, size), (moved, _) = plain, _surface(turn, shift, scale, units)
    back = (moved - shift) @ Rotation.from_rotvec(turn).as_matrix() / scale
    assert len(back) == len(surface)
    assert cKDTree(surface).query(back)[0].max() <= 1e-6 * size


@pytest.mark.parametrize("kernel", [k for k in KERNELS if k != "gaussian"])
def test_any_kernel_drives_a_muscle(kernel):
    scene = phantom_scene().with_options(
        {"model.kernel": kernel, "model.centres": 100, "model.resolution": 32}, frames="0:6:5"
    )
    scene.muscles = [scene.muscle("adductor_posterior")]
    smooth = get_kernel(kernel).hermite
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always")
        model = build_model(scene.muscles[0], scene, "rbf")
    assert any("values on and off the surface" in str(w.message) for w in said) is not smooth
    frames = list(simulate_frames(scene, [model]))
    for frame in frames:
        surface = frame.surfaces[model.name]
        mesh = trimesh.Trimesh(surface.vertices, surface.faces, process=False)
        assert mesh.is_watertight
        assert mesh.volume == pytest.approx(scene.muscles[0].mesh.volume, rel=1e-3)
    # 100 centres on a muscle of 210 mm: half a millimetre, cubic reaches 0.4.
    at_rest = frames[0].surfaces[model.name]
    near = _distances(scene.muscles[0].mesh.vertices, at_rest.vertices, at_rest.faces)
    assert np.sqrt((near**2).mean()) < 0.8


def test_centres_are_added_until_the_wanted_error_is_met_and_fitted_ones_err_less(monkeypatch, tmp_path):
    monkeypatch.setenv("RBFMUSCLE_CACHE", str(tmp_path))  # keeps the number of centres
    scene = phantom_scene()
    muscle = scene.muscle("abductor")
    vertices = np.array(muscle.mesh.vertices)

    def error(**options):
        model = RBFMuscle(muscle, scene, RBFOptions(**options))
        return len(model.rest.centres), np.sqrt((model.field()(vertices) ** 2).mean())

    count, plain = error(centres=100, placement="greedy")
    assert error(centres=100, placement="fitted")[1] < 0.7 * plain
    usual, few = error(placement="greedy")
    more, least = error(rest_error=0.7 * few, placement="greedy")
    assert least <= 0.7 * few < few < plain and count < usual < more < 4 * usual
    derivatives = [
        wanted_derivatives(count, fitted=fitted) for count, fitted in ((200, 0), (201, 0), (201, 1))
    ]
    assert derivatives == ["all", "normal", "all"]
    with (
        pytest.warns(NumericalWarning, match="fitted to values on and off"),
        pytest.raises(SceneError, match="placement 'fitted' needs a C2 kernel"),
    ):
        RBFMuscle(muscle, scene, RBFOptions(placement="fitted", kernel="matern_12"))


@pytest.mark.filterwarnings("ignore:kernel .* does not reach")
def test_where_no_level_set_can_be_shown_the_material_is_and_an_event_says_so():
    scene = phantom_scene().with_options(
        {"model.kernel": "gaussian", "model.epsilon": 1.0, "model.centres": 100, "model.surface": "marching"}
    )
    scene.muscles = [scene.muscle("adductor_posterior")]
    message = r"adductor_posterior.*no closed surface by marching cubes with kernel 'gaussian'"
    with pytest.raises(SolveError, match=message):
        next(iter(simulate_frames(scene, [build_model(scene.muscles[0], scene, "rbf")])))
    scene.muscles[0].options["surface"] = "material"
    model = build_model(scene.muscles[0], scene, "rbf")
    frame = next(iter(simulate_frames(scene, [model])))
    surface, rest = frame.surfaces[model.name], scene.muscles[0].mesh
    mesh = trimesh.Trimesh(surface.vertices, surface.faces, process=False)
    assert mesh.is_watertight and mesh.euler_number == 2
    assert mesh.volume == pytest.approx(rest.volume, rel=1e-10)
    # At rest the material is where the input mesh is, but for chords of 3 mm edges.
    assert _distances(surface.vertices, rest.vertices, rest.faces).max() < 0.5
    assert [(e.muscle, e.action) for e in frame.events] == [(model.name, "carried_sheets")]
    assert surface.quantities["unfitted_fraction"] == 1.0


class _Everywhere:
    """A neighbour that fills all of space."""

    def cut(self, points):
        return np.full(len(points), -5.0), np.tile([1.0, 0.0, 0.0], (len(points), 1))

    def points(self):
        return np.zeros((0, 3))


def test_neighbours_that_leave_no_surface_are_let_in_and_an_event_says_so():
    scene = phantom_scene()
    scene.muscles = [scene.muscle("adductor_posterior")]
    shown, told = [], []
    for cuts in ([], [_Everywhere()]):
        model = build_model(scene.muscles[0], scene, "rbf")
        loop = FrameLoop(scene, [model])
        loop.steppers[0].contacts.cuts += cuts
        frame = loop.advance(scene.motion.frames[0])
        shown.append(frame.surfaces[model.name].vertices)
        told.append([(e.muscle, e.bone, e.action) for e in frame.events])
    assert told == [[], [(model.name, "", "neighbours_let_in")]]
    assert np.array_equal(*shown)


def test_a_chosen_epsilon_never_gives_a_broken_field():
    """Gaussians so narrow do not reach from centre to centre: the muscle is refused, with the remedy."""
    narrow = {"kernel": "gaussian", "centres": 60, "samples": 300, "epsilon": 3.0, "condition": 1000.0}
    scene = phantom_scene().with_options({f"model.{key}": value for key, value in narrow.items()})
    scene.muscles = [scene.muscle("adductor_posterior")]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        with pytest.raises(
            SceneError, match=r"'gaussian' with 60 centres.*take kernel 'cubic'.*greater condition"
        ):
            build_model(scene.muscles[0], scene, "rbf")
        scene.muscles[0].options |= {"kernel": "quintic", "condition": 1e6}
        model = build_model(scene.muscles[0], scene, "rbf")
        assert model.rest.fit.condition == 1e6  # without a shape parameter a ridge keeps the bound


def test_fibres_through_a_unit_area_are_those_of_the_belly_over_its_girth():
    scene = spindle_scene(tendon={"length": 100.0, "strain": 0.08})
    model = RBFMuscle(scene.muscles[0], scene, RBFOptions(centres=150, nodes=600))
    x = np.abs(model.solid.quad_points[:, 0])
    middle, tendon = (
        np.average(model.law.density[there], weights=model.solid.weights[there])
        for there in (x < 10.0, (x > 90.0) & (x < 120.0))
    )
    assert middle == pytest.approx(1.0, abs=0.1)
    # Radii of 15 and 9 mm; a cell is 10 mm wide.
    assert tendon == pytest.approx((15.0 / 9.0) ** 2, rel=0.1)
