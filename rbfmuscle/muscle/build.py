"""Builds the elastic solid of an RBF muscle from its mesh, its attachments and its settings."""

import numpy as np

from rbfmuscle.geometry.rest_frame import RestFrame
from rbfmuscle.implicit.placement.lattice import Lattice
from rbfmuscle.muscle.activation import FibrePull
from rbfmuscle.muscle.fibres import fibre_directions, rise
from rbfmuscle.muscle.options import RBFOptions
from rbfmuscle.muscle.rest import LEAST_ATTACHED, RestState
from rbfmuscle.muscle.solid import EmbeddedSolid
from rbfmuscle.scene.objects import Muscle
from rbfmuscle.scene.scene import Scene


def build_solid(
    muscle: Muscle, scene: Scene, rest: RestState, options: RBFOptions
) -> tuple[EmbeddedSolid, FibrePull | None]:
    """The solid that carries the centres, and the law of its fibres where the muscle contracts."""
    frame, faces = RestFrame(np.asarray(muscle.mesh.vertices, dtype=float)), np.asarray(muscle.mesh.faces)
    points, centres, owner = rest.contact_points(), len(rest.centres), rest.attached_bone
    held = centres + np.flatnonzero(owner[centres:] >= 0)
    for bone in range(len(rest.bones)):
        if (owner[held] == bone).sum() < LEAST_ATTACHED:
            held = np.concatenate([held, np.flatnonzero(owner[:centres] == bone)])
    solid = EmbeddedSolid(
        Lattice(frame.local, faces, options.nodes), frame, points, owner.copy(), held, free=rest.free, count=centres,
        area=float(muscle.mesh.area) / len(rest.samples), iterations=options.iterations,
        bones={bone.name: (np.asarray(bone.mesh.vertices), np.asarray(bone.mesh.faces)) for bone in scene.bones},
    )  # fmt: skip
    axis = points[held].mean(axis=0) - points.mean(axis=0)
    along = fibre_directions(solid.quad_points, rise(solid), muscle.fibres, fallback=axis)
    count = len(along)
    solid.take_fibres(
        solid.fibres._replace(
            direction=np.ascontiguousarray(along),
            passive=np.full(count, 1.5 * (options.fibre_ratio - 1.0)),
            lower=np.full(count, 1.0 / options.slack),
        )
    )
    solid.attach_immobile()
    law = FibrePull(solid, muscle) if muscle.contraction is not None else None
    return solid, law
