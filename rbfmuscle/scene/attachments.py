"""Which vertices of a muscle are held by which bone."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.geometry.exact_distance import ExactDistance
from rbfmuscle.geometry.winding import inside_test
from rbfmuscle.scene.meshes.read import ReadMesh
from rbfmuscle.scene.objects import Attachment, Bone, find_named
from rbfmuscle.scene.options import NotNegative, Positive, Table, Vector
from rbfmuscle.validation import SceneError, is_file, shown, shown_path

if TYPE_CHECKING:
    import trimesh


class SphereTable(Table):
    """All vertices of the muscle within a ball."""

    centre: Vector
    radius: Positive


class AttachTable(Table):
    """A bone, and one of: a file or list of vertex numbers, a distance to the bone, a ball."""

    bone: str
    vertices: str | list[int] | None = None
    near: NotNegative | None = None
    sphere: SphereTable | None = None


def resolve_attachments(
    attach: Sequence[Attachment | AttachTable | dict[str, Any]],
    read: ReadMesh,
    bones: list[Bone],
    *,
    muscle: str,
) -> list[Attachment]:
    """Return the attachments of a muscle.

    Parameters
    ----------
    attach : list of Attachment, AttachTable or dict
    read : ReadMesh
        The muscle's mesh with the map from the file's vertex numbers.
    bones : list of Bone
    muscle : str
        For messages.

    Raises
    ------
    SceneError
        On an unknown bone, an empty selection, an index out of range, or a vertex held by two bones.
    """
    found = []
    for number, entry in enumerate(attach):
        place = f"muscle {muscle!r} attach {number + 1}: "
        if not isinstance(entry, AttachTable):
            row = vars(entry) if isinstance(entry, Attachment) else entry
            plain = {k: v.tolist() if isinstance(v, np.ndarray) else v for k, v in row.items()}
            entry = AttachTable.build(plain, place=place)
        bone = find_named(bones, entry.bone, "bone", place=place)
        found.append(Attachment(bone.name, np.unique(_select(entry, read, bone, place))))
    for first, second in itertools.combinations(found, 2):
        shared = np.intersect1d(first.vertices, second.vertices)
        if first.bone != second.bone and len(shared):
            raise SceneError(
                f"muscle {muscle!r}: {len(shared)} vertices (first: {shared[0]}) are attached to both "
                f"{first.bone!r} and {second.bone!r}, make the attachments smaller"
            )
    return found


def _select(table, read, bone, place):
    given = [key for key in ("vertices", "near", "sphere") if getattr(table, key) is not None]
    if len(given) != 1:
        raise SceneError(f"{place}give one of vertices, near and sphere, got {' and '.join(given) or 'none'}")
    if table.vertices is not None:
        kept = read.vertex_map[listed_vertices(table.vertices, len(read.vertex_map), place)]
        if not (kept >= 0).any():
            raise SceneError(f"{place}none of its vertices is part of the mended surface")
        return kept[kept >= 0]
    points = np.asarray(read.mesh.vertices)
    if table.sphere is not None:
        distance = np.linalg.norm(points - table.sphere.centre, axis=1)
        limit, what = table.sphere.radius, "sphere.radius"
    else:
        distance = signed_distances(points, bone.mesh)
        limit, what = table.near, "near"
    chosen = np.flatnonzero(distance <= limit)
    if len(chosen) == 0:
        raise SceneError(
            f"{place}{what} = {limit:g} reaches no vertex of the muscle, "
            f"the nearest is {distance.min():.4g} away; raise it"
        )
    return chosen


def signed_distances(points: Floats, mesh: trimesh.Trimesh) -> Floats:
    """Exact distance of points to a mesh, negative inside (by pseudonormals, or winding numbers if open)."""
    return ExactMeshes().distances(points, mesh)


class ExactMeshes:
    """Exact distances to meshes, each of which is sorted once for all questions."""

    def __init__(self) -> None:
        self._known: dict[int, Any] = {}

    def distances(self, points: Floats, mesh: trimesh.Trimesh) -> Floats:
        """Distance of points (n, 3) to a mesh, negative inside, (n,)."""
        points = np.ascontiguousarray(points, dtype=np.float64)
        if id(mesh) not in self._known:
            exact = ExactDistance(mesh.vertices, mesh.faces)
            # The mesh is kept too, so that no other one takes its number.
            self._known[id(mesh)] = (
                mesh,
                exact,
                None if mesh.is_watertight else inside_test(mesh.vertices, mesh.faces),
            )
        _, exact, inside = self._known[id(mesh)]
        distance = exact.signed_distance(points)
        return distance if inside is None else np.where(inside(points), -1.0, 1.0) * np.abs(distance)


def listed_vertices(listed: str | list[int], count: int, place: str) -> Integers:
    """Return the vertex numbers of a list or of a text file, below ``count``; ``place`` begins each message."""
    numbers: list[int] = []
    if isinstance(listed, str):
        place = f"{place}{shown_path(listed)}: "
        if not is_file(listed):
            raise SceneError(f"{place}cannot read it: no such file")
        try:
            words = Path(listed).read_text(encoding="utf-8", errors="replace").split()
        except OSError as error:
            raise SceneError(f"{place}cannot read it: {error.strerror}") from None
        for word in words:
            try:
                numbers.append(int(word))
            except ValueError:
                raise SceneError(f"{place}{shown(repr(word))} is not a vertex number") from None
    else:
        numbers = list(listed)
    if not numbers:
        raise SceneError(f"{place}no vertex numbers")
    wrong = [number for number in numbers if not 0 <= number < count]
    if wrong:
        raise SceneError(
            f"{place}vertex {shown(wrong[0])} is out of range, the mesh has vertices 0 to {count - 1}"
        )
    return np.array(numbers, dtype=np.int64)
