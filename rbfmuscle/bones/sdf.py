"""BoneSDF: signed distance and gradient of a rigid bone, in any pose, and what its mesh allows:
which triangles count, and where the sign of the distance comes from.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike

from rbfmuscle.bones.distance import BoneArrays, Memory, bone_arrays, distance_loop, winding_loop
from rbfmuscle.geometry.arrays import Floats, Integers, MeshLike, box_size, unit
from rbfmuscle.geometry.exact_distance import ExactDistance, faces_across
from rbfmuscle.geometry.frames import numbered_by_place, on_one_line
from rbfmuscle.geometry.solids import outer_surface
from rbfmuscle.geometry.surfaces import mesh_volume
from rbfmuscle.geometry.threads import in_chunks
from rbfmuscle.validation import MeshError, check_mesh, check_points

log = logging.getLogger(__name__)

# Area below this share of the squared longest edge is rounding.
LEAST_SHAPE = 1e-12


@dataclass
class BoneMesh:
    """A bone's mesh as its field takes it."""

    vertices: np.ndarray
    faces: np.ndarray
    doubtful: np.ndarray  # (m,) faces at a border, whose pseudonormals give no sign
    notes: list = field(default_factory=list)  # what was found and done, for the log

    @property
    def closed(self) -> bool:
        """Whether each edge has one face on each side, consistently oriented."""
        return not self.doubtful.any()


def prepare_bone(vertices: Floats, faces: Integers, *, name: str = "bone") -> BoneMesh:
    """Clean arrays for a distance field: no degenerate or duplicate faces, outward as far as can be
    told.

    Closed meshes are taken as they are. Of others equal vertices are merged, and patches oriented
    alike. Raises MeshError on NaN, indices out of range, an empty mesh, or one whose faces all have
    no area.
    """
    vertices, faces = check_mesh(vertices, faces, name=name)
    mesh = BoneMesh(vertices, faces, np.zeros(len(faces), dtype=np.bool_))
    flat = _flat(vertices, faces)
    if flat.any():
        _keep(mesh, ~flat, f"{int(flat.sum())} faces without area left out")
    if len(mesh.faces) == 0:
        raise MeshError(f"{name} has no face with an area")
    across = faces_across(mesh.faces)
    if (across < 0).any() or flat.any():
        across = _mend(mesh)
    if (across < 0).any():
        border = np.zeros(len(vertices), dtype=np.bool_)
        border[mesh.faces[(across < 0).any(axis=1)]] = True
        mesh.doubtful = border[mesh.faces].any(axis=1)
        count = int((across < 0).sum())
        mesh.notes.append(f"not closed ({count} open edges): the sign comes from winding numbers")
    if mesh_volume(mesh.vertices, mesh.faces) < 0.0:
        mesh.faces = np.ascontiguousarray(mesh.faces[:, ::-1])
        mesh.notes.append("faces pointed inward and were turned")
    return mesh


def _flat(vertices, faces):
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    longest = np.maximum.reduce([((q - p) ** 2).sum(axis=1) for p, q in ((a, b), (b, c), (c, a))])
    return area <= LEAST_SHAPE * longest


def _keep(mesh, which, note):
    mesh.faces = np.ascontiguousarray(mesh.faces[which])
    mesh.doubtful = np.zeros(len(mesh.faces), dtype=np.bool_)
    mesh.notes.append(note)


def _mend(mesh):
    """Merge equal vertices, drop duplicate faces, orient patches alike; return the faces across."""
    import igl

    _, first, inverse = np.unique(mesh.vertices, axis=0, return_index=True, return_inverse=True)
    if len(first) < len(mesh.vertices):
        used = len(np.unique(mesh.faces))
        mesh.faces = np.ascontiguousarray(first[inverse.reshape(-1)][mesh.faces])
        repeated = used - len(np.unique(mesh.faces))
        mesh.notes += [f"{repeated} repeated vertices merged"] if repeated else []
        flat = _flat(mesh.vertices, mesh.faces)
        if flat.any():
            _keep(mesh, ~flat, f"{int(flat.sum())} faces without area left out")
    _, kept = np.unique(np.sort(mesh.faces, axis=1), axis=0, return_index=True)
    if len(kept) < len(mesh.faces):
        _keep(mesh, np.sort(kept), f"{len(mesh.faces) - len(kept)} duplicate faces left out")
    across = faces_across(mesh.faces)
    if (across == -2).any():
        oriented = np.ascontiguousarray(igl.bfs_orient(mesh.faces)[0])
        if not np.array_equal(oriented, mesh.faces):
            mesh.faces = oriented
            mesh.notes.append("neighbouring faces were oriented alike")
        across = faces_across(mesh.faces)
    return across


IDENTITY = np.eye(4)
# Faces right behind which the winding number tells whether a mesh intersects itself: it is 1 on a
# sound one, and 2 or 0 in another part of it.
PROBES = 2000
BEHIND = 1e-6  # of the mesh's box


class BoneSDF:
    """Exact signed distance to one bone, negative inside; build it with :meth:`from_mesh`.

    It stays in bone coordinates; questions take the bone's pose.

    Attributes
    ----------
    vertices, faces : (n, 3) and (m, 3) ndarray
        The mesh as used: numbered by place; degenerate and duplicate faces and inner shells left
        out.
    bounds : (2, 3) ndarray
        Box of the mesh, bone coordinates.
    closed : bool
        Whether the sign comes from the mesh itself (else from winding numbers).
    notes : tuple of str
        What was found about the mesh.

    Examples
    --------
    >>> import trimesh
    >>> ball = trimesh.creation.icosphere(4, 10.0)
    >>> field = BoneSDF.from_mesh(ball)
    >>> field.distance([[0.0, 0.0, 12.0], [0.0, 0.0, 9.0]]).round(1).tolist()
    [2.0, -1.0]
    """

    def __init__(self, exact: ExactDistance, arrays: BoneArrays, notes: tuple[str, ...]) -> None:
        self.vertices = exact.vertices
        self.faces = exact.faces
        self.exact = exact
        self.arrays = arrays
        self.notes = notes
        used = self.vertices[np.unique(self.faces)]
        self.bounds = np.array([used.min(axis=0), used.max(axis=0)])

    @property
    def closed(self) -> bool:
        """Whether the sign comes from the mesh itself (else from winding numbers)."""
        return len(self.arrays.dipoles) == 0

    @classmethod
    def from_mesh(cls, mesh: MeshLike, *, name: str = "bone") -> BoneSDF:
        """Prepare the distance to a bone.

        Parameters
        ----------
        mesh : trimesh.Trimesh or pair of (n, 3) vertices and (m, 3) faces
            Rest (bone) coordinates. Meshes that are open or intersect themselves are signed by
            winding numbers, and the log says so.
        name : str
            What messages call the bone.

        Raises
        ------
        MeshError
            If the mesh is unusable.
        """
        vertices, faces = (mesh.vertices, mesh.faces) if hasattr(mesh, "faces") else mesh
        checked = check_mesh(np.asarray(vertices, dtype=np.float64), np.asarray(faces), name=name)
        vertices, faces, solid = outer_surface(*checked)
        if on_one_line(vertices):
            raise MeshError(f"{name} has no face with an area")
        order, faces = numbered_by_place(vertices, faces)
        found = prepare_bone(vertices[order], faces, name=name)
        exact = ExactDistance(found.vertices, found.faces)
        notes = [*solid, *found.notes]
        arrays = bone_arrays(exact, closed=False)
        if found.closed:
            if _intersects_itself(exact, arrays):
                notes.append("intersects itself: the sign comes from winding numbers")
            else:
                arrays = bone_arrays(exact, closed=True)
        for note in notes:
            log.warning("%s: %s", name, note)
        return cls(exact, arrays, tuple(notes))

    def distance(
        self, points: ArrayLike, pose: ArrayLike | None = None, *, reach: ArrayLike = np.inf
    ) -> Floats:
        """Signed distance of points, (n,) [unit of the mesh], negative inside the bone.

        Parameters
        ----------
        points : (n, 3) array_like
            World coordinates if ``pose`` is given, else bone coordinates.
        pose : (4, 4) array_like, optional
            Bone to world, rigid.
        reach : float or (n,) array_like
            Points further away than this may get any lower bound of their distance that is above
            it: much faster.
        """
        return self.distance_and_gradient(points, pose, reach=reach)[0]

    def gradient(
        self, points: ArrayLike, pose: ArrayLike | None = None, *, reach: ArrayLike = np.inf
    ) -> Floats:
        """Unit gradient of the distance, (n, 3), in world axes; parameters as for `distance`."""
        return self.distance_and_gradient(points, pose, reach=reach)[1]

    def distance_and_gradient(
        self,
        points: ArrayLike,
        pose: ArrayLike | None = None,
        *,
        reach: ArrayLike = np.inf,
        memory: Memory | None = None,
    ) -> tuple[Floats, Floats]:
        """Both at once, (n,) and (n, 3), in much less time; parameters as for `distance`.

        On the surface the gradient is the normal of the triangle. It is zero where only a lower
        bound is given. A ``memory`` of the same points saves time where they are asked about again
        and again, and changes no answer.
        """
        points = np.ascontiguousarray(check_points(points))
        pose, count = _check_pose(pose), len(points)
        limit = np.full(count, reach, dtype=np.float64)
        known = Memory.of(count) if memory is None else memory
        distance, gradient = np.empty(count), np.empty((count, 3))

        def work(a: int, b: int) -> None:
            some = (known.anchor[a:b], known.bound[a:b], known.triangle[a:b])
            out = (distance[a:b], gradient[a:b])
            distance_loop(self.arrays, pose, points[a:b], limit[a:b], *some, *out)

        in_chunks(count, work)
        return distance, gradient


def _check_pose(pose: ArrayLike | None) -> Floats:
    if pose is None:
        return IDENTITY
    pose = np.ascontiguousarray(pose, dtype=np.float64)
    if pose.shape != (4, 4) or not np.isfinite(pose).all():
        raise ValueError(f"pose must be a finite (4, 4) transform, got shape {pose.shape}")
    return pose


def _intersects_itself(exact: ExactDistance, arrays: BoneArrays) -> bool:
    """Whether faces of a closed mesh, spread over it, lie inside or outside another part of it."""
    some = exact.order[:: max(1, len(exact.order) // PROBES)]
    corners = exact.vertices[exact.faces[some]]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    behind = corners.mean(axis=1) - BEHIND * box_size(exact.vertices) * unit(normal)
    winding = np.empty(len(behind))
    winding_loop(arrays, behind, winding)
    return bool((np.abs(winding - 1.0) > 0.3).any())
