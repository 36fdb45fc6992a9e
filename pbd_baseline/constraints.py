"""Edge, volume, bending and contact constraints: one class a family, one loop each, for PBD and
XPBD alike.

Every projection is ``dlambda = -C / (sum_i w_i |grad_i C|^2 + a)``, ``dx_i = k w_i grad_i C
dlambda`` with the compliance a over the time of the step, which is one projection (Macklin 2019);
``a = 0`` is the hard constraint of PBD, and k in [0, 1] its stiffness (Müller 2007). w is the
inverse mass, 0 where a vertex is held; constraints between held vertices alone are left out.

Dihedral angles of one colour are gathered in blocks and projected by vector instructions.
"""

import numpy as np

from pbd_baseline.topology import ONE, THREE, TWO, colour, members_in_order
from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.geometry.frames import cross, dot, row_of
from rbfmuscle.geometry.surfaces import corner_from, triangle_plane, volume_cubic, volume_loop
from rbfmuscle.loops import loop
from rbfmuscle.simulation.contact import NO_FENCES, BoneContacts, Fences

# A half-space counts as violated below this share of the search reach.
TOUCHING = 1e-9


class ContactConstraint:
    """Keeps vertices out of bones: C = gap + n . (x - x_0) >= 0, linearised where the contacts were
    asked.

    They are looked for within ``reach`` [scene unit].
    """

    def __init__(self, *, reach: float) -> None:
        self.reach = float(reach)
        self.planes = NO_FENCES

    def find(self, contacts: BoneContacts, points: Floats, *, reach: float | None = None) -> float:
        """Ask the contacts where the vertices (n, 3) are now; return the greatest depth."""
        found = contacts.half_spaces(points, self.reach if reach is None else reach)
        self.planes = Fences(*found[:3], points[found.point])
        return self.depth(points)

    def depth(self, points: Floats) -> float:
        """Greatest depth of the vertices in the half-spaces found last, 0 outside."""
        return float(plane_depths(points, self.planes).max(initial=0.0))

    def project(self, points: Floats) -> None:
        """Push vertices out of the half-spaces, in place."""
        _push_loop(points, self.planes, TOUCHING * self.reach)


@loop
def plane_depths(points, planes):
    """Depth (c,) of each point in its half-space, 0 outside."""
    depth = np.empty(len(planes.point))
    for c in range(len(depth)):
        value = planes.gap[c]
        for a in range(3):
            value += planes.normal[c, a] * (points[planes.point[c], a] - planes.anchor[c, a])
        depth[c] = max(0.0, -value)
    return depth


@loop
def _push_loop(points, planes, least):
    """Push points out of their half-spaces, all by where they are now, if one is deeper than
    ``least``.
    """
    depth = plane_depths(points, planes)
    if len(depth) == 0 or depth.max() <= least:
        return
    for c in range(len(depth)):
        for a in range(3):
            points[planes.point[c], a] += depth[c] * planes.normal[c, a]


@loop
def clear_way(points, planes, direction, step):
    """Take out of a direction what leads into half-spaces within twice a step along it; whether
    anything did.
    """
    cleared = False
    for c in range(len(planes.point) if step != 0.0 else 0):
        i = planes.point[c]
        value, along = planes.gap[c], 0.0
        for a in range(3):
            value += planes.normal[c, a] * (points[i, a] - planes.anchor[c, a])
            along += planes.normal[c, a] * direction[i, a]
        if step * along < 0.0 and value + 2.0 * step * along < 0.0:
            for a in range(3):
                direction[i, a] -= along * planes.normal[c, a]
            cleared = True
    return cleared


# A gradient shorter than this share of its natural size belongs to a collapsed element: it has no
# direction.
TINY = 1e-12


class EdgeConstraint:
    """Keeps edge lengths: C = |x_i - x_j| - l, grad_i C = (x_i - x_j) / |x_i - x_j| = -grad_j C.

    ``edges`` (e, 2) has each once; those between two vertices of no ``inverse_mass`` (n,) are left
    out. One PBD projection removes the share ``stiffness`` of an error; the attribute
    ``compliance`` is that of XPBD times inverse time, 0 is hard. Beyond the ratios ``limits`` of
    length to rest length an edge is hard whatever its stiffness.
    """

    def __init__(
        self,
        vertices: Floats,
        edges: Integers,
        inverse_mass: Floats,
        *,
        stiffness: Floats | float = 1.0,
        limits: list[float] | tuple[float, float] = (0.0, np.inf),
    ) -> None:
        order, self.colours = colour(edges, inverse_mass)
        self.edges = members_in_order(edges, order)
        self.inverse_mass = inverse_mass
        self.order = order
        self.rest = np.linalg.norm(vertices[self.edges[:, 0]] - vertices[self.edges[:, 1]], axis=1)
        self.limits = float(limits[0]), float(limits[1])
        self.stiffness = np.broadcast_to(np.asarray(stiffness, dtype=float), len(edges))[order]
        self.compliance = np.zeros(len(order))

    def project(self, points: Floats) -> None:
        """One Gauss-Seidel sweep over ``points`` (n, 3), in place."""
        _edge_loop(
            points,
            self.inverse_mass,
            self.edges,
            self.rest,
            self.limits,
            self.stiffness,
            self.compliance,
        )


class VolumeConstraint:
    """Keeps the enclosed volume: C = V(x) - V_0, V = (1/6) sum a . (b x c), grad_a V = (1/6) sum b
    x c.
    """

    def __init__(self, vertices: Floats, faces: Integers) -> None:
        self.faces = np.ascontiguousarray(faces)
        self.rest = self.volume(vertices)
        # A slope below this, for a greatest component of 1, is rounding: the direction shifts the
        # surface along itself.
        self._least = 1e-13 * abs(self.rest) ** (2 / 3)

    def volume(self, points: Floats) -> float:
        """Signed enclosed volume [unit^3]."""
        return volume_loop(points, self.faces)

    def gradient(self, points: Floats) -> Floats:
        """Gradient (n, 3) of the volume."""
        out = np.zeros(points.shape)
        _volume_gradient_loop(points, self.faces, out)
        return out

    def restore(self, points: Floats, direction: Floats, planes: Fences = NO_FENCES) -> float:
        """Move points along a direction (n, 3) until the volume is the rest volume; return the
        factor s.

        V(x + s d) is a cubic in s, computed exactly, so the volume is met to rounding. Where the
        direction cannot meet it (no real root near zero), nothing moves and s is 0. What leads into
        half-spaces is taken out of the direction, in place.
        """
        least = self._least * float(np.abs(direction).max())
        step = _cubic_step(volume_cubic(points, self.faces, direction), self.rest, least)
        if clear_way(points, planes, direction, step):
            step = _cubic_step(volume_cubic(points, self.faces, direction), self.rest, least)
        points += step * direction
        return step


@loop
def _cubic_step(coefficients, wanted, least):
    """Root of c0 + c1 s + c2 s^2 + c3 s^3 = wanted that continues s = 0, by safeguarded Newton
    steps.
    """
    c0, c1, c2, c3 = coefficients
    error = c0 - wanted
    if abs(c1) <= least or error == 0.0:
        return 0.0
    limit = 4.0 * abs(error / c1)
    s = 0.0
    # The slope keeps its sign, so a few steps reach the last digit; what would be left is in the
    # volume error of the frame.
    for _ in range(50):
        slope = c1 + s * (2.0 * c2 + 3.0 * s * c3)
        if slope * c1 <= 0.0 or abs(s) > limit:
            return 0.0
        step = (error + s * (c1 + s * (c2 + s * c3))) / slope
        s -= step
        if abs(step) <= 1e-15 * abs(s):
            break
    return s


@loop
def _edge_loop(points, inverse_mass, edges, rest, limits, stiffness, compliance):
    # A flat array and unsigned numbers: no index is tested for counting from the end.
    x = points.reshape(-1)
    for c in range(len(edges)):
        wi, wj = inverse_mass[edges[c, 0]], inverse_mass[edges[c, 1]]
        i = THREE * edges[c, 0]
        j = THREE * edges[c, 1]
        dx = x[i] - x[j]
        dy = x[i + ONE] - x[j + ONE]
        dz = x[i + TWO] - x[j + TWO]
        length = np.sqrt(dx * dx + dy * dy + dz * dz)
        if length <= TINY * rest[c]:
            continue
        factor = stiffness[c] * (rest[c] - length) / ((wi + wj + compliance[c]) * length)
        if length > limits[1] * rest[c]:
            factor = min(factor, (limits[1] * rest[c] - length) / ((wi + wj) * length))
        elif length < limits[0] * rest[c]:
            factor = max(factor, (limits[0] * rest[c] - length) / ((wi + wj) * length))
        fi, fj = wi * factor, wj * factor
        x[i] += fi * dx
        x[i + ONE] += fi * dy
        x[i + TWO] += fi * dz
        x[j] -= fj * dx
        x[j + ONE] -= fj * dy
        x[j + TWO] -= fj * dz


@loop
def _volume_gradient_loop(points, faces, out):
    """Add a third of the area vector of each face at its vertices, on a closed mesh the same as b x
    c / 6.
    """
    for f in range(len(faces)):
        normal = triangle_plane(points, faces, f)[3]
        for v in faces[f]:
            for k in range(3):
                out[v, k] += normal[k] / 6.0


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
    which are held; the attribute ``compliance`` is that of XPBD per radian squared, 0 is hard.
    """

    def __init__(
        self,
        vertices: Floats,
        edges: Integers,
        wings: Integers,
        inverse_mass: Floats,
        *,
        stiffness: float = 0.9,
    ) -> None:
        members = np.column_stack([edges, wings])
        order, self.colours = colour(members, inverse_mass)
        self.members = members_in_order(members, order)
        self.inverse_mass = inverse_mass
        self.order = order
        self.rest = np.empty((len(order), 2))
        _dihedral_loop(vertices, self.members, self.rest)
        self.stiffness = float(stiffness)
        self.compliance = 0.0

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
        at = row_of(points, members[c, 0])
        e = corner_from(points, members[c, 1], at)
        a = corner_from(points, members[c, 2], at)
        b = corner_from(points, members[c, 3], at)
        p, q = cross(e, a), cross(b, e)
        ee, size = dot(e, e), np.sqrt(dot(p, p) * dot(q, q))
        if size <= TINY * ee * ee:
            out[c, 0], out[c, 1] = 1.0, 0.0
            continue
        out[c, 0] = dot(p, q) / size
        # sin t = -|e| a . q / (|p| |q|): as short as (p x q) . e with its three norms
        out[c, 1] = -dot(a, q) * np.sqrt(ee) / size


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
