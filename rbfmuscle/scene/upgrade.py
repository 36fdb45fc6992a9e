"""Scene files of format 1: their tables in the form of today, and their text rewritten."""

import re
import tomllib
from collections.abc import Callable
from pathlib import Path

from rbfmuscle.folders import write_whole
from rbfmuscle.scene.joints.joint import BY_TURNS
from rbfmuscle.validation import SceneError, shown

FORMAT = 2  # of scene files today
MAIN = "main"  # the class of all muscles, once [defaults]
TYPES = {"fixed": "weld", "slider": "slide"}
RENAMED = {"left_out": "missing_bones"}
MUSCLE_KEYS = {"tendon": "tendon_region"}
MODEL_KEYS = {"slack": "slack_ratio"}
DROPPED = "placement"  # of a model's settings

Tables = dict[str, object]  # of a TOML file, unchecked


def upgraded(data: Tables) -> Tables:
    """The tables of a file of format 1 as one of today has them; what is wrong in them stays."""
    found = {key: value for key, value in data.items() if key != "defaults"}
    if isinstance(about := data.get("scene"), dict):
        renamed = {RENAMED.get(key, key): value for key, value in about.items()}
        found["scene"] = renamed | {"format": FORMAT}
    for key, changed in (("joint", _joint), ("muscle", _muscle)):
        if isinstance(rows := data.get(key), list):
            found[key] = [changed(row) for row in rows]
    if "defaults" in data:
        found["classes"] = {MAIN: _muscle(data["defaults"])}
    return found


def _joint(row: object) -> object:
    """A joint whose type, once ``"ball"`` for one to six turns, is that of its number of axes."""
    if not isinstance(row, dict):
        return row
    kind = row.get("type", "ball")
    if kind in TYPES:
        return row | {"type": TYPES[kind]}
    axes = row.get("axes") or row.get("coordinates")
    count = len(axes) if isinstance(axes, dict) else 0
    if kind != "ball" or count == 0 or ("type" not in row and count < len(BY_TURNS)):
        return row
    if count < len(BY_TURNS):
        return row | {"type": BY_TURNS[count]}
    if not isinstance(row.get("axes"), dict):
        return row
    turns = [{"axis": axis, "coordinates": [name]} for name, axis in row["axes"].items()]
    kept = {key: value for key, value in row.items() if key != "axes"}
    return kept | {"type": "custom", "rotations": turns}


def _muscle(row: object) -> object:
    """A muscle, or defaults, whose balls are points with a radius."""
    if not isinstance(row, dict):
        return row
    new = {MUSCLE_KEYS.get(key, key): value for key, value in row.items()}
    if isinstance(model := row.get("model"), dict):
        new["model"] = {
            MODEL_KEYS.get(key, key): value for key, value in model.items() if key != DROPPED
        }
    if isinstance(row.get("attach"), list):
        new["attach"] = [_attachment(entry) for entry in row["attach"]]
    return new


def _attachment(entry: object) -> object:
    if not isinstance(entry, dict):
        return entry
    ball = entry.get("sphere")
    if not isinstance(ball, dict) or set(ball) != {"centre", "radius"}:
        return entry
    kept = {key: value for key, value in entry.items() if key != "sphere"}
    return kept | {"points": [ball["centre"]], "radius": ball["radius"]}


_BALL = re.compile(
    r"sphere\s*=\s*\{\s*centre\s*=\s*(\[[^][]*\])\s*,\s*radius\s*=\s*([-+.\w]+)\s*,?\s*\}"
)
_GIVEN = rf"""{DROPPED}[ \t]*=[ \t]*["']\w*["']"""
_EDITS: tuple[tuple[re.Pattern[str], str | Callable[[re.Match[str]], str]], ...] = (
    (re.compile(r"^(\s*format\s*=\s*)1\b", re.M), rf"\g<1>{FORMAT}"),
    (re.compile(r"^(\s*)\[defaults([].])", re.M), rf"\g<1>[classes.{MAIN}\g<2>"),
    (
        re.compile(r"^(\s*)(" + "|".join(RENAMED) + r")(\s*=)", re.M),
        lambda found: found[1] + RENAMED[found[2]] + found[3],
    ),
    (re.compile(r"^(\s*)tendon(\s*=)", re.M), r"\g<1>tendon_region\g<2>"),
    (re.compile(r"^(\s*\[muscle\.)tendon(\])", re.M), r"\g<1>tendon_region\g<2>"),
    (re.compile(r"\bslack(\s*=)"), r"slack_ratio\g<1>"),
    (re.compile(rf"^[ \t]*{_GIVEN}[ \t]*(?:#[^\n]*)?\r?\n", re.M), ""),
    (re.compile(rf"[ \t]*,[ \t]*{_GIVEN}|(?<=[{{ \t]){_GIVEN}[ \t]*,[ \t]*"), ""),
    (_BALL, r"points = [\1], radius = \2"),
)
_JOINT = re.compile(r"^\s*\[\[joint\]\]", re.M)
_TYPE = re.compile(r"""^(\s*type\s*=\s*)(["'])(\w+)\2""", re.M)


def upgraded_text(text: str) -> str:
    """The text of a file of format 1 in the form of today, comments and order kept.

    SceneError where the text is written in a way that these edits do not reach: what comes out is
    read, and has to be what the file means.
    """
    data = tomllib.loads(text)
    wanted = upgraded(data)
    new = text
    for pattern, replacement in _EDITS:
        new = pattern.sub(replacement, new)
    joints = wanted.get("joint")
    rows = joints if isinstance(joints, list) else []
    starts = [match.start() for match in _JOINT.finditer(new)]
    if len(starts) == len(rows):
        parts = [new[: starts[0]]] if starts else [new]
        for start, end, row in zip(starts, [*starts[1:], len(new)], rows):
            kind = row.get("type", "")
            parts.append(_TYPE.sub(rf"\g<1>\g<2>{kind}\g<2>", new[start:end], count=1))
        new = "".join(parts)
    try:
        same = tomllib.loads(new) == wanted
    except ValueError:
        same = False
    if not same:
        raise SceneError("cannot be rewritten line by line; write it anew by docs/scene_file.md")
    return new


def is_old(data: Tables) -> bool:
    """Whether the tables are those of a file of format 1."""
    about = data.get("scene")
    return isinstance(about, dict) and about.get("format") == 1 and about["format"] is not True


def upgrade_file(path: Path) -> bool:
    """Rewrite a file of format 1 in the form of today; whether there was anything to rewrite.

    The new text takes the file's place when it is complete; SceneError where it cannot be written,
    and nothing changes.
    """
    try:
        text = path.read_bytes().decode("utf-8")
        if not is_old(tomllib.loads(text)):
            return False
        new = upgraded_text(text)
    except OSError as error:
        raise SceneError(f"{path}: cannot read it: {error.strerror}") from None
    except (ValueError, RecursionError) as error:  # no TOML, no UTF-8, or not to be rewritten
        raise SceneError(f"{path}: {shown(str(error))}") from None
    try:
        write_whole(path, new)
    except OSError as error:
        raise SceneError(f"{path}: cannot write it: {error.strerror}") from None
    return True
