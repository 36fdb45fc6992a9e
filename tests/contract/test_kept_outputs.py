"""Scenes, imports, pages, files and pictures of small inputs hold what they held, with times of a
counting clock.
"""

import inspect
from itertools import pairwise
from shutil import copy
from typing import get_type_hints

import numpy as np
import pytest
from blend_model import arm_scene, use_blend_model
from conftest import ROOT
from fuzz.meshes import base_scene, damaged_shape, write_base
from fuzz.scenes import to_toml
from kept import check_kept, file_facts, text_facts
from PIL import Image
from trimesh.transformations import rotation_matrix as turned
from whole_runs import SCENES

import rbfmuscle as rm
from pbd_baseline.options import PBDOptions
from rbfmuscle.cli.app import GROUPS
from rbfmuscle.experiments.comparison import MEASURES
from rbfmuscle.importers.guess.guess import guess_scene, write_scene
from rbfmuscle.importers.opensim import scene as opensim
from rbfmuscle.metrics.summary import LIMITS
from rbfmuscle.muscle.options import RBFOptions
from rbfmuscle.output import appearance
from rbfmuscle.output.export import export_run
from rbfmuscle.output.saved import SavedRun
from rbfmuscle.report.plots import Point, Track, front_plot, line_plot
from rbfmuscle.report.render import draw_scene, render_run
from rbfmuscle.report.report import write_report
from rbfmuscle.scene.activation.contraction import Activations, resolve_contraction
from rbfmuscle.scene.meshes.read import prepare_mesh
from rbfmuscle.scene.motion import bone_poses, step_angle
from rbfmuscle.scene.options import Table
from rbfmuscle.simulation.plan import plan_scene
from rbfmuscle.validation import MeshError
from rbfmuscle.viewer.side import COLOURINGS, legend, shades
from rbfmuscle.viewer.sources import LiveSource

BOUNDS = ("gt", "ge", "lt", "le", "min_length", "max_length")


def scene_facts(scene):
    """A scene as run.json has it, its findings, plan, attachments, and what changes along its
    motion.
    """
    told = scene.resolved()
    frames = scene.motion.frames
    activations = Activations(scene)
    for table in (told, *told["bones"], *told["muscles"]):
        table.pop("sha256" if "sha256" in table else "file")
    yield told, plan_scene(scene), scene.body, [(f.level, f.place) for f in scene.check()]
    yield (
        [bone_poses(scene, frame) for frame in frames],
        [step_angle(scene, *pair) for pair in pairwise(frames)],
    )
    yield [bone_poses(scene, frame).tendons for frame in frames]
    yield [held.vertices for muscle in scene.muscles for held in muscle.attachments]
    yield [
        resolve_contraction(muscle) for muscle in scene.muscles if muscle.contraction is not None
    ]
    yield [activations.at(k) for k in range(len(frames))], activations.refine(1, frames[:2])


@pytest.fixture
def limb(tmp_path):
    """A scene of joints of several kinds, with a coupling, a tendon and activation."""
    write_base(tmp_path)
    return rm.Scene.load(copy(ROOT / "tests" / "data" / "limb.toml", tmp_path))


@pytest.mark.parametrize("name", ["limb", "contact_pbd", "sliding_xpbd", "tunnelling_arap_volume"])
def test_scene_is_what_is_kept(name, limb):
    check_kept(f"scene_{name}", list(scene_facts(limb if name == "limb" else SCENES[name]())))


def test_scene_with_a_file_of_motion_is_what_is_kept(tmp_path):
    write_base(tmp_path)
    (tmp_path / "scene.toml").write_text(
        to_toml(base_scene() | {"motion": {"file": "flex.mot"}}), encoding="utf-8"
    )
    check_kept("scene_file", list(scene_facts(rm.Scene.load(tmp_path / "scene.toml"))))


def test_mended_mesh_is_what_is_kept():
    found = {}
    for kind in (*range(8), *range(10, 14)):
        mesh = damaged_shape(np.random.default_rng(kind), kind)
        try:
            read = prepare_mesh(mesh.vertices, mesh.faces, place="x", name="y", may_be_open=True)
            found[kind] = read.mesh, read.notes, read.closed
        except MeshError as error:
            found[kind] = str(error)
    check_kept("meshes", found)


@pytest.mark.parametrize(("file", "name"), [("small", "osim"), ("muscles", "osim_muscles")])
def test_imported_model_is_what_is_kept(tmp_path, file, name):
    for part in (f"{file}.osim", "wedge.obj"):
        copy(ROOT / "tests" / "data" / part, tmp_path)
    found = opensim.import_osim(tmp_path / f"{file}.osim")
    opensim.write_scene(found, tmp_path / "scene")
    facts = list(scene_facts(rm.Scene.load(tmp_path / "scene" / "scene.toml", skeleton=True)))
    moved = [
        found.model.transforms(dict.fromkeys(found.model.coordinates(), 0.1 * k))
        for k in range(-2, 3)
    ]
    muscles = (
        [[found.model.muscles, [m.mesh for m in found.scene.muscles]]] if file == "muscles" else []
    )
    check_kept(name, [facts, found.places, found.notes, moved, *muscles])


def test_guessed_scene_is_what_is_kept(tmp_path):
    scene = rm.phantom_scene(spacing=4.0)
    for item in scene.bones + scene.muscles:
        item.mesh.export(tmp_path / f"{item.name}.ply")
    made = write_scene(guess_scene(tmp_path, "mm", tmp_path), tmp_path / "scene.toml")
    # Meshes in single precision.
    check_kept("guess", [list(scene_facts(made)), file_facts(tmp_path)], tolerance=1e-6)


@pytest.mark.filterwarnings("ignore:limb and hand")
@pytest.mark.parametrize("name", ["blend", "limb"])
def test_files_of_a_run_hold_what_is_kept(name, limb, tmp_path, monkeypatch, clock):
    folder = tmp_path / "run"
    if name == "blend":
        use_blend_model(monkeypatch)
    rm.simulate(arm_scene(end=60) if name == "blend" else limb).save(folder)
    info, facts = SavedRun(folder).info, {}
    if (
        name == "blend"
    ):  # the other's volume is the same in all frames: rounding decides where it is worst
        write_report(folder)
        facts = {
            key: info[key]
            for key in ("muscles", "frames", "times", "frame_time", "limits", "verdict")
        }
    export_run(folder, ["obj", "pvd", "stl", "ply"], units="cm", frames=slice(1, 3))
    export_run(folder, ["glb", "animated-glb"], frames=slice(1, 3))
    draw_scene(limb, folder / "scene.png")
    render_run(folder, folder / "side.png", frame=2)
    render_run(folder, folder / "plane.png", frame=3, views=["motion", "top"])
    # Without the lines of text above and below.
    facts["plots"] = [np.asarray(Image.open(file))[22:200] for file in sorted(folder.glob("*.png"))]
    check_kept(f"run_{name}", [facts, file_facts(folder)])


def numbers(values):
    """All numbers among values and tuples of them; not a number for what is none."""
    flat = [one for value in values for one in (value if isinstance(value, tuple) else [value])]
    return [one if isinstance(one, int | float) else np.nan for one in flat]


def defaults_of(call):
    """Defaults of a function, or of a class and its methods, and whether its options take several
    words.
    """
    calls = [call, *(one for _, one in inspect.getmembers(call, inspect.isfunction))]
    given = [each.default for one in calls for each in inspect.signature(one).parameters.values()]
    hints = get_type_hints(call, include_extras=True).values() if "cli" in call.__module__ else ()
    parts = [part for kind in hints for part in getattr(kind, "__metadata__", ())]
    return numbers([*given, *(getattr(part, "consume_multiple", None) for part in parts)])


def test_defaults_and_bounds_are_what_is_kept():
    calls = [getattr(rm, name) for name in rm._HOME if name not in rm._ERRORS] + [
        *sum(GROUPS.values(), ())
    ]
    found, kinds = (
        {call.__name__: defaults_of(call) for call in calls},
        [Table, PBDOptions, RBFOptions],
    )
    for kind in kinds:
        kinds += [new for new in kind.__subclasses__() if new not in kinds]
        fields = kind.model_fields.values()
        bounds = [
            getattr(part, key, None)
            for field in fields
            for part in field.metadata
            for key in BOUNDS
        ]
        found[kind.__name__] = numbers([*bounds, *(field.default for field in fields)])
    check_kept("defaults", [found, numbers(MEASURES.values()), numbers(LIMITS.values())])


def test_looks_are_what_is_kept():
    body, shares = np.roll(np.eye(3), 1, axis=0), np.linspace(0.0, 2.0, 201)
    names = {f"muscle {k}": str(k % 7) for k in range(30)}
    colours = map(appearance.rgb, appearance.muscle_colours(list(names), names).values())
    views = [appearance.view_axes(view, body) for view in appearance.VIEWS.values()]
    turns = [
        [{"a": np.eye(4)}, {"a": turned(angle, axis)}] for angle in (0.03, 0.1) for axis in body
    ]
    seen = [appearance.motion_direction(poses, body) for poses in turns]
    scales = [one for one in COLOURINGS.values() if one is not None]
    shown = [(shades(one, 3.0 * shares, 0.3), text_facts(legend(one, "cm", 0.1))) for one in scales]
    lines, axes = [Track(name, "#cc6677", shares, shares**2) for name in names], ("x", "y")
    plots = [
        line_plot("a", lines[:2], axes, limits=[2.0], zero=zero, legend=zero)
        for zero in (True, False)
    ]
    dots = [Point(1 + k % 7, 1 + k % 5, f"p{k}", str(k % 2), k == 4, k < 3) for k in range(9)]
    plots = list(map(text_facts, [*plots, front_plot(dots, axes)]))
    check_kept("looks", [list(colours), appearance.linear_rgb(shares), views, seen, shown, plots])


def test_live_pictures_are_what_is_kept(limb):
    source = LiveSource(limb)
    figure, pictures = source.figure(source.choices[0]), [source.rest]
    for share, coarse in ((0.3, False), (0.6, True), (0.6, True), (0.6, False)):
        for name, control in source.controls.items():
            figure.set(name, control.low + share * (control.high - control.low))
        pictures.append(figure.advance(coarse=coarse))
    facts = (
        source.controls,
        source.motion,
        source.body,
        source.millimetre,
        figure.pending,
        figure.near,
    )
    coarse = LiveSource(rm.phantom_scene(end=0.0, spacing=2.5), "pbd").rest.surfaces
    check_kept("live", [facts, pictures, coarse])
