"""What is measured of muscles that contract, on shapes whose answer is known."""

import numpy as np
import pytest
import trimesh
from contraction_scenes import MUSCLE, SPINDLE, spindle_scene
from scipy.spatial.transform import Rotation

import rbfmuscle as rm
from rbfmuscle.metrics.centreline import MuscleAtRest
from rbfmuscle.metrics.contraction import ContractionStudy, belly_measures, pennation


def test_pennation_is_the_angle_to_the_axis_whichever_way_fibres_are_numbered():
    angle = np.radians(25.0)
    line = np.outer(np.arange(4.0), [np.cos(angle), np.sin(angle), 0.0])
    lines = np.stack([line, line[::-1]])
    assert pennation(lines, np.ones((2, 3), bool), np.eye(3)[0]) == pytest.approx(25.0)


def test_fibres_of_the_spindle_at_rest_and_shortened():
    scene = spindle_scene(spacing=5.0, tendon={"length": 100.0})
    muscle = scene.muscle(MUSCLE)
    vertices, faces = np.asarray(muscle.mesh.vertices), np.asarray(muscle.mesh.faces)
    study = ContractionStudy(MuscleAtRest(muscle, scene.joints, vertices, faces))
    poses = {bone.name: np.eye(4) for bone in scene.bones}
    rest = study.measure(vertices, poses)
    # Whole segments of 20 mm count, none that tendon reaches.
    assert SPINDLE.belly_length - 45.0 < rest["fibre_length"] < SPINDLE.belly_length + 5.0
    assert rest["fibre_stretch"] == pytest.approx(1.0)
    assert rest["pennation"] < 8.0
    short = study.measure(vertices * [0.8, 1.0, 1.0], poses)
    assert 0.8 <= short["fibre_stretch"] < 0.82  # fibres lean a little
    muscle.fibres = None  # nothing is known of them then
    assert (
        ContractionStudy(MuscleAtRest(muscle, scene.joints, vertices, faces)).measure(vertices, poses) == {}
    )
    assert short["fibre_length"] / rest["fibre_length"] == pytest.approx(short["fibre_stretch"], rel=5e-3)


def test_run_reports_what_contracts():
    run = rm.simulate(
        spindle_scene(spacing=5.0, frames=2, model="arap-volume", tendon={"length": 100.0, "strain": 0.08})
    )
    assert run.values(MUSCLE, "activation") == pytest.approx([0.0, 0.5, 1.0])
    for quantity, sign in (
        ("fibre_length", -1),
        ("fibre_stretch", -1),
        ("csa_max", 1),
        ("belly_thickness", 1),
    ):
        assert sign * (np.diff(run.values(MUSCLE, quantity))[-1]) > 0.0, quantity
    assert run.values(MUSCLE, "csa_place") == pytest.approx([0.5] * 3, abs=0.02)
    assert {row.unit for row in run.metrics if row.quantity == "csa_max"} == {"mm^2"}


AXES = np.array([30.0, 6.0, 4.0])
TURN = Rotation.from_rotvec([0.5, -1.0, 0.3]).as_matrix()


def belly(turn=TURN, shift=(7.0, -3.0, 11.0), scale=1.0):
    mesh = trimesh.creation.icosphere(subdivisions=4)
    return scale * (np.array(mesh.vertices) * AXES @ turn.T + shift), np.array(mesh.faces)


@pytest.mark.parametrize("scale", [1.0, 0.001])
@pytest.mark.parametrize(("back", "ahead"), [(30.0, 30.0), (20.0, 40.0)])
def test_greatest_section_of_an_ellipsoid_is_its_middle(scale, back, ahead):
    vertices, faces = belly(scale=scale)
    middle, way = scale * np.array([7.0, -3.0, 11.0]), TURN[:, 0] * scale
    found = belly_measures(vertices, faces, middle - back * way, middle + ahead * way)
    # The triangles lie up to 0.3 % within the ellipsoid.
    assert found["csa_max"] == pytest.approx(np.pi * 24.0 * scale**2, rel=6e-3)
    assert found["csa_place"] == pytest.approx(back / (back + ahead), abs=2e-3)
    assert found["belly_thickness"] == pytest.approx(8.0 * scale, rel=6e-3)


def test_a_belly_looked_at_from_the_other_end_is_the_same():
    """An ellipsoid with a bulge at a third of its way."""
    vertices, faces = belly(turn=np.eye(3), shift=(0.0, 0.0, 0.0))
    bulge = 1.0 + 0.5 * np.exp(-((vertices[:, 0] - 10.0) ** 2) / 40.0)
    vertices = vertices * np.column_stack([np.ones(len(vertices)), bulge, bulge])
    ends = np.array([-25.0, 0.0, 0.0]), np.array([35.0, 0.0, 0.0])
    one, other = belly_measures(vertices, faces, *ends), belly_measures(vertices, faces, *ends[::-1])
    assert one["csa_max"] == pytest.approx(other["csa_max"], rel=1e-9)
    assert one["csa_place"] == pytest.approx(1.0 - other["csa_place"], abs=1e-9)
    assert one["belly_thickness"] == pytest.approx(other["belly_thickness"], rel=1e-9)
    x = np.linspace(-30.0, 30.0, 6001)
    area = np.pi * 24.0 * (1.0 - (x / 30.0) ** 2) * (1.0 + 0.5 * np.exp(-((x - 10.0) ** 2) / 40.0)) ** 2
    # Triangles within the surface, and a parabola through three stations: 1 % together.
    assert one["csa_max"] == pytest.approx(area.max(), rel=0.02)
    assert one["csa_place"] == pytest.approx((x[area.argmax()] + 25.0) / 60.0, abs=0.01)
