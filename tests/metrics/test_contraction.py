"""What is measured of muscles that contract, on shapes whose answer is known."""

import numpy as np
import pytest
import trimesh
from contraction_scenes import MUSCLE, SPINDLE, spindle_scene

import rbfmuscle as rm
from rbfmuscle.metrics.centreline import MuscleAtRest
from rbfmuscle.metrics.contraction import ContractionStudy, belly_measures, pennation, section_area
from rbfmuscle.models import build_model
from rbfmuscle.output.saved import SavedRun
from rbfmuscle.report.paint import check_colouring, painting
from rbfmuscle.report.viewer.live import LiveViewer
from rbfmuscle.simulation.live import LiveSession
from rbfmuscle.validation import UsageError


def test_section_of_a_tilted_ellipsoid():
    mesh = trimesh.creation.icosphere(subdivisions=5)
    mesh.apply_scale([30.0, 12.0, 8.0])
    turn = trimesh.transformations.rotation_matrix(0.7, [1, 2, 3], point=[5, 5, 5])
    mesh.apply_transform(turn)
    first, last = (turn @ [x, 0, 0, 1] for x in (-30.0, 30.0))
    found = belly_measures(np.asarray(mesh.vertices), np.asarray(mesh.faces), first[:3], last[:3])
    # The polyhedron lies inside the ellipsoid, by 0.03 % of the radius; calipers every 5 degrees.
    assert found["csa_max"] == pytest.approx(np.pi * 12 * 8, rel=2e-3)
    assert found["csa_place"] == pytest.approx(0.5, abs=2e-3)
    assert found["belly_thickness"] == pytest.approx(16.0, rel=5e-3)


def test_section_beside_the_surface_is_empty():
    mesh = trimesh.creation.icosphere()
    points = np.asarray(mesh.vertices)
    assert section_area(points, np.asarray(mesh.faces), np.eye(3)[2], points[:, 2], 2.0) == 0.0


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


def test_plain_muscles_report_nothing_of_it():
    run = rm.simulate(rm.phantom_scene(end=2.0, step=2.0, spacing=6.0), model="pbd", frames="0:1")
    assert not {"activation", "fibre_stretch", "csa_max"} & {row.quantity for row in run.metrics}


def test_slider_of_a_live_scene_activates_and_colours():
    scene = rm.phantom_scene(end=4.0, step=2.0, spacing=6.0)
    scene.muscles = [scene.muscle("extensor")]
    scene = scene.with_options({"activation": 0.0})
    session = LiveSession(scene)

    def build(model, quality):
        return [build_model(muscle, scene, model) for muscle in scene.muscles]

    viewer = LiveViewer(session, build, ["arap-volume"], ["full"])
    name = "activation extensor"
    assert viewer.coordinates[name] == (0.0, 1.0, 0.0)
    viewer.set(name, 0.35)
    while viewer.pending:
        viewer.advance()
    assert session.arrived
    viewer.colour_by("activation")
    assert np.all(viewer.advance().values["extensor"] == pytest.approx(0.35))
    viewer.rest()
    assert viewer.coordinates[name][2] == 0.0
    viewer.close()


@pytest.fixture(scope="module")
def saved(tmp_path_factory):
    """A saved run of the spindle."""
    folder = tmp_path_factory.mktemp("spindle")
    scene = spindle_scene(
        spacing=5.0, frames=1, model="arap-volume", tendon={"length": 100.0, "strain": 0.08}
    )
    rm.simulate(scene).save(folder, pictures=False)
    return SavedRun(folder)


def test_pictures_are_coloured_by_activation(saved):
    paint, chips = painting(saved, "activation", [0, 1])
    points = saved.surface(MUSCLE, 1)[0]
    assert [set(paint(saved, MUSCLE, frame, points)) for frame in (0, 1)] == [{0.0}, {1.0}]
    assert next(iter(chips)) == "activation 0" and list(chips)[-1] == "activation 1"
    assert painting(saved, "muscle", [0])[0] is None


def test_colours_of_what_a_run_has_not_are_refused(saved):
    with pytest.raises(UsageError, match="known: muscle, activation"):
        check_colouring(saved, "force")
    saved = SavedRun(saved.directory)  # what is taken from it here, the others need
    saved.metrics = [row for row in saved.metrics if row.quantity != "activation"]
    with pytest.raises(UsageError, match="none of its muscles contracts"):
        check_colouring(saved, "activation")
