"""Edge and volume constraints: one class a family, one loop each, for PBD and XPBD alike.

Every projection is ``dlambda = -C / (sum_i w_i |grad_i C|^2 + a)``, ``dx_i = k w_i grad_i C
dlambda`` with the compliance a over the time of the step, which is one projection (Macklin 2019);
``a = 0`` is the hard constraint of PBD, and k in [0, 1] its stiffness (Müller 2007). w is the
inverse mass, 0 where a vertex is held; constraints between held vertices alone are left out.
"""

import numpy as np

from pbd_baseline.contact import NO_PLANES, ContactPlanes, clear_way
from pbd_baseline.topology import ONE, THREE, TWO, colour, members_in_order, spread
from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.geometry.surfaces import volume_cubic, volume_loop
from rbfmuscle.loops import loop

# A gradient shorter than this share of its natural size belongs to a collapsed element: it has no
# direction.
TINY = 1e-12


class EdgeConstraint:
    """Keeps edge lengths: C = |x_i - x_j| - l, grad_i C = (x_i - x_j) / |x_i - x_j| = -grad_j C.

    ``edges`` (e, 2) has each once; those between two vertices of no ``inverse_mass`` (n,) are left
    out. One PBD projection removes the share ``stiffness`` of an error; ``compliance`` is that of
    XPBD times inverse time, 0 is hard. Beyond the ratios ``limits`` of length to rest length an
    edge is hard whatever its stiffness.
    """

    def __init__(
        self,
        vertices: Floats,
        edges: Integers,
        inverse_mass: Floats,
        *,
        stiffness: Floats | float = 1.0,
        compliance: float = 0.0,
        limits: list[float] | tuple[float, float] = (0.0, np.inf),
    ) -> None:
        order, self.colours = colour(edges, inverse_mass)
        self.edges = members_in_order(edges, order)
        self.inverse_mass = inverse_mass
        self.order = order
        self.rest = np.linalg.norm(vertices[self.edges[:, 0]] - vertices[self.edges[:, 1]], axis=1)
        self.limits = float(limits[0]), float(limits[1])
        self.stiffness = spread(stiffness, order)
        self.compliance = spread(compliance, order)

    def values(self, points: Floats) -> Floats:
        """C of each edge, in the order of ``self.edges``."""
        return (
            np.linalg.norm(points[self.edges[:, 0]] - points[self.edges[:, 1]], axis=1) - self.rest
        )

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
        # A slope below this is rounding: the direction shifts the surface along itself.
        self._least = 1e-13 * abs(self.rest) ** (2 / 3)

    def volume(self, points: Floats) -> float:
        """Signed enclosed volume [unit^3]."""
        return volume_loop(points, self.faces)

    def gradient(self, points: Floats) -> Floats:
        """Gradient (n, 3) of the volume."""
        out = np.zeros(points.shape)
        _volume_gradient_loop(points, self.faces, out)
        return out

    def project(self, points: Floats, inverse_mass: Floats) -> None:
        """One PBD projection along the plain gradient, in place: the rough step of the paper's
        figure 8.
        """
        step = self.gradient(points) * inverse_mass[:, None]
        slope = (step * step).sum()
        if slope > 0.0:
            points += step * ((self.rest - self.volume(points)) / slope)

    def restore(
        self, points: Floats, direction: Floats, planes: ContactPlanes = NO_PLANES
    ) -> float:
        """Move points along a direction (n, 3) until the volume is the rest volume; return the
        factor s.

        V(x + s d) is a cubic in s, computed exactly, so the volume is met to rounding. Where the
        direction cannot meet it (no real root near zero), nothing moves and s is 0. What leads into
        half-spaces is taken out of the direction, in place.
        """
        return _restore_loop(points, self.faces, direction, self.rest, self._least, planes)


@loop
def _restore_loop(points, faces, direction, rest, least, planes):
    """Move points along a direction to the rest volume; ``least`` is the slope that counts as none
    for a direction whose greatest component is 1.
    """
    least *= np.abs(direction).max()
    s = _cubic_step(volume_cubic(points, faces, direction), rest, least)
    if clear_way(points, planes, direction, s):
        s = _cubic_step(volume_cubic(points, faces, direction), rest, least)
    for i in range(len(points)):
        for a in range(3):
            points[i, a] += s * direction[i, a]
    return s


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
        a = faces[f, 0]
        b = faces[f, 1]
        c = faces[f, 2]
        ux = points[b, 0] - points[a, 0]
        uy = points[b, 1] - points[a, 1]
        uz = points[b, 2] - points[a, 2]
        vx = points[c, 0] - points[a, 0]
        vy = points[c, 1] - points[a, 1]
        vz = points[c, 2] - points[a, 2]
        nx = (uy * vz - uz * vy) / 6.0
        ny = (uz * vx - ux * vz) / 6.0
        nz = (ux * vy - uy * vx) / 6.0
        for v in (a, b, c):
            out[v, 0] += nx
            out[v, 1] += ny
            out[v, 2] += nz
