"""Colours of muscles and directions of view, shared by pictures, plots, pages and exported files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from rbfmuscle.geometry.arrays import Floats

BONE_COLOUR = "#e9e0cd"
BACKGROUND = "#ffffff"
# Told apart by people who are colour-blind (P. Tol, "muted"); its sand is left out, as bones have that colour.
MUSCLE_COLOURS = ("#cc6677", "#332288", "#44aa99", "#882255", "#88ccee", "#117733", "#aa4499", "#999933")
# How much nearer to white or black the muscles of one group are, one after the other.
_SHADES = (0.0, 0.3, -0.25)
# From the subject to the camera; z is up, as in the medical axes (left, posterior, superior).
VIEWS = {
    "front": ((0.0, -1.0, 0.12), "from -y"),
    "side": ((-1.0, -0.12, 0.12), "from -x"),
    "back": ((0.0, 1.0, 0.12), "from +y"),
    "far": ((1.0, -0.12, 0.12), "from +x"),
}
# What is drawn where nothing else is asked for.
USUAL_VIEWS = ("front", "side", "back")


def muscle_groups(info: Mapping[str, Any]) -> dict[str, str]:
    """Group of each muscle by the joints that it crosses.

    Parameters
    ----------
    info : dict
        What ``run.json`` holds. Joints that carry a single bone without another joint (a patella, a tendon's end) are
        left out; a muscle that crosses no other belongs to the bone that it lies along.
    """
    joints = info["scene"].get("joints", [])
    above = {joint["child"]: joint for joint in joints}
    carrying = {joint["parent"] for joint in joints}

    def chain(bone: str) -> list[str]:
        found = []
        while bone in above and bone not in found:
            found.append(bone)
            bone = above[bone]["parent"]
        return [*found, bone]

    groups = {}
    for muscle in info["scene"]["muscles"]:
        chains = [chain(part["bone"]) for part in muscle.get("attach", [])]
        crossed = {bone for one in chains for bone in one if any(bone not in other for other in chains)}
        names = [joint["name"] for joint in joints if joint["child"] in crossed & carrying]
        if len(joints) == 1 and crossed:
            names = [joints[0]["name"]]
        shared = [bone for bone in (chains[0] if chains else []) if all(bone in one for one in chains)]
        groups[muscle["name"]] = f"across {', '.join(names)}" if names else f"along {(shared or ['?'])[0]}"
    return groups


def muscle_colours(names: Sequence[str], groups: Mapping[str, str] | None = None) -> dict[str, str]:
    """Dict of muscle name to its colour in pictures and plots; of many muscles a hue for each group.

    Parameters
    ----------
    names : sequence of str
    groups : dict of str to str, optional
        From `muscle_groups`.
    """
    if groups is None or len(names) <= len(MUSCLE_COLOURS):
        return {name: MUSCLE_COLOURS[k % len(MUSCLE_COLOURS)] for k, name in enumerate(names)}
    kinds = list(dict.fromkeys(groups[name] for name in names))
    found, seen = {}, dict.fromkeys(kinds, 0)
    for name in names:
        kind = groups[name]
        hue = MUSCLE_COLOURS[kinds.index(kind) % len(MUSCLE_COLOURS)]
        found[name] = mixed_colour(hue, _SHADES[seen[kind] % len(_SHADES)])
        seen[kind] += 1
    return found


def mixed_colour(colour: str, share: float) -> str:
    """A colour brought nearer to white (share above 0) or to black (below)."""
    values = [int(colour[k : k + 2], 16) for k in (1, 3, 5)]
    end = 255 if share > 0 else 0
    return "#" + "".join(f"{round(value + abs(share) * (end - value)):02x}" for value in values)


def rgb(colour: str) -> Floats:
    """Red, green and blue (3,) of a colour like "#cc6677", 0 to 1."""
    return np.array([int(colour[k : k + 2], 16) for k in (1, 3, 5)]) / 255.0


def motion_direction(poses: Sequence[Mapping[str, Floats]]) -> Floats:
    """Direction (3,) from which the motion is seen in its plane: along the axis about which a bone turns most.

    Parameters
    ----------
    poses : sequence of dict of str to (4, 4) ndarray
        Of each frame, by bone. From the side where no bone turns, or about an axis that is nearly upright.
    """
    usual = np.array(VIEWS["side"][0])
    widest, axis = np.radians(2.0), usual
    for bone, start in poses[0].items():
        for pose in poses[1:]:
            turn = pose[bone][:3, :3] @ start[:3, :3].T
            skew = np.array([turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]])
            angle = float(np.arccos(np.clip((np.trace(turn) - 1.0) / 2.0, -1.0, 1.0)))
            if angle > widest and np.linalg.norm(skew) > 1e-9:
                widest, axis = angle, skew / np.linalg.norm(skew)
    if abs(axis[2]) > 0.8:
        return usual
    return axis if axis @ usual > 0 or (axis @ usual == 0 and axis[1] < 0) else -axis
