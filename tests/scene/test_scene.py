"""Scenes from files and from code; each mistake gives one line that names the place and the
remedy."""

import json
import pickle
import re

import numpy as np
import pytest
import trimesh
from conftest import ROOT

from rbfmuscle.run.info import record_scene
from rbfmuscle.scene.check import bone_collisions, check_initial, check_scene
from rbfmuscle.scene.file import attachment_file
from rbfmuscle.scene.frames import parse_slice
from rbfmuscle.scene.objects import from_mm, new_name
from rbfmuscle.scene.options import NeighbourOptions
from rbfmuscle.scene.scene import Scene, require_complete
from rbfmuscle.scene.settings import parse_settings
from rbfmuscle.validation import SceneError, UsageError

TEXT = (ROOT / "tests" / "data" / "biceps.toml").read_text(encoding="utf-8")


def meshes():
    upper = trimesh.creation.box((80, 20, 20)).apply_translation([-50, 0, 0])
    lower = trimesh.creation.box((80, 20, 20)).apply_translation([50, 0, 0])
    biceps = trimesh.creation.icosphere(subdivisions=3, radius=1.0)
    biceps.apply_scale([60, 10, 8]).apply_translation([0, 0, 20])
    return upper, lower, biceps


@pytest.fixture
def folder(tmp_path):
    for name, mesh in zip(("upper", "lower", "biceps"), meshes()):
        mesh.export(tmp_path / f"{name}.ply")
    held = np.flatnonzero(meshes()[2].vertices[:, 0] > 50)
    (tmp_path / "lower.txt").write_text("\n".join(map(str, held)))
    (tmp_path / "arm.toml").write_text(TEXT)
    return tmp_path


def load(folder, *changes):
    """Load the scene with (old, new) replacements in its text."""
    text = TEXT
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    (folder / "arm.toml").write_text(text)
    return Scene.load(folder / "arm.toml")


def built():
    upper, lower, biceps = meshes()
    scene = Scene("arm", units="mm").add_bone("upper", upper).add_bone("lower", lower)
    scene.add_joint("elbow", "upper", "lower", (0, 0, 0), {"flexion": (0, -1, 0)})
    held = np.flatnonzero(biceps.vertices[:, 0] > 50)
    attach = [{"bone": "upper", "near": 4}, {"bone": "lower", "vertices": held}]
    return scene.add_muscle("biceps", biceps, attach=attach)


class TestLoading:
    def test_units_and_scale_give_the_same_shape(self, folder):
        scaled = [(f'"{n}.ply"', f'"{n}.ply"\nscale = 0.001') for n in ("upper", "lower", "biceps")]
        metres = load(
            folder, ('units = "mm"', 'units = "m"'), ("near = 4", "near = 0.004"), *scaled
        )
        assert from_mm(4, metres.units) == pytest.approx(0.004)
        assert metres.muscles[0].mesh.volume * 1e9 == pytest.approx(
            load(folder).muscles[0].mesh.volume
        )
        held = [scene.muscles[0].attachments[0].vertices for scene in (metres, load(folder))]
        assert np.array_equal(*held)


BALL = "points = [[0, 0, 0]], radius = 3"


class TestMistakes:
    @pytest.mark.parametrize(
        ("old", "new", "message"),
        [
            (
                "centre = [0, 0, 0]",
                "center = [0, 0, 0]",
                r"'elbow': unknown key 'center', did you mean 'cen",
            ),
            ('child = "lower"', 'child = "lowr"', r"joint 'elbow': .*'lowr', did you mean 'lower'"),
            ('{ bone = "upper"', '{ bone = "uper"', r"attach 1: .*'uper', did you mean 'upper'"),
            ("elbow.flexion", "elbo.flexion", r"'elbo.flexion', did you mean 'elbow"),
            ("[0, -2, 0]", "[0, 0, 0]", r"'elbow' axes flexion: must not be the zero vector"),
            ("near = 4", f"near = 4, {BALL}", r"one of vertices, array, near, .*, got near and"),
            ("near = 4", "near = 0.001", r"reaches no vertex .*, the nearest is .* away"),
            ('"lower.txt"', '"nowhere.txt"', r"nowhere.txt: cannot read it"),
            (
                "near = 4",
                "near = 75",
                r"vertices \(first: \d+\) are attached to both 'upper' and 'lower'",
            ),
            ('name = "lower"', 'name = "upper"', r"bone 'upper' is given twice"),
            ('name = "biceps"', 'name = "../x"', r"muscle name '../x' may hold letters"),
            (
                'name = "biceps"',
                f'name = "{"b" * 101}"',
                "has 101 letters, at most 100 are allowed",
            ),
            ("[scene]", "[scene", r"not valid TOML.*line 1"),
            ('"report"', '"reprot"', r"\[detect\] tunnelling action: .*'reprot'"),
            (
                "[classes.main]",
                '[classes.main]\nattach = [ { bone = "arm", x = 1 } ]',
                r"\[classes.main\] attach 1: unknown",
            ),
            ("near = 4", "near = 4, radius = 3", r"'biceps' attach 1: radius belongs to points"),
            # Keys of the first format, or of another table.
            (
                "near = 4",
                "sphere = { centre = [0, 0, 0], radius = 3 }",
                r"'biceps' attach 1: unknown key 'sphere', write points = \[CENTRE\], radius =",
            ),
            ("[scene]\nformat = 2", "format = 2\n[scene]", r"'format', .* the table \[scene\]"),
            (
                "format = 2\n",
                'format = 1\nleft_out = ["hand"]\n',
                r"arm.toml: files of format 1 are read no more; write .* format = 2$",
            ),
            ("format = 2\n", "", r"\[scene\]: key format is missing, write format = 2$"),
            ("[classes.main]", "[defaults]", r"'defaults', \[classes.main\] holds"),
            ("units =", "left_out = []\nunits =", r"'left_out', did you mean 'missing_bones'\?"),
            (
                "[classes.main]",
                '[neighbours]\npairs = [["biceps", "bicep"]]\n\n[classes.main]',
                r"\[neighbours\] pairs: unknown muscle 'bicep', did you mean 'biceps'",
            ),
            (
                "[classes.main]",
                '[neighbours]\nbones = [["biceps", "uper"]]\n\n[classes.main]',
                r"\[neighbours\] bones: unknown bone 'uper', did you mean 'upper'",
            ),
        ],
    )
    def test_one_line_names_file_place_and_remedy(self, folder, old, new, message):
        with pytest.raises(SceneError, match=message) as caught:
            load(folder, (old, new))
        text = str(caught.value)
        assert "\n" not in text and text.startswith(str(folder / "arm.toml"))

    def test_scene_without_what_it_needs_or_with_a_loop(self, folder):
        both, axes = re.search(r"attach = \[.*\]", TEXT).group(), {"x": (1, 0, 0)}
        muscle = TEXT[TEXT.index("[[muscle]]") : TEXT.index("[contact]")]
        for act, words in (
            (lambda: load(folder, (both, "")), "muscle 'biceps' has no attachment"),
            (
                lambda: load(folder, (', { bone = "lower", vertices = "lower.txt" }', "")),
                "to 'upper' only",
            ),
            (lambda: load(folder, (muscle, "")), r"has no muscles, add a \[\[muscle\]\]$"),
            (lambda: require_complete(Scene("bare")), r"has no bones, add a \[\[bone\]\]$"),
            (lambda: Scene.load(folder), "is a folder"),
            (
                lambda: built().add_joint("again", "upper", "lower", (0, 0, 0), axes),
                "already the child",
            ),
            (
                lambda: built().add_joint("loop", "lower", "upper", (0, 0, 0), axes),
                "hang on itself",
            ),
        ):
            with pytest.raises(SceneError, match=words):
                act()


class TestFileNames:
    """Meshes of a run are files named after muscles and bones, also where case does not count."""

    @pytest.mark.parametrize(
        ("bones", "muscles", "said"),
        [
            (["aux"], [], "bone name 'aux' is that of a device on Windows"),
            (["b", "c"], ["COM7"], "muscle name 'COM7' is that of a device on Windows"),
            (["Femur", "femur"], [], "differs from 'Femur' in case alone"),
            (["rib", "rib_0001"], ["a"], "bone 'rib_0001' has the name of a frame of bone 'rib'"),
            (["b", "c"], ["a", "A"], "differs from 'a' in case alone"),
            (["b", "c"], ["a", "A_tendon"], "'A_tendon' has the name of the tendons of 'a'"),
            (["b", "c"], ["a_tendon", "a"], "'a_tendon' has the name of the tendons of 'a'"),
        ],
    )
    def test_names_whose_files_would_be_one_or_none_are_refused(self, bones, muscles, said):
        scene = Scene(units="mm")
        with pytest.raises(SceneError, match=said):
            for k, name in enumerate(bones):
                box = trimesh.creation.box((5.0, 5.0, 5.0)).apply_translation([40.0 * k, 0, 0])
                scene.add_bone(name, box)
            for name in muscles:
                ball = trimesh.creation.icosphere(radius=8.0).apply_translation([14.0, 0, 0])
                x = ball.vertices[:, 0]
                held = [
                    {"bone": bones[0], "vertices": np.flatnonzero(x < 9.0).tolist()},
                    {
                        "bone": bones[1],
                        "vertices": np.flatnonzero(x > 19.0).tolist(),
                        "tendon": {"to": [36.0, 0.0, 0.0]},
                    },
                ]
                scene.add_muscle(name, ball, attach=held)
            require_complete(scene)

    def test_names_that_stay_apart_are_taken(self):
        names = ["rib", "rib_1", "rib_x001", "com", "auxiliary"]
        scene = Scene(units="mm")
        for name in names:
            scene.add_bone(name)
        assert scene.meshless_bones == names
        # Of muscle and bone: a_b and c, a and b_c.
        assert attachment_file("a_b", "c") != attachment_file("a", "b_c")

    @pytest.mark.parametrize("name", ["Con", "nul", "LPT1"])
    def test_names_of_foreign_files_never_become_those_of_devices(self, name):
        assert new_name(name, []) == f"{name}_2"


class TestOptions:
    def test_copy_shares_meshes_and_leaves_the_original_alone(self):
        scene = built().set_motion(ramp={"elbow.flexion": {"to": 30, "step": 10}})
        other = scene.with_options(
            {"contact.substep_angle": 1.0, "detect.tunnelling.angle": 120.0, "motion.step": 5.0},
            model={"name": "rbf", "centres": 10},
            frames="1:3",
        )
        assert other.muscles[0].mesh is scene.muscles[0].mesh
        assert (other.contact.substep_angle, scene.contact.substep_angle) == (1.0, 2.0)
        assert (other.detect.tunnelling.angle, scene.detect.tunnelling.angle) == (120.0, None)
        assert other.muscles[0].options == {"centres": 10} and scene.muscles[0].options == {}
        assert len(other.motion) == 2 and len(scene.motion) == 4

    def test_another_model_drops_the_options_and_a_table_without_a_name_adds_to_them(self, folder):
        scene = load(
            folder, ('mesh = "biceps.ply"', 'mesh = "biceps.ply"\nmodel = { kernel = "cubic" }')
        )
        assert scene.muscles[0].options == {"centres": 60, "kernel": "cubic"}
        scene = load(folder)
        assert scene.with_options(model="pbd").muscles[0].options == {}
        assert scene.with_options(model="rbf").muscles[0].options == {"centres": 60}
        changed = scene.with_options({"muscle.biceps.model.centres": 70})
        assert changed.muscles[0].options == {"centres": 70}

    @pytest.mark.parametrize(
        ("key", "message"),
        [
            ("contct.initial", "did you mean 'contact'"),
            ("contact.initail", "did you mean 'initial'"),
            ("muscle.bicep.model", "did you mean 'biceps'"),
            ("motion.ramp.x.y.step", "no ramp 'x.y'"),
            ("contact", "name a key"),
            ("output.surfaces.format", "surfaces: .*rbfmuscle export writes other formats"),
        ],
    )
    def test_unknown_settings(self, key, message):
        with pytest.raises(UsageError, match=message):
            built().with_options({key: 1})

    def test_unknown_neighbours(self):
        scene = built()
        for key in ("pairs", "bones"):
            with pytest.raises(UsageError, match=f"{key}: unknown muscle 'bices', did you mean"):
                scene.with_options({f"neighbours.{key}": [["bices", "biceps"]]})
        scene.neighbours = NeighbourOptions(pairs=[["biceps", "brachialis"]])
        with pytest.raises(SceneError, match="unknown muscle 'brachialis'"):
            require_complete(scene)

    def test_settings_from_text(self):
        texts = [
            "a=1",
            "model.centres=200",
            "contact.initial=keep",
            "model={name='rbf', a=[1, 2]}",
            "a = 2",
        ]
        found, model = parse_settings(texts), {"name": "rbf", "a": [1, 2]}
        assert found == {"a": 2, "model.centres": 200, "contact.initial": "keep", "model": model}
        assert parse_slice("2:8:3") == slice(2, 8, 3) and parse_slice("-1") == slice(-1, None)
        for text in ("a:b", "1:2:0", ""):
            with pytest.raises(UsageError, match="A:B:S"):
                parse_slice(text)
        for value in ("nan", "-inf", "{a=[inf]}", "99999999999999999999"):
            with pytest.raises(UsageError, match=r"^model\.rest_error"):
                parse_settings([f"model.rest_error={value}"])

    def test_pickle_and_resolved(self, folder):
        scene = load(folder)
        again = pickle.loads(pickle.dumps(scene))
        assert record_scene(again) == record_scene(scene)
        resolved = json.loads(json.dumps(record_scene(scene)))
        assert resolved["muscles"][0]["model"] == {"name": "rbf", "centres": 60}
        assert len(resolved["bones"][0]["sha256"]) == 64


class TestCheck:
    def test_muscle_that_starts_inside_a_bone(self):
        scene = built()
        scene.muscles[0].mesh.apply_translation(
            [0, 0, -4]
        )  # 1 mm into the bones in the middle of each
        (note, *_) = [f for f in check_scene(scene) if "start inside" in f.message]
        # The free ones over the lower arm, whose top and end are at z = 10 and x = 10.
        x, _, z = scene.muscles[0].mesh.vertices.T
        deep = np.minimum(10.0 - z, x - 10.0)[(z < 10.0) & (x > 10.0)].max()
        assert note.level == "note" and f"up to {deep:.3g} mm deep" in note.message
        strict = scene.with_options({"contact.initial": "error"})
        with pytest.raises(SceneError, match=r"muscle 'biceps': .*start inside bone"):
            check_initial(strict)
        scene.muscles[0].mesh.apply_translation([-50, 0, -16])
        scene.muscles[0].mesh.apply_scale(0.5)
        with pytest.raises(SceneError, match="start inside bone 'upper'"):
            check_initial(scene)

    def test_real_hip_collisions_are_those_of_its_readme(self, hip_data):
        scene = Scene.load(hip_data / "adduction.toml")
        frames = [15, 22]  # 30 and 44 degrees: the readme has 0.7 mm and about 9 mm
        depths = {frame: depth for frame, _, _, depth in bone_collisions(scene, frames)}
        assert depths[15] == pytest.approx(0.7, abs=0.3)
        assert depths[22] == pytest.approx(9, abs=1)
        assert bone_collisions(Scene.load(hip_data / "gluteus.toml")) == []
