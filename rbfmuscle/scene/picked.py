"""Patches that were picked or painted in another program: points in a text file, vertex colours."""

import re
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.scene.meshes.repair import ReadMesh
from rbfmuscle.validation import SceneError, read_text, shown, shown_path

FEWEST = 3  # picked points of a patch
# A patch reaches so many times the greatest distance of a picked point from its nearest neighbour;
# the middle of three points is 0.58 of their distance away.
REACH = 0.6
# Picked points lie no farther from the muscle than this share of its size.
AWAY = 0.05
SHADE = 40.0  # greatest difference of a colour, of 255 in each channel
# Columns of points, as ParaView, Blender's exporters and people name them.
_AXES = (
    {"x", "points:0", "points_0", "px", "x coordinate"},
    {"y", "points:1", "points_1", "py", "y coordinate"},
    {"z", "points:2", "points_2", "pz", "z coordinate"},
)


def read_points(path: Path, *, context: str) -> Floats:
    """Points (n, 3) of a text file: columns by their names in a first line, else the first
    three.
    """
    lines = [line for line in read_text(path, context=context).splitlines() if line.strip()]
    context = f"{context}{shown_path(path)}: "
    rows = [
        [word.strip(" \"'") for word in re.split(r"[,;\t]|\s+", line.strip())] for line in lines
    ]
    columns = [0, 1, 2]
    if lines and not _is_number(rows[0][0]):
        head = [word.strip(" \"'").lower() for word in re.split(r"[,;\t]", lines[0].strip())]
        head = rows[0] if len(head) == 1 else head
        found = [next((k for k, word in enumerate(head) if word.lower() in a), -1) for a in _AXES]
        if min(found) < 0:
            raise SceneError(f"{context}no columns x, y and z in {shown(repr(lines[0]))}")
        columns, rows = found, rows[1:]
    try:
        points = np.array([[float(row[k]) for k in columns] for row in rows])
    except (ValueError, IndexError):
        raise SceneError(f"{context}every line must hold three coordinates") from None
    if len(points) < FEWEST or not np.isfinite(points).all():
        raise SceneError(
            f"{context}{len(points)} points, at least {FEWEST} finite ones make a patch"
        )
    return points


def _is_number(word):
    try:
        float(word)
    except ValueError:
        return False
    return True


def picked_vertices(points: Floats, vertices: Floats, *, context: str) -> Integers:
    """The vertices (n, 3) about picked points (k, 3)."""
    tree = cKDTree(points)
    away, nearest = cKDTree(vertices).query(points)
    size = float(np.linalg.norm(np.ptp(vertices, axis=0)))
    if away.max() > AWAY * size:
        raise SceneError(
            f"{context}a picked point lies {away.max():.4g} away from the muscle; pick points on "
            "its mesh, in the scene's frame and unit"
        )
    spacing = float(tree.query(points, k=2)[0][:, 1].max())
    near = np.flatnonzero(tree.query(vertices)[0] <= REACH * spacing)
    return np.union1d(near, nearest)


def painted_vertices(colour: str, read: ReadMesh, *, context: str) -> Integers:
    """The vertices that have a colour (``"#rrggbb"``) in the muscle's file."""
    import trimesh

    if re.fullmatch(r"#[0-9a-fA-F]{6}", colour) is None:
        raise SceneError(f"{context}colour must be like '#ff0000', got {shown(repr(colour))}")
    if not read.source:
        raise SceneError(f"{context}a colour needs a mesh that was read from a file")
    visual = trimesh.load(read.source, process=False).visual
    if getattr(visual, "kind", None) != "vertex" or len(visual.vertex_colors) != len(
        read.vertex_map
    ):
        raise SceneError(
            f"{context}{shown_path(Path(read.source))} holds no vertex colours; save the mesh as "
            "PLY with them"
        )
    wanted = np.array([int(colour[k : k + 2], 16) for k in (1, 3, 5)], dtype=float)
    away = np.abs(np.asarray(visual.vertex_colors, dtype=float)[:, :3] - wanted).max(axis=1)
    kept = read.vertex_map[away <= SHADE]
    if not (kept >= 0).any():
        raise SceneError(f"{context}no vertex has the colour {colour}, or one near to it")
    return np.unique(kept[kept >= 0])
