"""The fibres of an RBF muscle that contracts: which clusters are tendon, and how stiff that makes their edges."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from rbfmuscle.geometry.arrays import Booleans, Floats
from rbfmuscle.model.options import RBFOptions
from rbfmuscle.model.rest import Rest
from rbfmuscle.sim.contraction.law import FibreLaw
from rbfmuscle.sim.contraction.resolve import resolve_contraction
from rbfmuscle.sim.scene.objects import Muscle

# Weight of the edges of a cluster of tendon; the matrix is built with it once, and does not change. A belly that
# pulls with all its might stretches the tendon by 0.02 beyond its strain; at 20 by 0.04, and at 1,000 the
# iteration has not settled after eight rounds.
TENDON_WEIGHT = 100.0
# Weight of edges from tendon to belly: tendon does not hold the belly beside it at its length.
LOOSE = 1e-3


def contracting(muscle: Muscle, rest: Rest, options: RBFOptions) -> tuple[Rest, FibreLaw]:
    """The rest state of a muscle that contracts, its tendon stiffened, and the law of its clusters.

    Parameters
    ----------
    muscle : Muscle
        With keys of contraction.
    rest : Rest
        As for a muscle that does not contract.
    options : RBFOptions
    """
    contraction = resolve_contraction(muscle)
    tendon = contraction.tendon[cKDTree(np.asarray(muscle.mesh.vertices)).query(rest.centres)[1]]
    belly = ~tendon
    belly[rest.held] = False
    edges = rest.start, rest.other, rest.weight
    full = even_pull(rest.centres, *edges, rest.fibres, rest.weights[:, -1], belly) if belly.any() else 1.0
    law = FibreLaw(tendon, contraction, hold=options.stretch_hold, full=full)
    return replace(rest, weight=stiffened(rest.weight, rest.start, rest.other, tendon)), law


def stiffened(weight: Any, start: Any, other: Any, tendon: Any) -> Any:
    """Weights (e,) of the clusters' edges, by whether they lie in tendon and belly."""
    if not tendon.any():
        return weight
    head = np.repeat(tendon, np.diff(start))
    return weight * np.where(head, np.where(tendon[other], TENDON_WEIGHT, LOOSE), 1.0)


def even_pull(
    rest: Floats, start: Any, other: Any, weight: Any, fibre: Floats, level: Floats, belly: Booleans
) -> Any:
    """Share (K,) by which a fully activated cluster is pulled, such that all sections pull alike.

    Fibres run from end to end, so their tension is one along the muscle, whatever its girth. Clusters are spread
    over the surface: a section of twice the girth has twice as many, and would win over the narrow ones, which
    it stretches. The tension across a section is the sum over the edges through it, w |a · E|, which goes with the
    girth as the clusters' resistance does. A solid's resistance goes with the section's area, and the wide middle of a
    belly shortens less than its ends: so the share falls with the square of that sum, from 1 where it is small (a
    tenth of the belly lies below).

    Parameters
    ----------
    rest : (K, 3) ndarray
    start, other, weight : CSR lists of the clusters' edges.
    fibre : (K, 3) ndarray
    level : (K,) ndarray
        Harmonic field from one end, 0, to the other, 1: sections are where it is constant.
    belly : (K,) ndarray of bool
        Centres that contract.
    """
    head = np.repeat(np.arange(len(rest)), np.diff(start))
    pull = weight * np.abs(np.einsum("ei,ei->e", rest[other] - rest[head], fibre[head]))
    ends = np.stack([level[head], level[other]])
    order_low, order_high = np.argsort(ends.min(axis=0)), np.argsort(ends.max(axis=0))
    low, high = ends.min(axis=0)[order_low], ends.max(axis=0)[order_high]
    begun = np.concatenate([[0.0], np.cumsum(pull[order_low])])
    ended = np.concatenate([[0.0], np.cumsum(pull[order_high])])
    through = (
        begun[np.searchsorted(low, level, side="right")] - ended[np.searchsorted(high, level, side="left")]
    )
    least = np.quantile(through[belly], 0.1)
    return np.clip(least / np.maximum(through, 1e-12 * through.max()), 0.0, 1.0) ** 2
