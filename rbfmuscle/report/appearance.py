"""Groups of muscles and directions of view, shared by pictures, plots and pages."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from rbfmuscle.geometry.arrays import Floats

BACKGROUND = "#ffffff"
# From the subject to the camera; z is up, as in the medical axes (left, posterior, superior).
VIEWS: dict[str, tuple[tuple[float, float, float], str]] = {
    "front": ((0.0, -1.0, 0.12), "from -y"),
    "side": ((-1.0, -0.12, 0.12), "from -x"),
    "back": ((0.0, 1.0, 0.12), "from +y"),
    "far": ((1.0, -0.12, 0.12), "from +x"),
}
# What is drawn where nothing else is asked for.
USUAL_VIEWS = ("front", "side", "back")


def body_axes(superior: Sequence[float], anterior: Sequence[float]) -> Floats:
    """Left, posterior and superior (3, 3) of a body with these directions."""
    up = np.asarray(superior, dtype=float) / np.linalg.norm(superior)
    left = np.cross(up, anterior)
    left /= np.linalg.norm(left)
    return np.stack([left, np.cross(up, left), up])


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
