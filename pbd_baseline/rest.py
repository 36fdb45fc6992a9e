"""Settings of a PBD muscle, and what is known of it at rest, found once and shared by all its
models: weights between the bones' motions, softness along the fibres, thickness.

The weights stretch the surface evenly: they minimise the integral of |grad w|^4. Harmonic weights
(p = 2) are singular at the rim of a small patch that is held, and stretch edges there fivefold.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
import scipy.sparse as sparse
from pydantic import Field
from scipy.sparse.linalg import splu, spsolve
from scipy.spatial import cKDTree

from pbd_baseline.constraints import VolumeConstraint
from pbd_baseline.topology import Topology, cache_order
from rbfmuscle.cache import content_key, load_arrays, store_arrays
from rbfmuscle.geometry.arrays import Booleans, Floats, Integers, box_size, unit
from rbfmuscle.geometry.harmonic import (
    cotangent_laplacian,
    graph_laplacian,
    harmonic_weights,
    surface_gradient,
)
from rbfmuscle.geometry.lines import fibre_directions
from rbfmuscle.geometry.surfaces import edge_lengths, vertex_areas, vertex_normals
from rbfmuscle.scene.muscles import attachment_ends, ordered_muscle
from rbfmuscle.scene.objects import Muscle
from rbfmuscle.scene.options import NotNegative, Table
from rbfmuscle.scene.scene import Scene
from rbfmuscle.validation import MeshError, NotFiniteError, check_finite


class PBDOptions(Table):
    """``[muscle.model]`` of the mesh models.

    Each solve makes ``iterations`` sweeps (0: the method's own number; of a converged model 2,000
    at most). ``bending`` is the stiffness of dihedral angles in PBD, 0 to 1; ``edge_compliance``
    and ``bending_compliance`` are those of XPBD, over a time that passes by one for each two
    degrees of motion. ``fibre_exponent`` is a of k = (1 - |cos|)^a. Fibres shorten without
    resistance from their length in the scan to 1 / ``slack_ratio`` of it (1: no slack).
    """

    iterations: Annotated[int, Field(ge=0, le=10_000)] = 0
    fibre_exponent: NotNegative = 0.5
    bending: Annotated[float, Field(ge=0.0, le=1.0)] = 0.9
    edge_compliance: NotNegative = 0.2
    bending_compliance: NotNegative = 0.2
    slack_ratio: Annotated[float, Field(ge=1.0, le=5.0)] = 1.6


POWER = 4.0  # p of the minimised integral of |grad w|^p: smoother at the ends than 2
# A choice and not an end at convergence: after these the weights are within 0.001 of their limit,
# and they only predict; what is solved does not depend on them.
ROUNDS = 8
# Faces whose gradient is below this share of the largest count as having this much.
LEAST_GRADIENT = 1e-3
COTANGENTS = 1e-3, 1e3
# Height of a triangle over its longest side below which its gradient is that of this height.
FLATTEST = 1e-6


def even_weights(vertices: Floats, faces: Integers, groups: list[Integers]) -> Floats:
    """Weights (n, groups) in [0, 1] that sum to one, 1 on a group's own vertices, by re-weighted
    Laplace solves.
    """
    weights = harmonic_weights(vertices, faces, groups)
    held = np.zeros(len(vertices), dtype=bool)
    for group in groups:
        held[group] = True
    free, fixed = np.flatnonzero(~held), np.flatnonzero(held)
    if len(free) == 0 or len(groups) < 2:
        return weights
    cotangents, gradients = _face_operators(vertices, faces)
    first, second = (np.roll(faces, -shift, axis=1).T.ravel() for shift in (1, 2))
    for _ in range(ROUNDS):
        size = np.sqrt(sum(((gradient @ weights) ** 2).sum(axis=1) for gradient in gradients))
        conductance = np.maximum(size / size.max(), LEAST_GRADIENT) ** (POWER - 2.0)
        laplacian = graph_laplacian(
            first, second, (cotangents * conductance[:, None]).T.ravel(), len(vertices)
        )[free]
        solved = splu(laplacian[:, free].tocsc()).solve(-(laplacian[:, fixed] @ weights[fixed]))
        # a full step oscillates for p > 3; this one is Newton's where the direction of the gradient
        # stays
        weights[free] += (solved - weights[free]) / (POWER - 1.0)
    weights = np.clip(weights, 0.0, 1.0)
    return weights / weights.sum(axis=1, keepdims=True)


def _face_operators(vertices, faces):
    """Half cotangents (m, 3) opposite to each corner's edge, and three (m, n) gradient matrices."""
    corners = [vertices[faces[:, k]] for k in range(3)]
    normal = np.cross(corners[1] - corners[0], corners[2] - corners[0])
    sides = [corners[k - 1] - corners[k] for k in range(3)]
    longest = np.max([np.einsum("ij,ij->i", side, side) for side in sides], axis=0)
    square = np.maximum(np.einsum("ij,ij->i", normal, normal), (FLATTEST * longest) ** 2 + 1e-300)
    cotangents, slopes = np.empty((len(faces), 3)), []
    for k in range(3):
        one, two = corners[(k + 1) % 3], corners[(k + 2) % 3]
        dot = np.einsum("ij,ij->i", one - corners[k], two - corners[k])
        cotangents[:, k] = np.clip(0.5 * dot / np.sqrt(square), *COTANGENTS)
        slopes.append(np.cross(normal, two - one) / square[:, None])
    rows = np.tile(np.arange(len(faces)), 3)
    shape = (len(faces), len(vertices))
    columns = faces.T.ravel()
    matrices = [
        sparse.csr_matrix(
            (np.concatenate([slope[:, d] for slope in slopes]), (rows, columns)), shape=shape
        )
        for d in range(3)
    ]
    return cotangents, matrices


# Distance over which the thickness is smoothed, and falls to 0 at held vertices, as a share of the
# diagonal.
SMOOTHING = 0.04


def edge_stiffness(
    vertices: Floats, edges: Integers, directions: Floats, exponent: float
) -> Floats:
    """k = (1 - |cos(edge, fibre)|)^a, (e,): edges along the fibres are soft (Cervenka and Kohout, a
    = 0.5).
    """
    along = unit(vertices[edges[:, 1]] - vertices[edges[:, 0]])
    fibre = directions[edges[:, 0]]
    other = directions[edges[:, 1]]
    fibre = unit(fibre + np.where(np.einsum("ij,ij->i", fibre, other) < 0, -1, 1)[:, None] * other)
    aligned = np.abs(np.einsum("ij,ij->i", along, fibre))
    return np.clip(1.0 - aligned, 0.0, 1.0) ** exponent


def swelling_room(vertices: Floats, faces: Integers, normals: Floats, held: Booleans) -> Floats:
    """How far the surface moves at each vertex when the muscle swells: its local half thickness
    (n,).

    Smooth, [unit of the vertices], 0 at held vertices.
    """
    radius = _inner_balls(vertices, normals)
    reach = SMOOTHING * box_size(vertices)
    area = vertex_areas(vertices, faces)
    free = np.flatnonzero(~held)
    room = np.zeros(len(vertices))
    if len(free):
        mass = area / reach**2
        matrix = (cotangent_laplacian(vertices, faces) + sparse.diags(mass)).tocsc()
        room[free] = spsolve(matrix[free][:, free], (mass * radius)[free])
    return np.maximum(room, 0.0)


def _inner_balls(vertices, normals):
    """Radius of the largest inner ball that touches the surface at each vertex (shrinking balls, Ma
    2012): no vertex is in it but at a right angle or more.
    """
    tree = cKDTree(vertices)
    radius = np.full(len(vertices), 0.5 * float(np.ptp(vertices, axis=0).max()))
    # A ball becomes smaller each time, through another vertex: this ends.
    while True:
        distance, index = tree.query(vertices - radius[:, None] * normals)
        offset = vertices - vertices[index]
        height = np.einsum("ij,ij->i", offset, normals)
        square = np.einsum("ij,ij->i", offset, offset)
        # a neighbour at a right angle says nothing: the ball would shrink to the sampling
        inside = (distance < radius * (1 - 1e-6)) & (height > 0.3 * np.sqrt(square))
        if not inside.any():
            return radius
        radius[inside] = np.minimum(radius[inside], square[inside] / (2.0 * height[inside]))


# Raise it when weights or room are computed in another way: entries of the cache are then not
# found.
VERSION = 4


@dataclass(frozen=True)
class RestState:
    """A muscle at rest, its vertices renumbered for the cache."""

    order: np.ndarray  # (n,) the mesh's number of each vertex
    vertices: np.ndarray  # (n, 3)
    topology: Topology
    bones: list[str]  # that hold the muscle
    weights: np.ndarray  # (n, bones) of their motions, 1 on a bone's own vertices
    attached_bone: np.ndarray  # (n,) position in ``bones`` of what holds a vertex, -1 where free
    inverse_mass: np.ndarray  # (n,) 0 where held, else 1
    fibres: np.ndarray  # (n, 3) unit directions
    room: np.ndarray  # (n,) local half thickness, falling to 0 at held vertices
    volume: VolumeConstraint

    @classmethod
    def from_muscle(cls, muscle: Muscle, scene: Scene, options: PBDOptions) -> RestState:
        """Measure a muscle of a scene.

        Raises MeshError if its mesh is not closed, or no smooth weights can be found on it.
        """
        muscle, place = ordered_muscle(muscle)
        order, vertices, faces, bones, attached_bone = _renumbered(muscle)
        topology = Topology.from_mesh(vertices, faces)
        volume = VolumeConstraint(vertices, faces)
        inverse_mass = np.where(attached_bone < 0, 1.0, 0.0)
        try:
            weights, room = _weights_and_room(vertices, faces, attached_bone, len(bones))
        except (RuntimeError, np.linalg.LinAlgError, NotFiniteError) as error:
            raise MeshError(
                f"muscle {muscle.name!r}{f' ({muscle.source})' if muscle.source else ''}: the "
                "motions of its bones "
                f"cannot be spread over its mesh ({error}); remesh it, and attach each part of it "
                "to a bone"
            ) from error
        along = surface_gradient(
            vertices,
            faces,
            _to_insertion(muscle, scene, np.argsort(order), (faces, bones, weights)),
        )
        fibres = fibre_directions(vertices, along, muscle.fibres)
        return cls(
            place[order],
            vertices,
            topology,
            bones,
            weights,
            attached_bone,
            inverse_mass,
            fibres,
            room,
            volume,
        )

    def edge(self) -> float:
        """Median length of the edges [scene unit]."""
        return float(np.median(edge_lengths(self.vertices, self.topology.edges)))

    def relative_lengths(self) -> Floats:
        """Length of each edge in units of the median one."""
        return np.maximum(edge_lengths(self.vertices, self.topology.edges) / self.edge(), 1e-3)


def _to_insertion(muscle, scene, place, mesh):
    """Function (n,) that is 0 at one end of a muscle and 1 at the other; constant where it has one
    end.
    """
    ends = attachment_ends(muscle, scene.joints)
    faces, bones, weights = mesh
    if ends is None:
        return np.ones(len(weights))
    first, last = ({a.attachment_frame for a in end} for end in ends)
    if not first & last:
        return weights[:, [bone in last for bone in bones]].sum(axis=1)
    patches = [np.unique(place[np.concatenate([a.vertices for a in end])]) for end in ends]
    vertices = np.asarray(muscle.mesh.vertices, dtype=float)[np.argsort(place)]
    return harmonic_weights(vertices, faces, [np.setdiff1d(*patches), patches[1]])[:, 1]


def _renumbered(muscle):
    """Order of the vertices, vertices and faces in it, bones that hold the muscle, and who holds
    each vertex.
    """
    order = cache_order(np.asarray(muscle.mesh.faces), len(muscle.mesh.vertices))
    place = np.argsort(order, kind="stable")
    vertices = np.ascontiguousarray(muscle.mesh.vertices, dtype=np.float64)[order]
    faces = place[np.asarray(muscle.mesh.faces)]
    # In the order of their vertices, for the cache; each keeps its orientation.
    faces = np.ascontiguousarray(
        faces[np.argsort(faces.min(axis=1), kind="stable")], dtype=np.int64
    )
    bones = list(dict.fromkeys(attachment.attachment_frame for attachment in muscle.attachments))
    attached_bone = np.full(len(vertices), -1)
    for attachment in muscle.attachments:
        attached_bone[place[attachment.vertices]] = bones.index(attachment.attachment_frame)
    return order, vertices, faces, bones, attached_bone


def _weights_and_room(vertices, faces, attached_bone, bones):
    """What takes nearly all the time of the build, from the cache on disk where it is known."""
    key = content_key(vertices, faces, ("mesh muscle", VERSION, attached_bone.tolist()))
    known = load_arrays(key)
    if known is None or not {"weights", "room"} <= known.keys():
        groups = [np.flatnonzero(attached_bone == b) for b in range(bones)]
        known = {
            "weights": even_weights(vertices, faces, groups),
            "room": swelling_room(
                vertices, faces, vertex_normals(vertices, faces), attached_bone >= 0
            ),
        }
        for name, values in known.items():
            check_finite(values, name=name)
        store_arrays(key, known)
    return known["weights"], known["room"]


def solved_points(muscle: Muscle, scene: Scene, options: PBDOptions) -> str:
    """How many vertices a muscle has."""
    return f"{len(muscle.mesh.vertices)} vertices"
