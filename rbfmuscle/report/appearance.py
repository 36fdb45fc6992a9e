"""Colours and views shared by pictures, plots and exported files."""

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
# Where the camera stands; z is up, as in the medical axes (left, posterior, superior).
VIEWS = {
    "front": ((0.0, -1.0, 0.12), "from -y"),
    "side": ((-1.0, -0.12, 0.12), "from -x"),
    "back": ((0.0, 1.0, 0.12), "from +y"),
    "far": ((1.0, -0.12, 0.12), "from +x"),
}
# What is drawn where nothing else is asked for.
USUAL_VIEWS = ("front", "side", "back")
# The least and greatest height of a panel for its width.
_SHAPES = (0.6, 3.0)


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


def aim_camera(camera: Any, direction: Any, bounds: Any, size: tuple[int, int]) -> None:
    """Let a camera look along a direction, in a parallel projection that holds a box.

    Parameters
    ----------
    camera : pyvista.Camera
    direction : (3,) sequence of float
        From the box to the camera.
    bounds : (2, 3) ndarray
    size : (width, height)
        Of the view [pixel].
    """
    centre = bounds.mean(axis=0)
    corners, ahead, up = _projected(direction, bounds)
    wide, tall = np.ptp(corners, axis=0) / 2
    wide *= size[1] / size[0]
    camera.focal_point = centre
    camera.position = centre + ahead * 4.0 * np.linalg.norm(bounds[1] - bounds[0])
    camera.up = up
    camera.parallel_projection = True
    camera.parallel_scale = 1.04 * max(tall, wide)


def _projected(direction, bounds):
    """Corners of a box (8, 2) as a view sees them, to the right and up; the view's direction, and up."""
    ahead = np.asarray(direction) / np.linalg.norm(direction)
    right = np.cross([0.0, 0.0, 1.0], ahead)
    right /= np.linalg.norm(right)
    up = np.cross(ahead, right)
    corners = np.array([[x, y, z] for x in bounds[:, 0] for y in bounds[:, 1] for z in bounds[:, 2]])
    return (corners - bounds.mean(axis=0)) @ np.stack([right, up], axis=1), ahead, up


def fitted_size(bounds: Any, views: Any, size: Any) -> tuple[int, int]:
    """A panel as large as asked for, in the proportions of what it shows.

    Parameters
    ----------
    bounds : (2, 3) ndarray
    views : sequence of str
    size : (width, height)
        Pixels.
    """
    spans = [np.ptp(_projected(VIEWS[view][0], bounds)[0], axis=0) for view in views]
    wide, tall = np.max(spans, axis=0)
    shape = float(np.clip(tall / max(wide, 1e-12), *_SHAPES))
    area = float(size[0] * size[1])
    # Even numbers: films ask for them.
    return 2 * round(0.5 * (area / shape) ** 0.5), 2 * round(0.5 * (area * shape) ** 0.5)
