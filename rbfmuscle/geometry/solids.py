"""The outer surface of a rigid body whose mesh has several shells.

For contact a body is solid: the union of its parts, whatever the winding of each. Shells inside
another, as the wall of a marrow cavity, bound nothing; parts that go through each other are
joined; parts beside each other stay.
"""

from collections.abc import Callable
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from rbfmuscle.geometry.arrays import Booleans, Floats, Integers
from rbfmuscle.geometry.exact_distance import faces_across
from rbfmuscle.geometry.mesh_distance import MeshDistance, inside_test
from rbfmuscle.geometry.surfaces import repeated_faces, sorted_half_edges

# Parts whose union has less volume than they have together, by more than this share, overlap.
LEAST_OVERLAP = 1e-9
# Winding number from which on a face is inside a shell; it is 1/2 on it, as of faces in two shells.
INSIDE = 0.6
# Volume below this share of area^1.5 (0.094 for a ball) gives a shell no outside.
SHEET = 1e-3


class SolidDistance(MeshDistance):
    """Exact distance to the outer surface of a body, negative everywhere inside it.

    What a bone's distances at rest, its field and its metrics have in common. The mesh (vertices
    (n, 3) [scene unit], faces (m, 3)) may have holes and several shells.

    Examples
    --------
    >>> import trimesh
    >>> shells = [trimesh.creation.icosphere(4, 20.0), trimesh.creation.icosphere(4, 12.0)]
    >>> bone = trimesh.util.concatenate(shells)
    >>> SolidDistance(bone.vertices, bone.faces).signed([[0.0, 0.0, 0.0]]).round(1).tolist()
    [-20.0]
    """

    def __init__(self, vertices: ArrayLike, faces: ArrayLike) -> None:
        vertices, faces, _ = outer_surface(np.asarray(vertices, np.float64), np.asarray(faces))
        faces = _outward(vertices, faces)
        super().__init__(vertices, faces, closed=bool((faces_across(faces) >= 0).all()))


def outer_surface(vertices: Floats, faces: Integers) -> tuple[Floats, Integers, list[str]]:
    """Return vertices (n, 3) and outward faces (m, 3) of the boundary of the union of a mesh's
    shells, and what was done for it.

    Shells inside another are left out. Closed ones that go through each other are replaced by their
    union, whose vertices are put behind the given ones (n, 3); where they are open, faces inside
    another shell are left out. A mesh of one shell is returned as it is.
    """
    given = faces = np.ascontiguousarray(faces, dtype=np.int64)
    number, whole = label_shells(faces)
    if not whole:  # vertices at one place are one, whatever their numbers
        rows = np.ascontiguousarray(vertices + 0.0).view("V24").ravel()  # 0.0 is -0.0
        _, first, same = np.unique(rows, return_index=True, return_inverse=True)
        faces = first[same][faces]
        faces = faces[~repeated_faces(faces)]
        number, _ = label_shells(faces)
    if number.max(initial=0) == 0:
        return vertices, given, []
    count = int(number.max()) + 1
    order = np.argsort(number, kind="stable")
    parts = [faces[k] for k in np.split(order, np.cumsum(np.bincount(number))[:-1])]
    shells = [_Shell(vertices, _outward(vertices, part)) for part in parts]
    outer = [shell for shell in shells if not any(shell.lies_in(other) for other in shells)]
    notes = []
    if len(outer) < count:
        inner = count - len(outer)
        ignored = "the inner one is" if inner == 1 else f"the {inner} inner ones are"
        nested = "nested shells" if len(outer) == 1 else "shells"
        notes.append(f"{count} {nested}, {ignored} ignored: the inside counts as solid")
    bounds = []
    meet = np.array([[one.meets(other) for other in outer] for one in outer])
    group = connected_components(meet, directed=False)[1]
    for k in range(group.max() + 1):
        members = [outer[m] for m in np.flatnonzero(group == k)]
        vertices, joined = _join(vertices, members, notes)
        bounds.append(joined)
    return vertices, np.ascontiguousarray(np.concatenate(bounds)), notes


def label_shells(faces: Integers) -> tuple[Integers, bool]:
    """Number of the shell (m,) of each face, and whether each edge has two faces.

    Shells are connected by edges of exactly two faces: those that touch along an edge are two.
    """
    order, first, size = sorted_half_edges(faces)
    pair = first[size == 2]
    ends = (order[pair] // 3, order[pair + 1] // 3)
    links = coo_matrix((np.ones(len(pair)), ends), shape=(len(faces), len(faces)))
    return connected_components(links, directed=False)[1], bool((size == 2).all())


def _outward(vertices: Floats, faces: Integers) -> Integers:
    """Faces of one shell that agree and look outward; a sheet that holds no volume stays as it
    is.
    """
    import igl

    if (faces_across(faces) == -2).any():
        faces = np.ascontiguousarray(igl.bfs_orient(faces)[0])
    middle = vertices[np.unique(faces)].mean(axis=0)
    a, b, c = (vertices[faces[:, k]] - middle for k in range(3))
    area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()
    volume = np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6.0
    return faces[:, ::-1] if volume < -SHEET * area**1.5 else faces


class _Shell:
    """One shell of a mesh, outward."""

    def __init__(self, vertices: Floats, faces: Integers) -> None:
        self.vertices = vertices
        self.faces = np.ascontiguousarray(faces)
        corners = vertices[self.faces]
        self.middles = corners.mean(axis=1)
        self.box = np.array([corners.min(axis=(0, 1)), corners.max(axis=(0, 1))])

    @cached_property
    def inside(self) -> Callable[[Floats], Booleans]:
        """The test for points (n, 3)."""
        return inside_test(self.vertices, self.faces, least=INSIDE)

    def lies_in(self, other: "_Shell") -> bool:
        """Whether all of it is inside another shell."""
        if (
            other is self
            or (self.box[0] < other.box[0]).any()
            or (self.box[1] > other.box[1]).any()
        ):
            return False
        return bool(other.inside(self.middles).all())

    def meets(self, other: "_Shell") -> bool:
        """Whether the boxes meet."""
        return bool((self.box[0] <= other.box[1]).all() and (other.box[0] <= self.box[1]).all())


def _join(vertices: Floats, shells: list[_Shell], notes: list[str]) -> tuple[Floats, Integers]:
    """Vertices and the faces of a group of shells without what is inside any of them."""
    faces = [shell.faces for shell in shells]
    if len(shells) == 1:
        return vertices, faces[0]
    union = _union(shells)
    if union is None:
        kept = [
            ~np.any([other.inside(shell.middles) for other in shells if other is not shell], axis=0)
            for shell in shells
        ]
        lost = sum(int((~each).sum()) for each in kept)
        if lost:
            notes.append(f"{lost} faces inside another part left out: the inside counts as solid")
        return vertices, np.concatenate([part[each] for part, each in zip(faces, kept)])
    points, joined = union
    if len(points) == 0:
        return vertices, np.concatenate(faces)
    notes.append(f"{len(shells)} parts overlap, joined: their union counts")
    return np.vstack([vertices, points]), joined + len(vertices)


def _union(shells: list[_Shell]) -> tuple[Floats, Integers] | None:
    """Vertices and faces of the union of closed shells; none where they do not overlap, None where
    one is open.
    """
    from manifold3d import Error, Manifold, Mesh64, OpType

    solids = []
    for shell in shells:
        used, numbers = np.unique(shell.faces, return_inverse=True)
        corners = numbers.reshape(-1, 3).astype(np.uint64)
        # Each face is of its own: flat places stay divided as they are.
        face = np.arange(len(corners), dtype=np.uint64)
        solids.append(Manifold(Mesh64(shell.vertices[used], corners, face_id=face)))
    if any(solid.status() != Error.NoError for solid in solids):
        return None
    together = sum(solid.volume() for solid in solids)
    union = Manifold.batch_boolean(solids, OpType.Add)
    if together - union.volume() <= LEAST_OVERLAP * together:
        return np.empty((0, 3)), np.empty((0, 3), dtype=np.int64)
    mesh = union.to_mesh64()
    return np.array(mesh.vert_properties[:, :3]), np.array(mesh.tri_verts, dtype=np.int64)
