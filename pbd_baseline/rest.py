"""What is known of a mesh muscle at rest, found once and shared by all its models."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pbd_baseline.constraints import VolumeConstraint
from pbd_baseline.fibres import swelling_room
from pbd_baseline.options import PBDOptions
from pbd_baseline.topology import Topology, cache_order
from pbd_baseline.weights import even_weights
from rbfmuscle.cache import content_key, load_arrays, store_arrays
from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.geometry.harmonic import harmonic_weights, surface_gradient
from rbfmuscle.geometry.lines import fibre_directions
from rbfmuscle.geometry.surfaces import edge_lengths, vertex_normals
from rbfmuscle.scene.muscles import attachment_ends, ordered_muscle
from rbfmuscle.scene.objects import Muscle
from rbfmuscle.scene.scene import Scene
from rbfmuscle.validation import MeshError, NotFiniteError, check_finite

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
    faces = _sorted_faces(place[np.asarray(muscle.mesh.faces)])
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


def _sorted_faces(faces):
    """Faces in the order of their vertices, for the cache; each keeps its orientation."""
    return np.ascontiguousarray(faces[np.argsort(faces.min(axis=1), kind="stable")], dtype=np.int64)


def solved_points(muscle: Muscle, scene: Scene, options: PBDOptions) -> str:
    """How many vertices a muscle has."""
    return f"{len(muscle.mesh.vertices)} vertices"
