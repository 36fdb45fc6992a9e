"""What a VTK PolyData file holds, and its polygons and strips as triangles.

The files are read here and not by VTK: its readers end the process on some broken files, print pages on
others, and unpack without end what says so. A damaged file must cost its user one line.
"""

import os
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rbfmuscle.validation import MeshError

# An array may unpack to so many times the size of the whole file; the variable raises the limit.
EXPANSION = 100.0
EXPANSION_VARIABLE = "RBFMUSCLE_MESH_EXPANSION"
# Below this an array is never too large: a small file may well hold a few hundred vertices.
SMALL = 1 << 20
# A polygon of more corners is split from its first one: trying each takes time with their square.
MOST_CORNERS = 100


class Cells(NamedTuple):
    """Cells of one kind: cell k has the points ``numbers[ends[k - 1]:ends[k]]``."""

    ends: np.ndarray
    numbers: np.ndarray


class PolyData(NamedTuple):
    """Points (n, 3), the cells that hold them, and values of the cells by name."""

    points: np.ndarray
    lines: Cells
    polygons: Cells
    strips: Cells
    values: dict


NO_CELLS = Cells(np.zeros(0, dtype=np.int64), np.zeros(0, dtype=np.int64))


class BrokenFileError(ValueError):
    """Why a file cannot be read, without its name."""


def read_polydata(path: str | Path, suffix: str | None = None, *, values: bool = False) -> PolyData:
    """Return what a ``.vtk`` (legacy) or ``.vtp`` (XML) PolyData file holds.

    Parameters
    ----------
    path : path
    suffix : str, optional
        In place of the file's own.
    values : bool
        Also read the values of the cells (of XML files).

    Raises
    ------
    MeshError
        If the file is damaged, of another kind, or unpacks to more than a stated multiple of its size.
    """
    path = Path(path)
    try:
        content = path.read_bytes()
        if (suffix or path.suffix.lower()) == ".vtp":
            from rbfmuscle.sim.formats.vtp import parse_vtp

            return parse_vtp(content, values=values)
        from rbfmuscle.sim.formats.legacy import parse_legacy

        return parse_legacy(content)
    except OSError as error:
        raise MeshError(f"{path}: cannot be read: {error.strerror}") from None
    except BrokenFileError as error:
        raise MeshError(f"{path}: {error}") from None


def check_room(wanted: int, content_size: int, what: str) -> None:
    """Refuse an array of ``wanted`` bytes that a file of ``content_size`` bytes does not warrant."""
    allowed = max(SMALL, expansion_limit() * content_size)
    if wanted > allowed:
        raise BrokenFileError(
            f"{what} would take {wanted:.4g} bytes, {wanted / max(content_size, 1):.4g} times the file "
            f"(limit {expansion_limit():g}); export the mesh again, or set {EXPANSION_VARIABLE} to a larger number"
        )


def expansion_limit() -> float:
    """How many times the size of its file an array may take, from the environment where it is set there."""
    text = os.environ.get(EXPANSION_VARIABLE, "")
    try:
        value = float(text) if text else EXPANSION
    except ValueError:
        value = float("nan")
    if not value > 0:
        raise MeshError(f"{EXPANSION_VARIABLE} must be a positive number, got {text!r}")
    return value


def check_cells(cells: Cells, points: int, what: str) -> Cells:
    """Return cells whose ends rise to the count of their numbers, all of which are points."""
    ends, numbers = cells
    if len(ends) == 0:
        return NO_CELLS
    if ends[0] < 0 or (np.diff(ends) < 0).any() or ends[-1] > len(numbers):
        raise BrokenFileError(f"the {what} do not fit their {len(numbers)} point numbers")
    numbers = numbers[: ends[-1]]
    if len(numbers) and (numbers.min() < 0 or numbers.max() >= points):
        bad = numbers[(numbers < 0) | (numbers >= points)][0]
        raise BrokenFileError(f"the {what} name point {bad}, the points are 0 to {points - 1}")
    return Cells(ends, numbers)


def triangles_of(data: PolyData) -> np.ndarray:
    """All polygons and strips as triangles (m, 3)."""
    return np.vstack([_split_polygons(data.points, data.polygons), _split_strips(data.strips)])


def _split_polygons(points, cells):
    ends, numbers = cells
    if len(ends) == 0:
        return np.zeros((0, 3), dtype=np.int64)
    starts = np.concatenate([[0], ends[:-1]])
    sizes = ends - starts
    if (sizes == 3).all():
        return numbers.reshape(-1, 3)
    found = []
    for size in np.unique(sizes[sizes >= 3]):
        chosen = np.flatnonzero(sizes == size)
        corners = numbers[starts[chosen][:, None] + np.arange(size)]
        found.append((np.repeat(chosen, size - 2), _fan(points, corners).reshape(-1, 3)))
    if not found:
        return np.zeros((0, 3), dtype=np.int64)
    order = np.argsort(np.concatenate([cell for cell, _ in found]), kind="stable")
    return np.vstack([triangles for _, triangles in found])[order]


def _fan(points, corners):
    """Polygons of equally many corners (k, s) as fans (k, s - 2, 3), each from the corner that keeps it flat.

    A fan from the wrong corner of a concave polygon folds over: of all corners the one is taken whose worst
    triangle faces most the way of the polygon.
    """
    size = corners.shape[1]
    if size == 3 or size > MOST_CORNERS:
        first = np.broadcast_to(corners[:, :1], (len(corners), size - 2))
        return np.stack([first, corners[:, 1:-1], corners[:, 2:]], axis=2)
    with np.errstate(invalid="ignore", over="ignore"):
        places = points[corners]
        normal = np.cross(places, np.roll(places, -1, axis=1)).sum(axis=1)
        worst = np.full((len(corners), size), -np.inf)
        for first in range(size):
            turned = np.roll(places, -first, axis=1)
            sides = turned[:, 1:] - turned[:, :1]
            facing = np.cross(sides[:, :-1], sides[:, 1:]) @ normal[:, :, None]
            worst[:, first] = np.nan_to_num(facing[..., 0].min(axis=1))
    best = worst.argmax(axis=1)
    turned = np.take_along_axis(corners, (best[:, None] + np.arange(size)) % size, axis=1)
    first = np.broadcast_to(turned[:, :1], (len(turned), size - 2))
    return np.stack([first, turned[:, 1:-1], turned[:, 2:]], axis=2)


def _split_strips(cells):
    ends, numbers = cells
    found = [np.zeros((0, 3), dtype=np.int64)]
    for start, end in zip([0, *ends[:-1].tolist()], ends.tolist()):
        strip = numbers[start:end]
        if len(strip) >= 3:
            triangles = np.column_stack([strip[:-2], strip[1:-1], strip[2:]])
            triangles[1::2] = triangles[1::2, [1, 0, 2]]
            found.append(triangles)
    return np.vstack(found)
