"""The shortest path over the bones between a muscle's ends: a taut string that starts along the centreline.

The string has `NODES` nodes. Its first and last stay, and the others take the places where the sum of its segments'
squared lengths is least while each is on the outer side of the plane that touches the nearest bone there. Planes are
taken again until the nodes are where they were one or two rounds before.
"""

import numpy as np

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.jit import compiled
from rbfmuscle.metrics.centreline import distance_along, resampled
from rbfmuscle.metrics.penetration import BoneProbe, bones_about, inverse_pose

NODES = 33
ROUNDS = 40  # in which planes are taken, at most
STILL = 1e-4  # of the string's length: what counts as the same place
SWEEPS, OVER_RELAXATION = 100, 1.8  # of a round
RENEWED = 0.1  # of its distance to the nearest bone: a node that has moved farther gets another plane
# Nearer to a bone than this its distance is no way to tell the normal, in lengths of the string.
TOUCHING = 1e-9


def shortest_path(
    line: Floats, probes: list[BoneProbe], poses: dict[str, Floats], *, offset: Floats | None = None
) -> Floats:
    """Nodes (`NODES`, 3) of the shortest path over the bones between the ends of a line, beside which it begins.

    ``line`` (n, 3) says which side of the bones the path takes; the bones have poses (4, 4) by name. ``offset``
    (`NODES`, 3) leads from the points at even distances along the line to where the string begins: what it did in the
    frame before. Two nodes only where nothing lies between the ends.
    """
    chord = np.linspace(line[0], line[-1], NODES)
    near = bones_about(line, probes, poses)
    inner = chord[1:-1]
    if not any(probe.inside(inner, pose=inverse_pose(poses[probe.name])).any() for probe in near):
        return chord[[0, -1]]
    string = resampled(line, NODES - 1) + (0.0 if offset is None else offset)
    size, earlier = float(distance_along(line)[-1]), [string]
    gap, normal = _planes(string, near, poses, TOUCHING * size)
    taken, offsets = string.copy(), np.einsum("ij,ij->i", normal, string) - gap
    for _ in range(ROUNDS):
        string = string.copy()
        _tighten_loop(string, normal, offsets, SWEEPS, OVER_RELAXATION)
        # A node between two planes can go to and fro.
        if min(np.abs(string - other).max() for other in earlier) < STILL * size:
            break
        earlier = [earlier[-1], string]
        renewed = np.abs(string - taken).max(axis=1) > RENEWED * np.abs(gap)
        gap[renewed], normal[renewed] = _planes(string[renewed], near, poses, TOUCHING * size)
        taken[renewed] = string[renewed]
        offsets[renewed] = np.einsum("ij,ij->i", normal, string)[renewed] - gap[renewed]
    return string


def _planes(
    points: Floats, probes: list[BoneProbe], poses: dict[str, Floats], least: float
) -> tuple[Floats, Floats]:
    """Signed distance (n,) to the nearest bone and the unit normal (n, 3) of the plane that touches it there."""
    gap, normal = np.full(len(points), np.inf), np.zeros((len(points), 3))
    for probe in probes:
        pose = poses[probe.name]
        local = (points - pose[:3, 3]) @ pose[:3, :3]
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
