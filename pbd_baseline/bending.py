"""Dihedral bending: constraints of one colour are gathered in blocks and projected by vector
instructions.
"""

import numpy as np

from pbd_baseline.topology import colour, spread
from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.jit import compiled

# A gradient shorter than this share of its natural size belongs to a collapsed element: it has no
# direction.
TINY = 1e-12
# Constraints in a block. Rows of the block lie a constant apart in one flat array: only so does the
# compiler see that the loop over a block may use vector instructions (36 ns a constraint without,
# 17 with).
BLOCK = 64
# Rows: 0-8 edge and wings relative to the first vertex, 9-12 inverse masses, 13-14 rest, 15
# compliance times multiplier, 16 compliance, 17 stiffness; out come 18-29 moves of the vertices, 30
# the multiplier's change.
ROWS = 31


class BendingConstraint:
    """Keeps dihedral angles: C = 2 tan((t - t0) / 2), t the signed angle between the faces at an
    edge.

    C is t - t0 to third order, is defined by sine and cosine alone (no arc cosine to clamp) and
    grows without bound towards a fold; a projection turns by 90 degrees at most. grad C = (1 + C^2
    / 4) grad t, with the gradient of t by Bridson et al. 2003: for edge (0, 1) of length |e|, wings
    2 and 3 and unnormalised face normals n_2 and n_3, grad_2 t = -|e| n_2 / |n_2|^2 and grad_3 t =
    -|e| n_3 / |n_3|^2; the edge's ends take the opposite, split by where the wings' feet fall.
    Edges and wings (e, 2) are those of a `Topology`; the compliance is per radian squared.
    """

    def __init__(
        self,
        vertices: Floats,
        edges: Integers,
        wings: Integers,
        *,
        stiffness: float = 0.9,
        compliance: float = 0.0,
    ) -> None:
        members = np.column_stack([edges, wings])
        order, self.colours = colour(members, len(vertices))
        self.members = np.ascontiguousarray(members[order])
        self.order = order
        self.rest = np.empty((len(order), 2))
        _dihedral_loop(vertices, self.members, self.rest)
        self.stiffness = spread(stiffness, order)
        self.compliance = spread(compliance, order)
        self.multiplier = np.zeros(len(order))

    def values(self, points: Floats) -> Floats:
        """C of each edge, in the order of ``self.members``."""
        now = np.empty_like(self.rest)
        _dihedral_loop(points, self.members, now)
        sine = now[:, 1] * self.rest[:, 0] - now[:, 0] * self.rest[:, 1]
        cosine = now[:, 0] * self.rest[:, 0] + now[:, 1] * self.rest[:, 1]
        return 2.0 * sine / np.maximum(1.0 + cosine, TINY)

    def reset(self) -> None:
        """Forget the multipliers, as each time step does."""
        self.multiplier[:] = 0.0

    def project(self, points: Floats, inverse_mass: Floats) -> None:
        """One Gauss-Seidel sweep over ``points`` (n, 3), in place."""
        _sweep_loop(
            points,
            inverse_mass,
            self.colours,
            self.members,
            self.rest,
            self.stiffness,
            self.compliance,
            self.multiplier,
        )


@compiled(error_model="numpy")
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


@compiled
def _sweep_loop(points, inverse_mass, colours, members, rest, stiffness, compliance, multiplier):
    block = np.empty(ROWS * BLOCK)
    for q in range(len(colours) - 1):
        for low in range(colours[q], colours[q + 1], BLOCK):
            count = min(BLOCK, colours[q + 1] - low)
            for t in range(count):
                c = low + t
                _gather(points, inverse_mass, members, c, t, block)
                block[t + 13 * BLOCK], block[t + 14 * BLOCK] = rest[c, 0], rest[c, 1]
                block[t + 15 * BLOCK] = compliance[c] * multiplier[c]
                block[t + 16 * BLOCK], block[t + 17 * BLOCK] = compliance[c], stiffness[c]
            _project_block(block, count)
            for t in range(count):
                c = low + t
                multiplier[c] += block[t + 30 * BLOCK]
                i = members[c, 0]
                j = members[c, 1]
                k = members[c, 2]
                m = members[c, 3]
                for d in range(3):
                    points[i, d] += block[t + (18 + d) * BLOCK]
                    points[j, d] += block[t + (21 + d) * BLOCK]
                    points[k, d] += block[t + (24 + d) * BLOCK]
                    points[m, d] += block[t + (27 + d) * BLOCK]


@compiled
def _gather(points, inverse_mass, members, c, t, block):
    i = members[c, 0]
    j = members[c, 1]
    k = members[c, 2]
    m = members[c, 3]
    for d in range(3):
        x = points[i, d]
        block[t + d * BLOCK] = points[j, d] - x
        block[t + (3 + d) * BLOCK] = points[k, d] - x
        block[t + (6 + d) * BLOCK] = points[m, d] - x
    block[t + 9 * BLOCK], block[t + 10 * BLOCK] = inverse_mass[i], inverse_mass[j]
    block[t + 11 * BLOCK], block[t + 12 * BLOCK] = inverse_mass[k], inverse_mass[m]


@compiled(error_model="numpy", fastmath={"contract", "arcp", "nsz", "reassoc"})
def _project_block(g, count):
    """grad_k = -gk p, grad_m = -gm q, grad_j = aj p + bj q, grad_i = ai p + bi q; a collapsed face
    stays.
    """
    for t in range(count):
        ex = g[t]
        ey = g[t + BLOCK]
        ez = g[t + 2 * BLOCK]
        ax = g[t + 3 * BLOCK]
        ay = g[t + 4 * BLOCK]
        az = g[t + 5 * BLOCK]
        bx = g[t + 6 * BLOCK]
        by = g[t + 7 * BLOCK]
        bz = g[t + 8 * BLOCK]
        px = ey * az - ez * ay
        py = ez * ax - ex * az
        pz = ex * ay - ey * ax
        qx = by * ez - bz * ey
        qy = bz * ex - bx * ez
        qz = bx * ey - by * ex
        ee = ex * ex + ey * ey + ez * ez
        pp, qq = px * px + py * py + pz * pz, qx * qx + qy * qy + qz * qz
        pq = px * qx + py * qy + pz * qz
        length = np.sqrt(ee)
        sine = -(ax * qx + ay * qy + az * qz) * length
        good = 1.0 if min(pp, qq) > TINY * ee * ee else 0.0
        ps, qs = pp + (1.0 - good), qq + (1.0 - good)
        turned = sine * g[t + 13 * BLOCK] - pq * g[t + 14 * BLOCK]
        aligned = np.sqrt(ps * qs) + pq * g[t + 13 * BLOCK] + sine * g[t + 14 * BLOCK]
        half = turned / (max(aligned, abs(turned)) + 1e-300)
        growth = 1.0 + half * half
        gk, gm = growth * length / ps, growth * length / qs
        per = 1.0 / (ee + (1.0 - good))
        aj, bj = gk * per * (ax * ex + ay * ey + az * ez), gm * per * (bx * ex + by * ey + bz * ez)
        ai, bi = gk - aj, gm - bj
        wi = g[t + 9 * BLOCK]
        wj = g[t + 10 * BLOCK]
        wk = g[t + 11 * BLOCK]
        wm = g[t + 12 * BLOCK]
        total = g[t + 16 * BLOCK] + wk * gk * gk * pp + wm * gm * gm * qq
        total += wi * (ai * ai * pp + 2.0 * ai * bi * pq + bi * bi * qq)
        total += wj * (aj * aj * pp + 2.0 * aj * bj * pq + bj * bj * qq)
        change = -good * (2.0 * half + g[t + 15 * BLOCK]) / (total + 1e-300)
        g[t + 30 * BLOCK] = change
        change *= g[t + 17 * BLOCK]
        fi = wi * change
        fj = wj * change
        fk = wk * change * gk
        fm = wm * change * gm
        g[t + 18 * BLOCK], g[t + 21 * BLOCK] = fi * (ai * px + bi * qx), fj * (aj * px + bj * qx)
        g[t + 19 * BLOCK], g[t + 22 * BLOCK] = fi * (ai * py + bi * qy), fj * (aj * py + bj * qy)
        g[t + 20 * BLOCK], g[t + 23 * BLOCK] = fi * (ai * pz + bi * qz), fj * (aj * pz + bj * qz)
        g[t + 24 * BLOCK] = -fk * px
        g[t + 25 * BLOCK] = -fk * py
        g[t + 26 * BLOCK] = -fk * pz
        g[t + 27 * BLOCK] = -fm * qx
        g[t + 28 * BLOCK] = -fm * qy
        g[t + 29 * BLOCK] = -fm * qz
