"""Two solids of finite elements in contact with each other, both deformable, without friction.

The quadrature points of either surface are pressed out of the other surface by a penalty (two
passes), with the closest point y(ξ) on a bilinear face of the other and its outward normal n:

    W = penalty/2 Σ area g²,    g = n · (x - y(ξ)) < 0.

The forces are equal and opposite. Their derivative is that of g², with the turning of n and the
sliding of y along the face (Wriggers, Computational Contact Mechanics, 2006, chapter 5).
"""

from typing import NamedTuple

import numpy as np
import scipy.sparse as sparse
from scipy.spatial import cKDTree

from peers.finite_element import Equilibrium

# Faces around a point that are asked for the closest point, by their middles.
CANDIDATES = 9
PROJECTION_STEPS = 6  # of Newton's method for the closest point on a face
# Corners of a face in its own coordinates (ξ, η), around it.
CORNERS = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])


class Overlaps(NamedTuple):
    """Quadrature points of one surface that lie in the other solid, m of them."""

    one: int  # number of the solid whose points they are
    own: np.ndarray  # (m, 4) nodes of their faces, among those of both solids
    share: np.ndarray  # (m, 4) shape functions of these
    other: np.ndarray  # (m, 4) nodes of the faces that they meet, around each
    place: np.ndarray  # (m, 2) of the closest point on these
    gap: np.ndarray  # (m,) below zero
    normal: np.ndarray  # (m, 3) outward from the other solid
    area: np.ndarray  # (m,) at rest, that a point stands for
    points: np.ndarray  # (m, 3) where they are


class TouchingSolids(Equilibrium):
    """Two solids of bricks that touch each other.

    Nodes are those of the first solid, then those of the second.

    Parameters
    ----------
    solids : sequence of two HexSolid
        Their bones are set already.
    inner : sequence of two (k,) ndarray of bool
        Faces of each that are no surface, as those on a plane of symmetry.
    penalty : float
        Contact pressure for each unit of depth and each pass [shear modulus / scene unit].
    deepest : float
        Points that are farther from the other surface do not touch it [scene unit]: they lie behind
        the solid.
    """

    def __init__(self, solids, inner, *, penalty=30.0, deepest=4.0):
        self.solids = tuple(solids)
        self.shear = max(solid.shear for solid in self.solids)
        self.penalty = penalty
        self.deepest = deepest
        self.starts = np.array([0, len(self.solids[0].rest)])
        self.rest = np.concatenate([solid.rest for solid in self.solids])
        self.outer = [np.flatnonzero(~hidden) for hidden in inner]
        parts = [_faces(solid, outer) for solid, outer in zip(self.solids, self.outer)]
        self.own = [nodes + start for (nodes, _, _), start in zip(parts, self.starts)]
        self.share = [share for _, share, _ in parts]
        self.around = [around + start for (*_, around), start in zip(parts, self.starts)]
        self.reach = max(
            np.linalg.norm(np.ptp(self.rest[around], axis=1), axis=1).max()
            for around in self.around
        )

    def split(self, displacement):
        """The displacements of either solid."""
        return np.split(displacement, self.starts[1:])

    def energy(self, displacement):
        """Elastic and contact energy; infinite where a cell is turned inside out."""
        parts = zip(self.solids, self.split(displacement))
        total = sum(solid.energy(part) for solid, part in parts)
        if not np.isfinite(total):
            return np.inf
        for found in self.overlaps(displacement):
            total += 0.5 * self.penalty * float((found.area * found.gap**2).sum())
        return total

    def overlaps(self, displacement):
        """The points of either solid that lie in the other one, two `Overlaps`."""
        here = self.rest + displacement
        return [self._overlap(one, 1 - one, here) for one in range(2)]

    def forces(self, displacement):
        """Places (m, 3) of all points in contact, the sizes (m,) of the forces of both passes there
        and the forces (m, 3) on the first solid.
        """
        found = self.overlaps(displacement)
        size = [self.penalty * part.area * -part.gap for part in found]
        signs = [1.0 if part.one == 0 else -1.0 for part in found]
        pushes = [
            sign * force[:, None] * part.normal for sign, force, part in zip(signs, size, found)
        ]
        places = np.concatenate([part.points for part in found])
        return places, np.concatenate(size), np.concatenate(pushes)

    def _overlap(self, one, other, here):
        """The `Overlaps` of one solid's points in the other, where nodes are ``here``."""
        nodes = self.own[one]
        share = self.share[one]
        points = np.einsum("fqn,fni->fqi", share, here[nodes])
        face, spot = np.divmod(np.arange(points.shape[0] * points.shape[1]), points.shape[1])
        points = points.reshape(-1, 3)
        corners = here[self.around[other]]
        low, high = (end(corners, axis=(0, 1)) for end in (np.min, np.max))
        near = np.flatnonzero((points > low).all(axis=1) & (points < high).all(axis=1))
        limit = self.deepest + self.reach
        tree = cKDTree(corners.mean(axis=1))
        away, which = tree.query(points[near], k=CANDIDATES, distance_upper_bound=limit)
        some = np.isfinite(away)
        row, which = np.nonzero(some)[0], which[some]
        x = points[near[row]]
        place = closest(corners[which], x)
        gap, normal, far = _gaps(corners[which], x, place)
        order = np.lexsort((far, row))
        first = order[np.unique(row[order], return_index=True)[1]]
        first = first[(gap[first] < 0.0) & (far[first] < self.deepest)]
        point = near[row[first]]
        area = self.solids[one].side_weights[self.outer[one]]
        return Overlaps(
            one,
            nodes[face[point]],
            share[face[point], spot[point]],
            self.around[other][which[first]],
            place[first],
            gap[first],
            normal[first],
            area[face[point], spot[point]],
            points[point],
        )

    def _assemble(self, displacement, *, positive=False):
        parts = [
            solid._assemble(part, positive=positive)
            for solid, part in zip(self.solids, self.split(displacement))
        ]
        force = np.concatenate([one for one, _ in parts])
        matrix = sparse.block_diag([two for _, two in parts], format="csr")
        here = self.rest + displacement
        for found in self.overlaps(displacement):
            index, push, stiffness = self._press(found, here, positive)
            force += np.bincount(index.ravel(), push.ravel(), len(force))
            width = index.shape[1]
            rows = np.repeat(index, width, axis=1)
            columns = np.tile(index, width)
            entries = stiffness.ravel(), (rows.ravel(), columns.ravel())
            matrix = matrix + sparse.csr_array(entries, shape=matrix.shape)
        return force, sparse.csr_array(matrix)

    def _press(self, found, here, positive):
        """Unknowns (m, 24) of the points in contact, the forces there and their derivative (m, 24,
        24); a positive part of it if asked for.
        """
        corners = here[found.other]
        shape, slopes, twist = _bilinear(found.place)
        tangent = np.einsum("mac,mci->mai", slopes, corners)
        mixed = np.einsum("c,mci->mi", twist, corners)
        n = found.normal

        def rows(own, other, vector):
            """(m, 24) of what a motion of the nodes does along a vector."""
            both = np.concatenate([own, other], axis=1)
            return (both[:, :, None] * vector[:, None, :]).reshape(len(both), 24)

        none = np.zeros_like(found.share)
        along = rows(found.share, -shape, n)
        weight = self.penalty * found.area
        stiffness = along[:, :, None] * along[:, None, :]
        if not positive:
            # δy,α · n and (δx - δy) · y,α
            turn = np.stack([rows(none, slopes[:, a], n) for a in range(2)], axis=1)
            slide = np.stack([rows(found.share, -shape, tangent[:, a]) for a in range(2)], axis=1)
            metric = np.einsum("mai,mbi->mab", tangent, tangent)
            bend = np.zeros_like(metric)
            bend[:, 0, 1] = bend[:, 1, 0] = np.einsum("mi,mi->m", mixed, n)
            depth = found.gap[:, None, None]
            sliding = np.linalg.solve(metric - depth * bend, slide + depth * turn)
            turned = turn + bend @ sliding
            cross = np.swapaxes(turn, 1, 2) @ sliding
            second = depth * (np.swapaxes(turned, 1, 2) @ np.linalg.solve(metric, turned))
            second -= cross + np.swapaxes(cross, 1, 2)
            second -= np.swapaxes(sliding, 1, 2) @ bend @ sliding
            stiffness = stiffness + depth * second
        nodes = np.concatenate([found.own, found.other], axis=1)
        index = (3 * nodes[:, :, None] + np.arange(3)).reshape(len(nodes), 24)
        return index, (weight * found.gap)[:, None] * along, weight[:, None, None] * stiffness


def _faces(solid, outer):
    """Nodes (f, 4) of the outer faces and their shape functions (f, q, 4); and the nodes again, in
    order around each face and outward.
    """
    shape = solid.side_shape[outer]
    nodes = solid.side_nodes[outer]
    on_face = np.sort(np.argsort(-np.abs(shape).max(axis=1), axis=1)[:, :4], axis=1)
    own = np.take_along_axis(nodes, on_face, axis=1)
    share = np.take_along_axis(shape, on_face[:, None, :], axis=2)
    corners = solid.rest[own]
    middle = corners.mean(axis=1)
    outward = middle - solid.rest[nodes].mean(axis=1)
    side = corners[:, 0] - middle
    across = np.cross(outward, side)
    spread = corners - middle[:, None]
    angle = np.arctan2(
        np.einsum("fni,fi->fn", spread, across) / np.linalg.norm(across, axis=1)[:, None],
        np.einsum("fni,fi->fn", spread, side) / np.linalg.norm(side, axis=1)[:, None],
    )
    return own, share, np.take_along_axis(own, np.argsort(angle, axis=1), axis=1)


def _bilinear(place):
    """Shape functions (m, 4) of a face, their slopes (m, 2, 4), and the mixed second derivative
    (4,).
    """
    x, y = (1.0 + CORNERS[:, a] * place[:, [a]] for a in range(2))
    slopes = np.stack([CORNERS[:, 0] * y, CORNERS[:, 1] * x], axis=1)
    return 0.25 * x * y, 0.25 * slopes, 0.25 * CORNERS.prod(axis=1)


def closest(corners, points):
    """Places (m, 2) on faces of corners (m, 4, 3) where these are closest to points (m, 3)."""
    place = np.zeros((len(points), 2))
    for _ in range(PROJECTION_STEPS):
        shape, slopes, twist = _bilinear(place)
        away = points - np.einsum("mc,mci->mi", shape, corners)
        tangent = np.einsum("mac,mci->mai", slopes, corners)
        mixed = np.einsum("c,mci->mi", twist, corners)
        matrix = np.einsum("mai,mbi->mab", tangent, tangent)
        # Far from a face the curvature could make it singular: half of the metric stays.
        bend = np.einsum("mi,mi->m", away, mixed)
        most = 0.5 * np.sqrt(matrix[:, 0, 0] * matrix[:, 1, 1])
        matrix[:, 0, 1] -= np.clip(bend, -most, most)
        matrix[:, 1, 0] = matrix[:, 0, 1]
        determinant = matrix[:, 0, 0] * matrix[:, 1, 1] - matrix[:, 0, 1] ** 2
        least = 1e-3 * matrix[:, 0, 0] * matrix[:, 1, 1]
        determinant = np.maximum(determinant, least)
        side = np.einsum("mai,mi->ma", tangent, away)
        step = np.stack(
            [
                matrix[:, 1, 1] * side[:, 0] - matrix[:, 0, 1] * side[:, 1],
                matrix[:, 0, 0] * side[:, 1] - matrix[:, 0, 1] * side[:, 0],
            ],
            axis=1,
        )
        place = np.clip(place + step / determinant[:, None], -1.5, 1.5)
    return np.clip(place, -1.0, 1.0)


def _gaps(corners, points, place):
    """Distances (m,) along the normals (m, 3) of faces at a place, and to the place (m,)."""
    shape, slopes, _ = _bilinear(place)
    away = points - np.einsum("mc,mci->mi", shape, corners)
    tangent = np.einsum("mac,mci->mai", slopes, corners)
    normal = np.cross(tangent[:, 0], tangent[:, 1])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    return np.einsum("mi,mi->m", away, normal), normal, np.linalg.norm(away, axis=1)
