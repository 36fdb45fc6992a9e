"""Edge, bending and volume constraints: one class a family, one loop each, for PBD and XPBD alike.

Every projection is ``dlambda = (-C - a lambda) / (sum_i w_i |grad_i C|^2 + a)``,
``dx_i = k w_i grad_i C dlambda`` with the compliance a over the time of the step (Macklin 2016); ``a = 0`` is
the hard constraint of PBD, and k in [0, 1] its stiffness (Müller 2007). w is the inverse mass, 0 where a vertex
is held.
"""

import numba
import numpy as np

from pbd_baseline.topology import colour

# A gradient shorter than this share of its natural size belongs to a collapsed element: it has no direction.
TINY = 1e-12
# No dihedral angle turns back by more than 2 atan(1) = 90 degrees in one projection.
LARGEST_HALF_TANGENT = 1.0


class EdgeConstraint:
    """Keeps edge lengths: C = |x_i - x_j| - l, grad_i C = (x_i - x_j) / |x_i - x_j| = -grad_j C.

    Parameters
    ----------
    vertices : (n, 3) ndarray
        Rest positions.
    edges : (e, 2) ndarray of int
        Each undirected edge once.
    stiffness : float or (e,) ndarray
        Share of the error that one PBD projection removes, 0 to 1.
    compliance : float or (e,) ndarray
        XPBD compliance times inverse time; 0 is hard.
    """

    def __init__(self, vertices, edges, *, stiffness=1.0, compliance=0.0):
        order, self.colours = colour(edges, len(vertices))
        self.edges = np.ascontiguousarray(edges[order])
        self.order = order
        self.rest = np.linalg.norm(vertices[self.edges[:, 0]] - vertices[self.edges[:, 1]], axis=1)
        self.stiffness = _spread(stiffness, order)
        self.compliance = _spread(compliance, order)
        self.multiplier = np.zeros(len(order))

    def values(self, points):
        """C of each edge, in the order of ``self.edges``."""
        return np.linalg.norm(points[self.edges[:, 0]] - points[self.edges[:, 1]], axis=1) - self.rest

    def reset(self):
        """Forget the multipliers, as each time step does."""
        self.multiplier[:] = 0.0

    def project(self, points, inverse_mass):
        """One Gauss-Seidel sweep over ``points`` (n, 3), in place."""
        _edge_loop(
            points, inverse_mass, self.edges, self.rest, self.stiffness, self.compliance, self.multiplier
        )


class BendingConstraint:
    """Keeps dihedral angles: C = 2 tan((t - t0) / 2), t the signed angle between the faces at an edge.

    C is t - t0 to third order, is defined by sine and cosine alone (no arc cosine to clamp) and grows without
    bound towards a fold. grad C = (1 + C^2 / 4) grad t, with the gradient of t by Bridson et al. 2003: for edge
    (0, 1), length |e|, wings 2 and 3 and unnormalised face normals n_2 and n_3, grad_2 t = -|e| n_2 / |n_2|^2,
    grad_3 t = -|e| n_3 / |n_3|^2; the edge's ends take the opposite, split by where the wings' feet fall.

    Parameters
    ----------
    vertices : (n, 3) ndarray
        Rest positions.
    edges, wings : (e, 2) ndarray of int
        As in :class:`~pbd_baseline.topology.Topology`.
    stiffness, compliance : float or (e,) ndarray
        As in :class:`EdgeConstraint`; the compliance is per radian squared.
    """

    def __init__(self, vertices, edges, wings, *, stiffness=0.9, compliance=0.0):
        members = np.column_stack([edges, wings])
        order, self.colours = colour(members, len(vertices))
        self.members = np.ascontiguousarray(members[order])
        self.order = order
        self.rest = np.empty((len(order), 2))
        _dihedral_loop(vertices, self.members, self.rest)
        self.stiffness = _spread(stiffness, order)
        self.compliance = _spread(compliance, order)
        self.multiplier = np.zeros(len(order))

    def values(self, points):
        """C of each edge, in the order of ``self.members``."""
        now = np.empty_like(self.rest)
        _dihedral_loop(points, self.members, now)
        sine = now[:, 1] * self.rest[:, 0] - now[:, 0] * self.rest[:, 1]
        cosine = now[:, 0] * self.rest[:, 0] + now[:, 1] * self.rest[:, 1]
        return 2.0 * sine / np.maximum(1.0 + cosine, TINY)

    def reset(self):
        """Forget the multipliers, as each time step does."""
        self.multiplier[:] = 0.0

    def project(self, points, inverse_mass):
        """One Gauss-Seidel sweep over ``points`` (n, 3), in place."""
        _bending_loop(
            points, inverse_mass, self.members, self.rest, self.stiffness, self.compliance, self.multiplier
        )


class VolumeConstraint:
    """Keeps the enclosed volume: C = V(x) - V_0, V = (1/6) sum a . (b x c), grad_a V = (1/6) sum b x c.

    Parameters
    ----------
    vertices : (n, 3) ndarray
        Rest positions.
    faces : (m, 3) ndarray of int
        Closed, outward.
    """

    def __init__(self, vertices, faces):
        self.faces = np.ascontiguousarray(faces)
        self.rest = self.volume(vertices)

    def volume(self, points):
        """Signed enclosed volume [unit^3]."""
        return _volume_loop(points, self.faces, np.ascontiguousarray(points[0]))

    def gradient(self, points):
        """Gradient (n, 3) of the volume."""
        out = np.zeros_like(points)
        _volume_gradient_loop(points, self.faces, out)
        return out

    def project(self, points, inverse_mass):
        """One PBD projection along the plain gradient, in place: the rough step of the paper's figure 8."""
        step = self.gradient(points)
        step *= inverse_mass[:, None]
        slope = np.vdot(step, self.gradient(points))
        if slope > 0.0:
            points += step * ((self.rest - self.volume(points)) / slope)

    def restore(self, points, direction):
        """Move points along a direction (n, 3) until the volume is the rest volume; return the factor s.

        V(x + s d) is a cubic in s, computed exactly, so the volume is met to rounding. Where the direction
        cannot meet it (no real root near zero), nothing moves and s is 0.
        """
        s = _cubic_step(_cubic_loop(points, direction, self.faces), self.rest)
        points += s * direction
        return s


def _spread(value, order):
    value = np.asarray(value, dtype=np.float64)
    return np.ascontiguousarray(value[order]) if value.ndim else np.full(len(order), float(value))


def _cubic_step(coefficients, wanted):
    """Root of c0 + c1 s + c2 s^2 + c3 s^3 = wanted that continues s = 0, by safeguarded Newton steps."""
    c0, c1, c2, c3 = coefficients
    error = c0 - wanted
    if c1 == 0.0 or error == 0.0:
        return 0.0
    limit = 4.0 * abs(error / c1)
    s = 0.0
    for _ in range(50):
        slope = c1 + s * (2.0 * c2 + 3.0 * s * c3)
        if slope * c1 <= 0.0 or abs(s) > limit:
            return 0.0
        step = (error + s * (c1 + s * (c2 + s * c3))) / slope
        s -= step
        if abs(step) <= 1e-15 * abs(s):
            break
    return s


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _edge_loop(points, inverse_mass, edges, rest, stiffness, compliance, multiplier):
    for c in range(len(edges)):
        i, j = edges[c, 0], edges[c, 1]
        wi, wj = inverse_mass[i], inverse_mass[j]
        dx, dy, dz = points[i, 0] - points[j, 0], points[i, 1] - points[j, 1], points[i, 2] - points[j, 2]
        length = np.sqrt(dx * dx + dy * dy + dz * dz)
        total = wi + wj + compliance[c]
        if length <= TINY * rest[c] or total <= 0.0:
            continue
        change = -(length - rest[c] + compliance[c] * multiplier[c]) / total
        multiplier[c] += change
        factor = stiffness[c] * change / length
        fi, fj = wi * factor, wj * factor
        points[i, 0] += fi * dx
        points[i, 1] += fi * dy
        points[i, 2] += fi * dz
        points[j, 0] -= fj * dx
        points[j, 1] -= fj * dy
        points[j, 2] -= fj * dz


@numba.njit(cache=True, nogil=True, inline="always")
def _wing_frame(points, i, j, k, m):
    """Squared length of edge j - i, normals of faces (i, j, k) and (j, i, m) with theirs, feet of the wings."""
    ex, ey, ez = points[j, 0] - points[i, 0], points[j, 1] - points[i, 1], points[j, 2] - points[i, 2]
    ax, ay, az = points[k, 0] - points[i, 0], points[k, 1] - points[i, 1], points[k, 2] - points[i, 2]
    bx, by, bz = points[m, 0] - points[i, 0], points[m, 1] - points[i, 1], points[m, 2] - points[i, 2]
    px, py, pz = ey * az - ez * ay, ez * ax - ex * az, ex * ay - ey * ax
    qx, qy, qz = by * ez - bz * ey, bz * ex - bx * ez, bx * ey - by * ex
    ee = ex * ex + ey * ey + ez * ez
    pp, qq = px * px + py * py + pz * pz, qx * qx + qy * qy + qz * qz
    ae, be = ax * ex + ay * ey + az * ez, bx * ex + by * ey + bz * ez
    # sin t |p| |q| |e| = (p x q) . e, and a . q |e|^2 = (p x q) . e up to the sign, so one product serves
    sine = -(ax * qx + ay * qy + az * qz)
    cosine = px * qx + py * qy + pz * qz
    return ee, px, py, pz, pp, qx, qy, qz, qq, ae, be, sine, cosine


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _dihedral_loop(points, members, out):
    """Cosine and sine of the signed dihedral angle, positive on a convex edge."""
    for c in range(len(members)):
        i, j, k, m = members[c, 0], members[c, 1], members[c, 2], members[c, 3]
        ee, _, _, _, pp, _, _, _, qq, _, _, sine, cosine = _wing_frame(points, i, j, k, m)
        size = np.sqrt(pp * qq)
        if size <= TINY * ee * ee:
            out[c, 0], out[c, 1] = 1.0, 0.0
            continue
        out[c, 0] = cosine / size
        out[c, 1] = sine * np.sqrt(ee) / size


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _bending_loop(points, inverse_mass, members, rest, stiffness, compliance, multiplier):
    for c in range(len(members)):
        i, j, k, m = members[c, 0], members[c, 1], members[c, 2], members[c, 3]
        ee, px, py, pz, pp, qx, qy, qz, qq, ae, be, sine, cosine = _wing_frame(points, i, j, k, m)
        if pp <= TINY * ee * ee or qq <= TINY * ee * ee:
            continue
        size, length = np.sqrt(pp * qq), np.sqrt(ee)
        sine *= length
        turned = sine * rest[c, 0] - cosine * rest[c, 1]
        aligned = size + cosine * rest[c, 0] + sine * rest[c, 1]
        half = turned / aligned if abs(turned) < LARGEST_HALF_TANGENT * aligned else np.sign(turned)
        growth = 1.0 + half * half
        # grad_k = -gk p, grad_m = -gm q, grad_j = aj p + bj q, grad_i = (gk - aj) p + (gm - bj) q
        gk, gm = growth * length / pp, growth * length / qq
        aj, bj = gk * ae / ee, gm * be / ee
        ai, bi = gk - aj, gm - bj
        pq = cosine
        wi, wj, wk, wm = inverse_mass[i], inverse_mass[j], inverse_mass[k], inverse_mass[m]
        total = compliance[c] + wk * gk * gk * pp + wm * gm * gm * qq
        total += wi * (ai * ai * pp + 2.0 * ai * bi * pq + bi * bi * qq)
        total += wj * (aj * aj * pp + 2.0 * aj * bj * pq + bj * bj * qq)
        if total <= 0.0:
            continue
        change = -(2.0 * half + compliance[c] * multiplier[c]) / total
        multiplier[c] += change
        change *= stiffness[c]
        fi, fj, fk, fm = wi * change, wj * change, wk * change * gk, wm * change * gm
        for d, p, q in ((0, px, qx), (1, py, qy), (2, pz, qz)):
            points[i, d] += fi * (ai * p + bi * q)
            points[j, d] += fj * (aj * p + bj * q)
            points[k, d] -= fk * p
            points[m, d] -= fm * q


@numba.njit(cache=True, nogil=True)
def _volume_loop(points, faces, origin):
    """Enclosed volume; measured from ``origin`` so that a far translation costs no digits."""
    total = 0.0
    for f in range(len(faces)):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        ax, ay, az = points[a, 0] - origin[0], points[a, 1] - origin[1], points[a, 2] - origin[2]
        bx, by, bz = points[b, 0] - origin[0], points[b, 1] - origin[1], points[b, 2] - origin[2]
        cx, cy, cz = points[c, 0] - origin[0], points[c, 1] - origin[1], points[c, 2] - origin[2]
        total += ax * (by * cz - bz * cy) + ay * (bz * cx - bx * cz) + az * (bx * cy - by * cx)
    return total / 6.0


@numba.njit(cache=True, nogil=True)
def _volume_gradient_loop(points, faces, out):
    """A third of the area vector of each face, summed at its vertices.

    On a closed mesh this equals the sum of b x c / 6, without the cancellation far from the origin.
    """
    for f in range(len(faces)):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        ux, uy, uz = points[b, 0] - points[a, 0], points[b, 1] - points[a, 1], points[b, 2] - points[a, 2]
        vx, vy, vz = points[c, 0] - points[a, 0], points[c, 1] - points[a, 1], points[c, 2] - points[a, 2]
        nx, ny, nz = (uy * vz - uz * vy) / 6.0, (uz * vx - ux * vz) / 6.0, (ux * vy - uy * vx) / 6.0
        for v in (a, b, c):
            out[v, 0] += nx
            out[v, 1] += ny
            out[v, 2] += nz


@numba.njit(cache=True, nogil=True)
def _det(a, b, c):
    return (
        a[0] * (b[1] * c[2] - b[2] * c[1])
        + a[1] * (b[2] * c[0] - b[0] * c[2])
        + a[2] * (b[0] * c[1] - b[1] * c[0])
    )


@numba.njit(cache=True, nogil=True)
def _cubic_loop(points, direction, faces):
    """Coefficients of V(x + s d) = c0 + c1 s + c2 s^2 + c3 s^3."""
    c0, c1, c2, c3 = 0.0, 0.0, 0.0, 0.0
    ox, oy, oz = points[0, 0], points[0, 1], points[0, 2]
    for f in range(len(faces)):
        i, j, k = faces[f, 0], faces[f, 1], faces[f, 2]
        a = (points[i, 0] - ox, points[i, 1] - oy, points[i, 2] - oz)
        b = (points[j, 0] - ox, points[j, 1] - oy, points[j, 2] - oz)
        c = (points[k, 0] - ox, points[k, 1] - oy, points[k, 2] - oz)
        u = (direction[i, 0], direction[i, 1], direction[i, 2])
        v = (direction[j, 0], direction[j, 1], direction[j, 2])
        w = (direction[k, 0], direction[k, 1], direction[k, 2])
        c0 += _det(a, b, c)
        c1 += _det(u, b, c) + _det(a, v, c) + _det(a, b, w)
        c2 += _det(u, v, c) + _det(u, b, w) + _det(a, v, w)
        c3 += _det(u, v, w)
    return c0 / 6.0, c1 / 6.0, c2 / 6.0, c3 / 6.0
