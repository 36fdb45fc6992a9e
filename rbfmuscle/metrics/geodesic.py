"""The shortest path over the bones between a muscle's ends: a taut string that starts along the centreline.

The string has `NODES` nodes. Its first and last stay, and the others take the places where the sum of its segments'
squared lengths is least while each is on the outer side of the plane that touches the nearest bone there. Planes are
taken again until the nodes stay where they are.
"""

from __future__ import annotations

import numpy as np

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.jit import compiled
from rbfmuscle.metrics.penetration import BoneProbe, bone_coordinates, bones_about

NODES = 33
ROUNDS = 40  # in which planes are taken, at most
STILL = 1e-4  # of the string's length: a round that moves no node farther is the last
SWEEPS, OVER_RELAXATION = 100, 1.8  # of a round
# Nearer to a bone than this its distance is no way to tell the normal, in lengths of the string.
TOUCHING = 1e-9


def path_length(points: Floats) -> float:
    """Length of the line through points (n, 3)."""
    return float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum())


def shortest_path(line: Floats, probes: list[BoneProbe], poses: dict[str, Floats]) -> Floats:
    """Nodes of the shortest path over the bones between the ends of a line, beside which it begins.

    Parameters
    ----------
    line : (n, 3) ndarray
        Which side of the bones the path takes.
    probes : list of BoneProbe
    poses : dict of str to (4, 4) ndarray
        Of the bones.

    Returns
    -------
    (`NODES`, 3) ndarray
        Two nodes only where nothing lies between the ends.
    """
    chord = np.linspace(line[0], line[-1], NODES)
    near = bones_about(line, probes, poses)
    if not near or _planes(chord, near, poses)[0][1:-1].min() >= 0.0:
        return chord[[0, -1]]
    string = _evenly(line)
    size = path_length(line)
    for _ in range(ROUNDS):
        gap, normal = _planes(string, near, poses)
        before = string.copy()
        _tighten_loop(string, normal, np.einsum("ij,ij->i", normal, before) - gap, SWEEPS, OVER_RELAXATION)
        if np.abs(string - before).max() < STILL * size:
            break
    return string


def _evenly(line: Floats) -> Floats:
    """`NODES` points at even distances along a line (n, 3)."""
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(line, axis=0), axis=1))])
    places = np.linspace(0.0, along[-1], NODES)
    return np.stack([np.interp(places, along, line[:, axis]) for axis in range(3)], axis=1)


def _planes(points: Floats, probes: list[BoneProbe], poses: dict[str, Floats]) -> tuple[Floats, Floats]:
    """Signed distance (n,) to the nearest bone and the unit normal (n, 3) of the plane that touches it there."""
    gap, normal = np.full(len(points), np.inf), np.zeros((len(points), 3))
    least = TOUCHING * max(path_length(points), 1e-300)
    for probe in probes:
        pose = poses[probe.name]
        local = bone_coordinates(points, pose)
        distance, closest, outward = probe.nearest(local)
        far = np.abs(distance) > least
        outward[far] = (local[far] - closest[far]) / distance[far, None]
        here = distance < gap
        gap[here], normal[here] = distance[here], outward[here] @ pose[:3, :3].T
    return gap, normal


@compiled(error_model="numpy")
def _tighten_loop(string, normal, offset, sweeps, relaxation):
    """Move inner nodes to where the squared segments are least with normal · node >= offset, by projected SOR."""
    for _ in range(sweeps):
        for n in range(1, len(string) - 1):
            along = -offset[n]
            for a in range(3):
                middle = 0.5 * (string[n - 1, a] + string[n + 1, a])
                string[n, a] += relaxation * (middle - string[n, a])
                along += normal[n, a] * string[n, a]
            if along < 0.0:
                for a in range(3):
                    string[n, a] -= along * normal[n, a]
