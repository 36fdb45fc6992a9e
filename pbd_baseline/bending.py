"""Dihedral bending: constraints of one colour are gathered in blocks and projected by vector
instructions.
"""

import numpy as np

from pbd_baseline.topology import ONE, THREE, TWO, colour, members_in_order
from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.geometry.frames import cross, dot
from rbfmuscle.loops import loop

# A gradient shorter than this share of its natural size belongs to a collapsed element: it has no
# direction.
TINY = 1e-12
# Constraints in a block. Rows of the block lie a constant apart in one flat array: only so does the
# compiler see that the loop over a block may use vector instructions (36 ns a constraint without,
# 17 with).
BLOCK = 64
# Rows: 0-8 edge and wings relative to the first vertex, 9-12 inverse masses, 13-14 rest; out come
# in 0-11 the moves of the vertices.
ROWS = 15


class BendingConstraint:
    """Keeps dihedral angles: C = 2 tan((t - t0) / 2), t the signed angle between the faces at an
    edge.

    C is t - t0 to third order, is defined by sine and cosine alone (no arc cosine to clamp) and
    grows without bound towards a fold; a projection turns by 90 degrees at most. grad C = (1 + C^2
    / 4) grad t, with the gradient of t by Bridson et al. 2003: for edge (0, 1) of length |e|, wings
    2 and 3 and unnormalised face normals n_2 and n_3, grad_2 t = -|e| n_2 / |n_2|^2 and grad_3 t =
    -|e| n_3 / |n_3|^2; the edge's ends take the opposite, split by where the wings' feet fall.
    Edges and wings (e, 2) are those of a `Topology`, of whose vertices ``inverse_mass`` (n,) says
    which are held; the compliance is per radian squared.
    """

    def __init__(
        self,
        vertices: Floats,
        edges: Integers,
        wings: Integers,
        inverse_mass: Floats,
        *,
        stiffness: float = 0.9,
        compliance: float = 0.0,
    ) -> None:
        members = np.column_stack([edges, wings])
        order, self.colours = colour(members, inverse_mass)
        self.members = members_in_order(members, order)
        self.inverse_mass = inverse_mass
        self.order = order
        self.rest = np.empty((len(order), 2))
        _dihedral_loop(vertices, self.members, self.rest)
        self.stiffness = float(stiffness)
        self.compliance = float(compliance)

    def values(self, points: Floats) -> Floats:
        """C of each edge, in the order of ``self.members``."""
        now = np.empty_like(self.rest)
        _dihedral_loop(points, self.members, now)
        sine = now[:, 1] * self.rest[:, 0] - now[:, 0] * self.rest[:, 1]
        cosine = now[:, 0] * self.rest[:, 0] + now[:, 1] * self.rest[:, 1]
        return 2.0 * sine / np.maximum(1.0 + cosine, TINY)

    def project(self, points: Floats) -> None:
        """One Gauss-Seidel sweep over ``points`` (n, 3), in place."""
        _sweep_loop(
            points,
            self.inverse_mass,
            self.colours,
            self.members,
            self.rest,
            self.stiffness,
            self.compliance,
        )


@loop
def _dihedral_loop(points, members, out):
    """Cosine and sine of the signed dihedral angle, positive on a convex edge."""
    for c in range(len(members)):
        i = members[c, 0]
        j = members[c, 1]
        k = members[c, 2]
        m = members[c, 3]
        e = points[j] - points[i]
        a = points[k] - points[i]
        b = points[m] - points[i]
        p, q = np.cross(e, a), np.cross(b, e)
        ee, size = (e * e).sum(), np.sqrt((p * p).sum() * (q * q).sum())
        if size <= TINY * ee * ee:
            out[c, 0], out[c, 1] = 1.0, 0.0
            continue
        out[c, 0] = (p * q).sum() / size
        # sin t = -|e| a . q / (|p| |q|): as short as (p x q) . e with its three norms
        out[c, 1] = -(a * q).sum() * np.sqrt(ee) / size


@loop
def _sweep_loop(points, inverse_mass, colours, members, rest, stiffness, compliance):
    block = np.empty(ROWS * BLOCK)
    x = points.reshape(-1)
    for q in range(len(colours) - 1):
        for low in range(colours[q], colours[q + 1], BLOCK):
            count = min(BLOCK, colours[q + 1] - low)
            for t in range(count):
                c = low + t
                _gather(x, inverse_mass, members, c, t, block)
                block[t + 13 * BLOCK], block[t + 14 * BLOCK] = rest[c, 0], rest[c, 1]
            _project_block(block, count, stiffness, compliance)
            for t in range(count):
                c = low + t
                i = THREE * members[c, 0]
                j = THREE * members[c, 1]
                k = THREE * members[c, 2]
                m = THREE * members[c, 3]
                for d in range(3):
                    x[i + np.uint32(d)] += block[t + d * BLOCK]
                    x[j + np.uint32(d)] += block[t + (3 + d) * BLOCK]
                    x[k + np.uint32(d)] += block[t + (6 + d) * BLOCK]
                    x[m + np.uint32(d)] += block[t + (9 + d) * BLOCK]


@loop
def _gather(x, inverse_mass, members, c, t, block):
    """Fill place t of a block from constraint c; x (3 n,) are coordinates, indices unsigned, so
    that none is tested for counting from the end.
    """
    for k in range(4):
        block[t + (9 + k) * BLOCK] = inverse_mass[members[c, k]]
    first = THREE * members[c, 0]
    for k in range(3):
        other = THREE * members[c, k + 1]
        block[t + 3 * k * BLOCK] = x[other] - x[first]
        block[t + (3 * k + 1) * BLOCK] = x[other + ONE] - x[first + ONE]
        block[t + (3 * k + 2) * BLOCK] = x[other + TWO] - x[first + TWO]


@loop(fastmath={"contract", "arcp", "nsz", "reassoc"})
def _project_block(g, count, stiffness, compliance):
    """grad_k = -gk p, grad_m = -gm q, grad_j = aj p + bj q, grad_i = ai p + bi q; a collapsed face
    stays.
    """
    for t in range(count):
        e = _taken(g, t)
        a = _taken(g, t + 3 * BLOCK)
        b = _taken(g, t + 6 * BLOCK)
        p = cross(e, a)
        q = cross(b, e)
        ee = dot(e, e)
        pp, qq = dot(p, p), dot(q, q)
        pq = dot(p, q)
        length = np.sqrt(ee)
        sine = -dot(a, q) * length
        good = 1.0 if min(pp, qq) > TINY * ee * ee else 0.0
        ps, qs = pp + (1.0 - good), qq + (1.0 - good)
        half = _half_turn(g, t, sine, pq, np.sqrt(ps * qs))
        growth = 1.0 + half * half
        gk, gm = growth * length / ps, growth * length / qs
        per = 1.0 / (ee + (1.0 - good))
        aj, bj = gk * per * dot(a, e), gm * per * dot(b, e)
        ai, bi = gk - aj, gm - bj
        wi = g[t + 9 * BLOCK]
        wj = g[t + 10 * BLOCK]
        wk = g[t + 11 * BLOCK]
        wm = g[t + 12 * BLOCK]
        total = compliance + wk * gk * gk * pp + wm * gm * gm * qq
        total += wi * (ai * ai * pp + 2.0 * ai * bi * pq + bi * bi * qq)
        total += wj * (aj * aj * pp + 2.0 * aj * bj * pq + bj * bj * qq)
        change = -good * stiffness * (2.0 * half) / (total + 1e-300)
        _put(g, t, wi * change * ai, p, wi * change * bi, q)
        _put(g, t + 3 * BLOCK, wj * change * aj, p, wj * change * bj, q)
        fk = wk * change * gk
        fm = wm * change * gm
        g[t + 6 * BLOCK] = -fk * p[0]
        g[t + 7 * BLOCK] = -fk * p[1]
        g[t + 8 * BLOCK] = -fk * p[2]
        g[t + 9 * BLOCK] = -fm * q[0]
        g[t + 10 * BLOCK] = -fm * q[1]
        g[t + 11 * BLOCK] = -fm * q[2]


@loop
def _half_turn(g, t, sine, pq, aligned):
    """Tangent, at most 1, of half the angle by which a fold is off its angle at rest."""
    turned = sine * g[t + 13 * BLOCK] - pq * g[t + 14 * BLOCK]
    aligned = aligned + pq * g[t + 13 * BLOCK] + sine * g[t + 14 * BLOCK]
    return turned / (max(aligned, abs(turned)) + 1e-300)


@loop
def _taken(g, t):
    """A vector of column t of a block."""
    return g[t], g[t + BLOCK], g[t + 2 * BLOCK]


@loop
def _put(g, t, a, p, b, q):
    """Put a p + b q into column t of a block."""
    g[t] = a * p[0] + b * q[0]
    g[t + BLOCK] = a * p[1] + b * q[1]
    g[t + 2 * BLOCK] = a * p[2] + b * q[2]
