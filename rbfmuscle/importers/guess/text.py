"""The scene file of a guess: what is sure as it is, what is not marked GUESS, what cannot run commented out."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from rbfmuscle.importers.guess.patella import FLEXIONS
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
    movable = [joint for joint in guess.joints if joint.axes and not joint.follows]
    if movable:
        parts.append(_motion(movable))
    parts += [_muscle(muscle, hold_file) for muscle in guess.muscles]
    return "\n".join([*parts, _TAIL])


def _head(guess):
    lines = [
        f"# Scene guessed from {guess.title}. Lines marked GUESS want a look; the number is how sure it is, of 1.",
        "# All keys: docs/scene_file.md. Then: rbfmuscle check --picture, rbfmuscle run.",
        *(f"# NOT USED: {file}: {reason}" for file, reason in guess.unusable.items()),
        f'[scene]\nformat = 1\nname = "{guess.name}"',
        f'units = "{guess.units}"   # of every length here; a mesh in another unit takes scale = ...',
    ]
    if guess.orientation is not None:
        for word in ("superior", "anterior"):
            direction = _vector(getattr(guess.orientation, word), 5)
            lines.append(f"{word} = {direction}   # by {guess.orientation.source}")
    return "\n".join(
        [*lines, '\n[defaults]\nmodel = "rbf"   # or a table: { name = "rbf", centres = 300 }\n']
    )


def _bone(bone):
    mark = "" if bone.sure else f"   # GUESS: {bone.reason}"
    return f'[[bone]]\nname = "{bone.name}"{mark}\nmesh = "{bone.file}"\n'


def _vector(values, digits):
    return "[" + ", ".join(f"{round(float(value), digits) + 0.0:g}" for value in values) + "]"


def _joint(joint):
    lines = [
        f"[[joint]]   # GUESS {joint.confidence:.1f}: {joint.reason}",
        f'name = "{joint.name}"',
        f'parent = "{joint.parent.name}"',
        f'child = "{joint.child.name}"',
        f'type = "{joint.kind}"',
    ]
    if joint.kind != "fixed":
        lines.append(f"centre = {_vector(joint.centre, 6)}")
    if joint.path is not None:
        return "\n".join([*lines, *_path(joint), ""])
    if joint.axes:
        if not joint.ranges:
            lines.append("# GUESS: rename and turn the axes where angles should have the other sign")
        axes = ", ".join(f"{name} = {_vector(axis, 5)}" for name, axis in joint.axes.items())
        lines.append(f"axes = {{ {axes} }}   # angles follow the right-hand rule")
    for k, (name, ends) in enumerate(joint.ranges.items()):
        rest = f"rest = {joint.rest:g}, " if k == 0 and joint.rest else ""
        lines.append(f"coordinates.{name} = {{ {rest}range = {_vector(ends, 1)} }}")
    return "\n".join([*lines, ""])


def _path(joint):
    """The patella's custom joint by tables against the knee's flexion, which it follows."""
    path = joint.path
    x = _vector(joint.rest + np.array(FLEXIONS), 3)

    def axis(direction, values):
        spline = f"natural_spline = {{ x = {x}, y = {_vector(values, 4)} }}"
        return f'  {{ axis = {_vector(direction, 6)}, coordinates = ["flexion"], {spline} }},'

    knee = next(coordinate for coordinate in joint.follows)
    return [
        "rotations = [",
        axis(path.axis, path.turns),
        "]",
        "translations = [",
        axis(path.front, path.shifts[:, 0]),
        axis(path.down, path.shifts[:, 1]),
        "]",
        f'coordinates.flexion = {{ motion = "rotation", rest = {joint.rest:g} }}\n',
        f'[[coupling]]\ncoordinate = "{joint.coordinate}"\nof = ["{knee}"]\nlinear = [1, 0]',
    ]


def _stub(tendon):
    return (
        f"[[bone]]   # GUESS: holds an end that stops short of its bone; a stub put aside, where nothing meets it\n"
        f'name = "{tendon.name}"\nmesh = "{stub_file(tendon)}"\n'
    )


def _slider(tendon):
    """The joint of a tendon's stub, and what drives it."""
    hinge = tendon.joint.coordinate
    angles = _vector(tendon.joint.rest + np.array(ANGLES), 3)
    points = f"{{ x = {angles}, y = [{', '.join(f'{slide:.6g}' for slide in tendon.slides)}] }}"
    return (
        f"[[joint]]   # GUESS: slides along the missing tendon as {hinge} changes its length, straight to its bone\n"
        f'name = "{tendon.name}"\nparent = "{tendon.guide.name}"\nchild = "{tendon.name}"\ntype = "slider"\n'
        f"centre = {_vector(tendon.place, 6)}\naxes = {{ slide = {_vector(tendon.direction, 6)} }}\n\n"
        f'[[coupling]]\ncoordinate = "{tendon.name}.slide"\nof = ["{hinge}"]\nnatural_spline = {points}\n'
    )


def _motion(movable):
    """A ramp of the first coordinate, within its range."""
    joint = movable[0]
    _, high = joint.ranges.get(next(iter(joint.axes)), (0.0, joint.rest + 30.0))
    end = min(joint.rest + 30.0, high) if high > joint.rest else joint.rest
    ramp = f'{{ "{joint.coordinate}" = {{ from = {joint.rest:g}, to = {end:g}, step = 2 }} }}'
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
