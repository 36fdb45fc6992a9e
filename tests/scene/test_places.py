"""A mistake is named with its place: the words for tables, rows and keys of a scene file."""

import pytest

from rbfmuscle.scene.file import read_scene_file
from rbfmuscle.validation import SceneError

HEAD = '[scene]\nformat = 1\nunits = "mm"\n'
BONES = '[[bone]]\nname = "trunk"\nmesh = "t.ply"\n[[bone]]\nname = "arm"\nmesh = "a.ply"\n'
MUSCLE = '[[muscle]]\nname = "strap"\nmesh = "m.ply"\n'
SPHERE = '{ bone = "arm", sphere = { centre = [0, 0, 0], radius = 1, x = 1 } }'

WRONG = [
    ("[scene]\nx = 1\n", "not valid TOML"),
    (BONES + "x = 1\n", "[[bone]] 'arm': unknown key 'x'"),
    (BONES + '[[bone]]\nmesh = "t.ply"\nx = 1\n', "[[bone]] 3: unknown key 'x'"),
    (BONES + "[[bone]]\n", "[[bone]] 3 name: field required"),
    ('[defaults]\nattach = [ { bone = "arm", x = 1 } ]\n', "[defaults] attach 1: unknown key"),
    (MUSCLE + f'attach = [ {{ bone = "arm" }}, {SPHERE} ]\n', "[[muscle]] 'strap' attach 2 sphere: unknown"),
    (MUSCLE + 'attach = [ { bone = "arm", vertices = 3.5 } ]\n', "[[muscle]] 'strap' attach 1 vertices: "),
    ('[motion]\nramp = { "a.b" = { to = 1, step = 1, x = 1 } }\n', "[motion] ramp a.b: unknown key"),
    ('[motion]\nramp = { "a.b" = 3 }\n', "[motion] ramp a.b: input should be a table, got 3"),
    ("[detect]\ntunnelling = { x = 1 }\n", "[detect] tunnelling: unknown key"),
    ("[output]\nsurfaces = 3\n", "[output] surfaces: input should be a table, got 3"),
]


@pytest.mark.parametrize(("text", "message"), WRONG, ids=[message[:30] for _, message in WRONG])
def test_wrong_key_or_value_is_named_with_its_place(tmp_path, text, message):
    path = tmp_path / "s.toml"
    path.write_text(HEAD + text)
    with pytest.raises(SceneError) as caught:
        read_scene_file(path)
    assert str(caught.value).startswith(f"{path}: {message}")
