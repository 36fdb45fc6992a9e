"""The elastic solid that carries an RBF muscle: everything about it that never changes.

With y the nodes of a `Lattice` and F = Σ_k y_k ∇N_k the deformation gradient at its quadrature
points q, the nodes minimise

    E(y) = μ Σ_q w_q min over R, t of (|F_q - R D(t)|² - 2 τ (1 - t))
         + μ Σ_q w_q (c (|F_q a| - s_q)² + a_q (|F_q a| - l)²),
    D(t) = t aaᵀ + t^(-1/2) (I - aaᵀ),    1 / slack <= t <= 1,    s_q = |F_q a| kept within
    1 / slack and 1,    τ = min(ANTI_BUCKLING_TENSION (1 - d / d₀)², GREATEST_TENSION), d <= d₀,

subject to the volumes of the regions r of the lattice, V_r(y) = Σ_{q in r} w_q det F_q, and to the
contacts. R is a rotation, a the fibre direction. Between 1 / slack and 1 a fibre shortens without
resistance while the section thickens, and bears a small tension, 2 μ τ, which keeps a slack muscle
straight. It grows as the muscle's ends approach, from their distance d₀ at rest to d, and depends
on the bones alone: a tension that grew with the fibres' shortening would be a negative stiffness.
c = 3/2 (fibre_ratio - 1) stiffens fibres that are longer or shorter than the band; a_q and l are
those of active fibres (`activation.py`). For small stretches beyond the slack band and more and
more nodes this is the incompressible solid of shear modulus μ, Young's modulus 3 μ across and
3 μ · fibre_ratio along the fibres.
"""

from itertools import combinations
from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_matrix

from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.geometry.frames import RestFrame, diameter
from rbfmuscle.geometry.interpolation import Embedding
from rbfmuscle.solid.lattice import Embedding as LatticePoints
from rbfmuscle.solid.lattice import Lattice

# A bone holds its points, and with ten times the stiffness their mean. A spring at a point that
# stands for such a part of the surface is as stiff as a cell: springs are spread evenly over an
# attachment, however many points it has. Stiffer ones clamp whole cells, and the muscle leaves the
# bone as a stub that turns with it; without the mean, contracting muscles pull attachments along
# (docs/validation.md).
HELD_OF = 4000
FIRM, LOOSE = 10.0, 1.0
# Stiffness of second differences, relative to a cell: for nodes that hold hardly any material.
GHOST = 1e-3
# Nodes move together: the greatest motion of a node times its greatest share and this is 0.7 to 2.5
# times that of the material, in solves of the leg and the hip that end slowly.
TOGETHER = 4.0
# Nodes, about, of a region whose volume is kept: were it one of each, the solid would lock.
NODES_PER_REGION = 8
# Points that move by less than this fraction of the median for a unit force count as attached.
MOBILE = 0.02
# Tension of slack fibres over 2 μ: for a muscle whose ends are at 0.7 of their distance at rest,
# and for shorter ones, it is 0.06 of that at full activation. It begins with no slope: a tension
# that shortens fibres by more than the ends approach, as any above 1.5 (1 - d / d₀) does, would
# straighten the muscle at the first motion. Where it straightens the muscle within a few degrees,
# lengths bend there: with 30 in place of 10 their second differences on the hip are a quarter
# greater.
ANTI_BUCKLING_TENSION, GREATEST_TENSION = 10.0, 0.9
# Greatest pressure that a contact takes, over 2 μ. With 5 the gluteus maximus is pressed 6.6 mm
# into the femur in 90 degrees of flexion.
MOST_CONTACT_PRESSURE = 40.0


class Fibres(NamedTuple):
    """Springs along the fibres at the quadrature points, stiffnesses over twice the shear
    modulus.
    """

    direction: np.ndarray  # (Q, 3) at rest, unit
    passive: np.ndarray  # (Q,) stiffness of a spring that is slack from lower to upper
    active: np.ndarray  # (Q,) at full activation, of a spring whose target stretch is ``content``
    lower: np.ndarray  # (Q,) stretch against rest
    upper: np.ndarray  # (Q,)
    content: np.ndarray  # (Q,)


class Cells(NamedTuple):
    """The lattice's C cells, each with the same number P of quadrature points, point p of cell c in
    row c P + p; and the regions whose volumes are kept, which consist of whole cells.
    """

    nodes: np.ndarray  # (C, 27) nodes of a cell
    # (C, 27, 3 P) gradients of their shape functions [1 / scene unit]: in column a P + p that along
    # axis a at point p.
    slopes: np.ndarray
    weights: np.ndarray  # (Q,) volume of a point [scene unit cubed]
    points: np.ndarray  # (Q, 3) at rest
    region: np.ndarray  # (C,) its region
    volumes: np.ndarray  # (M,) of the regions at rest [scene unit cubed]


class SolidModel(NamedTuple):
    """An elastic solid of N nodes, Q quadrature points, M regions and n contact points."""

    rest: np.ndarray  # (N, 3) nodes at rest
    cells: Cells
    fibres: Fibres
    points: np.ndarray  # (n, 3) contact points at rest
    embedding: Embedding  # of the contact points
    owner: np.ndarray  # (n,) row of the bone that holds a contact point, -1 where it is free
    held: np.ndarray  # (h,) contact points by which the bones hold the solid
    held_bone: np.ndarray  # (h,) row of the bone
    end: np.ndarray  # (h,) 0 or 1 for held points of the two farthest bones, else -1
    end_distance: float  # between the middles of these at rest
    springs: np.ndarray  # (N, h) their forces on nodes at the origin, of held points a unit away
    hangs: np.ndarray  # (N, h) shape functions of the held points
    links: np.ndarray  # (N, N) second derivative of E / 2 μ: of second differences and springs
    matrix: np.ndarray  # (N, N) of all but fibres and springs, where rotations and stretches stay
    motion_weights: np.ndarray  # (N, b) how much of each bone's motion a node takes
    reach: np.ndarray  # (N,) how much of a node's motion material takes, about
    axes: np.ndarray  # (3, 3) rows: of the rest frame, which turn with the scene
    size: float  # diameter of the muscle [scene unit]
    side: float  # of a lattice cell [scene unit]
    area: float  # of the surface, for each contact point [scene unit squared]
    iterations: int  # of a solve, at most


def build_solid(
    lattice: Lattice,
    frame: RestFrame,
    points: Floats,
    owner: Integers,
    held: Integers,
    *,
    surface: float,
    area: float,
    iterations: int,
) -> SolidModel:
    """The solid on a lattice through a muscle, its fibres slack along no direction.

    ``points`` (n, 3) at rest are its contact points, each of which stands for an ``area`` of the
    ``surface`` [scene unit squared];
    ``owner`` (n,) is the row of the bone that holds each, -1 where it is free. The bones hold it by
    the points ``held``.
    """
    side = float(np.prod(lattice.spacing)) ** (1 / 3) * frame.size
    rest = frame.points(lattice.rest)
    cells = _cut_regions(lattice, frame)
    embedding = embed(lattice, frame, points)
    spring = side * HELD_OF * area / surface
    hangs = np.zeros((len(rest), len(held)))
    spots = embedding.columns[held].T, np.arange(len(held))
    np.add.at(hangs, spots, embedding.shares[held].T)
    one = np.ones(len(cells.weights))
    axis = np.tile([1.0, 0.0, 0.0], (len(one), 1))
    end, distance = _farthest_ends(points[held], owner[held])
    springs = _springs(hangs, owner[held], spring)
    ghost = GHOST * side * lattice.second_differences()
    model = SolidModel(
        rest=rest,
        cells=cells,
        fibres=Fibres(axis, 0.0 * one, 0.0 * one, one, one, one),
        points=points,
        embedding=embedding,
        owner=owner.astype(np.int64),
        held=held.astype(np.int64),
        held_bone=owner[held].astype(np.int64),
        end=end,
        end_distance=distance,
        springs=springs,
        hangs=hangs,
        links=ghost + springs @ hangs.T,
        matrix=ghost + _gram(cells, len(rest)),
        motion_weights=np.empty((0, 0)),
        reach=_reach(len(rest), embedding, embed(lattice, frame, cells.points)),
        axes=frame.axes,
        size=diameter(points),
        side=side,
        area=area,
        iterations=iterations,
    )
    return model._replace(motion_weights=_motion_weights(model))


def _reach(nodes: int, *embeddings: Embedding) -> Floats:
    """How much (N,) of a node's motion material takes, about: `TOGETHER` times its greatest share
    at embedded points, and no more than 1.
    """
    found = np.zeros(nodes)
    for embedding in embeddings:
        np.maximum.at(found, embedding.columns, embedding.shares)
    return np.minimum(TOGETHER * found, 1.0)


def _springs(hangs: Floats, bone: Integers, spring: float) -> Floats:
    """Forces (N, h) of the springs on nodes at the origin, for each held point a unit away."""
    springs = LOOSE * spring * hangs
    for b in np.unique(bone):
        group = bone == b
        springs[:, group] += (FIRM - LOOSE) * spring * hangs[:, group].mean(axis=1, keepdims=True)
    return springs


def embed(lattice: Lattice, frame: RestFrame, points: Floats) -> Embedding:
    """Points (n, 3) of the muscle at rest as sums of the lattice's nodes."""
    found = _embedded(lattice, frame, points)
    return Embedding(found.indices, found.weights)


def lattice_slopes(lattice: Lattice, frame: RestFrame, points: Floats) -> Floats:
    """Gradients (n, 27, 3) of the shape functions at points (n, 3) of the muscle at rest."""
    return np.ascontiguousarray(_embedded(lattice, frame, points).slopes @ frame.axes / frame.size)


def _embedded(lattice: Lattice, frame: RestFrame, points: Floats) -> LatticePoints:
    return lattice.embed((points - frame.origin) @ frame.axes.T / frame.size)


def _cut_regions(lattice: Lattice, frame: RestFrame) -> Cells:
    """The quadrature, and regions of about `NODES_PER_REGION` nodes."""
    cells = len(lattice.cells)
    region = lattice.regions(max(1, len(lattice.rest) // NODES_PER_REGION))
    weights = lattice.weights * frame.size**3
    slopes = lattice.quadrature.slopes @ frame.axes / frame.size
    by_cell = slopes.reshape(cells, -1, lattice.nodes.shape[1], 3).transpose(0, 2, 3, 1)
    return Cells(
        lattice.nodes,
        np.ascontiguousarray(by_cell.reshape(cells, lattice.nodes.shape[1], -1)),
        weights,
        frame.points(lattice.points),
        region,
        np.bincount(region, weights.reshape(cells, -1).sum(axis=1)),
    )


def _gram(cells: Cells, nodes: int) -> Floats:
    """Matrix (N, N) of Σ w |F|²."""
    found = np.zeros((nodes, nodes))
    for axis in np.eye(3):
        along = _derivatives(cells, np.tile(axis, (len(cells.weights), 1)), nodes)
        found += (along * cells.weights[:, None]).T @ along
    return found


def _derivatives(cells: Cells, directions: Floats, nodes: int) -> Floats:
    """Matrix (Q, N) of the derivatives at the quadrature points along ``directions`` (Q, 3)."""
    count, corners = cells.nodes.shape
    slopes = cells.slopes.reshape(count, corners, 3, -1)
    along = np.einsum("ckap,cpa->cpk", slopes, directions.reshape(count, -1, 3))
    out = np.zeros((*along.shape[:2], nodes))
    np.put_along_axis(out, cells.nodes[:, None, :], along, axis=2)
    return np.asarray(out.reshape(-1, nodes))


def _motion_weights(model: SolidModel) -> Floats:
    """How much (N, b) of each bone's motion a node takes: where springs to that bone alone move
    it.
    """
    inverse = _inverted(hung_matrix(model))
    bones = range(int(model.held_bone.max()) + 1)
    pulls = [model.springs[:, model.held_bone == b].sum(axis=1) for b in bones]
    # They sum to one: what moves all held points alike moves all nodes so.
    return np.asarray(inverse @ np.stack(pulls, 1))


def hung_matrix(model: SolidModel) -> Floats:
    """The matrix (N, N) of a solid with the springs at its held points."""
    return np.asarray(model.matrix + model.springs @ model.hangs.T)


def _inverted(matrix: Floats) -> Floats:
    inverse = np.linalg.inv(matrix)
    return np.ascontiguousarray(0.5 * (inverse + inverse.T))


def still_compliance(model: SolidModel, activation: float) -> Floats:
    """Motions (N, N) of the nodes for unit forces where rotations and stretches stay."""
    matrix = hung_matrix(model)
    cells = model.cells
    fibres = model.fibres
    stiff = fibres.passive + activation * fibres.active
    if stiff.any():
        along = _derivatives(cells, fibres.direction, len(model.rest))
        matrix = matrix + (along * (stiff * cells.weights)[:, None]).T @ along
    return _inverted(matrix)


def greatest_forces(model: SolidModel, activation: float) -> Floats:
    """Greatest contact forces (n,) over 2 μ.

    What a bone that is driven into an attachment would need to lift the points beside it bends the
    whole muscle: a point that moves less than the median for a unit force bears less.
    """
    move = mobility(model.embedding, still_compliance(model, activation))
    share = np.minimum(1.0, move / np.median(move[model.owner < 0]))
    # Attached points meet neighbours alone, which the bone presses aside with them.
    share[model.owner >= 0] = 1.0
    return MOST_CONTACT_PRESSURE * model.area * share


def attached_owner(model: SolidModel) -> Integers:
    """Row (n,) of the bone that holds each contact point, -1 where none does; free points that a
    force hardly moves count to the bone of the nearest held one.
    """
    move = mobility(model.embedding, still_compliance(model, 0.0))
    owner = model.owner.copy()
    free, attached = owner < 0, np.flatnonzero(owner >= 0)
    for point in np.flatnonzero(free & (move < MOBILE * np.median(move[free]))):
        away = ((model.points[attached] - model.points[point]) ** 2).sum(axis=1)
        owner[point] = owner[attached[np.argmin(away)]]
    return owner


def _farthest_ends(held: Floats, own: Integers) -> tuple[Integers, float]:
    """Which held points (h,) are those of the two bones that hold the muscle farthest apart, and
    how far.
    """
    end, most = np.full(len(held), -1), 0.0
    for first, second in combinations([own == bone for bone in np.unique(own)], 2):
        away = float(np.linalg.norm(held[first].mean(axis=0) - held[second].mean(axis=0)))
        if away > most:
            end, most = np.where(first, 0, np.where(second, 1, -1)), away
    return end.astype(np.int64), most


def mobility(embedding: Embedding, inverse: Floats) -> Floats:
    """Motion (n,) of each embedded point for a unit force at it: s A⁻¹ s."""
    columns, shares = embedding
    start = np.arange(0, shares.size + 1, shares.shape[1])
    sums = csr_matrix((shares.ravel(), columns.ravel(), start), (len(shares), len(inverse)))
    moved = np.take_along_axis(sums @ inverse, columns, axis=1)
    return np.asarray(np.einsum("nk,nk->n", shares, moved))
