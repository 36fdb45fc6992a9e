"""Distances of a surface's vertices from the bones, with what was found of each before."""

from typing import NamedTuple

import numpy as np

from rbfmuscle.bones.obstacles import query_bone
from rbfmuscle.jit import compiled


class Asked(NamedTuple):
    """Vertices about which the bones are asked."""

    x: np.ndarray  # (n, 3)
    rows: np.ndarray  # (k,) which of them
    limit: np.ndarray  # (k,) beyond which a lower bound will do [scene unit]
    same: float  # how far one may have moved since it was found [scene unit]


class Found(NamedTuple):
    """What the bones answered."""

    distance: np.ndarray  # (k,) to the nearest bone
    outward: np.ndarray  # (k, 3) in which it grows


class Question(NamedTuple):
    """Room for asking one bone about some of k points."""

    row: np.ndarray  # (k,) number of the point
    here: np.ndarray  # (k, 3) in bone coordinates
    points: np.ndarray  # (k, 3)
    reach: np.ndarray  # (k,)
    distance: np.ndarray  # (k,)
    outward: np.ndarray  # (k, 3)


@compiled
def ask_bones(obstacles, state, x, rows, limit, same, distance, outward):
    """Distances (k,) of vertices x[rows] to the nearest bone and the directions (k, 3) in which
    they grow; beyond a limit (k,) a lower bound without a direction.

    A bone is asked only where what is known of it does not say that it is farther. What a vertex
    found no farther than ``same`` away [scene unit] counts for it too, the distance less by that
    way.
    """
    count = len(rows)
    ask = Question(
        np.empty(count, np.int64),
        np.empty((count, 3)),
        np.empty((count, 3)),
        np.empty(count),
        np.empty(count),
        np.empty((count, 3)),
    )
    distance[:count] = np.inf
    outward[:count] = 0.0
    asked, found = Asked(x, rows, limit, same), Found(distance, outward)
    for b in range(len(obstacles.poses)):
        m = _recall(obstacles.poses[b], state, b, asked, ask, found)
        if m > 0:
            _ask_bone(obstacles, state, b, rows, ask, m, found)


@compiled
def _recall(pose, state, b, asked, ask, found):
    """What is known of bone b; puts the points that have to be asked into ``ask`` and counts
    them.
    """
    places = state.places[b]
    bounds = state.bounds[b]
    ways = state.outward[b]
    x = asked.x
    rows = asked.rows
    same = asked.same
    distance = found.distance
    outward = found.outward
    m = 0
    for i in range(len(rows)):
        v = rows[i]
        dx = x[v, 0] - pose[0, 3]
        dy = x[v, 1] - pose[1, 3]
        dz = x[v, 2] - pose[2, 3]
        px = dx * pose[0, 0] + dy * pose[1, 0] + dz * pose[2, 0]
        py = dx * pose[0, 1] + dy * pose[1, 1] + dz * pose[2, 1]
        pz = dx * pose[0, 2] + dy * pose[1, 2] + dz * pose[2, 2]
        square = (px - places[v, 0]) ** 2 + (py - places[v, 1]) ** 2 + (pz - places[v, 2]) ** 2
        least, most = bounds[v] - np.sqrt(square), min(distance[i], asked.limit[i])
        if least > most:
            distance[i] = min(distance[i], least)
        elif square <= same * same and (
            ways[v, 0] != 0.0 or ways[v, 1] != 0.0 or ways[v, 2] != 0.0
        ):
            distance[i] = least
            for a in range(3):
                outward[i, a] = (
                    pose[a, 0] * ways[v, 0] + pose[a, 1] * ways[v, 1] + pose[a, 2] * ways[v, 2]
                )
        else:
            ask.row[m], ask.reach[m] = i, most
            ask.here[m, 0] = px
            ask.here[m, 1] = py
            ask.here[m, 2] = pz
            for a in range(3):
                ask.points[m, a] = x[v, a]
            m += 1
    return m


@compiled
def _ask_bone(obstacles, state, b, rows, ask, m, found):
    """Ask bone b about the first m points, and keep what it says."""
    pose = obstacles.poses[b]
    one = ask.distance
    way = ask.outward
    query_bone(obstacles.bones, b, pose, ask.points[:m], ask.reach[:m], one[:m], way[:m])
    for j in range(m):
        i = ask.row[j]
        v, reached = rows[i], one[j] <= ask.reach[j]
        state.bounds[b, v] = one[j]
        for a in range(3):
            state.places[b, v, a] = ask.here[j, a]
            state.outward[b, v, a] = 0.0
            if reached:
                for k in range(3):
                    state.outward[b, v, a] += pose[k, a] * way[j, k]
        if one[j] < found.distance[i]:
            found.distance[i] = one[j]
            for a in range(3):
                found.outward[i, a] = way[j, a] if reached else 0.0
