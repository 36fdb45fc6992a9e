"""What the contact points of a solid meet, and how these yield to forces.

Bones are met with their facets rounded, fences where a point would pass through a bone.
"""

from collections.abc import Sequence

import numpy as np

from rbfmuscle.bones.distance import BoneArrays, Memory, distance_loop, least_distance
from rbfmuscle.bones.rounded import LEAST_SLOPE, RoundedBone, rounded_at
from rbfmuscle.geometry.arrays import Booleans, Floats, Integers, Singles
from rbfmuscle.geometry.frames import dot, local_point, row_of
from rbfmuscle.geometry.interpolation import Embedding
from rbfmuscle.loops import loop
from rbfmuscle.simulation.contact import NO_FENCES, HalfSpaces
from rbfmuscle.solid.kernels import add_rows

# Least cosine of the angle between the normals of a bone and of its rounded surface that counts.
LEAST_ALONG = 0.5
MOST_ROWS = 800  # contact points whose rows are kept: more are found anew


class Obstacles:
    """What the n contact points of a solid meet: bones in reach, rounded, and fences.

    Parameters
    ----------
    exact : sequence of BoneArrays
        The b bones in reach.
    rounded : sequence of RoundedBone
        The same bones as this muscle meets them.
    poses : (b, 4, 4) ndarray
        Of the bones; changed in place by whoever moves them.
    free : (n,) ndarray of bool
        Which contact points no bone holds; the others take no contact.
    allowed : (b, n) ndarray
        How deep each may be in a bone [scene unit]; changed in place.
    """

    def __init__(
        self,
        exact: Sequence[BoneArrays],
        rounded: Sequence[RoundedBone],
        poses: Floats,
        free: Booleans,
        allowed: Floats,
    ) -> None:
        self.exact = exact
        self.rounded = rounded
        self.poses = poses
        self.free = np.flatnonzero(free)
        self.allowed = allowed
        self.fences = NO_FENCES
        self.count = len(exact) + 1
        # Where each point was last asked about, in bone coordinates, and its distance there.
        self._smooth = [(np.zeros((len(free), 3)), np.full(len(free), -np.inf)) for _ in exact]
        self._exact = [Memory.of(len(free)) for _ in exact]

    def find_near(self, points: Floats, reach: float) -> Integers:
        """Which of the free points (n, 3) are nearer to an obstacle than ``reach``."""
        here = points[self.free]
        found = np.zeros(len(points), dtype=np.bool_)
        met = self.meet(self.free, here, np.full(len(here), reach))
        found[self.free[met.point]] = True
        return np.flatnonzero(found)

    def meet(self, which: Integers, here: Floats, reach: Floats) -> HalfSpaces:
        """The half-spaces that points ``which`` (m,), now ``here`` (m, 3), meet within ``reach``
        (m,).
        """
        room = len(which) * len(self.exact)
        found = HalfSpaces(
            np.empty(room, np.int64), np.empty(room), np.empty((room, 3)), np.empty(room, np.int64)
        )
        unknown = np.empty(len(which), np.int64)
        parts = [self.fences.meet(which, here, len(self.exact))]
        count = 0
        for b in range(len(self.exact)):
            count, lost = meet_bone(
                self.rounded[b],
                self.exact[b].boxes,
                self.poses[b],
                which,
                here,
                reach,
                self.allowed[b],
                *self._smooth[b],
                b,
                count,
                *found,
                unknown,
            )
            if lost:
                some = unknown[:lost]
                gap, normal = self.ask(b, which[some], here[some], reach[some])
                near = np.flatnonzero(gap < reach[some])
                source = np.full(len(near), b)
                parts.append(HalfSpaces(some[near], gap[near], normal[near], source))
        parts.append(found.some(slice(count)))
        return HalfSpaces.joined(parts)

    def meet_exactly(self, which: Integers, here: Floats, reach: float) -> HalfSpaces:
        """The same with the bones as they are, but along the normals of the rounded ones: those of
        facets turn at once where a point passes an edge.
        """
        parts = [self.fences.meet(which, here, len(self.exact))]
        for b in range(len(self.exact)):
            gap, normal = self.ask(b, which, here, np.full(len(which), reach))
            near = np.flatnonzero(gap < reach)
            gap, normal = gap[near], normal[near]
            turn_normals(self.rounded[b], self.poses[b], here[near], gap, normal)
            parts.append(HalfSpaces(near, gap, normal, np.full(len(near), b)))
        return HalfSpaces.joined(parts)

    def ask(self, b: int, which: Integers, here: Floats, reach: Floats) -> tuple[Floats, Floats]:
        """Gaps (m,) to bone b as it is, at least ``reach`` (m,) where they are more, and its
        normals (m, 3).
        """
        known = self._exact[b]
        some = known.some(which)
        gap, normal = np.empty(len(which)), np.empty((len(which), 3))
        allowed = self.allowed[b, which]
        distance_loop(self.exact[b], self.poses[b], here, reach - allowed, *some, gap, normal)
        for part, found in zip(known, some, strict=True):
            part[which] = found
        return gap + allowed, normal


@loop
def meet_bone(
    rounded,
    boxes,
    pose,
    which,
    here,
    reach,
    allowed,
    anchor,
    bound,
    bone,
    count,
    point,
    gap,
    normal,
    source,
    unknown,
):
    """Add the half-spaces that points ``here`` (m, 3) meet at one rounded bone within ``reach``
    (m,) to the ``count`` first rows of `HalfSpaces` with ``bone`` as their source. Returns their
    number then, and that of the points where the rounded bone has no answer, whose places are
    written to ``unknown`` (m,).

    ``which`` (m,) are the numbers of the points in ``allowed`` (n,), how deep each may be in the
    bone, and in what is known of each: its distance was ``bound`` (n,) at ``anchor`` (n, 3) in bone
    coordinates, and changes by no more than the point moves. ``boxes`` are those of the bone's
    `BoneArrays`.
    """
    lost = 0
    for k in range(len(which)):
        i = which[k]
        local = local_point(pose, row_of(here, k))
        wanted = reach[k] - allowed[i]
        if least_distance(boxes, local, row_of(anchor, i), bound[i]) >= wanted:
            continue
        smooth, distance, x, y, z = rounded_at(rounded, *local, LEAST_SLOPE)
        if np.isnan(distance):
            unknown[lost] = k
            lost += 1
            continue
        if distance == np.inf:
            continue
        bound[i] = smooth
        for a in range(3):
            anchor[i, a] = local[a]
        if distance < wanted:
            point[count] = k
            gap[count] = distance + allowed[i]
            for a in range(3):
                normal[count, a] = pose[a, 0] * x + pose[a, 1] * y + pose[a, 2] * z
            source[count] = bone
            count += 1
    return count, lost


@loop
def turn_normals(rounded, pose, here, gap, normal):
    """Turn the normals (k, 3) at points ``here`` (k, 3) to those of a rounded bone with ``pose``
    (4, 4), where it has any; the gaps (k,) become the ways along these.
    """
    for k in range(len(here)):
        local = local_point(pose, row_of(here, k))
        _, _, gx, gy, gz = rounded_at(rounded, *local, LEAST_SLOPE)
        if np.isnan(gx):
            continue
        along = 0.0
        for a in range(3):
            turned = dot(row_of(pose, a), (gx, gy, gz))
            along += turned * normal[k, a]
            normal[k, a] = turned
        gap[k] /= max(along, LEAST_ALONG)


@loop(fastmath={"contract"})
def fill_delassus(columns, shares, normal, rows, out):
    """Fill the motions (w, w) of points along their ``normal`` (w, 3) by unit forces along these.

    ``columns`` and ``shares`` (w, 27) are those of the points, ``rows`` (w, 3 N) the motions of the
    nodes.
    """
    for i in range(len(columns)):
        row = rows[i]
        for j in range(i + 1):
            value = 0.0
            for k in range(columns.shape[1]):
                n = 3 * columns[j, k]
                along = (
                    normal[j, 0] * row[n] + normal[j, 1] * row[n + 1] + normal[j, 2] * row[n + 2]
                )
                value += shares[j, k] * along
            out[i, j] = value
            out[j, i] = value


class Reaction:
    """Motions of the nodes by unit forces at the points that have been in contact.

    Parameters
    ----------
    embedding : Embedding
        Of all contact points.
    inverse : (3 N, 3 N) ndarray
        H⁻¹.
    """

    def __init__(self, embedding: Embedding, inverse: Singles) -> None:
        self.embedding = embedding
        self.inverse = inverse
        self._clear()

    def _clear(self) -> None:
        self.slot = np.full(len(self.embedding.columns), -1)
        self.count = 0
        self.rows = np.empty((64, 3, len(self.inverse)), np.float32)

    def along(self, points: Integers, normal: Floats) -> Singles:
        """Motions (w, 3 N) by unit forces along ``normal`` (w, 3) at some points."""
        new = np.unique(points[self.slot[points] < 0])
        if len(new):
            if self.count + len(new) > MOST_ROWS:
                self._clear()
                new = np.unique(points)
            self._add(new)
        out = np.empty((len(points), len(self.inverse)), np.float32)
        combine(self.slot[points], normal, self.rows, out)
        return out

    def at(self, feet: Embedding, normal: Floats) -> Singles:
        """Motions (w, 3 N) by unit forces along ``normal`` (w, 3) at other embedded points."""
        rows = np.empty((len(normal), len(self.inverse)), np.float32)
        width = 3 * feet.columns.shape[1]
        shares = (feet.shares[:, :, None] * normal[:, None, :]).reshape(-1, width)
        columns = (3 * feet.columns[:, :, None] + np.arange(3)).reshape(-1, width)
        add_rows(columns, shares, self.inverse, rows)
        return rows

    def _add(self, new: Integers) -> None:
        first, self.count = self.count, self.count + len(new)
        self.slot[new] = np.arange(first, self.count)
        if self.count > len(self.rows):
            known = self.rows
            self.rows = np.empty((2 * self.count, 3, len(self.inverse)), np.float32)
            self.rows[:first] = known[:first]
        columns, shares = self.embedding.some(new)
        three = np.repeat(3 * columns, 3, axis=0) + np.tile(np.arange(3), len(new))[:, None]
        rows = self.rows[first : self.count].reshape(3 * len(new), -1)
        add_rows(three, np.repeat(shares, 3, axis=0), self.inverse, rows)


@loop(fastmath={"contract"})
def combine(slots, normal, rows, out):
    """Fill the sums (w, m) along ``normal`` (w, 3) of the ``rows`` (k, 3, m) at ``slots`` (w,)."""
    for i in range(len(slots)):
        x, y, z = rows[slots[i]]
        for n in range(out.shape[1]):
            out[i, n] = normal[i, 0] * x[n] + normal[i, 1] * y[n] + normal[i, 2] * z[n]
