"""Patches that were picked or painted in another program: points in a text file, vertex colours,
regions of another mesh.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import cKDTree

from rbfmuscle.geometry.arrays import Booleans, Floats, Integers
from rbfmuscle.geometry.vectors import box_size
from rbfmuscle.scene.meshes.formats import read_part
from rbfmuscle.scene.meshes.repair import ReadMesh
from rbfmuscle.scene.meshes.transform import MeshTransform
from rbfmuscle.validation import MeshError, SceneError, read_text, shown, shown_path

if TYPE_CHECKING:
    import trimesh

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
    if not len(points) or not np.isfinite(points).all():
        raise SceneError(f"{context}{len(points)} points, all must be finite")
    return points


def check_patch(points: Floats, *, context: str) -> Floats:
    """Points that make a patch without a radius; SceneError where they are too few."""
    if len(points) < FEWEST:
        raise SceneError(
            f"{context}{len(points)} points, at least {FEWEST} make a patch; give a radius"
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
    size = box_size(vertices)
    if away.max() > AWAY * size:
        far = int(away.argmax())
        place = ", ".join(f"{value:.4g}" for value in points[far])
        raise SceneError(
            f"{context}point {far + 1} of {len(points)}, ({place}), lies {away[far]:.4g} units of "
            "the scene away from the muscle; pick points on its mesh, in the scene's frame and unit"
        )
    spacing = float(tree.query(points, k=2)[0][:, 1].max())
    near = np.flatnonzero(tree.query(vertices)[0] <= REACH * spacing)
    return np.union1d(near, nearest)


def painted_vertices(colour: str, read: ReadMesh, *, context: str) -> Integers:
    """The vertices that have a colour (``"#rrggbb"``) in the muscle's file."""
    if not read.source:
        raise SceneError(f"{context}a colour needs a mesh that was read from a file")
    painted = _painted(colour, Path(read.source), len(read.vertex_map), context)
    kept = read.vertex_map[painted]
    if not (kept >= 0).any():
        raise SceneError(f"{context}no vertex has the colour {colour}, or one near to it")
    return np.unique(kept[kept >= 0])


def _painted(colour: str, path: Path, count: int, context: str) -> Booleans:
    """Whether each of the ``count`` vertices of a file has a colour."""
    import trimesh

    if re.fullmatch(r"#[0-9a-fA-F]{6}", colour) is None:
        raise SceneError(f"{context}colour must be like '#ff0000', got {shown(repr(colour))}")
    visual = trimesh.load(path, process=False).visual
    if getattr(visual, "kind", None) != "vertex" or len(visual.vertex_colors) != count:
        raise SceneError(
            f"{context}{shown_path(path)} holds no vertex colours; save the mesh as PLY with them"
        )
    wanted = np.array([int(colour[k : k + 2], 16) for k in (1, 3, 5)], dtype=float)
    away = np.abs(np.asarray(visual.vertex_colors, dtype=float)[:, :3] - wanted).max(axis=1)
    return away <= SHADE


def region_vertices(
    path: Path, transform: MeshTransform, colour: str | None, mesh: trimesh.Trimesh, *, context: str
) -> Integers:
    """The vertices of a muscle's mesh on another mesh, or on what is painted there.

    Nearer to it than half an edge, of the mesh whose edges are longer; ``transform`` takes the
    other mesh to the scene.
    """
    import igl
    from trimesh.triangles import points_to_barycentric

    try:
        part = read_part(path)
    except MeshError as error:
        raise SceneError(f"{context}{error}") from None
    painted = np.ones(len(part.vertices), dtype=bool)
    if colour is not None:
        painted = _painted(colour, path, len(part.vertices), context)
    other = transform.points(part.vertices)
    square, faces, places = igl.point_mesh_squared_distance(
        np.asarray(mesh.vertices), other, np.ascontiguousarray(part.faces)
    )[:3]
    corners = part.faces[faces]
    share = (points_to_barycentric(other[corners], places) * painted[corners]).sum(axis=1)
    edge = max(_edge(np.asarray(mesh.vertices), np.asarray(mesh.faces)), _edge(other, part.faces))
    away = np.sqrt(square)
    chosen = np.flatnonzero((share >= 1 / 2) & (away <= 0.5 * edge))
    if not len(chosen):
        words = f"the nearest is {away.min():.4g} away" if painted.any() else "nothing is painted"
        raise SceneError(f"{context}no vertex of the muscle lies on {shown_path(path)}, {words}")
    return chosen


def _edge(vertices: Floats, faces: Integers) -> float:
    """Median length of the edges."""
    return float(np.median(np.linalg.norm(vertices[faces[:, 0]] - vertices[faces[:, 1]], axis=1)))
