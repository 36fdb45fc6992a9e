"""Coordinates of a rest mesh that stay the same wherever its scene lies."""

from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from rbfmuscle.geometry.arrays import Floats, Integers


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


def _certain_axes(points: Floats) -> Floats:
    """Right-handed principal axes as rows; the axes themselves where rounding would choose between
    others.
    """
    _, sizes, axes = np.linalg.svd(points, full_matrices=False)
    if np.diff(sizes).max() > -0.02 * sizes[0]:
        return np.eye(3)
    axes[2] *= np.sign(np.linalg.det(axes))
    return axes


def principal_axes(points: Floats) -> Floats:
    """Right-handed principal axes of points (n, 3) as rows, that of the largest extent first."""
    axes = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2]
    axes[2] *= np.sign(np.linalg.det(axes))
    return np.asarray(axes)


class BoneFrame:
    """The rest frame of a bone, along its principal axes so that a grid in it is small.

    ``axes`` are rows in bone coordinates, ``size`` is the length of a local unit, and ``local`` the
    vertices (n, 3) in these, rounded to 1e-8. They must not all lie on one line.
    """

    def __init__(self, vertices: Floats) -> None:
        frame = RestFrame(vertices)
        # Found in rounded numbers, so that equal moments give the same axes for every pose of the
        # scene.
        turn = _certain_axes(frame.local)
        self.origin = frame.origin
        self.size = frame.size
        self.axes = turn @ frame.axes
        self.local = np.round(frame.local @ turn.T, 8) + 0.0
        self._placed = lru_cache(maxsize=16)(self._place)

    def __getstate__(self) -> dict[str, object]:
        return {name: value for name, value in vars(self).items() if name != "_placed"}

    def __setstate__(self, state: dict[str, object]) -> None:
        vars(self).update(state)
        self._placed = lru_cache(maxsize=16)(self._place)

    def box(self, bounds: ArrayLike) -> Floats:
        """Local box (2, 3) that holds a box given in bone coordinates."""
        local = (box_corners(bounds) - self.origin) @ self.axes.T / self.size
        return np.array([local.min(axis=0), local.max(axis=0)])

    def placed(self, pose: Floats) -> Floats:
        """Transform (4, 4) whose transpose takes world points to local units, for a pose of the
        bone.
        """
        # The same pose is asked for many times a frame.
        return self._placed(pose.tobytes())

    def _place(self, pose: bytes) -> Floats:
        pose, out = np.frombuffer(pose).reshape(4, 4), np.eye(4)
        out[:3, :3] = pose[:3, :3] @ self.axes.T / self.size
        out[:3, 3] = pose[:3, :3] @ self.origin + pose[:3, 3]
        return out
