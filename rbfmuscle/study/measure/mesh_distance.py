"""Exact signed distance to a closed triangle mesh, by libigl's tree and angle-weighted pseudonormals."""

import numpy as np

from rbfmuscle.compiled.loop import compiled
from rbfmuscle.validation import check_mesh, check_points


class MeshDistance:
    """Exact distance of points to a closed, outward mesh; negative inside.

    The tree is built once and kept, so a bone is prepared once and asked in its own coordinates.

    Parameters
    ----------
    vertices : (n, 3) array_like
        [scene unit]
    faces : (m, 3) array_like of int
    closed : bool
        False for a mesh with holes.
    whole : (k, 3) array_like of int, optional
        All faces of the mesh, where ``faces`` are those of a part of it that surrounds the closest points.

    Notes
    -----
    The sign comes from the pseudonormal of the feature (face, edge or vertex) that holds the closest point
    (Baerentzen and Aanaes 2005), which is exact for closed, consistently oriented meshes. Where that normal
    is nearly square to the way to the point, as at a sliver folded on itself, and for meshes with holes, the
    winding number decides (Jacobson et al. 2013; Barill et al. 2018): inside where it exceeds one half.
    """

    def __init__(self, vertices, faces, *, closed=True, whole=None):
        import igl

        self.closed = closed

        self.vertices, self.faces = check_mesh(vertices, faces)
        self._tree = igl.AABB()
        self._tree.init(self.vertices, self.faces)
        self._whole = self.faces if whole is None else whole
        self._normals = None

    def unsigned(self, points):
        """Distance to the surface.

        Parameters
        ----------
        points : (n, 3) array_like

        Returns
        -------
        (n,) ndarray
            [scene unit]
        """
        points = check_points(points)
        if len(points) == 0:
            return np.zeros(0)
        return np.sqrt(self._tree.squared_distance(self.vertices, self.faces, points)[0])

    def signed(self, points):
        """Distance to the surface, negative inside.

        Parameters
        ----------
        points : (n, 3) array_like

        Returns
        -------
        (n,) ndarray
            [scene unit]
        """
        points = check_points(points)
        if len(points) == 0:
            return np.zeros(0)
        if not self.closed:
            import igl

            inside = igl.fast_winding_number(self.vertices, self._whole, points) > 0.5
            return np.where(inside, -1.0, 1.0) * self.unsigned(points)
        if self._normals is None:
            self._normals = pseudonormals(self.vertices, self.faces)
        squared, nearest, closest = self._tree.squared_distance(self.vertices, self.faces, points)
        out, unsure = np.sqrt(squared), np.zeros(len(points), dtype=np.bool_)
        nearest, closest = np.ascontiguousarray(nearest, dtype=np.int64), np.ascontiguousarray(closest)
        _sign_loop(points, nearest, closest, self.vertices, self.faces, *self._normals, out, unsure)
        for n in np.flatnonzero(unsure):
            inside = _winding_loop(points[n], self.vertices, self._whole) > 0.5
            out[n] = -abs(out[n]) if inside else abs(out[n])
        return out

    def depth(self, points):
        """How deep points lie inside, 0 where outside.

        The deepest point is looked at again with the winding number, until one is inside for certain: where a
        mesh is folded on itself a sign can be wrong, and one wrong sign would decide the greatest depth.

        Parameters
        ----------
        points : (n, 3) array_like

        Returns
        -------
        (n,) ndarray
            [scene unit]
        """
        points = check_points(points)
        depth = np.maximum(-self.signed(points), 0.0)
        while depth.any():
            deepest = int(depth.argmax())
            if _winding_loop(points[deepest], self.vertices, self._whole) > 0.5:
                break
            depth[deepest] = 0.0
        return depth


def pseudonormals(vertices, faces):
    """Normals of faces, edges and vertices for the sign of a distance.

    Parameters
    ----------
    vertices : (n, 3) ndarray
    faces : (m, 3) ndarray of int

    Returns
    -------
    face : (m, 3) ndarray
        Unit normals (zero where the face has no area).
    edge : (m, 3, 3) ndarray
        ``edge[f, k]`` belongs to the edge opposite corner k: the sum of the normals of its faces.
    vertex : (n, 3) ndarray
        Normals of the faces around, weighted by their angles.
    """
    corner = vertices[faces]
    face = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    length = np.linalg.norm(face, axis=1, keepdims=True)
    face = np.divide(face, length, out=np.zeros_like(face), where=length > 0)
    vertex = np.zeros_like(vertices)
    for k in range(3):
        u, v = corner[:, (k + 1) % 3] - corner[:, k], corner[:, (k + 2) % 3] - corner[:, k]
        angle = np.arctan2(np.linalg.norm(np.cross(u, v), axis=1), np.einsum("ij,ij->i", u, v))
        for axis in range(3):
            vertex[:, axis] += np.bincount(faces[:, k], angle * face[:, axis], minlength=len(vertices))
    ends = np.sort(np.stack([faces[:, [1, 2]], faces[:, [2, 0]], faces[:, [0, 1]]], axis=1), axis=2)
    key = (ends[..., 0] * len(vertices) + ends[..., 1]).ravel()
    _, label = np.unique(key, return_inverse=True)
    owner = np.repeat(face, 3, axis=0)
    total = np.stack([np.bincount(label, owner[:, axis]) for axis in range(3)], axis=1)
    return face, np.ascontiguousarray(total[label].reshape(-1, 3, 3)), vertex


@compiled
def _sign_loop(
    points, nearest, closest, vertices, faces, face_normal, edge_normal, vertex_normal, out, unsure
):
    weight = np.empty(3)
    for n in range(len(points)):
        f = nearest[n]
        # Barycentric coordinates as ratios of areas; below this share the closest point is on the edge.
        for k in range(3):
            p, q = vertices[faces[f, (k + 1) % 3]], vertices[faces[f, (k + 2) % 3]]
            cross = np.cross(p - closest[n], q - closest[n])
            weight[k] = np.sqrt(cross[0] ** 2 + cross[1] ** 2 + cross[2] ** 2)
        total = weight[0] + weight[1] + weight[2]
        zeros, last_zero, largest = 0, 0, 0
        for k in range(3):
            if weight[k] <= 1e-7 * total:
                zeros += 1
                last_zero = k
            if weight[k] > weight[largest]:
                largest = k
        if zeros == 0:
            normal = face_normal[f]
        elif zeros == 1:
            normal = edge_normal[f, last_zero]
        else:
            normal = vertex_normal[faces[f, largest]]
        side = 0.0
        for k in range(3):
            side += (points[n, k] - closest[n, k]) * normal[k]
        unsure[n] = zeros > 0 and abs(side) < 0.1 * out[n]
        if side < 0.0:
            out[n] = -out[n]


@compiled
def _winding_loop(point, vertices, faces):
    """Winding number of a mesh about one point, by solid angles of triangles (van Oosterom 1983)."""
    total = 0.0
    for f in range(len(faces)):
        a, b, c = vertices[faces[f, 0]], vertices[faces[f, 1]], vertices[faces[f, 2]]
        ax, ay, az = a[0] - point[0], a[1] - point[1], a[2] - point[2]
        bx, by, bz = b[0] - point[0], b[1] - point[1], b[2] - point[2]
        cx, cy, cz = c[0] - point[0], c[1] - point[1], c[2] - point[2]
        p = np.sqrt(ax * ax + ay * ay + az * az)
        q = np.sqrt(bx * bx + by * by + bz * bz)
        r = np.sqrt(cx * cx + cy * cy + cz * cz)
        triple = ax * (by * cz - bz * cy) + ay * (bz * cx - bx * cz) + az * (bx * cy - by * cx)
        below = p * q * r + (ax * bx + ay * by + az * bz) * r
        below += (bx * cx + by * cy + bz * cz) * p + (cx * ax + cy * ay + cz * az) * q
        total += np.arctan2(triple, below)
    return total / (2.0 * np.pi)
