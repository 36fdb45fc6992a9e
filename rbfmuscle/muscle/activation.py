"""The fibres of an RBF muscle that contracts: springs along the solid's fibres, in its shear
modulus.

A fibre that is stretched by λ against the scan bears, beside the tension of the passive solid,

    a d D(x) PEAK μ (λ - l) / (1/s - l),   l = 0.5 / s,

with a the activation, s the stretch in the scan, l the stretch at which active fibres bear nothing
and d the number of fibres through a unit area, 1 where the belly is widest: fibres run from end to
end, so where it narrows each area bears more. At the slack length a fully active fibre bears `PEAK`
shear moduli (Blemker, Pinsky & Delp 2005). Tendon is a spring that this tension stretches by
``tendon_strain``.

D is 1 up to the slack length. Where x, the mean of s λ over the belly, is beyond it, D makes of the
straight line of a belly that is stretched evenly the descending limb of the force-length curve,
1 - ((x - 1) / 0.5)², which ends at one and a half slack lengths (Zajac 1989). It goes by the mean,
as in models of Hill's type: by each place's own stretch a place that is longer would be weaker and
give way ever more, until a part of the belly is torn out and the rest has the least length (Zahalak
1997, "Can muscle fibers be stable on the descending limbs of their sarcomere length-tension
relations?").
"""

from collections.abc import Sequence

import numpy as np
from scipy.spatial import cKDTree

from rbfmuscle.geometry.arrays import Booleans, Floats
from rbfmuscle.scene.activation import make_contraction
from rbfmuscle.scene.joints import Joint
from rbfmuscle.scene.muscles import attachment_ends
from rbfmuscle.scene.objects import Muscle
from rbfmuscle.solid.model import Fibres, SolidModel, hung_matrix

PEAK = 30.0  # greatest isometric tension of active fibres, in shear moduli
WIDEST = 0.2  # share of the belly that counts as its widest part
# fibres through a unit area, in those of the widest part: the rims of attachments draw more
# together
DENSEST = 10.0
LEAST_STRAIN = 1e-3  # of tendon at full activation, so that it is not rigid


def held_at_insertion(model: SolidModel, muscle: Muscle, joints: Sequence[Joint]) -> Booleans:
    """Which of the solid's held points (h,) lie nearer to the second end of the muscle than to the
    first; none where it has one end.
    """
    held = model.points[model.held]
    ends = attachment_ends(muscle, joints)
    if ends is None:
        return np.zeros(len(held), dtype=bool)
    vertices = np.asarray(muscle.mesh.vertices, dtype=float)
    first, last = (
        cKDTree(vertices[np.concatenate([a.vertices for a in end])]).query(held)[0] for end in ends
    )
    return np.asarray(last < first)


def along_fibres(model: SolidModel, insertion: Booleans) -> Floats:
    """Gradient (Q, 3) at the quadrature points of the share that the points held at the
    ``insertion`` (h,) have in what moves a node.
    """
    matrix = hung_matrix(model)
    share = np.linalg.solve(matrix, model.springs @ np.stack([insertion, ~insertion], axis=1))
    return _gradient(model, share[:, 0] / share.sum(axis=1))


def _gradient(model: SolidModel, values: Floats) -> Floats:
    """Gradient (Q, 3) at the quadrature points of values (N,) at the nodes."""
    cells = model.cells
    found = np.einsum("ck,ckb->cb", values[cells.nodes], cells.slopes)
    return np.asarray(found.reshape(len(found), 3, -1).swapaxes(1, 2).reshape(-1, 3))


def contracting_fibres(model: SolidModel, muscle: Muscle, insertion: Booleans) -> Fibres:
    """The fibres of a muscle that contracts; the springs of active ones at full activation.

    ``insertion`` (h,) are the points held at the muscle's second end.
    """
    given, passive = make_contraction(muscle), model.fibres
    tendon = given.tendon[cKDTree(np.asarray(muscle.mesh.vertices)).query(model.cells.points)[1]]
    density = fibre_density(model, ~tendon, insertion)
    slack = 1.0 / given.stretch_at_rest
    lower, upper = passive.lower.copy(), np.full(len(tendon), max(1.0, slack))
    if given.slack:
        lower[:] = min(1.0, slack)
    lower[tendon] = 1.0
    upper[tendon] = 1.0
    active = density * 0.5 * PEAK / max(slack - given.shortest, 0.05)
    active[tendon] = 0.0
    stiff, strain = passive.passive.copy(), max(given.tendon_strain, LEAST_STRAIN)
    stiff[tendon] = density[tendon] * 0.5 * PEAK / strain
    content = np.full(len(active), given.shortest)
    return Fibres(passive.direction, stiff, active, lower, upper, content)


def descending_limb(model: SolidModel, nodes: Floats) -> float:
    """Share of its springs' tension that an active belly with nodes (N, 3) bears, from 1 where its
    mean fibre is at the slack length or shorter to 0 at one and a half of it.
    """
    fibres = model.fibres
    weights = model.cells.weights * (fibres.active > 0.0)
    along = [(_gradient(model, column) * fibres.direction).sum(axis=1) for column in nodes.T]
    # Against the slack length, from the stretch against rest.
    lengths = 0.5 * np.linalg.norm(along, axis=0) / fibres.content
    x = max(1.0, float(weights @ lengths / weights.sum()))
    return max(0.0, 1.0 - ((x - 1.0) / 0.5) ** 2) / ((x - 0.5) / 0.5)


def fibre_density(model: SolidModel, belly: Booleans, insertion: Booleans) -> Floats:
    """Fibres through a unit area at the quadrature points (Q,), 1 where the belly is widest.

    They run as a flux without sources from one end to the other, spread evenly over both;
    ``insertion`` (h,) are the points held at the second.
    """
    source = np.where(insertion, 1.0 / max(insertion.sum(), 1), -1.0 / max((~insertion).sum(), 1))
    potential = np.linalg.lstsq(model.matrix, model.hangs @ source, rcond=None)[0]
    size = np.linalg.norm(_gradient(model, potential), axis=1)
    order = np.argsort(size[belly], kind="stable")
    weight = np.cumsum(model.cells.weights[belly][order])
    widest = size[belly][order][np.searchsorted(weight, 0.5 * WIDEST * weight[-1])]
    return np.minimum(size / max(float(widest), 1e-300), DENSEST)
