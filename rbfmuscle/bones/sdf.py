"""BoneSDF: signed distance and gradient of a rigid bone, in any pose, and what its mesh allows:
which triangles count, and where the sign of the distance comes from.
"""

from __future__ import annotations

import logging

import numpy as np
from numpy.typing import ArrayLike

from rbfmuscle.bones.distance import BoneArrays, Memory, bone_arrays, distances, winding_loop
from rbfmuscle.geometry.arrays import Floats, Integers, MeshLike, box_size, unit
from rbfmuscle.geometry.exact_distance import ExactDistance, faces_across
from rbfmuscle.geometry.frames import numbered_by_place, on_one_line
from rbfmuscle.geometry.solids import outer_surface
from rbfmuscle.geometry.surfaces import mesh_volume
from rbfmuscle.validation import MeshError, check_mesh, check_points

log = logging.getLogger(__name__)

# Area below this share of the squared longest edge is rounding.
LEAST_SHAPE = 1e-12


def prepare_bone(
    vertices: Floats, faces: Integers, *, name: str = "bone"
) -> tuple[Integers, bool, list[str]]:
    """Faces for a distance field: none degenerate or double, outward as far as can be told; whether
    each of their edges has one face on each side; and what was found and done, for the log.

    Closed meshes are taken as they are. Of others equal vertices are merged, and patches oriented
    alike. Raises MeshError on NaN, indices out of range, an empty mesh, or one whose faces all have
    no area.
    """
    vertices, faces = check_mesh(vertices, faces, name=name)
    notes: list[str] = []
    faces = _with_area(vertices, faces, notes)
    if len(faces) == 0:
        raise MeshError(f"{name} has no face with an area")
    if notes or (faces_across(faces) < 0).any():
        faces = _mended(vertices, faces, notes)
    count = int((faces_across(faces) < 0).sum())
    if count:
        notes.append(f"not closed ({count} open edges): the sign comes from winding numbers")
    if mesh_volume(vertices, faces) < 0.0:
        faces = np.ascontiguousarray(faces[:, ::-1])
        notes.append("faces pointed inward and were turned")
    return faces, count == 0, notes


def _with_area(vertices: Floats, faces: Integers, notes: list[str]) -> Integers:
    """The faces that have an area; adds a note where others are left out."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    longest = np.maximum.reduce([((q - p) ** 2).sum(axis=1) for p, q in ((a, b), (b, c), (c, a))])
    flat = area <= LEAST_SHAPE * longest
    if not flat.any():
        return faces
    notes.append(f"{int(flat.sum())} faces without area left out")
    return np.ascontiguousarray(faces[~flat])


def _mended(vertices: Floats, faces: Integers, notes: list[str]) -> Integers:
    """Faces with equal vertices merged, without duplicates, in patches that are oriented alike;
    adds notes of what was done.
    """
    import igl

    _, first, inverse = np.unique(vertices, axis=0, return_index=True, return_inverse=True)
    if len(first) < len(vertices):
        merged = np.ascontiguousarray(first[inverse.reshape(-1)][faces])
        repeated = len(np.unique(faces)) - len(np.unique(merged))
        if repeated:
            notes.append(f"{repeated} repeated vertices merged")
        faces = _with_area(vertices, merged, notes)
    _, kept = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    if len(kept) < len(faces):
        notes.append(f"{len(faces) - len(kept)} duplicate faces left out")
        faces = np.ascontiguousarray(faces[np.sort(kept)])
    if (faces_across(faces) == -2).any():
        oriented = np.ascontiguousarray(igl.bfs_orient(faces)[0])
        if not np.array_equal(oriented, faces):
            notes.append("neighbouring faces were oriented alike")
        faces = oriented
    return faces


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
        faces, closed, found = prepare_bone(vertices[order], faces, name=name)
        exact = ExactDistance(vertices[order], faces)
        notes = [*solid, *found]
        arrays = bone_arrays(exact, closed=False)
        if closed:
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
        points = check_points(points)
        pose = IDENTITY if pose is None else np.ascontiguousarray(pose, dtype=np.float64)
        if pose.shape != (4, 4) or not np.isfinite(pose).all():
            raise ValueError(f"pose must be a finite (4, 4) transform, got shape {pose.shape}")
        limit = np.full(len(points), reach, dtype=np.float64)
        known = Memory.of(len(points)) if memory is None else memory
        return distances(self.arrays, pose, points, limit, known)


def _intersects_itself(exact: ExactDistance, arrays: BoneArrays) -> bool:
    """Whether faces of a closed mesh, spread over it, lie inside or outside another part of it."""
    some = exact.tree.order[:: max(1, len(exact.faces) // PROBES)]
    corners = exact.vertices[exact.faces[some]]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    behind = corners.mean(axis=1) - BEHIND * box_size(exact.vertices) * unit(normal)
    winding = np.empty(len(behind))
    winding_loop(arrays, behind, winding)
    return bool((np.abs(winding - 1.0) > 0.3).any())
