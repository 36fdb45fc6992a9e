"""The scene file of a guess: what is sure as it is, what is not marked GUESS, what cannot run commented out."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rbfmuscle.importers.guess.tendons import ANGLES, stub_file, tendons_of

_TAIL = """[contact]
initial = "resolve"   # muscles that start inside a bone are pushed out; or "keep", "error"

[detect]
tunnelling = { angle = 135, action = "substep" }   # points that pass through a bone in one step

[output]
surfaces = { format = "pvd" }   # or vtp, ply, stl, obj, glb
"""


def scene_text(guess: Any, hold_file: Callable[..., Any]) -> str:
    """Text of the scene file.

    Parameters
    ----------
    guess : SceneGuess
    hold_file : callable
        Name of the file of a muscle's hold.
    """
    tendons = tendons_of(guess)
    parts = [_head(guess), *(_bone(bone) for bone in guess.bones), *(_stub(tendon) for tendon in tendons)]
    parts += [_joint(joint) for joint in guess.joints] + [_slider(tendon) for tendon in tendons]
    movable = [joint for joint in guess.joints if joint.kind != "fixed"]
    if movable:
        parts.append(_motion(movable))
    parts += [_muscle(muscle, hold_file) for muscle in guess.muscles]
    return "\n".join([*parts, _TAIL])


def joint_name(joint: Any) -> str:
    """Name of a guessed joint in the scene."""
    return f"{joint.child.name}_joint"


def _head(guess):
    return (
        f"# Scene guessed from {guess.title}. Lines marked GUESS want a look; the number is how sure it is, of 1.\n"
        f"# All keys: docs/scene_file.md. Then: rbfmuscle check --picture, rbfmuscle run.\n"
        f'[scene]\nformat = 1\nname = "{guess.name}"\n'
        f'units = "{guess.units}"   # of every length here; a mesh in another unit takes scale = ...\n\n'
        f'[defaults]\nmodel = "rbf"   # or a table: {{ name = "rbf", centres = 300 }}\n'
    )


def _bone(bone):
    mark = "" if bone.sure else f"   # GUESS: {bone.reason}"
    return f'[[bone]]\nname = "{bone.name}"{mark}\nmesh = "{bone.file}"\n'


def _vector(values, digits):
    return "[" + ", ".join(f"{round(float(value), digits) + 0.0:g}" for value in values) + "]"


def _joint(joint):
    lines = [
        f"[[joint]]   # GUESS {joint.confidence:.1f}: {joint.reason}",
        f'name = "{joint_name(joint)}"',
        f'parent = "{joint.parent.name}"',
        f'child = "{joint.child.name}"',
        f'type = "{joint.kind}"',
    ]
    if joint.kind != "fixed":
        lines.append(f"centre = [{', '.join(repr(round(float(x), 6)) for x in joint.centre)}]")
    if joint.kind == "ball":
        lines.append(
            "# GUESS: the axes of the mesh files; rename and turn them, angles follow the right-hand rule"
        )
        lines.append("axes = { rotation_x = [1, 0, 0], rotation_y = [0, 1, 0], rotation_z = [0, 0, 1] }")
    elif joint.kind == "hinge":
        lines.append("# GUESS: turn the axis around where angles should have the other sign")
        lines.append(f"axes = {{ angle = {_vector(joint.axis, 5)} }}")
    return "\n".join([*lines, ""])


def _stub(tendon):
    return (
        f"[[bone]]   # GUESS: holds an end that stops short of its bone; a stub put aside, where nothing meets it\n"
        f'name = "{tendon.name}"\nmesh = "{stub_file(tendon)}"\n'
    )


def _slider(tendon):
    """The joint of a tendon's stub, and what drives it."""
    hinge = joint_name(tendon.joint)
    points = f"{{ x = {list(ANGLES)}, y = [{', '.join(f'{slide:.6g}' for slide in tendon.slides)}] }}"
    return (
        f"[[joint]]   # GUESS: slides along the missing tendon as {hinge} changes its length, straight to its bone\n"
        f'name = "{tendon.name}"\nparent = "{tendon.guide.name}"\nchild = "{tendon.name}"\ntype = "slider"\n'
        f"centre = {_vector(tendon.place, 6)}\naxes = {{ slide = {_vector(tendon.direction, 6)} }}\n\n"
        f'[[coupling]]\ncoordinate = "{tendon.name}.slide"\nof = ["{hinge}.angle"]\nnatural_spline = {points}\n'
    )


def _motion(movable):
    joint = movable[0]
    coordinate = "rotation_x" if joint.kind == "ball" else "angle"
    ramp = f'{{ "{joint_name(joint)}.{coordinate}" = {{ from = 0, to = 30, step = 2 }} }}'
    return f"[motion]   # degrees\nramp = {ramp}   # GUESS\n"


def _muscle(guess, hold_file):
    part = guess.muscle
    mark = "" if part.sure else f"   # GUESS: {part.reason}"
    lines = ["[[muscle]]", f'name = "{part.name}"{mark}', f'mesh = "{part.file}"', "attach = ["]
    for hold in guess.holds:
        entry = f'{{ bone = "{hold.attached_bone}", vertices = "attachments/{hold_file(guess, hold)}" }}'
        lines.append(
            f"  {entry},   # GUESS {guess.confidence:.1f}: {len(hold.vertices)} vertices, {hold.reason}"
        )
    lines.append("]")
    lines[1:1] = [f"# {reason}" for reason in guess.reasons]
    if guess.wrong:
        lines = [f"# {line}" for line in [f"NOT RUN: {guess.wrong}", *lines]]
    return "\n".join([*lines, ""])
