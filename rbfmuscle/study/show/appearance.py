"""Colours shared by pictures, plots and exported files."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np

# Muscles nearer to each other than this share of the scene's extent are neighbours.
NEXT_TO = 0.008

BONE_COLOUR = "#ece2cb"
BACKGROUND = "#ffffff"
# Flesh tones of different lightness and hue, so that neighbours stand apart.
MUSCLE_COLOURS = ("#b5443f", "#dd8468", "#7f2638", "#c96a80", "#e9b39a", "#a1562f", "#94404f", "#d2505a")
# Plots need more distance between lines than flesh tones give.
LINE_COLOURS = ("#b5443f", "#2f6f8f", "#d99a2b", "#4f8a5b", "#7a5aa6", "#8c6d5a", "#c86fa0", "#5d6d7e")


def muscle_colours(names: list[str]) -> dict[str, str]:
    """Dict of muscle name to its colour in pictures."""
    return {name: MUSCLE_COLOURS[k % len(MUSCLE_COLOURS)] for k, name in enumerate(names)}


def line_colours(names: dict[str, Any] | list[str]) -> dict[str, str]:
    """Dict of muscle name to its colour in plots."""
    return {name: LINE_COLOURS[k % len(LINE_COLOURS)] for k, name in enumerate(names)}


def neighbour_colours(saved: Any) -> dict[str, str]:
    """Dict of muscle name to its colour; of many muscles those that lie next to each other differ."""
    from scipy.spatial import cKDTree

    plain = muscle_colours(saved.muscles)
    if len(plain) <= len(MUSCLE_COLOURS):
        return plain
    trees = {}
    for name in saved.muscles:
        points = saved.surface(name, saved.frames[0])[0]
        trees[name] = cKDTree(points[:: max(1, len(points) // 600)])
    size = float(np.linalg.norm(np.ptp(np.concatenate([tree.data for tree in trees.values()]), axis=0)))
    near: dict[str, set[str]] = {name: set() for name in trees}
    for one, two in itertools.combinations(trees, 2):
        if trees[one].count_neighbors(trees[two], NEXT_TO * size):
            near[one].add(two)
            near[two].add(one)
    found: dict[str, str] = {}
    for name in sorted(near, key=lambda name: -len(near[name])):
        taken = [found[other] for other in near[name] if other in found]
        found[name] = min(
            MUSCLE_COLOURS, key=lambda colour: (taken.count(colour), list(found.values()).count(colour))
        )
    return {name: found[name] for name in saved.muscles}
