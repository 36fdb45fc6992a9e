"""Classes of muscles and included files."""

import pytest
from blend_model import arm_files

from rbfmuscle.scene.scene import Scene
from rbfmuscle.validation import SceneError

CLASSES = """
[classes.main]
model = { name = "rbf", centres = 120 }
attach = [{ bone = "upper", vertices = "upper.txt" }, { bone = "fore", vertices = "fore.txt" }]
[classes.thin]
model = { nodes = 80 }
fibre_stretch_at_rest = 0.9
[classes.old]
model = "pbd"
"""
MUSCLES = (("first", -20.0), ("second", 0.0), ("third", 20.0))


@pytest.fixture
def arm(tmp_path):
    """Three muscles, of which the second is thin and the third has settings of its own."""
    path = arm_files(tmp_path, muscles=MUSCLES)
    text = path.read_text()
    main = text[text.index("[classes.main]") : text.index("[output]")]
    text = text.replace(main, CLASSES)
    text = text.replace('"second.ply"', '"second.ply"\nclass = "thin"')
    path.write_text(text + 'class = "thin"\nmodel = { centres = 60 }\n')
    return path


class TestClasses:
    def test_own_keys_then_those_of_the_class_then_of_main(self, arm):
        first, second, third = Scene.load(arm).muscles
        assert (first.model, first.options) == ("rbf", {"centres": 120})
        assert second.options == {"centres": 120, "nodes": 80}
        assert third.options == {"centres": 60, "nodes": 80}
        assert first.contraction is None
        assert second.contraction.fibre_stretch_at_rest == 0.9
        assert all(len(muscle.attachments) == 2 for muscle in (first, second, third))

    def test_another_model_drops_the_settings(self, arm):
        arm.write_text(
            arm.read_text().replace('"second.ply"\nclass = "thin"', '"second.ply"\nclass = "old"')
        )
        assert (Scene.load(arm).muscles[1].model, Scene.load(arm).muscles[1].options) == ("pbd", {})

    def test_unknown_class_is_named(self, arm):
        arm.write_text(arm.read_text().replace('class = "thin"', 'class = "thn"', 1))
        with pytest.raises(SceneError, match="muscle 'second': unknown class 'thn', did you mean"):
            Scene.load(arm)


class TestInclude:
    @pytest.fixture
    def split(self, arm):
        """The muscles in a folder of their own, with their meshes; the rest in the scene file."""
        folder = arm.parent / "muscles"
        folder.mkdir()
        text = arm.read_text()
        cut = text.index("[[muscle]]")
        (folder / "muscles.toml").write_text(CLASSES + text[cut:])
        for name in ("first.ply", "second.ply", "third.ply", "upper.txt", "fore.txt"):
            (arm.parent / name).rename(folder / name)
        whole = text[:cut].replace(CLASSES, "[classes.old]\nmodel = 'xpbd'\n")
        arm.write_text('include = ["muscles/muscles.toml"]\n' + whole)
        return arm, folder / "muscles.toml"

    def test_tables_join_and_files_are_found_from_where_they_are_named(self, split):
        scene = Scene.load(split[0])
        assert [muscle.name for muscle in scene.muscles] == ["first", "second", "third"]
        assert scene.muscles[1].options == {"centres": 120, "nodes": 80}

    def test_a_table_of_the_file_takes_the_place_of_an_included_one(self, split):
        scene, inner = split
        scene.write_text(
            scene.read_text()
            + '[[muscle]]\nname = "x"\nmesh = "muscles/first.ply"\nclass = "old"\n'
        )
        ramp = '[motion]\nramp = { "elbow.flexion" = { to = 80, step = 1 } }\n'
        inner.write_text(ramp + inner.read_text())
        loaded = Scene.load(scene)
        assert loaded.muscles[-1].model == "xpbd" and len(loaded.motion) == 3

    @pytest.mark.parametrize(
        ("text", "words"),
        [
            ('include = ["arm.toml"]', "would include itself"),
            ('include = ["nowhere.toml"]', "nowhere.toml: no such scene file"),
            ("include = 3", "must be a list of names"),
            ('[scene]\nunits = "m"', "lengths are in m, not in mm"),
        ],
    )
    def test_what_cannot_be_included_is_named(self, split, text, words):
        scene, _ = split
        (scene.parent / "more.toml").write_text(text + "\n")
        scene.write_text(scene.read_text().replace("muscles/muscles.toml", "more.toml"))
        with pytest.raises(SceneError, match=words) as caught:
            Scene.load(scene)
        assert "\n" not in str(caught.value)

    def test_guesses_of_included_files_count(self, split):
        scene, inner = split
        inner.write_text(
            inner.read_text().replace("{ bone", "{ guess = { confidence = 0.3 }, bone", 1)
        )
        assert {guess.name for guess in Scene.load(scene).guesses} == {"first", "second", "third"}
