"""Fibres over a motion: what both kinds of model and a saved run give."""

import csv
import json

import numpy as np
import pytest
import pyvista
import trimesh
from toy_scene import held

import rbfmuscle as rm
from rbfmuscle.geometry.lines import line_length
from rbfmuscle.geometry.mesh_distance import MeshDistance
from rbfmuscle.metrics.verdict import published_band
from rbfmuscle.run.appearance import stretch_colours
from rbfmuscle.validation import SceneError, UsageError
from rbfmuscle.viewer.sources import SavedSource

FIBRES = 12
PENNATION = np.radians(25.0)


def hinge(model="rbf"):
    """A strap along two bones that a hinge joins 30 mm behind it, held by the lower one by a
    tendon.
    """
    scene = rm.Scene("hinge", units="mm")
    for name, middle in (("trunk", 60.0), ("limb", -65.0)):
        mesh = trimesh.creation.cylinder(8.0, 120.0, sections=24)
        scene.add_bone(name, mesh.apply_translation([0.0, 30.0, middle]))
    scene.add_joint("elbow", "trunk", "limb", [0.0, 30.0, 0.0], {"bend": [-1, 0, 0]})
    belly = trimesh.creation.capsule(70.0, 9.0, count=[12, 12]).subdivide()
    belly.apply_translation([0.0, 0.0, 15.0])
    z = belly.vertices[:, 2]
    attach = held(trunk=z > z.max() - 6.0, limb=z < z.min() + 6.0)
    attach[1]["tendon"] = {"to": [0.0, 0.0, -70.0]}
    scene.add_muscle("strap", belly, attach=attach, model=model)
    return scene.set_motion(ramp={"elbow.bend": {"from": -10.0, "to": 10.0, "step": 5.0}})


@pytest.fixture(scope="module", params=["rbf", "pbd"])
def run(request):
    return rm.simulate(hinge(request.param), settings={"output.fibres": FIBRES})


def feather():
    """A pennate strap 12 mm thick whose fibres slope by 25 degrees between two faces; the ends of
    these are held, and slide apart.
    """
    mesh = trimesh.creation.box((60.0, 12.0, 12.0))
    while mesh.edges_unique_length.max() > 4.0:
        mesh = mesh.subdivide()
    straight = np.array(mesh.vertices)
    sheared = straight + straight[:, [1]] * [1.0 / np.tan(PENNATION), 0.0, 0.0]
    scene = rm.Scene("feather", units="mm")
    for name, x in (("trunk", -60.0), ("limb", 60.0)):
        scene.add_bone(name, trimesh.creation.box((10.0, 10.0, 10.0)).apply_translation([x, 0, 0]))
    scene.add_joint("slide", "trunk", "limb", (0, 0, 0), {"by": (1, 0, 0)}, type="slide")
    below, above = straight[:, 1] < -5.99, straight[:, 1] > 5.99
    attach = held(
        trunk=below & (straight[:, 0] < -24.0),
        limb=above & (straight[:, 0] > 24.0),
    )
    sheets = {
        name: {"vertices": np.flatnonzero(face).tolist()}
        for name, face in (("origin", below), ("insertion", above))
    }
    body = trimesh.Trimesh(sheared, mesh.faces, process=False)
    scene.add_muscle("strap", body, attach=attach, model="pbd", aponeuroses=sheets)
    return scene.set_motion(ramp={"slide.by": {"from": 0.0, "to": 2.0, "step": 2.0}})


def test_fibres_of_a_pennate_muscle_run_between_its_aponeuroses(tmp_path):
    scene = rm.Scene.load(feather().save(tmp_path / "feather.toml"))
    run = rm.simulate(scene, settings={"output.fibres": FIBRES})
    lines = run["strap"].fibres(0)
    inner = lines[:, 1:-1]
    chord = inner[:, -1] - inner[:, 0]
    angle = np.arctan2(chord[:, 1], chord[:, 0])
    assert np.degrees(angle) == pytest.approx(np.degrees(PENNATION), abs=2.0)
    lengths = np.linalg.norm(np.diff(inner, axis=1), axis=2).sum(axis=1)
    # Either end is found within a cell of 0.7 mm.
    assert lengths == pytest.approx(12.0 / np.sin(PENNATION), abs=1.5)
    # Straight aponeuroses join their ends to what is held.
    lean = 6.0 / np.tan(PENNATION)
    for x, sign in ((lines[:, 0, 0], -1.0), (lines[:, -1, 0], 1.0)):
        assert np.all((sign * x <= 30.0 + lean) & (sign * x >= 24.0 + lean))
    path = np.linalg.norm(np.diff(lines, axis=1), axis=2).sum(axis=1)
    assert run["strap"].fibre_lengths[0] == pytest.approx(path)
    # In motion the bones carry the held ends, the material those of the fibres.
    moved = run["strap"].fibres(1)
    np.testing.assert_allclose(moved[:, -1] - lines[:, -1], np.tile([2.0, 0, 0], (FIBRES, 1)))
    np.testing.assert_allclose(moved[:, 0], lines[:, 0])
    surface = MeshDistance(*run.frames[1].material_meshes["strap"])
    # The interpolated displacement goes through 300 points of the surface.
    assert np.abs(surface.signed(moved[:, [1, -2]].reshape(-1, 3))).max() < 0.2
    middle = 0.5 * (moved[:, 1] + moved[:, -2]) - 0.5 * (lines[:, 1] + lines[:, -2])
    assert middle[:, 0].mean() == pytest.approx(1.0, abs=0.3)


@pytest.mark.parametrize(
    ("sheets", "said"),
    [
        ({"origin": {"vertices": [0]}}, "aponeuroses: insertion: field"),
        ({"origin": {"near": 1.0}, "insertion": {"vertices": [1]}}, "near"),
        ({"origin": {"vertices": [0, 1]}, "insertion": {"vertices": [1]}}, "first: 1"),
        ({"origin": {"vertices": [10**6]}, "insertion": {"vertices": [1]}}, "origin: vertex"),
    ],
)
def test_wrong_aponeuroses_are_refused_by_name(sheets, said):
    scene = feather()
    strap = scene.muscles.pop()
    with pytest.raises(SceneError, match=said):
        scene.add_muscle("strap", strap.mesh, attach=strap.attachments, aponeuroses=sheets)


def test_fibres_go_from_bone_to_bone_with_their_tendon(run):
    strap = run["strap"]
    for k, frame in enumerate(run.frames):
        points = strap.fibres(k)
        assert points.shape[0] == FIBRES
        insertion = frame.poses["limb"] @ [0.0, 0.0, -70.0, 1.0]
        np.testing.assert_allclose(points[:, -1], np.tile(insertion[:3], (FIBRES, 1)), atol=1e-9)
        origins = points[:, 0] - frame.poses["trunk"][:3, 3]
        np.testing.assert_allclose(origins, strap.fibres(0)[:, 0], atol=1e-9)
        lengths = [line_length(line) for line in points]
        np.testing.assert_allclose(strap.fibre_lengths[k], lengths, rtol=1e-12)


def test_moment_arms_of_fibres_are_their_distances_from_the_axis(run):
    arms = run["strap"].moment_arms("bend")
    assert arms.shape == (len(run), FIBRES)
    # Fibres lie within 9 mm of the strap's middle, the axis 30 mm behind that; their tendon is one.
    assert np.abs(arms).min() > 20.0
    assert np.abs(arms).max() < 40.0
    # How far inside these 9 mm the middle fibre lies hangs on the mesh: the strap bends.
    assert np.median(arms, axis=1) == pytest.approx(run.values("strap", "moment_arm"), abs=9.0)
    found = np.percentile(arms, [5, 50, 95], axis=1)
    for name, values in zip(("p05", "p50", "p95"), found):
        np.testing.assert_allclose(run.values("strap", f"fibre_moment_arm_{name}"), values)


def test_stretch_is_one_at_rest_and_that_of_the_belly(run):
    middle = run.frames[2].fibres["strap"]
    assert middle.stretch == pytest.approx(1.0, abs=2e-3)  # of the solver
    for frame in run.frames:
        fibres = frame.fibres["strap"]
        tendon = line_length(frame.tendons["strap tendon 2 to limb"].points)
        belly = fibres.lengths - tendon
        at_rest = middle.lengths - line_length(
            run.frames[2].tendons["strap tendon 2 to limb"].points
        )
        # Each fibre's tendon begins at its own end, within 6 mm of the tendon's line.
        assert fibres.stretch == pytest.approx(belly / at_rest, abs=0.02)
    assert run.values("strap", "fibre_stretch_p50")[0] == pytest.approx(
        np.median(run.frames[0].fibres["strap"].stretch)
    )


def test_a_saved_run_has_the_fibres(run, tmp_path):
    run.save(tmp_path, pictures=False)
    loaded = rm.Run.load(tmp_path)
    np.testing.assert_array_equal(loaded["strap"].fibres(1), run["strap"].fibres(1))
    np.testing.assert_array_equal(
        loaded["strap"].moment_arms("elbow.bend"), run["strap"].moment_arms("bend")
    )
    drawn = pyvista.read(tmp_path / "fibres" / "strap_0003.vtp")
    fibres = run.frames[3].fibres["strap"]
    assert drawn.n_lines == drawn.n_cells == FIBRES
    np.testing.assert_allclose(drawn.points, fibres.points.reshape(-1, 3), rtol=1e-12)
    np.testing.assert_allclose(drawn.cell_data["length"], fibres.lengths)
    np.testing.assert_allclose(drawn.cell_data["stretch"], fibres.stretch)
    np.testing.assert_allclose(drawn.point_data["local_stretch"], fibres.local_stretch.ravel())
    with (tmp_path / "fibres.csv").open(encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == FIBRES * len(run)
    row = rows[FIBRES * 3 + 5]
    assert (row["frame"], row["muscle"], row["fibre"]) == ("3", "strap", "5")
    assert float(row["length"]) == pytest.approx(fibres.lengths[5])


def test_fibres_are_exported_and_drawn(run, tmp_path):
    run.save(tmp_path / "run", pictures=False)
    page = (tmp_path / "run" / "report.html").read_text(encoding="utf-8")
    plot = page[page.index('aria-label="Moment arm: elbow.bend"') :].partition("</svg>")[0]
    assert plot.count("fill-opacity: 0.2") == 1  # the fibres' band
    run.export(tmp_path / "out", ["vtp", "animated-glb"], units=None)
    moved = pyvista.read(tmp_path / "out" / "vtp" / "strap_fibres_0004.vtp")
    np.testing.assert_allclose(moved.points, run["strap"].fibres(4).reshape(-1, 3), rtol=1e-12)
    data = (tmp_path / "out" / "animated-glb" / "hinge.glb").read_bytes()
    tree = json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")])
    (lines,) = (mesh for mesh in tree["meshes"] if mesh["name"] == "strap_fibres")
    (primitive,) = lines["primitives"]
    ends = tree["accessors"][primitive["indices"]]
    assert (primitive["mode"], len(primitive["targets"])) == (1, len(run) - 1)
    assert ends["count"] == 2 * FIBRES * (run["strap"].fibres(0).shape[1] - 1)
    place = tree["accessors"][primitive["attributes"]["POSITION"]]
    metres = 0.001 * run["strap"].fibres(0).reshape(-1, 3)
    np.testing.assert_allclose(place["max"], metres.max(axis=0), rtol=1e-6)
    source = SavedSource({"run": rm.Run.load(tmp_path / "run")})
    picture = source.figure("run").advance()
    assert picture.fibres["strap"].points.shape == run["strap"].fibres(0).shape


def test_curves_of_usd_follow_the_fibres(run, tmp_path):
    from pxr import Usd, UsdGeom

    run.save(tmp_path / "run", pictures=False)
    (file,) = run.export(tmp_path / "out", "usd")
    stage = Usd.Stage.Open(str(file))
    curves = UsdGeom.BasisCurves(stage.GetPrimAtPath("/hinge/strap_fibres"))
    for frame in (0, 3):
        np.testing.assert_allclose(
            curves.GetPointsAttr().Get(frame), run["strap"].fibres(frame).reshape(-1, 3), rtol=1e-5
        )
    assert len(curves.GetCurveVertexCountsAttr().Get()) == FIBRES


def test_colours_of_stretch_are_white_at_one():
    blue, white, red = stretch_colours(np.array([0.3, 1.0, 1.6]))
    assert white.min() > 0.95
    assert blue[2] > blue[0] and red[0] > red[2]


def test_a_run_without_fibres_says_how_to_have_them():
    run = rm.simulate(rm.phantom_scene(end=0.0, model="pbd"))
    with pytest.raises(UsageError, match=r"output\.fibres=32"):
        run["extensor"].fibres(0)


def test_the_number_of_fibres_is_checked_and_true_is_the_usual_one():
    scene = rm.phantom_scene(end=0.0)
    assert scene.with_options({"output.fibres": True}).output.fibres == 32
    assert scene.output.fibres == scene.with_options({"output.fibres": False}).output.fibres == 0
    for wrong in (1001, -1, "many"):
        with pytest.raises(UsageError, match=r"output\.fibres"):
            scene.with_options({"output.fibres": wrong})


def test_published_bands_are_found_by_name():
    band = published_band("psoas_major", "hip.hip_flexion")
    assert band.angle[0] == -5.0 and (band.least < band.greatest).all()
    assert published_band("Iliacus_r", "hip_r.internal_rotation") is not None
    # Extensors have negative moment arms about flexion.
    assert published_band("gluteus_maximus", "hip.flexion").greatest.max() < 0.0
    for muscle, coordinate in (
        ("psoas", "knee.flexion"),
        ("psoas", "hip.shift"),
        ("sartorius", "hip.flexion"),
    ):
        assert published_band(muscle, coordinate) is None
