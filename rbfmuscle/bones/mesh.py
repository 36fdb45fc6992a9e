"""What a bone's mesh allows: which triangles count, and where the sign of the distance comes
from.
"""

from dataclasses import dataclass, field

import numpy as np

from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.geometry.exact_distance import faces_across
from rbfmuscle.geometry.surfaces import mesh_volume
from rbfmuscle.validation import MeshError, check_mesh

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


def points_near(
    vertices: Floats, faces: Integers, count: int, width: float, *, seed: int = 0
) -> Floats:
    """Random points (count, 3) up to ``width`` from the surface, along the faces' normals."""
    rng = np.random.default_rng(seed)
    corners = vertices[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(normal, axis=1)
    face = rng.choice(len(area), count, p=area / area.sum())
    points = np.einsum("nk,nkj->nj", rng.dirichlet(np.ones(3), count), corners[face])
    return points + rng.uniform(-width, width, (count, 1)) * (normal[face] / area[face, None])


def mean_edge(vertices: Floats, faces: Integers) -> float:
    """Mean length of the sides of triangles."""
    corners = vertices[faces]
    return float(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).mean())
