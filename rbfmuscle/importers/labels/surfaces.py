"""From labels to smooth closed surfaces, without the steps of their voxels.

The mask of a label, 1/2 inside and -1/2 outside, is smoothed by I - (I - G)^4, G a Gaussian of 1.3 voxels:
flat to fourth order in the pass band, so that curved surfaces are not drawn in as they are by G alone. Where two
labels share a face, the fields are each other's negative there and so are their zero sets. The level is then
shifted to the label's volume, a few hundredths of a voxel.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates
from scipy.ndimage import label as connected

from rbfmuscle.geometry.crossing import crossing_faces
from rbfmuscle.geometry.surfaces import mesh_volume
from rbfmuscle.validation import MeshError

# Deviation of the Gaussian [voxels], and how often what it lost is smoothed again.
SMOOTHING, PASSES = 1.3, 4
# Voxels kept around a label, beyond which the filter sees nothing.
MARGIN = 6
# Greatest shift of the level, as a share of the jump across a face.
MOST_SHIFT = 0.35
# Share of the largest piece from which on a piece belongs to a bone of several parts.
PIECE = 0.01
# Edge of the surface's triangles [voxels], and rounds in which triangles that cross are drawn apart.
EDGE, UNTANGLE = 2.2, 20


@dataclass
class LabelSurface:
    """The surface of one label.

    Attributes
    ----------
    label : int
    name : str
    mesh : trimesh.Trimesh
        Closed, outward [mm].
    volume : float
        Of the label's voxels [mm3].
    notes : list of str
        Islands that were left out, holes that were filled.
    """

    label: int
    name: str
    mesh: object
    volume: float
    notes: list


def label_surface(volume: Any, label: int, *, edge: float = EDGE, pieces: bool = False) -> LabelSurface:
    """Smooth surface of a label.

    Parameters
    ----------
    volume : LabelVolume
    label : int
    edge : float
        Wanted edge of the triangles [voxels].
    pieces : bool
        Keep every piece of a hundredth of the whole or more (bones of several parts), not the largest alone.

    Raises
    ------
    MeshError
        If the label has too few voxels for a surface.
    """
    name = volume.name(label)
    mask, corner = _cut_out(volume.labels, label)
    mask, notes = _without_islands(mask, name, volume.source, PIECE if pieces else 1.0)
    size = float(np.prod(volume.spacing))
    wanted = float(mask.sum()) * size
    field = smooth_mask(mask)
    level, vertices, faces = _level_of_volume(field, wanted / size)
    vertices, faces = _decimate(vertices, faces, edge)
    vertices = _untangled(vertices, faces, field - level)
    vertices = _to_volume(vertices, faces, wanted / size)
    world = (vertices + corner) @ volume.affine[:3, :3].T + volume.affine[:3, 3]
    return LabelSurface(int(label), name, _outward(world, faces), wanted, notes)


def smooth_mask(mask: np.ndarray) -> np.ndarray:
    """Field of a mask (i, j, k): positive inside, zero about half-way between voxels in and out."""
    rest = np.where(mask, np.float32(0.5), np.float32(-0.5))
    field = np.zeros_like(rest)
    for _ in range(PASSES):
        part = gaussian_filter(rest, SMOOTHING, truncate=4.0, mode="nearest")
        field += part
        rest -= part
    return field


def _cut_out(labels, label):
    """Mask of a label in its box, with a margin, and the index of the box's corner."""
    present = labels == label
    box = []
    for axis in range(3):
        along = np.flatnonzero(present.any(axis=tuple(k for k in range(3) if k != axis)))
        box.append(slice(int(along[0]), int(along[-1]) + 1))
    corner = np.array([part.start for part in box]) - MARGIN
    return np.pad(present[tuple(box)], MARGIN), corner


def _without_islands(mask, name, source, least):
    """The pieces of at least a share of the largest, their inner holes filled, and what was left out."""
    notes = []
    pieces, count = connected(mask)
    if count > 1:
        sizes = np.bincount(pieces.ravel())
        sizes[0] = 0
        kept = sizes >= least * sizes.max()
        mask = kept[pieces]
        rest = int(sizes[~kept].sum())
        if rest:
            share = 100 * rest / sizes.sum()
            notes.append(f"{int((~kept).sum()) - 1} islands of {rest} voxels left out ({share:.2g} %)")
    outside, count = connected(~mask)
    if count > 1:
        hollow = (outside != outside[0, 0, 0]) & ~mask
        mask = mask | hollow
        notes.append(f"{count - 1} holes of {int(hollow.sum())} voxels filled")
    if mask.sum() < 27:
        raise MeshError(
            f"{source}: label {name!r} has {int(mask.sum())} voxels, too few for a surface; remove it"
        )
    return mask, notes


def _level_of_volume(field, wanted):
    """Zero set of the field, its level shifted until it encloses the wanted number of voxels."""
    level, best = 0.0, None
    for _ in range(4):
        vertices, faces = _contour(field, level)
        volume, area = _volume_and_area(vertices, faces)
        if best is None or abs(volume - wanted) < best[0]:
            best = (abs(volume - wanted), level, vertices, faces)
        if abs(volume - wanted) < 1e-4 * wanted:
            break
        slope = 0.5  # of the field across a face: from 1/2 to -1/2 over about two voxels
        level = float(np.clip(level - slope * (wanted - volume) / area, -MOST_SHIFT, MOST_SHIFT))
    return best[1:]


def _contour(field, level):
    from skimage.measure import marching_cubes

    vertices, faces, _, _ = marching_cubes(-field, -level, allow_degenerate=False)
    return vertices.astype(np.float64), faces.astype(np.int64)


def _volume_and_area(vertices, faces):
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2.0
    return abs(mesh_volume(vertices, faces)), float(area)


def _decimate(vertices, faces, edge):
    """Fewer triangles by quadric edge collapse (Garland and Heckbert 1997), for a wanted edge."""
    import igl

    _, area = _volume_and_area(vertices, faces)
    target = max(200, int(area / (np.sqrt(3.0) / 4.0 * edge**2)))
    if target >= len(faces):
        return vertices, faces
    found = igl.qslim(vertices, faces, target)
    return np.asarray(found[0], dtype=np.float64), np.asarray(found[1], dtype=np.int64)


def _untangled(vertices, faces, field):
    """Vertices where no triangle goes through another: beside such places evened out, and put back on the zero set.

    Edges that collapse on either side of a wall thinner than a triangle fold it, or bring its sides through each other.
    """
    heads, tails = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    degree = np.bincount(heads, minlength=len(vertices))
    least, best = np.inf, vertices
    for _ in range(UNTANGLE):
        crossing = crossing_faces(vertices, faces)
        if crossing.sum() < least:
            least, best = crossing.sum(), vertices
        if least == 0:
            break
        near = np.zeros(len(vertices), dtype=bool)
        near[faces[crossing]] = True
        near[faces[near[faces].any(axis=1)]] = True  # and their neighbours
        means = np.stack([np.bincount(heads, vertices[tails, k]) / degree for k in range(3)], axis=1)
        vertices = vertices.copy()
        vertices[near] = _on_zero_set(0.5 * (vertices[near] + means[near]), field)
    return best


def _on_zero_set(points, field):
    """Points moved along the gradient of a field on a grid to where it is zero, by a voxel at most."""
    start = points
    for _ in range(3):
        value = map_coordinates(field, points.T, order=1, mode="nearest")
        slope = np.empty_like(points)
        for k in range(3):
            step = 0.5 * np.eye(3)[k]
            ahead, behind = (
                map_coordinates(field, (points + s).T, order=1, mode="nearest") for s in (step, -step)
            )
            slope[:, k] = ahead - behind
        points = points - (value / np.maximum((slope**2).sum(axis=1), 0.01))[:, None] * slope
    moved = points - start
    return start + moved * np.minimum(1.0, 1.0 / np.maximum(np.linalg.norm(moved, axis=1), 1e-12))[:, None]


def _to_volume(vertices, faces, wanted):
    """Vertices moved along their normals, all by the same way, until the mesh holds the wanted volume."""
    import trimesh

    for _ in range(2):
        volume, area = _volume_and_area(vertices, faces)
        mesh = trimesh.Trimesh(vertices, faces, process=False)
        outward = np.sign(mesh.volume) * mesh.vertex_normals
        vertices = vertices + (wanted - volume) / area * outward
    return vertices


def _outward(vertices, faces):
    import trimesh

    mesh = trimesh.Trimesh(vertices, faces, process=False)
    if mesh.volume < 0:
        mesh = trimesh.Trimesh(vertices, faces[:, ::-1], process=False)
    return mesh
