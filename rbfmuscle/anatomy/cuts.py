"""Where a scan ends, and so a bone or a muscle: flat caps, and plane rims of open ends."""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from rbfmuscle.geometry.vectors import box_size, unit
from rbfmuscle.scene.meshes.repair import boundary_rims

if TYPE_CHECKING:
    import trimesh

# A cap's faces look along its normal (cosine), lie within a share of the part's size of its end,
# and are most of what lies there.
ALONG, DEPTH, FLAT = 0.99, 0.005, 0.6
EXACT = 2e-4  # share for a muscle, which is nearly flat where it lies on a bone
LEAST_AREA = 0.005  # of the surface: a smaller flat place is no cut
TRIED = 6  # directions tried of those in which most of the surface lies flat
ROUNDED = 50.0  # normals are counted in cells of one over this
LEAST_RIM = 8  # edges of a rim that is a cut end
PLANE = 0.005  # of the size: how far a rim's points may lie from their plane


class Cut(NamedTuple):
    """A flat end: its middle (3,), outward unit normal (3,), and which vertices (n,) lie on it."""

    middle: np.ndarray
    normal: np.ndarray
    on: np.ndarray


def find_cut(mesh: trimesh.Trimesh, *, depth: float = DEPTH) -> Cut | None:
    """The largest flat end of a mesh, None where all its ends are round.

    ``depth`` is the share of its size within which a cap is flat.
    """
    vertices = np.asarray(mesh.vertices)
    points, normals, areas = (
        np.asarray(values) for values in (mesh.triangles_center, mesh.face_normals, mesh.area_faces)
    )
    depth *= box_size(vertices)
    found, largest = None, LEAST_AREA * areas.sum()
    for direction in _flat_directions(normals, areas):
        height = points @ direction
        near = height > height.max() - depth
        cap = near & (normals @ direction > ALONG)
        area = areas[cap].sum()
        if area > largest and area > FLAT * areas[near].sum():
            largest = area
            normal = unit(areas[cap] @ normals[cap])
            top = vertices @ normal
            middle = np.average(points[cap], axis=0, weights=areas[cap])
            found = Cut(middle, normal, top > top.max() - depth)
    return found if found is not None else _open_cut(mesh)


def _flat_directions(normals, areas):
    """Unit normals (k, 3) that most of the area has, and the axes of the coordinates."""
    cells, number = np.unique(np.rint(ROUNDED * normals).astype(int), axis=0, return_inverse=True)
    area = np.bincount(number.ravel(), weights=areas)
    most = np.argsort(-area)[:TRIED]
    return np.concatenate([unit(cells[most].astype(float)), np.eye(3), -np.eye(3)])


def _open_cut(mesh):
    """The largest hole whose rim lies in a plane at the end of the mesh."""
    found, largest = None, LEAST_AREA * float(mesh.area)
    vertices = np.asarray(mesh.vertices)
    size = box_size(vertices)
    for rim in boundary_rims(np.asarray(mesh.faces)):
        points = vertices[rim]
        middle = points.mean(axis=0)
        spokes = points - middle
        # Rims run as their faces do, and so around the hole from behind.
        vector = -0.5 * np.cross(spokes, np.roll(spokes, -1, axis=0)).sum(axis=0)
        area = float(np.linalg.norm(vector))
        if len(rim) < LEAST_RIM or area <= largest:
            continue
        normal = vector / area
        height = (vertices - middle) @ normal
        if np.abs(spokes @ normal).max() < PLANE * size and height.max() < PLANE * size:
            found, largest = Cut(middle, normal, height > -PLANE * size), area
    return found
