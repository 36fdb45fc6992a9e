"""Memory and time that an RBF muscle will take, from its settings alone."""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from typing import Any

import numpy as np

from rbfmuscle.geometry.rest_frame import RestFrame
from rbfmuscle.implicit.field import RBFField
from rbfmuscle.implicit.field_fit import wanted_derivatives
from rbfmuscle.implicit.fit.lapack import factor_cholesky
from rbfmuscle.implicit.kernels.table import get_kernel
from rbfmuscle.implicit.placement.lattice import AREA_A_POINT, MOST_HALVINGS
from rbfmuscle.implicit.placement.refinement import FITTED
from rbfmuscle.model.drawing import MARCHING_CELLS
from rbfmuscle.model.options import RBFOptions
from rbfmuscle.model.placement import choose_centres, sample_is_cached
from rbfmuscle.model.shown import shown_vertices
from rbfmuscle.sim.plan.forecast import MuscleCost
from rbfmuscle.sim.plan.rates import shortest
from rbfmuscle.sim.scene.objects import Muscle
from rbfmuscle.sim.scene.scene import Scene

# Vertices of the surface on an area of one cell squared; nodes of the grid kept beside them, bytes of each.
VERTICES_A_CELL, NODE_BYTES, VERTEX_BYTES = 1.5, 10, 400
# Work to build: visits for a sample, for a vertex of the mesh and more for each centre, a tenth without rounds.
SAMPLE_VISITS, VERTEX_VISITS, CENTRE_VISITS = 240_000, 120_000, 240
# Share of that work which is left where the samples are kept on disk already.
KEPT = 0.15
# A sub-step: calls; then of each iteration calls, visits for a centre and for a contact point; the search for
# tunnelling, visits for a contact point.
PREDICT_CALLS, ITERATION_CALLS, SOLVE_VISITS, CONTACT_VISITS, CROSSING_VISITS = 1200, 540, 3700, 240, 850
# A surface: calls of the fit and of the extraction, pairs for an entry of the fit's matrix, visits for a bone's
# vertex and for a vertex of the surface, pairs for a vertex and a centre.
FIT_CALLS, EXTRACT_CALLS, ENTRY_PAIRS, BONE_VISITS, SURFACE_VISITS, SURFACE_PAIRS = (
    1000,
    4300,
    1.8,
    200,
    1200,
    3.5,
)
# Contact points that ever come near a bone, of all: the leg's squat.
NEAR_SHARE = 0.025
# Contact points hang on so many centres: an index and a share of eight bytes each.
HANGING_BYTES = 6 * 16
# With an inside: calls of a sub-step, visits for a node; bytes of a contact point, and of a pair of nodes (the matrix,
# its inverse, and a region's response for eight nodes).
INSIDE_CALLS, NODE_VISITS = 6000, 90_000
DENSE_BYTES, PAIR_BYTES = 27 * 40, 19


def estimate_muscle(
    muscle: Muscle, scene: Scene, rates: Mapping[str, float], options: RBFOptions
) -> MuscleCost:
    """What an RBF muscle with these options takes, as `rbfmuscle.models.estimate_model` says it."""
    chosen = choose_centres(muscle, scene, options, known_only=True)
    centres = chosen.centres
    points = centres + (dense_count(muscle, options) if options.inside else options.samples)
    shown, nodes = _surface_size(muscle, options)
    unknowns = _unknowns(options, centres)
    pair, flop = _field_rates(options.kernel)
    call, visit = rates["call"], rates["visit"]
    bones = sum(len(bone.mesh.vertices) for bone in scene.bones)
    mesh_visits = len(muscle.mesh.vertices) * (VERTEX_VISITS + CENTRE_VISITS * centres)
    frame = RestFrame(np.asarray(muscle.mesh.vertices, dtype=float))
    mesh = frame.local, np.asarray(muscle.mesh.faces)
    sampling, placing = SAMPLE_VISITS * options.samples, mesh_visits
    if sample_is_cached(*mesh, options.samples, seed=options.seed, placement="even"):
        sampling *= KEPT
    if sample_is_cached(*mesh, centres, seed=options.seed, placement="greedy"):
        placing *= KEPT
    search = CROSSING_VISITS * points if scene.detect is not None else 0
    iteration = ITERATION_CALLS * call + visit * (SOLVE_VISITS * centres + CONTACT_VISITS * points)
    solve = options.iterations * iteration
    held = NEAR_SHARE * 8.0 * centres * points + 16.0 * centres**2 + HANGING_BYTES * points
    if options.inside:
        solve = INSIDE_CALLS * call + visit * NODE_VISITS * options.inside
        held += DENSE_BYTES * points + PAIR_BYTES * options.inside**2 - NEAR_SHARE * 8.0 * centres * points
    fit = FIT_CALLS * call + flop * unknowns**3 / 3.0 + pair * ENTRY_PAIRS * unknowns**2
    surface = visit * (BONE_VISITS * bones + SURFACE_VISITS * shown) + pair * SURFACE_PAIRS * shown * centres
    return MuscleCost(
        build=visit * (sampling + placing),
        step=PREDICT_CALLS * call + solve + visit * search,
        show=fit + EXTRACT_CALLS * call + surface,
        memory=held + 24.0 * bones / max(len(scene.muscles), 1),  # which they share
        working=16.0 * unknowns**2 + NODE_BYTES * nodes + VERTEX_BYTES * shown,
        carried=options.samples,
        shown=int(shown),
        points=f"{centres} centres ({chosen.reason})",
    )


def dense_count(muscle: Muscle, options: RBFOptions) -> int:
    """Contact points of a muscle with an inside that are no centres: its samples, halved as `dense_points` does."""
    size = RestFrame(np.asarray(muscle.mesh.vertices, dtype=float)).size
    wanted, count = float(muscle.mesh.area) / (AREA_A_POINT * size**2), options.samples
    for _ in range(MOST_HALVINGS):
        if count >= wanted:
            break
        count *= 4
    return count


def _surface_size(muscle: Muscle, options: Any) -> Any:
    """Vertices of the shown surface, and nodes of the grid where it is marched."""
    if options.surface == "material":
        return shown_vertices(muscle, options.resolution), 0.0
    resolution = options.resolution or MARCHING_CELLS
    vertices = np.asarray(muscle.mesh.vertices, dtype=float)
    axes = np.linalg.svd(vertices - vertices.mean(axis=0), full_matrices=False)[2]
    extent = np.ptp(vertices @ axes.T, axis=0)
    cell = extent.max() / resolution
    return VERTICES_A_CELL * muscle.mesh.area / cell**2, float(np.prod(extent / cell + 7.0))


def _unknowns(options: RBFOptions, centres: int) -> int:
    """Order of the matrix that is factored in each frame."""
    if not get_kernel(options.kernel).hermite:
        return 3 * centres
    derivatives = wanted_derivatives(centres, fitted=options.placement == FITTED)
    return (4 if derivatives == "all" else 2) * centres


@lru_cache(maxsize=8)
def _field_rates(kernel: Any, count: int = 100, points: int = 1500, size: int = 400) -> Any:
    """Seconds for a pair of point and centre, and for an operation of a Cholesky factorisation, measured now."""
    from threadpoolctl import threadpool_limits

    rng = np.random.default_rng(0)
    normals = rng.normal(size=(count, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    matrix = np.asfortranarray(np.diag(np.full(size, 2.0)) + 1.0 / size)
    with threadpool_limits(1, user_api="blas"):
        field = RBFField.fit_surface(normals, normals, kernel=kernel, epsilon=1.0)
        there = rng.normal(size=(points, 3))
        pair = shortest(lambda: field.value_and_gradient(there)) / (points * count)
        flop = shortest(lambda: factor_cholesky(matrix.copy(order="F"))) / (size**3 / 3.0)
    return pair, flop
