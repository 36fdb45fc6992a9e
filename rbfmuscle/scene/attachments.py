"""Which vertices of a muscle are held by which bone."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.geometry.exact_distance import ExactDistance
from rbfmuscle.geometry.winding import inside_test
from rbfmuscle.scene.meshes.read import ReadMesh
from rbfmuscle.scene.objects import Attachment, Bone
from rbfmuscle.scene.options import NotNegative, Positive, Table, Vector
from rbfmuscle.validation import SceneError, did_you_mean, is_file, shown, shown_path

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
    attach: Sequence[Any], read: ReadMesh, bones: list[Bone], *, muscle: str
) -> list[Any]:
    """Return the Attachment list of a muscle.

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
        place = f"muscle {muscle!r} attach {number + 1}"
        if isinstance(entry, Attachment):
            entry = {"bone": entry.bone, "vertices": np.asarray(entry.vertices).tolist()}
        elif isinstance(entry, dict):
            entry = {
                key: value.tolist() if isinstance(value, np.ndarray) else value
                for key, value in entry.items()
            }
        table = entry if isinstance(entry, AttachTable) else AttachTable.build(entry, place=f"{place}: ")
        bone = next((bone for bone in bones if bone.name == table.bone), None)
        if bone is None:
            raise SceneError(
                f"{place}: unknown bone {table.bone!r}, {did_you_mean(table.bone, [b.name for b in bones])}"
            )
        found.append(Attachment(bone.name, np.unique(_select(table, read, bone, place))))
    _check_overlap(found, muscle)
    return found


def _select(table, read, bone, place):
    given = [key for key in ("vertices", "near", "sphere") if getattr(table, key) is not None]
    if len(given) != 1:
        what = " and ".join(given) if given else "none"
        raise SceneError(f"{place}: give one of vertices, near and sphere, got {what}")
    points = np.asarray(read.mesh.vertices)
    if table.vertices is not None:
        return _listed_vertices(table.vertices, read, place)
    if table.sphere is not None:
        distance = np.linalg.norm(points - table.sphere.centre, axis=1)
        limit, what = table.sphere.radius, "sphere.radius"
    else:
        distance = signed_distances(points, bone.mesh)
        limit, what = table.near, "near"
    chosen = np.flatnonzero(distance <= limit)
    if len(chosen) == 0:
        raise SceneError(
            f"{place}: {what} = {limit:g} reaches no vertex of the muscle, "
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


def _listed_vertices(listed, read, place):
    if isinstance(listed, str):
        numbers, place = _read_numbers(Path(listed), place), f"{place}: {listed}"
    else:
        numbers = _whole_numbers(listed, place)
    if len(numbers) == 0:
        raise SceneError(f"{place}: no vertex numbers")
    wrong = (numbers < 0) | (numbers >= len(read.vertex_map))
    if wrong.any():
        raise SceneError(
            f"{place}: vertex {numbers[wrong][0]} is out of range, "
            f"the mesh has vertices 0 to {len(read.vertex_map) - 1}"
        )
    kept = read.vertex_map[numbers]
    kept = kept[kept >= 0]
    if len(kept) == 0:
        raise SceneError(f"{place}: none of its vertices is part of the mended surface")
    return kept


def _read_numbers(path, place):
    if not is_file(path):
        raise SceneError(f"{place}: cannot read {shown_path(path)}: no such file")
    try:
        words = path.read_text(encoding="utf-8", errors="replace").split()
    except OSError as error:
        raise SceneError(f"{place}: cannot read {path}: {error.strerror}") from None
    numbers = []
    for word in words:
        try:
            numbers.append(int(word))
        except ValueError:
            raise SceneError(f"{place}: {path}: {shown(repr(word))} is not a vertex number") from None
    return _whole_numbers(numbers, f"{place}: {path}")


def _whole_numbers(numbers, place):
    try:
        return np.array(numbers, dtype=np.int64)
    except OverflowError:
        largest = max(numbers, key=abs)
        raise SceneError(f"{place}: vertex {shown(largest)} is out of range") from None


def _check_overlap(found, muscle):
    for k, first in enumerate(found):
        for second in found[k + 1 :]:
            if first.bone == second.bone:
                continue
            shared = np.intersect1d(first.vertices, second.vertices)
            if len(shared):
                raise SceneError(
                    f"muscle {muscle!r}: {len(shared)} vertices (first: {shared[0]}) are attached to both "
                    f"{first.bone!r} and {second.bone!r}, make the attachments smaller"
                )
