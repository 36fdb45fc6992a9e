"""A mistake is told where it stands: the words for each place of a scene file, table by table."""

import pytest

from rbfmuscle.scene.file import read_scene_file
from rbfmuscle.validation import SceneError

HEAD = '[scene]\nformat = 1\nunits = "mm"\n'
BONES = '[[bone]]\nname = "trunk"\nmesh = "t.ply"\n[[bone]]\nname = "arm"\nmesh = "a.ply"\n'
JOINT = '[[joint]]\nname = "hip"\nparent = "trunk"\nchild = "arm"\ncentre = [0, 0, 0]\naxes = { bend = [1, 0, 0] }\n'
MUSCLE = '[[muscle]]\nname = "strap"\nmesh = "m.ply"\n'

PLACES = [
    (HEAD + "x = 1\n", "[scene]"),
    (HEAD + BONES + "x = 1\n", "[[bone]] 'arm'"),
    (HEAD + '[[bone]]\nmesh = "t.ply"\nname = 1\n', "[[bone]] 1 name"),
    (HEAD + BONES + '[[bone]]\nmesh = "t.ply"\nx = 1\n', "[[bone]] 3"),
    (HEAD + JOINT + "x = 1\n", "[[joint]] 'hip'"),
    (HEAD + JOINT + "[joint.limits]\nx = 1\n", "[[joint]] 'hip'"),
    (HEAD + "[defaults]\nx = 1\n", "[defaults]"),
    (HEAD + '[defaults]\nattach = [ { bone = "arm", x = 1 } ]\n', "[defaults] attach 1"),
    (HEAD + MUSCLE + "x = 1\n", "[[muscle]] 'strap'"),
    (
        HEAD + MUSCLE + 'attach = [ { bone = "arm", near = 1 }, { bone = "arm", x = 1 } ]\n',
        "[[muscle]] 'strap' attach 2",
    ),
    (
        HEAD + MUSCLE + 'attach = [ { bone = "arm", sphere = { centre = [0, 0, 0], radius = 1, x = 1 } } ]\n',
        "[[muscle]] 'strap' attach 1 sphere",
    ),
    (HEAD + "[motion]\nx = 1\n", "[motion]"),
    (
        HEAD + '[motion]\nramp = { "hip.bend" = { from = 0, to = 1, step = 1, x = 1 } }\n',
        "[motion] ramp hip.bend",
    ),
    (HEAD + "[contact]\nx = 1\n", "[contact]"),
    (HEAD + "[sliding]\nx = 1\n", "[sliding]"),
    (HEAD + "[detect]\nx = 1\n", "[detect]"),
    (HEAD + "[detect]\ntunnelling = { x = 1 }\n", "[detect] tunnelling"),
    (HEAD + "[output]\nx = 1\n", "[output]"),
    (HEAD + "[output]\nsurfaces = { x = 1 }\n", "[output] surfaces"),
]


@pytest.mark.parametrize(("text", "place"), PLACES, ids=[place for _, place in PLACES])
def test_unknown_key_is_told_with_its_place(tmp_path, text, place):
    path = tmp_path / "s.toml"
    path.write_text(text)
    with pytest.raises(SceneError) as caught:
        read_scene_file(path)
    assert str(caught.value).startswith(f"{path}: {place}: ")


WRONG = [
    ("[output]\nsurfaces = 3\n", "[output] surfaces: input should be a table, got 3"),
    ("[motion]\nramp = 3\n", "[motion] ramp: input should be a table, got 3"),
    ('[motion]\nramp = { "a.b" = 3 }\n', "[motion] ramp a.b: input should be a table, got 3"),
    (MUSCLE + 'attach = [ { bone = "arm", vertices = 3.5 } ]\n', "[[muscle]] 'strap' attach 1 vertices: "),
    (BONES + "[[bone]]\n", "[[bone]] 3 name: field required"),
]


@pytest.mark.parametrize(("text", "message"), WRONG, ids=[message.split(":")[0] for _, message in WRONG])
def test_wrong_value_is_told_without_words_of_the_library(tmp_path, text, message):
    path = tmp_path / "s.toml"
    path.write_text(HEAD + text)
    with pytest.raises(SceneError) as caught:
        read_scene_file(path)
    assert str(caught.value).startswith(f"{path}: {message}")


def test_unknown_table_is_told_as_such(tmp_path):
    path = tmp_path / "s.toml"
    path.write_text(HEAD + "[contcat]\nx = 1\n")
    with pytest.raises(SceneError) as caught:
        read_scene_file(path)
    assert "unknown key 'contcat', did you mean 'contact'" in str(caught.value)
