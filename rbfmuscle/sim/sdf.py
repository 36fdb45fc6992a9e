"""BoneSDF: signed distance and gradient of a rigid bone, in any pose.

The field is a tricubic B-spline over exact distances; it stays in bone coordinates and is never rebuilt. Only
this module converts a foreign sign: distances are negative inside.
"""

import numba
import numpy as np

from rbfmuscle.validation import MeshError, check_mesh, check_points

IDENTITY = np.eye(4)


class BoneSDF:
    """Distance field of one bone; build it with :meth:`from_mesh`."""

    def __init__(self, vertices, faces, origin, spacing, coefficients):
        self.vertices = vertices
        self.faces = faces
        self.origin = origin
        self.spacing = spacing
        self.coefficients = coefficients
        self.bounds = np.array([vertices.min(axis=0), vertices.max(axis=0)])
        self.closed = True

    @property
    def memory(self):
        """Bytes held by the field."""
        return self.coefficients.nbytes

    @classmethod
    def from_mesh(cls, mesh, *, tolerance=None, region=None, cache=True):
        """Build the field of a closed mesh (a trimesh.Trimesh or a pair of vertices and faces)."""
        import igl
        from scipy.ndimage import spline_filter

        vertices, faces = (mesh.vertices, mesh.faces) if hasattr(mesh, "faces") else mesh
        vertices, faces = check_mesh(np.asarray(vertices), np.asarray(faces), name="bone")
        low, high = vertices.min(axis=0), vertices.max(axis=0)
        extent = float((high - low).max())
        if extent == 0.0:
            raise MeshError("bone has no extent")
        spacing = (np.prod(high - low + 0.1 * extent) / 4e5) ** (1 / 3)
        pad = 0.05 * extent + 2 * spacing
        origin = low - pad
        shape = np.ceil((high - low + 2 * pad) / spacing).astype(int) + 1
        axes = [origin[k] + spacing * np.arange(shape[k]) for k in range(3)]
        nodes = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        exact = igl.signed_distance(nodes, vertices, faces, igl.SIGNED_DISTANCE_TYPE_PSEUDONORMAL)[0]
        coefficients = spline_filter(exact.reshape(shape), order=3, mode="mirror")
        return cls(vertices, faces, origin, spacing, np.ascontiguousarray(coefficients))

    def distance(self, points, pose=None):
        """Signed distance of points, (n,) [unit of the mesh], negative inside the bone.

        Parameters
        ----------
        points : (n, 3) array_like
            World coordinates if ``pose`` is given, else bone coordinates.
        pose : (4, 4) array_like, optional
            Bone to world.
        """
        return self.distance_and_gradient(points, pose)[0]

    def gradient(self, points, pose=None):
        """Gradient of the distance, (n, 3), in the axes of ``points``."""
        return self.distance_and_gradient(points, pose)[1]

    def distance_and_gradient(self, points, pose=None, reach=None):
        """Signed distance (n,) and its gradient (n, 3), from the same functions."""
        points = check_points(points)
        pose = IDENTITY if pose is None else np.ascontiguousarray(pose, dtype=np.float64)
        distance, gradient = np.empty(len(points)), np.empty((len(points), 3))
        _evaluate_loop(points, pose, self.origin, self.spacing, self.coefficients, distance, gradient)
        return distance, gradient

    def direction(self, points, pose=None):
        """Unit direction (n, 3) in which the distance grows."""
        gradient = self.gradient(points, pose)
        return gradient / np.maximum(np.linalg.norm(gradient, axis=1, keepdims=True), 1e-300)

    def closest_point(self, points, pose=None):
        """Closest point (n, 3) of the bone's surface."""
        points = check_points(points)
        for _ in range(3):
            distance, gradient = self.distance_and_gradient(points, pose)
            square = np.maximum((gradient * gradient).sum(axis=1), 0.25)
            points = points - (distance / square)[:, None] * gradient
        return points


@numba.njit(cache=True, nogil=True)
def _evaluate_loop(points, pose, origin, spacing, coefficients, distance, gradient):
    weight, slope = np.empty((3, 4)), np.empty((3, 4))
    base, local, inside, grad = np.empty(3, np.int64), np.empty(3), np.empty(3), np.empty(3)
    for n in range(len(points)):
        for k in range(3):
            local[k] = 0.0
            for j in range(3):
                local[k] += pose[j, k] * (points[n, j] - pose[j, 3])
            high = origin[k] + spacing * (coefficients.shape[k] - 1.001)
            inside[k] = min(max(local[k], origin[k] + 0.001 * spacing), high)
            u = (inside[k] - origin[k]) / spacing
            base[k] = int(u)
            _weights(u - base[k], spacing, weight[k], slope[k])
        value = _sum(coefficients, base, weight, slope, grad)
        beyond = 0.0
        for k in range(3):
            beyond += (local[k] - inside[k]) ** 2
        if beyond > 0.0:
            # Outside the grid: the closest surface point of the nearest grid point is kept.
            square = 0.0
            for k in range(3):
                grad[k] = local[k] - inside[k] + value * grad[k]
                square += grad[k] ** 2
            value = np.sqrt(square)
            for k in range(3):
                grad[k] /= value
        distance[n] = value
        for k in range(3):
            gradient[n, k] = pose[k, 0] * grad[0] + pose[k, 1] * grad[1] + pose[k, 2] * grad[2]


@numba.njit(cache=True, nogil=True)
def _weights(t, spacing, weight, slope):
    s = 1.0 - t
    weight[0] = s * s * s / 6.0
    weight[1] = (4.0 - 6.0 * t * t + 3.0 * t * t * t) / 6.0
    weight[2] = (4.0 - 6.0 * s * s + 3.0 * s * s * s) / 6.0
    weight[3] = t * t * t / 6.0
    slope[0] = -0.5 * s * s / spacing
    slope[1] = (1.5 * t * t - 2.0 * t) / spacing
    slope[2] = (2.0 * s - 1.5 * s * s) / spacing
    slope[3] = 0.5 * t * t / spacing


@numba.njit(cache=True, nogil=True)
def _sum(coefficients, base, weight, slope, grad):
    value, grad[:] = 0.0, 0.0
    nx, ny, nz = coefficients.shape
    for a in range(4):
        i = abs(base[0] + a - 1)
        i = i if i < nx else 2 * nx - 2 - i
        for b in range(4):
            j = abs(base[1] + b - 1)
            j = j if j < ny else 2 * ny - 2 - j
            line, lean = 0.0, 0.0
            for c in range(4):
                k = abs(base[2] + c - 1)
                k = k if k < nz else 2 * nz - 2 - k
                line += weight[2, c] * coefficients[i, j, k]
                lean += slope[2, c] * coefficients[i, j, k]
            value += weight[0, a] * weight[1, b] * line
            grad[0] += slope[0, a] * weight[1, b] * line
            grad[1] += weight[0, a] * slope[1, b] * line
            grad[2] += weight[0, a] * weight[1, b] * lean
    return value
