"""Damaged scene files: values that no key can mean, missing and foreign keys, broken text, endless
motions.
"""

import json
from typing import Any

import numpy as np

from fuzz.meshes import FORMS, base_scene, pick, suffix_of


class Raw(str):
    """Text that stands in TOML as it is."""


def nested(depth):
    return Raw("[" * depth + "]" * depth)


# Values put in the place of any other.
HOSTILE = (
    0,
    -1,
    1,
    2,
    1.5,
    -0.0,
    1e-308,
    1e308,
    -1e308,
    1e12,
    1e-12,
    10**6,
    2**31,
    2**63,
    10**20,
    Raw("9" * 5000),
    float("inf"),
    float("-inf"),
    float("nan"),
    True,
    False,
    "",
    "x",
    "x" * 5000,
    "rbf",
    "pbd",
    "xpbd",
    "arap-pbd",
    "../..",
    "/dev/zero",
    "/dev/null",
    "/proc/self/mem",
    "a/b",
    "a\nb",
    "\u2028",
    "muscle",
    "upper",
    "hip.flexion",
    [],
    {},
    [[]],
    [0, 0, 0],
    [1e308] * 3,
    [float("nan")] * 3,
    ["a"],
    [{}],
    [1, [2]],
    {"name": "rbf"},
    {"name": 1},
    {"name": "pbd", "iterations": 2},
    Raw("1979-05-27T07:32:00Z"),
    Raw("0x10"),
    Raw("1_000"),
    Raw("1e400"),
    nested(30),
    nested(1000),
    nested(100000),
    Raw("'''a'''"),
    Raw("{ a = 1, a = 2 }"),
    Raw("?"),
)
KEYS = (
    "x",
    "name",
    "mesh",
    "model",
    "axes",
    "from",
    "step",
    "scale",
    "attach",
    "near",
    "type",
    "",
    "a.b",
    "😀",
    "\x07",
)


def scene_text(rng: np.random.Generator, *, deep: bool = False) -> str:
    """A damaged scene file; ``deep`` asks for changes that many scenes survive, so that what
    follows is met too.
    """
    scene = base_scene()
    changes = [_motion, _joint, _attach, _model, _tables]
    if not deep:
        changes += [_change_value, _change_value, _remove, _add_key, _meshes]
    for _ in range(rng.integers(1, 3 if deep else 4)):
        pick(rng, changes)(scene, rng)
    text = to_toml(scene)
    return _change_text(text, rng) if not deep and rng.random() < 0.15 else text


def _places(part, path=()):
    """Every container and key in the tables."""
    items = part.items() if isinstance(part, dict) else enumerate(part)
    for key, value in list(items):
        yield part, key
        if isinstance(value, (dict, list)):
            yield from _places(value, (*path, key))


def _change_value(scene, rng):
    part, key = pick(rng, list(_places(scene)))
    part[key] = pick(rng, HOSTILE)


def _remove(scene, rng):
    part, key = pick(rng, list(_places(scene)))
    del part[key]


def _add_key(scene, rng):
    tables = [scene] + [part[key] for part, key in _places(scene) if isinstance(part[key], dict)]
    pick(rng, tables)[pick(rng, KEYS)] = pick(rng, HOSTILE)


def _number(rng):
    """From small to absurd, as likely in each decade."""
    return float(rng.choice([-1, 1, 1, 1]) * 10.0 ** rng.uniform(-12, 14))


def _motion(scene, rng):
    name = pick(rng, ["hip.flexion", "flexion", "hip.turn", "turn", "knee.flexion"])
    step = abs(_number(rng)) if rng.random() < 0.7 else 3.0
    count = int(rng.choice([1, 2, 5, 2000]))
    motions = (
        {"ramp": {name: {"from": _number(rng), "to": _number(rng), "step": step}}},
        {"ramp": {name: {"to": 10.0 ** rng.uniform(0, 9), "step": 10.0 ** rng.uniform(0, 8)}}},
        {"waypoints": [{name: float(rng.normal(0, 60))} for _ in range(count)], "step": step},
        {"waypoints": [{name: _number(rng)}, {"turn": _number(rng)}], "step": step},
        {"file": pick(rng, ["flex.mot", "none.mot", "upper.ply", ".", "/dev/zero", "upper.txt"])},
        pick(rng, HOSTILE),
    )
    scene["motion"] = pick(rng, motions)


def _rows(scene, kind):
    rows = scene.get(kind)
    return [row for row in rows if isinstance(row, dict)] if isinstance(rows, list) else []


def _update(scene, rng, kind, changes):
    """Change one of the rows of a kind, where there are any."""
    rows = _rows(scene, kind)
    if rows:
        pick(rng, rows).update(pick(rng, changes))


def _joint(scene, rng):
    axis = [_number(rng) for _ in range(3)]
    changes = (
        {"centre": axis},
        {"axes": {"flexion": axis}},
        {
            "child": pick(rng, ["upper", "lower", "muscle", ""]),
            "parent": pick(rng, ["upper", "lower"]),
        },
        {"type": pick(rng, ["hinge", "slide", "free", "weld", "custom", "ball", "bal", 3])},
    )
    _update(scene, rng, "joint", changes)
    if rng.random() < 0.2:
        scene["joint"] = _rows(scene, "joint") * 2


def _attach(scene, rng):
    number = pick(rng, [0, 5, -1, 161, 162, 10**9, 10**19, 2**62])
    places = (
        {"vertices": [number, 1, 2]},
        {
            "vertices": pick(
                rng, ["upper.txt", "none.txt", "upper.ply", ".", "fibres.json", "/dev/zero"]
            )
        },
        {"near": _number(rng)},
        {"points": [[34.0, 0.0, _number(rng)]], "radius": abs(_number(rng))},
        {"vertices": []},
        {},
    )
    entry = {"bone": pick(rng, ["upper", "lower", "lowr", ""]), **pick(rng, places)}
    _update(scene, rng, "muscle", [{"attach": [entry, {"bone": "lower", "vertices": "lower.txt"}]}])


OPTIONS = (
    "centres",
    "samples",
    "iterations",
    "nodes",
    "slack_ratio",
    "fibre_ratio",
    "epsilon",
    "kernel",
    "bending",
    "fibre_exponent",
)
# What an option may be set to: out of its range, or in it and quick. What is allowed and slow is
# not an error.
SETTINGS = (
    -1,
    0,
    1,
    3,
    4,
    5,
    0.5,
    1.5,
    50,
    1e-9,
    1e-3,
    10**7,
    10**18,
    1e300,
    float("nan"),
    "x",
    "",
    "even",
    "adaptive",
    "normal",
    "all",
    "gaussian",
    "linear",
    "wendland_c2",
    "cubik",
    [],
    [0.5, 2.0],
    [2.0, 0.5],
    {},
    True,
)
MODELS = ("rbf", "pbd", "xpbd", "arap-pbd", "arap-volume")


def _model(scene, rng):
    model = {"name": pick(rng, MODELS)}
    if model["name"] == "rbf":
        model |= {"centres": 60, "samples": 200, "resolution": 16, "iterations": 4}
    for _ in range(rng.integers(0, 3)):
        model[pick(rng, OPTIONS)] = pick(rng, SETTINGS)
    other = pick(rng, [*HOSTILE[:10], "pbd", "xpbd"])
    _update(scene, rng, "muscle", [{"model": other if rng.random() < 0.15 else model}])


TABLES = (
    ("contact", "substep_angle", [1e-300, 1e-9, 1e-3, 0.5, 90, 91, 0, -1]),
    ("contact", "initial", ["keep", "error", "resolv"]),
    ("neighbours", "pairs", [[], [["muscle", "muscle"]], [["a", "b"]], [["muscle"]], 1]),
    ("neighbours", "bones", [[], [["muscle", "pelvis"]], [["a", "b"]], [["muscle"]], 1]),
    ("detect", "tunnelling", [{}, {"angle": 1e-300}, {"action": "report"}, 1]),
    ("output", "surfaces", [False, True, {"format": "stl"}, {"format": "glb"}, {"format": "x"}]),
    ("scene", "units", ["m", "cm", "km", 1]),
)


def _tables(scene, rng):
    name, key, values = pick(rng, TABLES)
    if isinstance(scene.get(name, {}), dict):
        scene.setdefault(name, {})[key] = pick(rng, values)


def _meshes(scene, rng):
    form, files = (
        pick(rng, FORMS),
        ["upper.ply", "none.ply", ".", "fibres.json", "upper.txt", "/dev/zero"],
    )
    changes = (
        {"mesh": f"muscle-{form}{suffix_of(form)}"},
        {"mesh": pick(rng, files)},
        {"scale": _number(rng)},
        {"fibres": pick(rng, ["fibres.json", "none.json", "upper.ply", "flex.mot", ".", 3])},
    )
    _update(scene, rng, pick(rng, ["bone", "muscle"]), changes)


def _change_text(text, rng):
    """Break the text itself: cut it, drop or repeat a piece, put other characters in."""
    at, other = sorted(rng.integers(0, len(text), 2).tolist())
    return (
        text[:at],
        text[:at] + text[other:],
        text[:other] + text[at:],
        text[:at] + "".join(chr(c) for c in rng.integers(1, 0x2FF, 5)) + text[at:],
        text[:at]
        + pick(rng, ["[", "]", "{", "}", '"', "=", "\n", "\x00", "#", "[[bone]]\n"])
        + text[at:],
    )[int(rng.integers(5))]


def to_toml(scene: dict[str, Any]) -> str:
    """Tables as TOML: one level of headings, all else inline."""
    first, lines = [], []
    for name, table in scene.items():
        rows = [table] if isinstance(table, dict) else table
        if not (isinstance(rows, list) and rows and all(isinstance(row, dict) for row in rows)):
            first.append(f"{_key(name)} = {_value(table)}")
            continue
        for row in rows:
            lines.append(f"[{_key(name)}]" if rows is not table else f"[[{_key(name)}]]")
            lines += [f"{_key(key)} = {_value(value)}" for key, value in row.items()]
    return "\n".join(first + lines) + "\n"


def _key(name):
    return name if name.isidentifier() and name.isascii() else json.dumps(name)


def _value(value):
    if isinstance(value, Raw):
        return str(value)
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return json.dumps(value)
    if isinstance(value, dict):
        return (
            "{ " + ", ".join(f"{_key(key)} = {_value(item)}" for key, item in value.items()) + " }"
        )
    if isinstance(value, list):
        return "[" + ", ".join(map(_value, value)) + "]"
    return repr(value)
