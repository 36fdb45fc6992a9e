"""Builds the inside of an RBF muscle from its mesh, its attachments and its settings."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from rbfmuscle.geometry.rest_frame import RestFrame
from rbfmuscle.implicit.placement.lattice import Lattice, dense_points
from rbfmuscle.model.fibres import fibre_directions
from rbfmuscle.model.inside.pull import FibrePull
from rbfmuscle.model.inside.solid import Interior
from rbfmuscle.model.options import RBFOptions
from rbfmuscle.model.rest import LEAST_ATTACHED, Rest
from rbfmuscle.sim.scene.objects import Muscle

NODES_A_REGION = 8


def build_interior(muscle: Muscle, rest: Rest, options: RBFOptions) -> tuple[Interior, FibrePull | None]:
    """The solid that carries the centres, and what its fibres do where the muscle contracts.

    Parameters
    ----------
    muscle : Muscle
    rest : Rest
    options : RBFOptions

    Returns
    -------
    interior : Interior
        Its contact points are the centres, the samples, then denser ones of the surface.
    pull : FibrePull or None
    """
    frame, faces = RestFrame(np.asarray(muscle.mesh.vertices, dtype=float)), np.asarray(muscle.mesh.faces)
    samples = np.round((rest.samples - frame.origin) @ frame.axes.T / frame.size, 8)
    denser = dense_points(frame.local, faces, samples, rest.sample_faces)
    points, centres = np.concatenate([rest.contact_points(), frame.points(denser)]), len(rest.centres)
    of_samples = rest.holder[centres:]
    owner = np.concatenate([rest.holder, of_samples[cKDTree(samples).query(denser)[1]]])
    held = centres + np.flatnonzero(of_samples >= 0)
    for bone in range(len(rest.bones)):
        if (owner[held] == bone).sum() < LEAST_ATTACHED:
            held = np.concatenate([held, np.flatnonzero(rest.holder[:centres] == bone)])
    lattice = Lattice(frame.local, faces, options.inside)
    interior = Interior(
        lattice, frame, points, owner, held, count=centres, free=rest.free,
        regions=max(1, len(lattice.rest) // NODES_A_REGION), iterations=options.iterations,
        contacts=options.contacts, memory=options.acceleration, area=float(muscle.mesh.area) / len(points),
    )  # fmt: skip
    if options.fibre_ratio > 1.0 or muscle.contraction is not None:
        axis = points[held].mean(axis=0) - points.mean(axis=0)
        along = fibre_directions(interior.quad_points, interior.rise(), muscle.fibres, fallback=axis)
        interior.reinforce(along, options.fibre_ratio)
    stuck, fixed = np.flatnonzero(interior.hardly_move() & (owner < 0)), np.flatnonzero(owner >= 0)
    interior.owner[stuck] = owner[fixed[cKDTree(points[fixed]).query(points[stuck])[1]]]
    pull = None
    if muscle.contraction is not None:
        pull = FibrePull(interior, muscle, passive=1.5 * (options.fibre_ratio - 1.0))
    return interior, pull
