"""From the keys of a muscle that contracts to numbers on its mesh: slack length, tendon."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import scipy.sparse as sparse
from scipy.sparse.csgraph import dijkstra

from rbfmuscle.geometry.arrays import Booleans
from rbfmuscle.geometry.exact_distance import ExactDistance
from rbfmuscle.scene.activation.keys import (
    KEYS,
    TENDON_STRAIN,
    Contraction,
    ContractionTable,
    CurveTable,
    TendonTable,
)
from rbfmuscle.scene.attachments import listed_vertices
from rbfmuscle.scene.objects import Muscle
from rbfmuscle.validation import SceneError, did_you_mean

# A fibre that lies farther outside than this share of the muscle's diagonal is one of another muscle or frame:
# lines that run on to the bone, beyond the mesh of the muscle, stay below.
OUTSIDE = 0.1


def contraction_keys(
    given: dict[str, Any], *, muscle: str, folder: str | Path | None = None
) -> ContractionTable | None:
    """The checked keys of one muscle, or None where it has none.

    Parameters
    ----------
    given : dict
        None counts as not given.
    muscle : str
        For messages.
    folder : path, optional
        What relative files are relative to.
    """
    for key in given:
        if key not in KEYS:
            raise SceneError(f"muscle {muscle!r}: unknown key {key!r}, {did_you_mean(key, KEYS)}")
    found = {key: given[key] for key in KEYS if given.get(key) is not None}
    if not found:
        return None
    _check_activation(found.get("activation"), muscle)
    for key, inner in (("activation", "file"), ("tendon", "vertices")):
        value = found.get(key)
        if folder is not None and isinstance(value, dict) and isinstance(value.get(inner), str):
            found[key] = {**value, inner: str(Path(folder) / value[inner])}
    if isinstance(found.get("activation"), dict):
        found["activation"] = CurveTable.build(found["activation"], place=f"muscle {muscle!r} activation: ")
    if isinstance(found.get("tendon"), dict):
        found["tendon"] = TendonTable.build(found["tendon"], place=f"muscle {muscle!r} tendon: ")
    return ContractionTable.build(found, place=f"muscle {muscle!r} ")


def _check_activation(value, muscle):
    """One message in place of one for each of the forms that it may take."""
    numbers = value if isinstance(value, list) else [value]
    for number in numbers:
        if number is None or isinstance(value, dict):
            continue
        if isinstance(number, bool) or not isinstance(number, (int, float)) or not 0.0 <= number <= 1.0:
            raise SceneError(
                f"muscle {muscle!r}: activation must be a number from 0 to 1, a list of them over the motion, or "
                f"a table with 'file', got {number!r}"
            )


def resolve_contraction(muscle: Muscle) -> Any:
    """What the keys of a muscle come to on its mesh, or None where it has none.

    Raises
    ------
    SceneError
        On fibres outside the muscle, a length that needs fibres, a tendon that covers all or nothing.
    """
    keys = muscle.contraction
    if keys is None:
        return None
    if muscle.fibres:
        _check_fibres(muscle)
    stretch = keys.fibre_stretch_at_rest or 1.0
    if keys.optimal_fibre_length is not None:
        stretch = _stretch_from_length(muscle, keys.optimal_fibre_length)
    strain = keys.tendon.strain if isinstance(keys.tendon, TendonTable) else TENDON_STRAIN
    given = keys.fibre_stretch_at_rest is not None or keys.optimal_fibre_length is not None
    return Contraction(stretch, keys.shortening, _tendon(muscle, keys.tendon), strain, given)


def _stretch_from_length(muscle, optimal):
    if not muscle.fibres:
        raise SceneError(
            f"muscle {muscle.name!r}: optimal_fibre_length needs fibres, give these or fibre_stretch_at_rest"
        )
    lengths = [np.linalg.norm(np.diff(line, axis=0), axis=1).sum() for line in muscle.fibres]
    stretch = float(np.mean(lengths)) / optimal
    if not 0.2 < stretch < 5.0:
        raise SceneError(
            f"muscle {muscle.name!r}: optimal_fibre_length {optimal:g} against fibres of {np.mean(lengths):g} in "
            f"the scan is a stretch of {stretch:.3g}, it must lie between 0.2 and 5; check the unit"
        )
    return stretch


def _check_fibres(muscle):
    mesh = muscle.mesh
    vertices = np.asarray(mesh.vertices, dtype=float)
    distance = ExactDistance(vertices, np.asarray(mesh.faces))
    limit = OUTSIDE * float(np.linalg.norm(np.ptp(vertices, axis=0)))
    for number, line in enumerate(muscle.fibres):
        outside = float(distance.signed_distance(np.asarray(line, dtype=float)).max())
        if outside > limit:
            raise SceneError(
                f"muscle {muscle.name!r} fibres: polyline {number} leaves the muscle, by {outside:.4g} at worst "
                f"({limit:.4g} is allowed); check its unit and frame"
            )


def _tendon(muscle: Muscle, given: float | TendonTable | None) -> Booleans:
    """Vertices (n,) that are tendon."""
    vertices = np.asarray(muscle.mesh.vertices, dtype=float)
    tendon = np.zeros(len(vertices), dtype=bool)
    if given is None:
        return tendon
    place = f"muscle {muscle.name!r} tendon"
    if isinstance(given, TendonTable) and given.vertices is not None:
        tendon[listed_vertices(given.vertices, len(vertices), f"{place}: ")] = True
    else:
        tendon = _near_ends(muscle, given, place)
    free = np.ones(len(vertices), dtype=bool)
    free[np.concatenate([a.vertices for a in muscle.attachments])] = False
    if not (free & ~tendon).any():
        raise SceneError(f"{place}: covers all of the muscle, leave a belly that can contract")
    if not (free & tendon).any():
        raise SceneError(f"{place}: holds no vertex beyond the attachments, make it longer")
    return tendon


def _near_ends(muscle, given, place):
    """Vertices (n,) up to a length from the attachments, or a share of the way to the others."""
    vertices, bones = muscle.mesh.vertices, [attachment.bone for attachment in muscle.attachments]
    at, length = (None, None) if isinstance(given, float) else (given.at, given.length)
    if at is not None and at not in bones:
        raise SceneError(f"{place}: not attached to {at!r}, {did_you_mean(at, bones)}")
    ends = {
        bone: np.concatenate([a.vertices for a in muscle.attachments if a.bone == bone])
        for bone in dict.fromkeys(bones)
    }
    tendon = np.zeros(len(vertices), dtype=bool)
    for bone in ends if at is None else [at]:
        away = _along_surface(np.asarray(vertices, dtype=float), muscle.mesh.faces, ends[bone])
        others = np.concatenate([end for other, end in ends.items() if other != bone])
        tendon |= away <= (given * float(away[others].mean()) if length is None else length)
    return tendon


def _along_surface(vertices, faces, start):
    """Length of the shortest way over the surface from the vertices ``start``, (n,), some per cent too long.

    Along edges, and across them to the corner on the other side: along edges alone ways are up to 15 % too long.
    """
    faces = np.asarray(faces)
    corners = [faces[:, [k, (k + 1) % 3, (k + 2) % 3]] for k in range(3)]
    sides = np.concatenate(corners)  # an edge, and the corner opposite
    key = np.sort(sides[:, :2], axis=1) @ [len(vertices), 1]
    order = np.argsort(key, kind="stable")
    pairs = order.reshape(-1, 2) if len(order) % 2 == 0 else order[:0].reshape(-1, 2)
    across = sides[pairs][:, :, 2][key[pairs[:, 0]] == key[pairs[:, 1]]]
    ways = np.unique(np.sort(np.concatenate([sides[:, :2], across]), axis=1), axis=0)
    lengths = np.linalg.norm(vertices[ways[:, 0]] - vertices[ways[:, 1]], axis=1)
    count = len(vertices)
    graph = sparse.coo_matrix((np.maximum(lengths, 1e-300), ways.T), shape=(count, count)).tocsr()
    return dijkstra(graph, directed=False, indices=start, min_only=True)
