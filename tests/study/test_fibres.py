"""Fibres: where they grow, how they are carried, what is measured of them and what of it lands in files."""

import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import trimesh
from blend_model import arm_scene, files_in, use_blend_model
from conftest import ROOT

from rbfmuscle.geometry.exact_distance import ExactDistance
from rbfmuscle.geometry.mean_value import mean_value_weights
from rbfmuscle.run import simulate, stream_run
from rbfmuscle.study.files.export import export_run
from rbfmuscle.study.files.saved import SavedRun
from rbfmuscle.study.measure.centreline import MuscleAtRest
from rbfmuscle.study.measure.fibre_field import FibreField, attachment_points
from rbfmuscle.study.measure.fibre_lines import grow_fibres, resampled, spread
from rbfmuscle.study.measure.fibre_study import FibreBundle, FibreStudy, line_lengths
from rbfmuscle.validation import SolveError, UsageError

LENGTH, RADIUS = 60.0, 8.0


def cylinder():
    """A closed cylinder along x with finely divided caps, and the vertices of both caps."""
    mesh = trimesh.creation.cylinder(RADIUS, LENGTH, sections=48)
    vertices, faces = trimesh.remesh.subdivide_to_size(mesh.vertices, mesh.faces, 2.5)
    mesh = trimesh.Trimesh(vertices[:, [2, 0, 1]], faces)
    assert mesh.is_watertight and mesh.volume > 0
    x = mesh.vertices[:, 0]
    ends = [np.flatnonzero(x < -LENGTH / 2 + 1e-6), np.flatnonzero(x > LENGTH / 2 - 1e-6)]
    return np.array(mesh.vertices), np.array(mesh.faces), ends


def ring(quarter=np.pi / 2, middle=40.0):
    """A quarter of a torus about z, and the vertices of its two end discs."""
    vertices, faces, ends = cylinder()
    angle = (vertices[:, 0] / LENGTH + 0.5) * quarter
    r = middle - vertices[:, 1]
    return np.stack([r * np.cos(angle), r * np.sin(angle), vertices[:, 2]], axis=1), faces, ends


class TestField:
    def test_cylinder_has_a_linear_field(self):
        vertices, faces, ends = cylinder()
        sides = [attachment_points(vertices, faces, end, 1.0) for end in ends]
        field = FibreField(vertices, faces, sides)
        inner = np.random.default_rng(0).uniform(-1, 1, (200, 3)) * [LENGTH / 2 - 6, 4.5, 4.5]
        gradient = field.gradient(inner)
        tilt = np.degrees(np.arccos(gradient[:, 0] / np.linalg.norm(gradient, axis=1)))
        # Half a cell: caps and side cross the grid where they like.
        assert tilt.max() < 2.0
        # All flux goes through each section: gradient = 1 / area.
        np.testing.assert_allclose(gradient[:, 0], 1 / (np.pi * RADIUS**2), rtol=0.05)

    def test_areas_of_an_attachment_add_up(self):
        vertices, faces, ends = cylinder()
        points, areas = attachment_points(vertices, faces, ends[0], 0.7)
        chosen = np.isin(faces, ends[0]).all(axis=1)
        assert areas.sum() == pytest.approx(trimesh.Trimesh(vertices, faces).area_faces[chosen].sum())
        np.testing.assert_allclose(points[:, 0], -LENGTH / 2)

    def test_separate_parts_are_refused(self):
        a = trimesh.creation.icosphere(radius=5.0)
        b = a.copy().apply_translation([30, 0, 0])
        both = trimesh.util.concatenate([a, b])
        ends = [np.flatnonzero(both.vertices[:, 0] < 0), np.flatnonzero(both.vertices[:, 0] > 30)]
        with pytest.raises(SolveError, match="no way leads"):
            grow_fibres(np.array(both.vertices), np.array(both.faces), ends)


class TestGrowth:
    def test_fibres_of_a_cylinder_are_straight_and_even(self):
        vertices, faces, ends = cylinder()
        lines = grow_fibres(vertices, faces, ends, count=40, segments=10)
        assert lines.shape == (40, 11, 3)
        np.testing.assert_allclose(lines[:, 0, 0], -LENGTH / 2, atol=1e-9)
        np.testing.assert_allclose(lines[:, -1, 0], LENGTH / 2, atol=1e-9)
        # Ends snap to the attachment's points, which are half an edge apart.
        np.testing.assert_allclose(line_lengths(lines), LENGTH, rtol=0.01)
        sideways = np.linalg.norm(lines[:, :, 1:] - lines[:, :1, 1:], axis=2)
        assert sideways.max() < 1.5
        # Even over the section: the mean of r^2 is R^2 / 2.
        assert np.mean((lines[:, 5, 1:] ** 2).sum(axis=1)) == pytest.approx(RADIUS**2 / 2, rel=0.1)

    def test_fibres_of_a_bent_muscle_are_arcs_inside_it(self):
        vertices, faces, ends = ring()
        lines = grow_fibres(vertices, faces, ends, count=60, segments=15)
        inner = lines[:, 1:-1].reshape(-1, 3)
        assert ExactDistance(vertices, faces).signed_distance(inner).max() < 0
        radius = np.linalg.norm(lines[:, :, :2], axis=2)
        # Within a grid cell (0.6 mm) and the snapped ends of concentric arcs.
        assert np.abs(radius - radius.mean(axis=1, keepdims=True)).max() < 1.5
        np.testing.assert_allclose(line_lengths(lines), radius.mean(axis=1) * np.pi / 2, rtol=0.02)

    def test_fibres_grow_and_move_with_their_muscle(self):
        vertices, faces, ends = ring()
        lines = grow_fibres(vertices, faces, ends, count=8, segments=6)
        larger = grow_fibres(50.0 * vertices + [700.0, -300.0, 20.0], faces, ends, count=8, segments=6)
        np.testing.assert_allclose((larger - [700.0, -300.0, 20.0]) / 50.0, lines, atol=1e-6)

    def test_ends_may_be_given_in_either_order(self):
        vertices, faces, ends = ring()
        first, second = (grow_fibres(vertices, faces, e, count=10, segments=4) for e in (ends, ends[::-1]))
        assert np.all(first[:, 0, 1] < 2.0) and np.all(second[:, -1, 1] < 2.0)

    def test_spread_points_are_even_and_some_of_the_given(self):
        points = np.random.default_rng(1).uniform(size=(4000, 3)) * [1, 1, 0]
        chosen = spread(points, 25)
        assert (np.linalg.norm(chosen[:, None] - points, axis=2).min(axis=1) == 0).all()
        apart = np.linalg.norm(chosen[:, None] - chosen, axis=2) + 9 * np.eye(25)
        assert apart.min() > 0.1  # 0.2 on a perfect lattice

    def test_resampling_keeps_ends_and_length(self):
        corner = np.array([[0, 0, 0], [3.0, 0, 0], [3, 4, 0]])
        even = resampled(corner, 7)
        np.testing.assert_allclose(np.linalg.norm(np.diff(even, axis=0), axis=1)[[0, 1, 2, 4, 5, 6]], 1.0)
        np.testing.assert_array_equal(even[[0, -1]], corner[[0, -1]])


class TestMeanValue:
    def points(self, count=50):
        rng = np.random.default_rng(3)
        way = rng.normal(size=(count, 3))
        return way / np.linalg.norm(way, axis=1, keepdims=True) * rng.uniform(0, 0.9, (count, 1))

    def test_affine_motion_is_exact(self):
        mesh = trimesh.creation.icosphere(subdivisions=2)
        points = self.points()
        weights = mean_value_weights(points, mesh.vertices, mesh.faces)
        np.testing.assert_allclose(weights.sum(axis=1), 1.0, atol=1e-12)
        rng = np.random.default_rng(4)
        matrix, shift = rng.normal(size=(3, 3)), rng.normal(size=3)
        moved = weights @ (mesh.vertices @ matrix.T + shift)
        np.testing.assert_allclose(moved, points @ matrix.T + shift, atol=1e-11)

    def test_equals_the_published_pseudocode(self):
        mesh = trimesh.creation.box((2, 2, 2)).subdivide()
        points = self.points(8)
        found = mean_value_weights(points, mesh.vertices, mesh.faces)
        for point, row in zip(points, found):
            expected = np.zeros(len(mesh.vertices))
            for face in mesh.faces:
                far = np.linalg.norm(mesh.vertices[face] - point, axis=1)
                unit = (mesh.vertices[face] - point) / far[:, None]
                theta = [
                    2 * np.arcsin(np.linalg.norm(unit[(i + 1) % 3] - unit[(i + 2) % 3]) / 2) for i in range(3)
                ]
                half = sum(theta) / 2
                c = [
                    2
                    * np.sin(half)
                    * np.sin(half - theta[i])
                    / (np.sin(theta[(i + 1) % 3]) * np.sin(theta[i - 1]))
                    - 1
                    for i in range(3)
                ]
                s = np.sign(np.linalg.det(unit)) * np.sqrt(1 - np.clip(c, -1, 1) ** 2)
                for i in range(3):
                    j, k = (i + 1) % 3, (i + 2) % 3
                    top = theta[i] - c[j] * theta[k] - c[k] * theta[j]
                    expected[face[i]] += top / (far[i] * np.sin(theta[j]) * s[k])
            np.testing.assert_allclose(row, expected / expected.sum(), atol=1e-9)

    def test_point_on_a_vertex_is_refused(self):
        mesh = trimesh.creation.icosphere()
        with pytest.raises(ValueError, match="does not lie inside"):
            mean_value_weights(mesh.vertices[:1], mesh.vertices, mesh.faces)


class TestCarried:
    @pytest.fixture
    def bundle(self):
        scene = arm_scene()
        mesh = scene.muscles[0].mesh
        carried = np.array(mesh.vertices), np.array(mesh.faces)
        return scene, FibreBundle(MuscleAtRest(scene.muscles[0], scene.joints, *carried), count=20)

    def test_rest_gives_back_the_fibres(self, bundle):
        scene, made = bundle
        rest = {bone.name: np.eye(4) for bone in scene.bones}
        lines = made.lines(np.array(scene.muscles[0].mesh.vertices), rest)
        # Single precision weights: 1e-6 of the muscle's 52 mm.
        np.testing.assert_allclose(lines.points, made.rest, atol=1e-4)
        np.testing.assert_allclose(lines.lengths, lines.rest_lengths, rtol=1e-5)

    def test_rigid_motion_moves_them_rigidly(self, bundle):
        scene, made = bundle
        move = trimesh.transformations.rotation_matrix(1.1, (1, -2, 0.5), (3, 1, 4))
        move[:3, 3] += [1000, -2000, 500]
        vertices = trimesh.transform_points(scene.muscles[0].mesh.vertices, move)
        lines = made.lines(vertices, {bone.name: move for bone in scene.bones})
        np.testing.assert_allclose(
            lines.points.reshape(-1, 3), trimesh.transform_points(made.rest.reshape(-1, 3), move), atol=1e-4
        )

    def test_bones_that_move_as_one_are_one_end(self):
        scene = arm_scene(fibres=True)
        muscle = scene.muscles[0]
        scene.add_bone("cuff", trimesh.creation.box((4, 4, 4)))
        scene.add_joint("clasp", "upper", "cuff", (-20, 0, 0), {"twist": (1, 0, 0)})
        x = muscle.mesh.vertices[:, 0]
        ends = {"upper": x < -22, "cuff": (x > -22) & (x < -17), "fore": x > 19}
        muscle.attachments = [
            replace(muscle.attachments[0], bone=bone, vertices=np.flatnonzero(held))
            for bone, held in ends.items()
        ]
        carried = {muscle.name: (np.array(muscle.mesh.vertices), np.array(muscle.mesh.faces))}
        first, last = FibreStudy(scene, carried).bundles[muscle.name].holders
        assert set(first) <= {"upper", "cuff"}
        assert set(last) == {"fore"}

    def test_ends_go_with_their_bones(self, bundle):
        scene, made = bundle
        poses = {"upper": np.eye(4), "fore": trimesh.transformations.translation_matrix([0, 7, 0])}
        points = made.lines(np.array(scene.muscles[0].mesh.vertices), poses).points
        np.testing.assert_array_equal(points[:, 0], made.rest[:, 0])
        np.testing.assert_allclose(points[:, -1], made.rest[:, -1] + [0, 7, 0], atol=1e-12)


@pytest.fixture(scope="module")
def run():
    """An arm bent in steps of 4 degrees, with 12 fibres of 6 segments."""
    with pytest.MonkeyPatch.context() as patch:
        use_blend_model(patch)
        return simulate(arm_scene(end=40, step=4, fibres={"count": 12, "segments": 6}))


class TestRun:
    def test_lengths_and_arms_are_measured(self, run):
        each = np.array([frame.fibres["biceps"].lengths for frame in run.frames])
        np.testing.assert_allclose(run.values("biceps", "fibre_length_mean"), each.mean(axis=1))
        np.testing.assert_allclose(run.values("biceps", "fibre_length_std"), each.std(axis=1))
        angle = np.array([frame.coordinates["elbow.flexion"] for frame in run.frames])
        arms = -np.gradient(each, angle, axis=0)[1:-1]
        np.testing.assert_allclose(run.values("biceps", "fibre_moment_arm_mean")[1:-1], arms.mean(axis=1))
        np.testing.assert_allclose(run.values("biceps", "fibre_moment_arm_std")[1:-1], arms.std(axis=1))
        assert run.values("biceps", "fibre_moment_arm_mean").min() > 0

    def test_sum_rule(self, run):
        """l(q) = l(0) - integral r dq to 1 % of the change: steps of 4 degrees, one-sided ends."""
        length = run.values("biceps", "fibre_length_mean")
        arm = run.values("biceps", "fibre_moment_arm_mean")
        angle = np.array([frame.coordinates["elbow.flexion"] for frame in run.frames])
        change = -np.cumsum(0.5 * (arm[1:] + arm[:-1]) * np.diff(angle))
        assert np.abs(length[1:] - length[0] - change).max() <= 0.01 * np.abs(length - length[0]).max()

    def test_files_read_back_and_are_exported(self, run, tmp_path):
        pyvista = pytest.importorskip("pyvista")
        run.save(tmp_path, pictures=False)
        lines = run["biceps"].fibres(10)
        points, cells = SavedRun(tmp_path).fibres("biceps", 10)
        np.testing.assert_array_equal(points, lines.points)
        np.testing.assert_array_equal(cells["length"], lines.lengths)
        np.testing.assert_array_equal(cells["stretch"], lines.lengths / lines.rest_lengths)
        table = np.genfromtxt(
            tmp_path / "fibre_lengths.csv", delimiter=",", names=True, dtype=None, encoding="utf-8"
        )
        np.testing.assert_array_equal(table["length"][table["frame"] == 10], lines.lengths)
        reader = pyvista.get_reader(tmp_path / "fibres.pvd")
        assert list(reader.time_values) == list(range(11))
        export_run(tmp_path, ["pvd", "sto"], units="m", ascii=True, frames=slice(10, 11))
        made = pyvista.read(tmp_path / "export" / "pvd" / "biceps_fibres_0010.vtp")
        assert made.n_lines == 12
        np.testing.assert_allclose(made.points, lines.points.reshape(-1, 3) * 1e-3, rtol=1e-12)
        np.testing.assert_allclose(made.cell_data["length"], lines.lengths * 1e-3)
        assert (tmp_path / "export" / "pvd" / "fibres.pvd").is_file()
        assert (tmp_path / "export" / "sto" / "FibreMomentArm_elbow.flexion.sto").is_file()

    def test_a_run_without_fibres_leaves_none_of_an_earlier_one(self, run, tmp_path, monkeypatch):
        run.save(tmp_path, pictures=False)
        use_blend_model(monkeypatch)
        stream_run(arm_scene(), tmp_path, pictures=False)
        assert not [name for name in files_in(tmp_path) if "fibre" in name]
        with pytest.raises(UsageError, match=r"output\.fibres = true"):
            SavedRun(tmp_path).fibres("biceps", 0)

    def test_options(self):
        scene = arm_scene()
        assert scene.output.fibres is False
        changed = scene.with_options({"output.fibres": True, "output.fibres.count": 30})
        assert (changed.output.fibres.count, changed.output.fibres.segments) == (30, 15)
        with pytest.raises(UsageError, match="count"):
            scene.with_options({"output.fibres.count": 0})
        with pytest.raises(UsageError, match=r"output\.fibres"):
            simulate_one_frame()["biceps"].fibres()


def simulate_one_frame():
    with pytest.MonkeyPatch.context() as patch:
        use_blend_model(patch)
        return simulate(arm_scene(end=0))


def test_without_fibres_no_code_of_theirs_is_loaded():
    code = (
        "import sys; sys.path.insert(0, 'tests')\n"
        "from blend_model import arm_scene, BlendMuscle\n"
        "import rbfmuscle.models as m, rbfmuscle.run as r\n"
        "m.build_model = BlendMuscle\n"
        "r.simulate(arm_scene())\n"
        "print([m for m in sys.modules if 'fibre_' in m or 'mean_value' in m])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT, timeout=120)
    assert done.stdout.strip() == "[]", done.stderr


@pytest.mark.parametrize("model", ["rbf", "pbd"])
def test_fibres_stay_in_the_muscles_of_the_hip(hip_scene, model):
    """From rest to 90 degrees of flexion, all but a few points of both models' fibres lie inside the surface."""
    run = simulate(hip_scene, model=model, settings={"output.fibres": True}, frames="0:46:45")
    for muscle in run:
        for k, share in ((0, 0.01), (1, 0.1)):
            surface, lines = muscle.surface(k), muscle.fibres(k)
            depth = ExactDistance(surface.vertices, surface.faces).signed_distance(
                lines.points[:, 1:-1].reshape(-1, 3)
            )
            # The RBF surface is a fit (0.5 mm RMS) and cut by the bones; mesh models fold in front of the hip.
            assert np.mean(depth > 0) < share
