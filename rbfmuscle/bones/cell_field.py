"""Distance of a bone from lists of triangles by cell, for the loops that still read these.

The field stays in bone coordinates and is never rebuilt; queries carry points there inside their
loop. Distances are negative inside. What a query reads, and how, is in ``query.py``; how it is
built, in ``build.py``.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from rbfmuscle.bones.build import build_cells, grid_shape
from rbfmuscle.bones.cells import BLOCK
from rbfmuscle.bones.mesh import mean_edge, points_near, prepare_bone
from rbfmuscle.bones.query import FieldData, query_loop
from rbfmuscle.cache import content_key, load_arrays, store_arrays
from rbfmuscle.geometry.arrays import Floats, MeshLike
from rbfmuscle.geometry.exact_distance import ExactDistance
from rbfmuscle.geometry.mesh_distance import MeshDistance
from rbfmuscle.geometry.rest_frame import BoneFrame, numbered_by_place, on_one_line
from rbfmuscle.geometry.solids import outer_surface
from rbfmuscle.geometry.surfaces import face_normals
from rbfmuscle.validation import MeshError, check_mesh, check_points, check_positive

IDENTITY = np.eye(4)
NO_GRADIENT = np.empty((0, 3))
# Fine cells against the mean edge of the mesh, and at least this many along its longest side.
CELL_SHARE, LEAST_CELLS = 0.6, 40
# Fine cells cover points nearer than this many of their edges.
BAND = 1.2
# Default tolerance as a share of the mean edge: facets are flat, so errors scale with them.
TOLERANCE_SHARE = 0.004
# Points at which a field measures itself, and how often it may be refined.
PROBES, ATTEMPTS = 4000, 5
# Regions grow to the next of so many parts of a bone's longest side, so that motions that are alike
# share a field; beyond the bone's box by one of these they mean nothing more.
REGION_PARTS = 32
# Bytes that a field may take unless told otherwise.
MEMORY_LIMIT = 2**28


class CellField:
    """Distance field of one bone; build it with :meth:`from_mesh`.

    Attributes
    ----------
    vertices, faces : (n, 3) and (m, 3) ndarray
        The mesh as used: numbered by place; degenerate and duplicate faces and inner shells left
        out.
    bounds : (2, 3) ndarray
        Box of the mesh, bone coordinates.
    spacing : float
        Edge of a fine cell [unit of the mesh].
    band : float
        Distance up to which fine cells answer.
    error : float
        RMS error within the band, measured when it was built.
    closed : bool
        Whether the sign comes from the mesh itself (else from winding numbers).
    notes : tuple of str
        What was found about the mesh.
    data : FieldData
        What queries read, in a frame of the bone's own: a scene that is moved, turned or written in
        another unit gives the same field.
    """

    def __init__(self, vertices: Floats, frame: BoneFrame, parts: _Parts) -> None:
        self.vertices = vertices
        self.faces = parts.faces
        self.notes = tuple(parts.notes)
        used = self.vertices[np.unique(self.faces)]
        self.bounds = np.array([used.min(axis=0), used.max(axis=0)])
        self.data, self.closed = parts.data, parts.closed
        self.spacing, self.error = parts.spacing * frame.size, parts.error * frame.size
        self.band = BAND * self.spacing
        self._frame = frame

    @property
    def memory(self) -> int:
        """Bytes that queries read."""
        return sum(array.nbytes for array in self.data)

    @property
    def unit(self) -> float:
        """Length of a unit of the frame that ``data`` is in [unit of the mesh]."""
        return self._frame.size

    @property
    def local_to_bone(self) -> Floats:
        """Transform (4, 4) from the frame that ``data`` is in to bone coordinates."""
        out = np.eye(4)
        out[:3, :3] = self._frame.axes.T * self._frame.size
        out[:3, 3] = self._frame.origin
        return out

    @classmethod
    def from_mesh(
        cls,
        mesh: MeshLike,
        *,
        tolerance: float | None = None,
        region: ArrayLike | None = None,
        cache: bool = True,
        memory_limit: int = MEMORY_LIMIT,
        name: str = "bone",
    ) -> CellField:
        """Build the field of a bone, or take it from the cache.

        Parameters
        ----------
        mesh : trimesh.Trimesh or pair of (n, 3) vertices and (m, 3) faces
            Rest (bone) coordinates. Closed and outward for exact signs; others are signed by
            winding numbers, and the log says so.
        tolerance : float, optional
            RMS error near the surface [unit of the mesh]. By default 0.4 % of the mean edge, or
            what the memory allows.
        region : (2, 3) array_like, optional
            Box, bone coordinates, that points come from, which is grown to the next of
            `REGION_PARTS` parts of the bone. Outside of it the field is coarse, but still right.
        cache : bool
            Look the field up on disk, and keep it there.
        memory_limit : int
            Bytes the field may take.
        name : str
            What messages call the bone.

        Raises
        ------
        MeshError
            If the mesh is unusable, or the tolerance needs more memory than allowed.
        """
        vertices, faces = (mesh.vertices, mesh.faces) if hasattr(mesh, "faces") else mesh
        vertices, faces = np.asarray(vertices, dtype=np.float64), np.asarray(faces)
        tolerance = None if tolerance is None else check_positive(tolerance, name="tolerance")
        region = None if region is None else check_points(region, name="region")
        if region is not None and (region.shape != (2, 3) or np.any(region[0] > region[1])):
            raise ValueError(f"region must be (2, 3), least corner first, got {region.tolist()}")
        steps = None if region is None else _region_steps(region, vertices)
        key = content_key(vertices, faces, (tolerance, steps, memory_limit)) if cache else None
        arrays = None if key is None else load_arrays(key)
        parts = None if arrays is None else _from_arrays(arrays)
        vertices, faces, solid = outer_surface(*check_mesh(vertices, faces, name=name))
        if parts is None and on_one_line(vertices):
            raise MeshError(f"{name} has no face with an area")
        order, faces = numbered_by_place(vertices, faces)
        vertices = vertices[order]
        frame = BoneFrame(vertices)
        if parts is None:
            region = None if steps is None else _stepped_region(steps, vertices)
            parts = _build(
                prepare_bone(frame.local, faces, name=name),
                frame,
                tolerance,
                region,
                memory_limit,
                name,
            )
            if key is not None:
                store_arrays(key, _to_arrays(parts))
        parts = parts._replace(notes=[*solid, *parts.notes])
        return cls(vertices, frame, parts)


def _region_steps(region, vertices):
    """A box (2, 3) in whole steps from the least corner of the mesh's box, grown outwards; a list,
    for a key.
    """
    low, extent = vertices.min(axis=0), np.ptp(vertices, axis=0)
    steps = (region - low) * REGION_PARTS / max(float(extent.max()), 1e-300)
    most = np.ceil(extent * REGION_PARTS / max(float(extent.max()), 1e-300)) + 1.0
    steps = np.clip([np.floor(steps[0]), np.ceil(steps[1])], -1.0, most)
    return steps.astype(int).tolist()


def _stepped_region(steps, vertices):
    """The box (2, 3) of `_region_steps`."""
    extent = float(np.ptp(vertices, axis=0).max())
    return vertices.min(axis=0) + np.array(steps) * extent / REGION_PARTS


class _Parts(NamedTuple):
    """A field in local units, as it is kept on disk."""

    faces: np.ndarray
    notes: list
    data: FieldData
    spacing: float
    error: float
    closed: bool


def _build(mesh, frame, tolerance, region, memory_limit, name):
    """Refine until the field errs by no more than the tolerance."""
    exact = ExactDistance(mesh.vertices, mesh.faces)
    edge = mean_edge(mesh.vertices, mesh.faces)
    used = mesh.vertices[np.unique(mesh.faces)]
    extent = float(np.ptp(used, axis=0).max())
    spacing = min(CELL_SHARE * edge, extent / LEAST_CELLS)
    box = None if region is None else frame.box(region)
    wanted = TOLERANCE_SHARE * edge if tolerance is None else tolerance / frame.size
    wound = MeshDistance(mesh.vertices, mesh.faces, closed=mesh.closed).inside
    inside = None if mesh.closed else wound
    error = np.inf
    for _ in range(ATTEMPTS):
        spacing = _check_memory(mesh, exact, spacing, tolerance, memory_limit, name)
        data, sound = build_cells(
            exact, spacing, BAND * spacing, inside=inside, region=box, doubtful=mesh.doubtful
        )
        if inside is None and not sound:
            mesh.notes.append("intersects itself: the sign comes from winding numbers")
            inside = wound
            continue
        error = _measure(mesh, data, exact, BAND * spacing, box)
        reached = _Parts(mesh.faces, mesh.notes, data, spacing, error, inside is None)
        if error <= wanted:
            return reached
        spacing *= max(0.5, 0.9 * (wanted / error) ** (1 / 3))
    mesh.notes.append(
        f"errs by {error * frame.size:.3g} RMS near the surface, {wanted * frame.size:.3g} was "
        "asked for"
    )
    return reached


def _check_memory(mesh, exact, spacing, tolerance, limit, name):
    """Spacing that fits in the memory: larger if the caller asked for no tolerance, else an
    error.
    """
    low, high = exact.vertices.min(axis=0), exact.vertices.max(axis=0)
    area = float(np.linalg.norm(face_normals(mesh.vertices, mesh.faces), axis=1).sum())

    def need(h):
        table = 4.0 * np.prod(BLOCK * grid_shape(low, high, h, BAND * h).astype(np.float64))
        return table + 25.0 * (2 * BAND + 6) * area / h**2 + 160.0 * len(mesh.faces)

    if need(spacing) <= limit:
        return spacing
    if tolerance is not None:
        raise MeshError(
            f"{name}: a tolerance of {tolerance:g} needs about {need(spacing) / 2**20:.0f} MB, "
            f"{limit / 2**20:.0f} MB are allowed; raise the tolerance or the memory limit"
        )
    start = spacing
    while need(spacing) > limit and spacing < 1e3 * start:
        spacing *= 1.25
    if need(spacing) > limit:
        raise MeshError(f"{name}: its {len(mesh.faces)} faces do not fit in {limit / 2**20:.0f} MB")
    return spacing


def _measure(mesh, data, exact, band, region):
    """RMS error at points spread over the band, in the region."""
    faces = mesh.faces
    if region is not None:
        corners = mesh.vertices[faces]
        faces = faces[
            np.all((corners.min(axis=1) <= region[1]) & (corners.max(axis=1) >= region[0]), axis=1)
        ]
    if len(faces) == 0:
        return 0.0
    points = points_near(mesh.vertices, faces, PROBES, band)
    distance = np.empty(len(points))
    query_loop(points, IDENTITY, np.full(PROBES, np.inf), 1.0, distance, NO_GRADIENT, data)
    difference = np.abs(distance) - np.abs(exact.signed_distance(points))
    return float(np.sqrt(np.mean(difference**2)))


def _to_arrays(parts):
    arrays = {"data_" + name: array for name, array in parts.data._asdict().items()}
    numbers = np.array([parts.spacing, parts.error, float(parts.closed)])
    return {
        **arrays,
        "faces": parts.faces,
        "numbers": numbers,
        "notes": np.array("\n".join(parts.notes)),
    }


def _from_arrays(arrays):
    if not {"numbers", "notes", "faces"} <= arrays.keys():
        return None
    notes = [note for note in str(arrays["notes"]).split("\n") if note]
    data = FieldData(**{name: arrays["data_" + name] for name in FieldData._fields})
    spacing, error, closed = arrays["numbers"]
    return _Parts(arrays["faces"], notes, data, float(spacing), float(error), bool(closed))
