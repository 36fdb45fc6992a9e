"""A bone's distance with its facets rounded off, for what settles on it.

Bones are meshes: flat facets that meet at an angle. A surface of points that slides over one has a
place to rest between every two edges, as cogs have; a bone has not. Here the distance is a cubic
B-spline whose coefficients are the exact distances at the nodes of a lattice: smoothed over about a
cell (a kernel of a standard deviation of 0.58 cells), its gradient turns steadily. Only blocks of
the lattice that are asked for are ever filled.
"""

from collections.abc import Sequence

import numpy as np

from rbfmuscle.bones.broad_phase import box_loop, boxes_apart, lower_bound, note_query
from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.geometry.bsplines import bspline_sum, bspline_weights
from rbfmuscle.geometry.fields import BoneField
from rbfmuscle.geometry.rest_frame import RestFrame
from rbfmuscle.jit import compiled
from rbfmuscle.simulation.contact import BoneContacts, HalfSpaces
from rbfmuscle.validation import check_points

SIDE = 4  # cells along a block
WIDE = SIDE + 3  # nodes along it, those of the splines that reach into it too
MOST = 1 << 20  # blocks along an axis in either direction: beyond any bone
SHIFTS = np.array([42, 21, 0])  # bits of a block's three numbers in its key
PROBES, STEPS_IN = 300, 12  # paths into a bone that tell how thick it is, and places along each
LEAST_SLOPE = 0.3  # where the distance's slope is less, inside a thin bone, the exact one answers


class RoundedBones:
    """The rounded distances to some bones, in place of their exact fields where a muscle settles.

    ``frame`` gives the axes and the origin of their lattices, which are then those of the muscle
    wherever the scene lies; ``edges`` (r,) are those of their cells [scene unit]. The blocks of
    bone b are those from ``start[b]`` on, by their sorted ``keys``, each with its ``nodes``.
    """

    def __init__(self, fields: Sequence[BoneField], frame: RestFrame, edges: Floats) -> None:
        self.fields = list(fields)
        self.frame = frame
        self.edges = edges
        self.start: Integers = np.zeros(len(self.fields) + 1, dtype=np.int64)
        self.keys: Integers = np.zeros(0, dtype=np.int64)
        self.nodes: Floats = np.zeros((0, WIDE, WIDE, WIDE))

    def fill(self, rows: Integers, keys: Integers) -> None:
        """Find the distances of blocks (n,) that are lacking, given by bones' rows and blocks'
        keys.
        """
        grid = np.stack(np.meshgrid(*[np.arange(WIDE) - 1] * 3, indexing="ij"), -1).reshape(-1, 3)
        owner = [np.repeat(np.arange(len(self.fields)), np.diff(self.start))]
        key, nodes = [self.keys], [self.nodes]
        for b in np.unique(rows):
            new = np.unique(keys[rows == b])
            block = (new[:, None] >> SHIFTS & 2 * MOST - 1) - MOST
            place = (block[:, None, :] * SIDE + grid).reshape(-1, 3) * self.edges[b]
            found = (
                self.fields[b].distance(self.frame.origin + place @ self.frame.axes) / self.edges[b]
            )
            owner.append(np.full(len(new), b))
            key.append(new)
            nodes.append(found.reshape(-1, WIDE, WIDE, WIDE))
        order = np.lexsort((np.concatenate(key), np.concatenate(owner)))
        self.keys, self.nodes = np.concatenate(key)[order], np.concatenate(nodes)[order]
        self.start = np.searchsorted(np.concatenate(owner)[order], np.arange(len(self.fields) + 1))


class RoundedContacts:
    """The obstacles of ``count`` contact points in one pose of the bones, which are rounded;
    ``exact`` as they are.
    """

    def __init__(self, bones: RoundedBones, exact: BoneContacts, count: int) -> None:
        self.bones = bones
        self.exact = exact
        rows = len(exact.reached)
        turns, origin = exact.placed[:, :3, :3], bones.frame.origin
        axes = np.ascontiguousarray(bones.frame.axes @ turns.transpose(0, 2, 1))
        self._lattice = axes, turns @ origin + exact.placed[:, :3, 3], bones.edges
        self._known = np.zeros((rows, count, 3)), np.full((rows, count), -np.inf)
        self._free, self._allowed = exact.free(count), np.zeros((rows, count))
        for row, b in enumerate(exact.reached):
            self._allowed[row] = exact.allowed.get(b, 0.0)

    def half_spaces(self, points: Floats, reach: Floats) -> HalfSpaces:
        """As `BoneContacts.half_spaces`, of all the contact points (n, 3), nearer than ``reach``
        (n,).
        """
        exact = self.exact
        bones = self.bones
        points = check_points(points)
        room = self._allowed.size
        index, row = np.empty((2, room), dtype=np.int64)
        gap, normal = np.empty(room), np.empty((room, 3))
        while True:
            count, lacking, flat = _contacts_loop(
                points,
                self._free,
                reach,
                (exact.placed, exact.boxes, self._allowed),
                self._known,
                self._lattice,
                (bones.start, bones.keys, bones.nodes),
                (index, gap, normal, row),
            )
            if not lacking:
                break
            bones.fill(row[:lacking], index[:lacking])
        index = index[:count]
        gap = gap[:count]
        normal = normal[:count]
        row = row[:count]
        if flat:
            for k in np.unique(row[np.isnan(gap)]):
                some = np.flatnonzero(np.isnan(gap) & (row == k))
                at = index[some]
                distance, normal[some] = exact.distance_and_direction(
                    points[at], exact.reached[k], reach[at]
                )
                gap[some] = distance + self._allowed[k, at]
            near = gap < reach[index]
            index = index[near]
            gap = gap[near]
            normal = normal[near]
            row = row[near]
        source = np.array(exact.reached, dtype=np.int64)[row]
        return exact.with_planes(HalfSpaces(index, gap, normal, source), points, reach)


def bone_thickness(field: BoneField, vertices: Floats, faces: Integers, most: float) -> float:
    """Thickness that nine tenths of a bone's surface exceed, at most ``most`` [scene unit].

    Twice the depth that a path into the bone, from the middle of a face against its normal,
    reaches.
    """
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    normal = np.cross(b - a, c - a)
    area = np.linalg.norm(normal, axis=1)
    share = (np.arange(PROBES) + 0.5) / PROBES * area.sum()
    chosen = np.minimum(np.searchsorted(np.cumsum(area), share), len(faces) - 1)
    start, way = (
        (a + b + c)[chosen] / 3.0,
        -normal[chosen] / np.maximum(area[chosen], 1e-300)[:, None],
    )
    depth = np.zeros(PROBES)
    for t in np.linspace(0.0, most, STEPS_IN + 1)[1:]:
        depth = np.maximum(depth, -field.distance(start + t * way))
    return min(2.0 * float(np.quantile(depth, 0.1)), most)


@compiled(error_model="numpy", inline="always")
def _place(point, axis, origin, edge):
    """Place of a point along an axis of the lattice, in cells."""
    place = 0.0
    for b in range(3):
        place += (point[b] - origin[b]) * axis[b]
    return place / edge


@compiled(error_model="numpy")
def _contacts_loop(points, free, reach, obstacles, known, lattice, blocks, found):
    """Fill the contacts ``found`` of all bones: how many, how many blocks are lacking, whether
    splines are flat.

    The bones' rows and the keys of lacking blocks are put into ``found`` instead; the gap is NaN
    where a spline is flat. ``known`` has the places of the last queries in bone coordinates and
    lower bounds of the distances there.
    """
    poses, boxes, allowed = obstacles
    anchor, bound = known
    axes, origin, edge = lattice
    start, keys, nodes = blocks
    index, gap, normal, row = found
    box = np.empty((2, 3))
    weight = np.empty((3, 4))
    lean = np.empty((3, 4))
    place, first = np.empty(3), np.empty(3, np.int64)
    box_loop(points, free, box)
    farthest = -np.inf
    count = 0
    lacking = 0
    flat = False
    for i in range(len(points)):
        if free[i]:
            farthest = max(farthest, reach[i])
    for b in range(len(poses)):
        if boxes_apart(box, poses[b], boxes[b]) > farthest:
            continue
        known_keys = keys[start[b] : start[b + 1]]
        for i in range(len(points)):
            if (
                not free[i]
                or lower_bound(points, i, poses[b], boxes[b], anchor[b], bound[b]) > reach[i]
            ):
                continue
            key = 0
            for a in range(3):
                place[a] = _place(points[i], axes[b, a], origin[b], edge[b])
                key += (np.int64(np.floor(place[a] / SIDE)) + MOST) << SHIFTS[a]
            k = np.searchsorted(known_keys, key)
            if k == len(known_keys) or known_keys[k] != key:
                row[lacking], index[lacking] = b, key
                lacking += 1
            if lacking > 0:
                continue
            for a in range(3):
                cell = np.int64(np.floor(place[a]))
                bspline_weights(place[a] - cell, weight[a], lean[a])
                first[a] = cell - SIDE * np.int64(np.floor(place[a] / SIDE))
            value, x, y, z = bspline_sum(nodes[start[b] + k], first, weight, lean)
            steep, here = np.sqrt(x * x + y * y + z * z), np.nan
            if steep > LEAST_SLOPE:
                here = value / steep * edge[b]
                note_query(points, i, poses[b], here, anchor[b], bound[b])
                here += allowed[b, i]
                for a in range(3):
                    normal[count, a] = (
                        x * axes[b, 0, a] + y * axes[b, 1, a] + z * axes[b, 2, a]
                    ) / steep
            else:
                flat = True
            if not here >= reach[i]:
                index[count] = i
                gap[count] = here
                row[count] = b
                count += 1
    return count, lacking, flat
