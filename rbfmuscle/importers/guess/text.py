"""The scene file of a guess: what is sure as it is, what is not marked GUESS, what cannot run commented out."""

from __future__ import annotations

import re
from typing import Any

from rbfmuscle.importers.guess.anatomy import JointGuess, rounded
from rbfmuscle.importers.guess.attachments import AttachmentGuess, MuscleGuess
from rbfmuscle.importers.toml_text import table_text

_TAIL = """[contact]
initial = "resolve"   # muscles that start inside a bone are pushed out; or "keep", "error"

[detect]
tunnelling = { angle = 135, action = "substep" }   # points that pass through a bone in one step
"""


def scene_text(guess: Any) -> str:
    """Text of the scene file of a `SceneGuess`."""
    bones = [
        table_text("[[bone]]", {"name": bone.name, "mesh": bone.file}, _doubt(bone))
        for bone in guess.parts.bones
    ]
    movable = [joint for joint in guess.joints if joint.axes and not joint.follows]
    motion = [_motion(movable[0])] if movable else []
    muscles = map(_muscle, guess.muscles)
    return "\n".join([_head(guess), *bones, *map(_joint, guess.joints), *motion, *muscles, _TAIL])


def _doubt(part):
    return {"name": f"GUESS: {part.doubt}"} if part.doubt else {}


def _head(guess):
    folder, parts = guess.folder, guess.parts
    lines = [
        f"# Scene guessed from the meshes in {folder.name or folder}. "
        "Lines marked GUESS want a look; the number is how sure it is, of 1.",
        "# All keys: docs/scene_file.md. Then: rbfmuscle check --picture, rbfmuscle run.",
        *(f"# NOT USED: {file}: {reason}" for file, reason in parts.unusable.items()),
    ]
    name = re.sub(r"[^A-Za-z0-9_-]+", "_", folder.resolve().name) or "scene"
    row = {"format": 1, "name": name, "units": parts.units}
    comments = {"units": "of every length here; a mesh in another unit takes scale = ..."}
    if parts.left_out:
        row["left_out"] = parts.left_out
        comments["left_out"] = "bones whose meshes cannot be used; every run counts them as beyond its limits"
    for word in ("superior", "anterior") if guess.orientation is not None else ():
        row[word] = rounded(getattr(guess.orientation, word), 5)
        comments[word] = f"by {guess.orientation.source}"
    scene = table_text("[scene]", row, comments)
    models = {"model": 'or a table: { name = "rbf", centres = 300 }'}
    return "\n".join([*lines, scene, table_text("[defaults]", {"model": "rbf"}, models)])


def _joint(joint: JointGuess) -> str:
    comments = {"axes": "angles follow the right-hand rule"}
    if not joint.ranges:
        comments["axes"] += "; GUESS: rename and turn them where angles should have the other sign"
    text = table_text(f"[[joint]]   # GUESS {joint.confidence:.1f}: {joint.reason}", joint.row(), comments)
    if joint.follows:
        row = {"coordinate": joint.coordinate, "of": [joint.follows], "linear": [1, 0]}
        text += "\n" + table_text("[[coupling]]", row)
    return text


def _motion(joint):
    """A ramp of the joint's first coordinate, within its range."""
    _, high = joint.ranges.get(next(iter(joint.axes)), (0.0, joint.rest + 30.0))
    end = min(joint.rest + 30.0, high) if high > joint.rest else joint.rest
    ramp = {joint.coordinate: {"from": joint.rest, "to": end, "step": 2}}
    return table_text("[motion]   # degrees", {"ramp": ramp}, {"ramp": "GUESS"})


def hold_file(muscle: MuscleGuess, hold: AttachmentGuess) -> str:
    """File of a hold's vertices, relative to the scene's folder."""
    return f"attachments/{muscle.muscle.name}_{hold.bone.name}.txt"


def _attachment(hold, file):
    """A row of ``attach``, with its tendon."""
    if hold.tendon is None:
        return {"bone": hold.bone.name, "vertices": file}
    line = {"to": rounded(hold.tendon.to, 6)}
    if hold.tendon.via:
        line["via"] = [{"bone": bone.name, "point": rounded(at, 6)} for bone, at in hold.tendon.via]
    return {"bone": hold.tendon.bone.name, "vertices": file, "tendon": line}


def _muscle(guess: MuscleGuess) -> str:
    part, sure = guess.muscle, f"GUESS {guess.confidence:.1f}"
    attach = [_attachment(hold, hold_file(guess, hold)) for hold in guess.holds]
    said = [f"{sure}: {len(hold.vertices)} vertices, {hold.reason}" for hold in guess.holds]
    row = {"name": part.name, "mesh": part.file, "attach": attach}
    head = "\n".join(["[[muscle]]", *(f"# {reason}" for reason in guess.reasons)])
    text = table_text(head, row, {"attach": said, **_doubt(part)})
    if guess.wrong:
        text = "".join(f"# {line}\n" for line in [f"NOT RUN: {guess.wrong}", *text.splitlines()])
    return text
