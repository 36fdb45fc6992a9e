"""Neighbouring muscles that keep their distance and slide: virtual edges as half-spaces.

After Cervenka et al. 2023, section 5.4.1: a point nearer to its neighbour than a threshold at rest stays near
the neighbour's surface; within a strip it is free, so that it slides; beyond a release distance it is let go.

All muscles predict first; then each sees its neighbours' predicted surfaces, and what it may do is written as
planes through its own predicted points. Each of two muscles may use half of the gap between them, or gives
way by half of the overlap, so both stay on their own side of one surface whatever the other does: the answer
does not depend on the order in which muscles are solved, nor on how many run at a time.
"""

import numpy as np

from rbfmuscle.sim.loop.skin import Skin
from rbfmuscle.sim.plan.reach import sampled_poses, swept_region
from rbfmuscle.validation import SceneError

# Defaults [mm]: nearer than THRESHOLD at rest is linked; STRIP beyond is free; RELEASE beyond that lets go.
THRESHOLD, STRIP, RELEASE = 2.0, 1.0, 2.0
# Neighbours are looked for within this distance [mm] of the predicted points.
SEARCH = 5.0
# Distance [mm] between the surfaces as solved below which they are cut, and how deep an overlap may be.
CUT_FROM, CUT_DEPTH = 4.0, 6.0


class Planes:
    """Half-spaces of one kind against one obstacle, fixed through a sub-step.

    Attributes
    ----------
    index, gap, normal
        As in :class:`~rbfmuscle.sim.loop.contact.HalfSpaces`, at the points ``anchor`` (c, 3).
    """

    def __init__(self):
        self.set(np.zeros(0, dtype=np.int64), np.zeros(0), np.zeros((0, 3)), np.zeros((0, 3)))

    def set(self, index, gap, normal, anchor):
        """Replace the planes."""
        self.index, self.gap, self.normal, self.anchor = index, gap, normal, anchor

    def contacts(self, points, reach):
        """``(index, gap, normal)`` of the planes nearer than ``reach`` to the model's contact points now."""
        gap = self.gap + np.einsum("ij,ij->i", self.normal, points[self.index] - self.anchor)
        near = gap < reach
        return self.index[near], gap[near], self.normal[near]


class Link:
    """How one muscle sees one neighbour: which points are linked, and the planes they get.

    Parameters
    ----------
    lane : Lane
        The muscle that is held.
    skin, other : Skin
        Its own surface and the neighbour's.
    limits : SlidingLimits
    """

    def __init__(self, lane, skin, other, limits):
        self.lane, self.skin, self.other, self.limits = lane, skin, other, limits
        self.push, self.pull = Planes(), Planes()
        self.free = lane.contacts.free(len(lane.model.contact_points()))
        self.linked = np.zeros(len(self.free), dtype=bool)
        self.before = None
        self.zone = None
        index, distance, _, _ = self._near()
        self.linked[index[distance < limits.threshold]] = True

    def update(self):
        """Planes from both muscles' predicted states."""
        limits = self.limits
        points = self.lane.model.contact_points()
        index, distance, normal, nearest = self._near()
        far = np.ones(len(points), dtype=bool)
        far[index] = distance > limits.hold + limits.release
        self.linked &= ~far
        if limits.join:
            self.linked[index[distance < limits.threshold]] = True
        share = np.where(self.other.fixed[nearest], 1.0, 0.5)
        self.push.set(index, share * distance, normal, points[index])
        held = self.linked[index]
        slack = share[held] * (limits.hold - distance[held])
        self.pull.set(index[held], slack, -normal[held], points[index[held]])

    def measure(self):
        """Overlap, widest gap of linked points, and their slip over the neighbour since the last call."""
        points = self.lane.model.contact_points()
        index, distance, normal, nearest = self._near()
        held = self.linked[index]
        close = distance < self.limits.cut_from
        self.zone = _box(points[index[close]], self.limits.cut_depth) if close.any() else None
        found = {
            "sliding_overlap_max": max(0.0, -float(distance.min(initial=0.0))),
            "sliding_gap_max": float(distance[held].max(initial=0.0)),
            "sliding_speed": self._slip(points, index[held], normal[held], nearest[held]),
        }
        self.before = points.copy(), self.other.vertices.copy()
        return found

    def cut(self, points):
        """Half the difference of both muscles' distances near where they meet, infinity elsewhere."""
        return self.cut_with_gradient(points)[0]

    def cut_with_gradient(self, points):
        """Cut (n,) and its gradient (n, 3): the surface midway between two overlapping muscles."""
        value, gradient = np.full(len(points), np.inf), np.zeros((len(points), 3))
        if self.zone is None or not self.limits.cut:
            return value, gradient
        zone, depth = self.zone, self.limits.cut_depth
        inside = np.all((points > zone[0]) & (points < zone[1]), axis=1)
        if self.skin.implicit is not None and self.other.implicit is not None:
            # What is shown is the zero set of the fields: where these are equal both are cut alike.
            (ours, own), (theirs, normal) = (
                self.skin.implicit(points[inside]),
                self.other.implicit(points[inside]),
            )
            value[inside], gradient[inside] = 0.5 * (theirs - ours), 0.5 * (normal - own)
            return value, gradient
        near, theirs, normal, _ = self.other.query(points, inside, depth)
        inside[:] = False
        inside[near] = True
        both, ours, own, _ = self.skin.query(points, inside, depth)
        match = np.searchsorted(near, both)
        value[both] = 0.5 * (theirs[match] - ours)
        gradient[both] = 0.5 * (normal[match] - own)
        return value, gradient

    def _near(self):
        return self.other.query(self.lane.model.contact_points(), self.free, self.limits.search)

    def _slip(self, points, index, normal, nearest):
        if self.before is None or len(index) == 0:
            return 0.0
        own = points[index] - self.before[0][index]
        way = own - (self.other.vertices[nearest] - self.before[1][nearest])
        way -= np.einsum("ij,ij->i", way, normal)[:, None] * normal
        return float(np.linalg.norm(way, axis=1).mean())


class BoneLink:
    """Points near a bone at rest, held near it in the same way; the bone's own contact keeps them out."""

    def __init__(self, lane, bone_index, limits):
        self.lane, self.bone, self.limits = lane, bone_index, limits
        points = lane.model.contact_points()
        distance, _ = lane.contacts.distance_and_direction(points, bone_index)
        self.linked = lane.contacts.free(len(points)) & (distance < limits.threshold)
        self.pull = Planes()

    def update(self):
        """Planes from the predicted state."""
        limits, points = self.limits, self.lane.model.contact_points()
        index = np.flatnonzero(self.linked)
        distance, normal = self.lane.contacts.distance_and_direction(points[index], self.bone)
        held = distance <= limits.hold + limits.release
        self.linked[index[~held]] = False
        index, distance, normal = index[held], distance[held], normal[held]
        self.pull.set(index, limits.hold - distance, -normal, points[index])


class SlidingLimits:
    """The distances of ``[sliding]`` in the scene's unit, with their defaults."""

    def __init__(self, options, scene):
        def length(value, default):
            return scene.length(default) if value is None else float(value)

        self.threshold = length(options.threshold, THRESHOLD)
        self.hold = self.threshold + length(options.strip, STRIP)
        self.release = length(options.release, RELEASE)
        self.search = max(scene.length(SEARCH), self.hold + self.release)
        self.cut_from, self.cut_depth = scene.length(CUT_FROM), scene.length(CUT_DEPTH)
        self.join, self.cut = options.join, options.cut


class Sliding:
    """All links of a scene.

    Parameters
    ----------
    scene : Scene
        With ``sliding`` options.
    lanes : list of Lane
        In their rest state.

    Raises
    ------
    SceneError
        If ``pairs`` names an unknown muscle.
    """

    def __init__(self, scene, lanes):
        options = scene.sliding
        limits = SlidingLimits(options, scene)
        self.links = {lane.name: [] for lane in lanes}
        self.bone_links = {lane.name: [] for lane in lanes}
        pairs = _pairs(scene, [lane.name for lane in lanes], limits.search)
        reach = max(limits.search, limits.cut_depth)
        self.skins = {
            lane.name: Skin(lane.model, reach) for lane in lanes if any(lane.name in p for p in pairs)
        }
        for lane in lanes:
            for other in lanes:
                if frozenset((lane.name, other.name)) in pairs:
                    link = Link(lane, self.skins[lane.name], self.skins[other.name], limits)
                    self.links[lane.name].append(link)
                    lane.contacts.neighbours += [link.push, link.pull]
                    lane.contacts.cuts.append(link)
            if options.bones:
                held = [BoneLink(lane, b, limits) for b in lane.contacts.reached]
                self.bone_links[lane.name] = held
                lane.contacts.neighbours += [link.pull for link in held]

    def refresh(self, lane):
        """Take over a muscle's surface as it is now."""
        if lane.name in self.skins:
            with lane.timed("sliding"):
                self.skins[lane.name].refresh()

    def fit(self, lane):
        """Take over the field that a muscle will be shown by, where it has one."""
        if self.links[lane.name] and hasattr(lane.model, "implicit"):
            with lane.timed("surface"):
                self.skins[lane.name].implicit = lane.model.implicit()

    def update(self, lane):
        """New planes for one muscle; its neighbours' skins have been refreshed."""
        with lane.timed("sliding"):
            for link in [*self.links[lane.name], *self.bone_links[lane.name]]:
                link.update()

    def measure(self, lane):
        """Worst of what a muscle's links say: a dict of quantities, empty without neighbours."""
        with lane.timed("sliding"):
            found = [link.measure() for link in self.links[lane.name]]
        return {key: max(one[key] for one in found) for key in found[0]} if found else {}


def _pairs(scene, names, reach):
    """Pairs of muscles that slide: those named, or all, as far as their swept boxes meet."""
    named = scene.sliding.pairs
    for name in sorted({name for pair in named or [] for name in pair}):
        if name not in names:
            raise SceneError(f"[sliding] pairs: unknown muscle {name!r}, known: {', '.join(names)}")
    wanted = [frozenset(pair) for pair in named] if named else None
    muscles = [muscle for muscle in scene.muscles if muscle.name in names]
    root = scene.bones[0].name
    poses = sampled_poses(scene)
    boxes = {muscle.name: swept_region(muscle, root, poses) for muscle in muscles}
    found = set()
    for i, one in enumerate(muscles):
        for two in muscles[:i]:
            a, b = boxes[one.name], boxes[two.name]
            pair = frozenset((one.name, two.name))
            if (
                np.all(a[0] - reach <= b[1])
                and np.all(b[0] - reach <= a[1])
                and (not wanted or pair in wanted)
            ):
                found.add(pair)
    return found


def _box(points, pad):
    return points.min(axis=0) - pad, points.max(axis=0) + pad
