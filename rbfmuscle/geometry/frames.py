"""Vectors of three numbers and rotations as unit quaternions (w, x, y, z), for compiled loops;
boxes, and coordinates of a rest mesh that stay the same wherever its scene lies.
"""

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.loops import loop


def turned_quaternions(quaternions: Floats, rotation: Floats) -> Floats:
    """Unit quaternions (n, 4), each followed by a rotation (3, 3)."""
    before = Rotation.from_quat(np.roll(quaternions, -1, axis=1))  # SciPy has w last
    turned = Rotation.from_matrix(rotation) * before
    return np.roll(turned.as_quat(), 1, axis=1)


@loop
def quaternion_matrix(q):
    """Rows of the rotation matrix of a unit quaternion, as three tuples."""
    w = q[0]
    x = q[1]
    y = q[2]
    z = q[3]
    return (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )


@loop
def rotate(q, v):
    """Rotate a vector by a unit quaternion; returns three numbers."""
    tx = 2.0 * (q[2] * v[2] - q[3] * v[1])
    ty = 2.0 * (q[3] * v[0] - q[1] * v[2])
    tz = 2.0 * (q[1] * v[1] - q[2] * v[0])
    return (
        v[0] + q[0] * tx + q[2] * tz - q[3] * ty,
        v[1] + q[0] * ty + q[3] * tx - q[1] * tz,
        v[2] + q[0] * tz + q[1] * ty - q[2] * tx,
    )


@loop
def dot(u, v):
    """Product of two vectors of three numbers."""
    return u[0] * v[0] + u[1] * v[1] + u[2] * v[2]


@loop
def cross(u, v):
    """Vector product of two vectors of three numbers."""
    return u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]


@loop
def minus(u, v):
    """Difference of two vectors of three numbers."""
    return u[0] - v[0], u[1] - v[1], u[2] - v[2]


@loop
def plus(u, v):
    """Sum of two vectors of three numbers."""
    return u[0] + v[0], u[1] + v[1], u[2] + v[2]


@loop
def divided(u, number):
    """A vector of three numbers, divided by a number."""
    return u[0] / number, u[1] / number, u[2] / number


@loop
def row_of(rows, k):
    """Row k of an array (n, 3), as three numbers."""
    return rows[k, 0], rows[k, 1], rows[k, 2]


@loop
def local_point(pose, point):
    """A point of three numbers, in world coordinates, as a pose (4, 4) sees it."""
    way = minus(point, (pose[0, 3], pose[1, 3], pose[2, 3]))
    return (
        dot((pose[0, 0], pose[1, 0], pose[2, 0]), way),
        dot((pose[0, 1], pose[1, 1], pose[2, 1]), way),
        dot((pose[0, 2], pose[1, 2], pose[2, 2]), way),
    )


@loop
def turned(pose, vector):
    """A vector of three numbers, turned by a pose (4, 4)."""
    return dot(row_of(pose, 0), vector), dot(row_of(pose, 1), vector), dot(row_of(pose, 2), vector)


@loop
def turn_towards(m, q):
    """The unit quaternion q a step nearer to the rotational part of a matrix m, given as rows.

    The torque that aligns R with m is the skew part of P = m Rᵀ, and tr(P) I - P its change with
    the angle, so a step is one of Newton's method. Where that is not positive definite, as far from
    the solution, it is that of Müller et al. (2016). No step turns by more than a radian.
    """
    r = quaternion_matrix(q)
    p00 = dot(m[0], r[0])
    p11 = dot(m[1], r[1])
    p22 = dot(m[2], r[2])
    p01 = dot(m[0], r[1])
    p10 = dot(m[1], r[0])
    p02 = dot(m[0], r[2])
    p20 = dot(m[2], r[0])
    p12 = dot(m[1], r[2])
    p21 = dot(m[2], r[1])
    x = p21 - p12
    y = p02 - p20
    z = p10 - p01
    a = p11 + p22
    b = p00 + p22
    c = p00 + p11
    d = -0.5 * (p01 + p10)
    e = -0.5 * (p02 + p20)
    f = -0.5 * (p12 + p21)
    # The adjugate of the symmetric matrix with a, b, c on its diagonal and d, e, f beside it.
    aa = b * c - f * f
    bb = a * c - e * e
    cc = a * b - d * d
    ab = e * f - d * c
    ac = d * f - b * e
    bc = d * e - a * f
    det = a * aa + d * ab + e * ac
    newton = (a > 0.0) & (cc > 0.0) & (det > 1e-9 * (a + b + c) ** 3)
    share = 1.0 / (det if newton else abs(p00 + p11 + p22) + 1e-12)
    u = share * (aa * x + ab * y + ac * z if newton else x)
    v = share * (ab * x + bb * y + bc * z if newton else y)
    w = share * (ac * x + bc * y + cc * z if newton else z)
    half = 0.5 / np.sqrt(max(u * u + v * v + w * w, 1.0))
    return _turned(q, half * u, half * v, half * w)


@loop
def _turned(q, u, v, w):
    """Unit quaternion q followed by a small rotation, by twice the vector (u, v, w)."""
    a = q[0] - u * q[1] - v * q[2] - w * q[3]
    b = q[1] + u * q[0] + v * q[3] - w * q[2]
    c = q[2] - u * q[3] + v * q[0] + w * q[1]
    d = q[3] + u * q[2] - v * q[1] + w * q[0]
    share = 1.0 / np.sqrt(a * a + b * b + c * c + d * d)
    return share * a, share * b, share * c, share * d


def diameter(points: Floats) -> float:
    """Twice the greatest distance from the mean: a size that does not change when the scene is
    turned.
    """
    return 2.0 * float(np.linalg.norm(points - points.mean(axis=0), axis=1).max())


def box_corners(bounds: ArrayLike) -> Floats:
    """Corners (8, 3) of a box (2, 3)."""
    return np.array(np.meshgrid(*np.transpose(bounds))).reshape(3, -1).T


def moved_box(bounds: Floats, poses: Floats) -> Floats:
    """Boxes (..., 2, 3) along the axes that hold a box (2, 3) after poses (..., 4, 4)."""
    centre, half = 0.5 * (bounds[0] + bounds[1]), 0.5 * (bounds[1] - bounds[0])
    middle = poses[..., :3, :3] @ centre + poses[..., :3, 3]
    reach = np.abs(poses[..., :3, :3]) @ half
    return np.stack([middle - reach, middle + reach], axis=-2)


class RestFrame:
    """Coordinates of a rest mesh that do not change when the scene is moved, turned or written in
    another unit.

    Sampling and binding choose between points; two that are equally good must not be told apart by
    rounding, or a moved scene would get other centres. Here they see the same numbers, ``local``
    (n, 3), wherever the scene lies: vertices in a frame spanned by those farthest from their mean
    and from the line to it, in units of the mesh's size, rounded to 1e-8. The frame is that of any
    numbering of the vertices, but for meshes so symmetric that several lie equally far.
    """

    def __init__(self, vertices: Floats) -> None:
        self.origin = vertices.mean(axis=0)
        offset = vertices - self.origin
        distance = np.linalg.norm(offset, axis=1)
        self.size = float(distance.max())
        first = offset[_farthest(distance)]
        first = first / np.linalg.norm(first)
        across = offset - (offset @ first)[:, None] * first
        span = np.linalg.norm(across, axis=1)
        second = across[_farthest(span)]
        second = second / np.linalg.norm(second)
        self.axes = np.array([first, second, np.cross(first, second)])
        self.local = np.round(offset @ self.axes.T / self.size, 8) + 0.0  # no zero has a sign

    def points(self, local: Floats) -> Floats:
        """World positions of local points."""
        return local @ self.axes * self.size + self.origin

    def corners(self, chosen: Integers) -> Floats:
        """World corners (8, 3) of the box about some of the vertices, along the frame's axes."""
        some = self.local[chosen]
        return self.points(box_corners([some.min(axis=0), some.max(axis=0)]))

    def directions(self, local: Floats) -> Floats:
        """World directions of local ones."""
        return local @ self.axes


def _farthest(distance: Floats) -> int:
    """The greatest of some distances; of those that are equal but for rounding the first."""
    return int(np.argmax(distance >= (1.0 - 1e-9) * distance.max()))


def numbered_by_place(vertices: Floats, faces: Integers) -> tuple[Integers, Integers]:
    """Order (n,) of a mesh's vertices that follows from where they lie, and its faces (m, 3) in it.

    It is the same wherever the scene lies and however the mesh was numbered, but for symmetric
    meshes (see `RestFrame`) and vertices at one place.
    """
    order = np.lexsort(RestFrame(vertices).local.T)
    renumbered = np.argsort(order)[faces]
    first = renumbered.argmin(axis=1)[:, None]
    renumbered = np.take_along_axis(renumbered, (first + np.arange(3)) % 3, axis=1)
    return order, renumbered[np.lexsort(renumbered.T[::-1])]


def on_one_line(vertices: Floats) -> bool:
    """Whether all vertices coincide or lie on one line, so that they span no frame."""
    offset = vertices - vertices.mean(axis=0)
    sizes = np.linalg.svd(offset, full_matrices=False, compute_uv=False)
    return bool(sizes[1] <= 1e-12 * max(sizes[0], 1e-300))


def principal_axes(points: Floats) -> Floats:
    """Right-handed principal axes of points (n, 3) as rows, that of the largest extent first."""
    axes = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2]
    axes[2] *= np.sign(np.linalg.det(axes))
    return np.asarray(axes)
