"""The metric of a solid's iterations: what its nodes and its volumes yield to forces.

At each quadrature point the energy is least over a rotation R exp(ω) and the stretch t of slack
fibres, φ(F) = min ½ |F - R D(t)|² + τ t. With S = RᵀF, P = sym(S D), E_k the generators of the
rotations and x = (ω, t),

    ∂²φ / ∂F² = I - B M⁻¹ Bᵀ,    B = (R E_k D, R D'),
    M_ωω = tr(P) I - P,    M_ωt = -S : E_k D',    M_tt = 1 + 2 / t³ - S : D'',

t alone where it is not at one of its bounds. Fibres beyond the band where they are slack add
c n nᵀ ⊗ a aᵀ and what their tension holds across, and a region's pressure p adds -p ∂² det F / ∂F².
With the second differences and the springs this is Newton's matrix H. Where the energy of a point
has a negative second derivative a part of that is taken off, and all of it where H would not be
positive definite otherwise: the more is taken off, the shorter are the steps. An iteration goes by
H⁻¹ (force); where it ends does not depend on H.
"""

from typing import NamedTuple

import numpy as np
from scipy.linalg import lapack, solve_triangular
from scipy.spatial.transform import Rotation

from rbfmuscle.geometry.arrays import Booleans, Floats, Integers, Singles
from rbfmuscle.loops import loop
from rbfmuscle.solid.contact import Reaction
from rbfmuscle.solid.kernels import (
    ACTIVE,
    CONTENT,
    FIBRE,
    GRADIENT,
    LOWER,
    PASSIVE,
    POINTS,
    ROTATION,
    STRETCH,
    UPPER,
    add_stiffness,
    at_points,
    nearest_deformations,
)
from rbfmuscle.solid.model import SolidModel

# Bulk modulus over 2 μ: a muscle that bones squeeze yields in volume, by a share of pressure / bulk
# modulus. With 50, Poisson's ratio 0.495, muscles of the leg lost up to 4.5 % in a squat; with 200,
# 0.4988, they lose 1.8 % in as many iterations. The surface is drawn at the volume at rest in any
# case.
BULK = 200.0
# A quadrature point whose volume det F falls below `LEAST` of that at rest is pulled to the nearest
# deformation that has it: the energy gains μ Σ_q w_q `STIFFNESS` min over G of |F_q - G|² with
# det G >= LEAST.
LEAST, STIFFNESS = 0.5, 100.0
NEAREST = 0.1  # of what its motion is divided by, where several are about as near
# Of a stretch: nearer to its bounds it counts as at them.
AT_BOUND = 1e-6
# Of a fibre's stretch: nearer to where it goes slack it counts as taut. At rest every fibre stands
# there, and each iteration would find other ones slack.
TAUT = 0.004
# Least stiffness of a point along any direction, over 2 μ, and the shares of what points lack of it
# that are added, in the order in which they are tried until H is positive definite. With all of it
# muscles that hang between others take steps of a fiftieth of their way.
FLOOR = 0.002
SHARES = (0.25, 0.5, 1.0)
BLOCK = 32  # rows and columns of a matrix that are mirrored at once
# ε_abc, by which ∂² det F / ∂F_ab ∂F_cd = ε_ace ε_bdf F_ef.
LEVI_CIVITA = np.zeros((3, 3, 3))
LEVI_CIVITA[[0, 1, 2], [1, 2, 0], [2, 0, 1]] = 1.0
LEVI_CIVITA[[0, 1, 2], [2, 0, 1], [1, 2, 0]] = -1.0
GENERATORS = np.array(
    [
        [[0.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]],
        [[0.0, 0.0, 1.0], [0.0, 0.0, 0.0], [-1.0, 0.0, 0.0]],
        [[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 0.0]],
    ]
)


class Metric(NamedTuple):
    """What corrections of nodes and volumes are made by; it only decides how fast a solve
    converges, so that single precision will do: of H⁻¹ it changes 1e-4, measured by H.
    """

    gradient: Floats  # (M, 3, N) of the volumes, where the metric was found
    inverse: Singles  # (3 N, 3 N) H⁻¹, node by node
    response: Singles  # (N, 3, M) motions of the nodes for unit whitened pressures, U
    whiten: Floats  # (M, M) L⁻¹ of G + K = L Lᵀ
    reaction: Reaction  # motions by unit forces at contact points

    def yielded(self, forces: Floats) -> Singles:
        """Motion (N, 3) of nodes under forces (N, 3)."""
        return (self.inverse @ forces.ravel().astype(np.float32)).reshape(-1, 3)

    def pressed(self, pressures: Floats) -> Singles:
        """Motion (N, 3) of nodes under whitened pressures (M,)."""
        return self.response @ pressures.astype(np.float32)

    def turned(self, rotation: Floats) -> "Metric":
        """That of the solid turned by a rotation (3, 3)."""
        nodes = len(self.response)
        single = rotation.astype(np.float32)
        half = single @ self.inverse.reshape(nodes, 3, 3 * nodes)
        turned = half.reshape(3 * nodes, nodes, 3) @ single.T
        inverse = np.asarray(turned.reshape(3 * nodes, -1), dtype=np.float32)
        return self._replace(
            gradient=np.einsum("ab,mbn->man", rotation, self.gradient),
            inverse=inverse,
            response=np.ascontiguousarray(single @ self.response),
            reaction=Reaction(self.reaction.embedding, inverse),
        )


def find_metric(
    model: SolidModel,
    gradient: Floats,
    work: Floats,
    squeezed: Booleans,
    pressure: Floats,
    *,
    floor: float = FLOOR,
) -> Metric:
    """The metric for gradients (M, 3, N) of the regions' volumes and their pressures (M,), where
    the points are as in ``work`` (C, ROWS * P), some of them ``squeezed`` (Q,). ``floor`` is the
    least stiffness of a point along any direction, over 2 μ, towards which it is raised.

    LinAlgError where the gradients are not independent, or H is not positive definite.
    """
    count, _, nodes = gradient.shape
    points = point_stiffness(work, np.repeat(pressure[model.cells.region], POINTS), squeezed)
    inverse = _positive_inverse(model, points, floor)
    flat = gradient.transpose(0, 2, 1).reshape(count, -1)
    answer = flat.astype(np.float32) @ inverse
    compliance = answer.astype(np.float64) @ flat.T
    compliance[np.diag_indices(count)] *= 1.0 + 1e-9
    compliance[np.diag_indices(count)] += model.cells.volumes / BULK
    whiten = solve_triangular(np.linalg.cholesky(compliance), np.eye(count), lower=True)
    response = (whiten.astype(np.float32) @ answer).reshape(count, nodes, 3).transpose(1, 2, 0)
    reaction = Reaction(model.embedding, inverse)
    return Metric(gradient.copy(), inverse, np.ascontiguousarray(response), whiten, reaction)


def _positive_inverse(model: SolidModel, points: Floats, floor: float) -> Singles:
    """H⁻¹ (3 N, 3 N) for the stiffness (Q, 9, 9) of the points, with the least share of `SHARES` by
    which H is positive definite.
    """
    missing = lacking(points, floor)
    for share in SHARES:
        inverse = inverted(stiffness_matrix(model, points + share * missing))
        if inverse is not None:
            return inverse
    raise np.linalg.LinAlgError("the stiffness of the solid is not positive definite")


def lacking(points: Floats, floor: float = FLOOR) -> Floats:
    """What the stiffness (Q, 9, 9) of points lacks of a ``floor`` along any direction."""
    value, vector = np.linalg.eigh(points)
    missing = np.maximum(floor - value, 0.0)
    return np.asarray((vector * missing[:, None, :]) @ vector.swapaxes(1, 2))


def stiffness_matrix(model: SolidModel, points: Floats) -> Floats:
    """H (3 N, 3 N), node by node, for the stiffness (Q, 9, 9) of the points."""
    cells, nodes = model.cells, len(model.rest)
    points = points * cells.weights[:, None, None]
    by_cell = points.reshape(len(cells.nodes), POINTS, 9, 9).transpose(0, 2, 3, 1)
    shape = (len(cells.nodes), 3, 3, 3, 3, POINTS)
    matrix = np.zeros((nodes, 3, nodes, 3))
    for a in range(3):
        matrix[:, a, :, a] = model.links
    matrix = matrix.reshape(3 * nodes, -1)
    add_stiffness(cells.nodes, cells.slopes, np.ascontiguousarray(by_cell).reshape(shape), matrix)
    return matrix


def inverted(matrix: Floats) -> Singles | None:
    """Inverse of a symmetric matrix (n, n); None where it is not positive definite."""
    # LAPACK goes by columns: the upper triangle there is the lower one here.
    factor, failed = lapack.spotrf(matrix.T.astype(np.float32), lower=0, overwrite_a=1)
    if failed:
        return None
    upper, _ = lapack.spotri(factor, lower=0, overwrite_c=1)
    mirror(upper.T)
    return upper.T


@loop
def mirror(lower):
    """Copy the lower triangle of a matrix (n, n) to the upper one, block by block."""
    for top in range(0, len(lower), BLOCK):
        for left in range(0, top + 1, BLOCK):
            for i in range(top, min(top + BLOCK, len(lower))):
                for j in range(left, min(left + BLOCK, i)):
                    lower[j, i] = lower[i, j]


def point_stiffness(work: Floats, pressure: Floats, squeezed: Booleans) -> Floats:
    """Second derivative (Q, 9, 9) of the energy over 2 μ and the weight by F at each point, under a
    ``pressure`` (Q,) over 2 μ, where some are ``squeezed`` (Q,).
    """
    pressed = pressure[:, None, None] * determinant_bend(at_points(work, GRADIENT, 3, 3))
    found = matrix_stiffness(work) + fibre_stiffness(work) - pressed
    if squeezed.any():
        found[squeezed] += squeezed_stiffness(work, np.flatnonzero(squeezed))
    return found


def determinant_bend(f: Floats) -> Floats:
    """Second derivative (q, 9, 9) of det F by F (q, 3, 3)."""
    bend = np.einsum("ace,bdf,qef->qabcd", LEVI_CIVITA, LEVI_CIVITA, f, optimize=True)
    return np.asarray(bend.reshape(-1, 9, 9))


def squeezed_stiffness(work: Floats, squeezed: Integers) -> Floats:
    """The part (k, 9, 9) of what pulls points (k,) apart, half the square of the distance from F to
    the nearest G with det G = LEAST.

    With the cofactors h of G, G - F = s h. So dG = P dF with M = (I - s ∂h/∂G)⁻¹ and
    P = M - M h hᵀ M / (hᵀ M h), as h · dG = 0, and I - P is the second derivative. It holds hardly
    anything but the volume: with I in its place steps are too short along all else. Near a point
    that several G are equally near to, as F = 0 is, M is kept within 1 / `NEAREST`.
    """
    f, g = at_points(work, GRADIENT, 3, 3)[squeezed], nearest_deformations(squeezed, LEAST, work)
    h = np.cross(np.roll(g, -1, axis=1), np.roll(g, -2, axis=1))
    s = ((g - f) * h).sum(axis=(1, 2)) / (h**2).sum(axis=(1, 2))
    one = np.eye(9)
    bend, vector = np.linalg.eigh(determinant_bend(g))
    side = np.maximum(1.0 - s[:, None] * bend, NEAREST)
    m = (vector / side[:, None, :]) @ vector.swapaxes(1, 2)
    h = h.reshape(-1, 9, 1)
    mh = m @ h
    return np.asarray(STIFFNESS * (one - m + mh @ mh.swapaxes(1, 2) / (h.swapaxes(1, 2) @ mh)))


def matrix_stiffness(work: Floats) -> Floats:
    """The part (Q, 9, 9) of the material about the fibres, I - B M⁻¹ Bᵀ.

    With Bᵀ B = L Lᵀ and the eigenvalues m of L⁻¹ M L⁻ᵀ, 1 - 1 / m is left along each of the
    directions that rotations and stretch follow; where m is not positive, the energy is no minimum.
    """
    f, a, t = at_points(work, GRADIENT, 3, 3), at_points(work, FIBRE, 3), at_points(work, STRETCH)
    turn = Rotation.from_quat(at_points(work, ROTATION, 4)[:, [1, 2, 3, 0]]).as_matrix()
    along = a[:, :, None] * a[:, None, :]
    across = np.eye(3) - along
    u = 1.0 / np.sqrt(t)

    def sections(first: Floats, second: Floats) -> Floats:
        return first[:, None, None] * along + second[:, None, None] * across

    # D and its derivatives by t.
    wanted, slope = sections(t, u), sections(np.ones_like(t), -0.5 * u**3)
    bend = sections(np.zeros_like(t), 0.75 * u**5)
    s = turn.swapaxes(1, 2) @ f
    p = s @ wanted
    p = 0.5 * (p + p.swapaxes(1, 2))
    free = (t > at_points(work, LOWER) * (1.0 + AT_BOUND)) & (t < 1.0 - AT_BOUND)
    ways = np.empty((len(t), 4, 3, 3))  # the columns of B, before R
    ways[:, :3] = GENERATORS @ wanted[:, None]
    ways[:, 3] = np.where(free[:, None, None], slope, 0.0)
    gram = np.einsum("qiab,qjab->qij", ways, ways)
    gram[~free, 3, 3] = 1.0
    matrix = np.zeros((len(t), 4, 4))
    matrix[:, :3, :3] = np.trace(p, axis1=1, axis2=2)[:, None, None] * np.eye(3) - p
    mixed = -np.einsum("qab,qkab->qk", s, GENERATORS @ slope[:, None]) * free[:, None]
    matrix[:, :3, 3] = matrix[:, 3, :3] = mixed
    matrix[:, 3, 3] = np.where(free, 1.0 + 2.0 / t**3 - (s * bend).sum(axis=(1, 2)), 1.0)
    root = np.linalg.inv(np.linalg.cholesky(gram))
    value, vector = np.linalg.eigh(root @ matrix @ root.swapaxes(1, 2))
    softer = 1.0 / np.maximum(value, 1e-3)
    ways = vector.swapaxes(1, 2) @ root @ (turn[:, None] @ ways).reshape(len(t), 4, 9)
    return np.asarray(np.eye(9) - (ways * softer[:, :, None]).swapaxes(1, 2) @ ways)


def fibre_stiffness(work: Floats) -> Floats:
    """The part (Q, 9, 9) of the fibres: along them, and across by their tension."""
    f, a = at_points(work, GRADIENT, 3, 3), at_points(work, FIBRE, 3)
    lower, upper = at_points(work, LOWER), at_points(work, UPPER)
    passive, active = at_points(work, PASSIVE), at_points(work, ACTIVE)
    fa = np.einsum("qab,qb->qa", f, a)
    length = np.sqrt((fa**2).sum(axis=1) + 1e-12)
    slack = (length > lower + TAUT) & (length < upper - TAUT)
    stiff = np.where(slack, 0.0, passive) + active
    tension = passive * (length - np.clip(length, lower, upper))
    tension += active * (length - at_points(work, CONTENT))
    side = np.maximum(tension / length, 0.0)
    n = fa / length[:, None]
    spring = (stiff - side)[:, None, None] * (n[:, :, None] * n[:, None, :])
    spring += side[:, None, None] * np.eye(3)
    return np.einsum("qac,qb,qd->qabcd", spring, a, a).reshape(-1, 9, 9)
