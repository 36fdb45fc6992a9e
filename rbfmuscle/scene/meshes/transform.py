"""Where a mesh lies in the scene: its scale, mirror and transform, as a scene file gives them."""

from collections.abc import Mapping, Sequence
from typing import Annotated, Literal, TypeAlias

import numpy as np
from numpy.typing import ArrayLike
from pydantic import BeforeValidator, Field

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.geometry.vectors import to_world
from rbfmuscle.scene.joints.joint import X, Y, Z, rotation_about
from rbfmuscle.scene.options import Finite, Positive, Table, Vector

FLAT = 1e-9  # least determinant of a transform, over the cube of its largest entry
TransformInput: TypeAlias = ArrayLike | Mapping[str, Sequence[float]] | None
AXES = {"x": 0, "y": 1, "z": 2}


class TransformParts(Table):
    """``transform`` by its parts: turns about the scene's x, then y, then z axis through the
    origin [degree], then a shift [scene unit].
    """

    rotate: Vector = Field(default=[0.0, 0.0, 0.0])
    translate: Vector = Field(default=[0.0, 0.0, 0.0])

    def matrix(self) -> Floats:
        """The transform (4, 4)."""
        matrix = np.eye(4)
        for axis, angle in zip((X, Y, Z), np.radians(self.rotate)):
            matrix = rotation_about(axis, float(angle), np.zeros(3)) @ matrix
        matrix[:3, 3] = self.translate
        return matrix


def _as_matrix(value: object) -> object:
    """Parts, or an array, as rows of a matrix."""
    if value is None:
        return None
    if isinstance(value, dict):
        return TransformParts.build(value, context="").matrix().tolist()
    try:
        matrix = np.array(value, dtype=float)
    except (TypeError, ValueError):
        matrix = np.empty(0)
    if matrix.shape != (4, 4):
        raise ValueError("must be a table with rotate and translate, or 4 rows of 4 numbers")
    if not (np.isfinite(matrix).all() and (matrix[3] == [0.0, 0.0, 0.0, 1.0]).all()):
        raise ValueError("needs finite numbers, and 0, 0, 0, 1 in its last row")
    if abs(np.linalg.det(matrix[:3, :3])) <= FLAT * np.abs(matrix[:3, :3]).max() ** 3:
        raise ValueError("makes the mesh flat, its first three columns must be independent")
    return matrix.tolist()


class MeshTransform(Table):
    """Keys of a bone or a muscle that say where its mesh lies: the scale first, then the mirror,
    then the transform.
    """

    scale: Positive = 1.0
    mirror: Literal["x", "y", "z"] | None = None
    transform: Annotated[list[list[Finite]] | None, BeforeValidator(_as_matrix)] = None

    @property
    def matrix(self) -> Floats | None:
        """Mirror and transform (4, 4) of points in the scene's unit; None where neither is given.

        A file without them has exactly its own points times the scale.
        """
        if self.mirror is None and self.transform is None:
            return None
        matrix = np.eye(4) if self.transform is None else np.array(self.transform)
        if self.mirror is not None:
            matrix[:, AXES[self.mirror]] *= -1.0
        return matrix

    @property
    def turns_inside_out(self) -> bool:
        """Whether triangles have to be turned for their outside to stay outside."""
        return self.matrix is not None and bool(np.linalg.det(self.matrix[:3, :3]) < 0.0)

    def points(self, points: Floats) -> Floats:
        """Points (n, 3) of a file, in the scene."""
        scaled, matrix = np.asarray(points, dtype=float) * self.scale, self.matrix
        return scaled if matrix is None else to_world(scaled, matrix)


def mesh_transform(
    scale: float, mirror: str | None, transform: TransformInput, *, context: str
) -> MeshTransform:
    """The checked keys; SceneError that begins with ``context`` where one is wrong."""
    given = {"scale": scale, "mirror": mirror, "transform": transform}
    return MeshTransform.build(given, context=context)
