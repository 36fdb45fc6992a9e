"""From the keys of a muscle that contracts to numbers on its mesh: slack length, tendon."""

import numpy as np
import scipy.sparse as sparse
from scipy.sparse.csgraph import dijkstra

from rbfmuscle.geometry.arrays import Booleans
from rbfmuscle.geometry.exact_distance import ExactDistance
from rbfmuscle.scene.activation.keys import TENDON_STRAIN, Contraction, ContractionTable, TendonTable
from rbfmuscle.scene.objects import Muscle
from rbfmuscle.validation import SceneError, did_you_mean

# A fibre that lies farther outside than this share of the muscle's diagonal is one of another muscle or frame:
# lines that run on to the bone, beyond the mesh of the muscle, stay below.
OUTSIDE = 0.1


def resolve_contraction(muscle: Muscle) -> Contraction:
    """What the keys of a muscle come to on its mesh.

    SceneError on fibres outside it, or a tendon that covers all or nothing.
    """
    keys = muscle.contraction or ContractionTable()
    _check_fibres(muscle)
    stretch, tendon = keys.fibre_stretch_at_rest, keys.tendon
    strain = TENDON_STRAIN if tendon is None else tendon.strain
    return Contraction(stretch or 1.0, _tendon(muscle, tendon), strain, stretch is not None)


def _check_fibres(muscle):
    mesh = muscle.mesh
    vertices = np.asarray(mesh.vertices, dtype=float)
    distance = ExactDistance(vertices, np.asarray(mesh.faces))
    limit = OUTSIDE * float(np.linalg.norm(np.ptp(vertices, axis=0)))
    for number, line in enumerate(muscle.fibres or ()):
        outside = float(distance.signed_distance(np.asarray(line, dtype=float)).max())
        if outside > limit:
            raise SceneError(
                f"muscle {muscle.name!r} fibres: polyline {number} leaves the muscle, by {outside:.4g} at worst "
                f"({limit:.4g} is allowed); check its unit and frame"
            )


def _tendon(muscle: Muscle, given: TendonTable | None) -> Booleans:
    """Vertices (n,) that are tendon: up to a length from the attachments."""
    free = np.ones(len(muscle.mesh.vertices), dtype=bool)
    if given is None:
        return ~free
    place = f"muscle {muscle.name!r} tendon"
    bones = [attachment.bone for attachment in muscle.attachments]
    if given.at is not None and given.at not in bones:
        raise SceneError(f"{place}: not attached to {given.at!r}, {did_you_mean(given.at, bones)}")
    start = np.concatenate([a.vertices for a in muscle.attachments if given.at in (None, a.bone)])
    tendon = _along_surface(muscle.mesh, start) <= given.length
    free[np.concatenate([a.vertices for a in muscle.attachments])] = False
    if not (free & ~tendon).any():
        raise SceneError(f"{place}: covers all of the muscle, leave a belly that can contract")
    if not (free & tendon).any():
        raise SceneError(f"{place}: holds no vertex beyond the attachments, make it longer")
    return tendon


def _along_surface(mesh, start):
    """Length of the shortest path over the surface from the vertices ``start``, (n,), some per cent too long.

    Along edges, and across them to the corner on the other side: along edges alone paths are up to 15 % too long.
    """
    ends = np.concatenate([mesh.edges_unique, mesh.face_adjacency_unshared])
    ends = np.unique(np.sort(ends, axis=1), axis=0)
    lengths = np.linalg.norm(mesh.vertices[ends[:, 0]] - mesh.vertices[ends[:, 1]], axis=1)
    count = len(mesh.vertices)
    graph = sparse.coo_matrix((np.maximum(lengths, 1e-300), ends.T), shape=(count, count)).tocsr()
    return dijkstra(graph, directed=False, indices=start, min_only=True)
