"""How the way from one frame to the next is cut into sub-steps."""

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple, TypeAlias

import numpy as np

from rbfmuscle.geometry.arrays import Floats, to_world
from rbfmuscle.geometry.frames import RestFrame, diameter
from rbfmuscle.loops import loop
from rbfmuscle.scene.frames import interpolate
from rbfmuscle.scene.joints import Coordinate, all_coordinates
from rbfmuscle.scene.motion import (
    bone_poses,
    rest_coordinates,
    shown_value,
    step_angle,
    unit_sign,
)
from rbfmuscle.scene.objects import Muscle, from_mm
from rbfmuscle.scene.scene import Scene
from rbfmuscle.scene.tendons import Poses
from rbfmuscle.validation import SceneError

Coordinates: TypeAlias = dict[str, float]
# No attached point moves farther against a bone in one sub-step than this share of its muscle's
# diameter.
TRAVEL = 1.0 / 27.0
# A tendon's end asks for at most so many times the sub-steps that the bones themselves need: where
# it jumps, no number of them would do.
FINER = 8.0
# Sub-steps that one coordinate may take in a motion, and a muscle in one frame: 90 degrees
# take 45, the end of a tendon 8 times that.
MOST_SUBSTEPS = 100_000
MOST_IN_FRAME = 2000
LOOKED_INTO = 64  # where it is about as many, it is first found whether smaller ones are shorter
# Pieces in which a path is followed to see how far it turns the bones.
PIECES = 8


class StepLimits(NamedTuple):
    """What one step may do to b bones and ends."""

    root: int  # the bone from which they are seen to turn, -1 for the world
    owner: np.ndarray  # (a,) bone of each attachment
    corners: np.ndarray  # (a, 8, 3) of a box about it
    travel: np.ndarray  # (a,) by how much these may move [scene unit]
    angle: float  # by which a bone may turn [radian]
    is_end: np.ndarray  # (b,) what is the end of a tendon
    seen: int  # the first so many are those from which attachments are seen to move


class SubSteps:
    """How a scene's motion is cut into sub-steps.

    No bone turns by more than the scene's ``substep_angle`` in one, and no attached point moves far
    against a bone. Where one coordinate moves alone, sub-steps end at multiples of that angle,
    however the frames are spaced: a muscle that can settle in several ways then comes to a pose by
    the same path. For one ``muscle`` only its own bones and the others that it can meet, ``bones``,
    count.
    """

    def __init__(
        self,
        scene: Scene,
        muscle: Muscle | None = None,
        *,
        bones: Sequence[str] = (),
        poses: Callable[[Coordinates], Poses] | None = None,
    ) -> None:
        self.scene, self._poses = scene, poses or PoseCache(scene)
        self._rest = rest_coordinates(scene)
        muscles = scene.muscles if muscle is None else [muscle]
        attachments = [(part, attachment) for part in muscles for attachment in part.attachments]
        own = [attachment.attachment_frame for _, attachment in attachments]
        self._facts = all_coordinates(scene.joints)
        #: The bones that count, and the coordinates that move them against each other. A muscle's
        #: are seen from the
        #: first that holds it, a whole scene's from the world.
        guides = [name for _, attachment in attachments for name in attachment.bones]
        if muscle is None:
            self.bones = [*dict.fromkeys([*own, *(bone.name for bone in scene.bones)])]
            self.relevant = set(self._facts)
        else:
            self.bones = [*dict.fromkeys([*own, *bones])]
            self.relevant = _moving_apart(scene, [*guides, *bones])
        self.limit = math.radians(scene.contact.substep_angle)
        # Of each attachment: its bone, a box about it, and how far that may move in one sub-step.
        frames = {part.name: RestFrame(np.asarray(part.mesh.vertices)) for part in muscles}
        corners = [
            frames[part.name].corners(attachment.vertices) for part, attachment in attachments
        ]
        sizes = [diameter(np.asarray(part.mesh.vertices)) for part, _ in attachments]
        ends = {
            attachment.attachment_frame
            for _, attachment in attachments
            if attachment.tendon is not None
        }
        # Attached points are seen from these; behind them come the bones that guide tendons.
        seen = len(self.bones)
        self.bones = [*dict.fromkeys([*self.bones, *guides])]
        # Seen from a bone, not from an end that may jump.
        root = -1 if muscle is None else self.bones.index(guides[0]) if guides else 0
        self._limits = StepLimits(
            root,
            np.array([self.bones.index(name) for name in own], dtype=int),
            np.array(corners).reshape(-1, 8, 3),
            TRAVEL * np.array(sizes),
            self.limit,
            np.array([name in ends for name in self.bones], dtype=bool),
            seen,
        )

    def split(self, before: Coordinates, after: Coordinates) -> list[Coordinates]:
        """Coordinates of the sub-steps to the next frame, ``before`` left out; empty where nothing
        moves. SceneError says why there would be more than `MOST_IN_FRAME`.
        """
        before, after = {**self._rest, **before}, {**self._rest, **after}
        moving = [k for k in {*before, *after} if before.get(k, 0.0) != after.get(k, 0.0)]
        if not moving:
            return []
        moving = [k for k in moving if k in self.relevant]
        if not moving:
            return [dict(after)]
        if len(moving) == 1 and self._facts[moving[0]].motion == "rotation":
            return [*self._stops_on_grid(before, after, moving[0]), dict(after)]
        # What does not move these bones against each other does not count.
        start = {**before, **{k: value for k, value in after.items() if k not in self.relevant}}
        angle = path_angle(self.scene, start, after, self._facts)
        first, last = (interpolate(before, after, t) for t in (0.0, 1.0))
        return self._even_stops(first, last, angle)

    def _even_stops(self, before, after, angle):
        """The fewest equal sub-steps that are short enough, in which no bone turns by more than
        ``angle`` [radian] in all; both ends name the same coordinates.
        """
        count = max(1, math.ceil(angle / self.limit - 1e-9))
        while True:
            if count > MOST_IN_FRAME:
                raise SceneError(self._too_many(before, after))
            between = [interpolate(before, after, k / count) for k in range(1, count)]
            stops = [before, *between, after]
            poses = [self._matrices(stop) for stop in stops]
            excess = list(map(self._excess, poses[:-1], poses[1:]))
            most = max(excess)
            if most <= 1.0 + 1e-9:
                return stops[1:]
            worst = excess.index(most)
            if count * most > LOOKED_INTO:
                self._halve(stops[worst], stops[worst + 1], MOST_IN_FRAME / count)
            count = max(count + 1, math.ceil(count * min(most, 4.0)))

    def _halve(self, before, after, most):
        """Halve a step, always the half that asks for more, until it is short enough; SceneError
        where that takes more than ``most`` parts. It is found at once where a bone jumps.
        """
        parts = 1
        whole = before, after
        while True:
            middle = interpolate(before, after, 0.5)
            halves = [(before, middle), (middle, after)]
            values = [self._excess(*map(self._matrices, half)) for half in halves]
            parts *= 2
            before, after = halves[int(np.argmax(values))]
            if max(values) <= 1.0 + 1e-9:
                return
            if parts > most:
                raise SceneError(self._too_many(*whole))

    def _too_many(self, before, after):
        """What moves too far from one set of coordinates to another, and what may be wrong."""
        moving = [k for k in after if before.get(k, 0.0) != after[k]]
        way = ", ".join(
            f"{k} {shown_value(self.scene, k, before.get(k, 0.0)):.6g} to "
            f"{shown_value(self.scene, k, after[k]):.6g}{unit_sign(self.scene, k)}"
            for k in moving
        )
        old, new = self._matrices(before), self._matrices(after)
        bone, seen, far = self._farthest(old, new)
        most = self._limits.travel.min(initial=np.inf)
        moved = f"{bone} moves by {far:.4g} {self.scene.units}{seen and f' against {seen}'}"
        return (
            f"more than {MOST_IN_FRAME} sub-steps in one frame: between {way} {moved}, and a "
            f"sub-step may move it by {most:.3g} (1/27 of a muscle's size) and turn it "
            f"by {math.degrees(self.limit):.3g} deg; correct the joints that move it or take "
            "frames closer together"
        )

    def _farthest(self, old, new):
        """Of a step between poses (b, 4, 4): what holds the attached points that move farthest, the
        bone from which they are seen, and how far.
        """
        found = ("a bone", "", 0.0)
        limits = self._limits
        for owner, corners in zip(limits.owner, limits.corners):
            for seen in range(limits.seen):
                ways = [
                    to_world(corners, to)
                    for to in (np.linalg.inv(pose[seen]) @ pose[owner] for pose in (old, new))
                ]
                far = float(np.linalg.norm(ways[1] - ways[0], axis=1).max())
                if far > found[2] and not limits.is_end[[owner, seen]].any():
                    found = (self.bones[owner], self.bones[seen], far)
        return found

    def estimate(self, name: str, changes: Floats) -> float:
        """About how many sub-steps some changes of one coordinate take, from a small probe at rest;
        may be infinite.
        """
        turns = self._facts[name].motion == "rotation"
        probe = self.limit if turns else from_mm(1.0, self.scene.units)
        rest = rest_coordinates(self.scene)
        moved = {**rest, name: rest.get(name, 0.0) + probe}
        with np.errstate(all="ignore"):
            excess = self._excess(self._matrices(rest), self._matrices(moved))
            rate = max(1.0 if turns else 0.0, excess) / probe if math.isfinite(excess) else math.inf
            total = float(np.ceil(np.abs(changes[changes != 0.0]) * rate - 1e-9).sum())
        # Not a number, where numbers overflow, is more than any limit.
        return total if math.isfinite(total) else math.inf

    def _stops_on_grid(self, before, after, name):
        """Stops strictly between two values of the coordinate ``name``, in order."""
        start, end = before.get(name, 0.0), after.get(name, 0.0)
        low, high = min(start, end), max(start, end)
        found = []
        for cell in range(math.floor(low / self.limit + 1e-9), math.ceil(high / self.limit - 1e-9)):
            # The whole cell decides how it is split, also where the path takes only a part of it.
            ends = [{**before, name: self.limit * (cell + k)} for k in range(2)]
            if len(found) > MOST_IN_FRAME:
                raise SceneError(self._too_many(before, after))
            found.append(ends[0][name])
            angle = abs(ends[1][name] - ends[0][name])
            found += [stop[name] for stop in self._even_stops(ends[0], ends[1], angle)]
        margin = 1e-6 * self.limit
        inner = []
        for value in sorted(found):
            # Ends of neighbouring cells may differ by rounding.
            if (inner[-1] if inner else low) + margin < value < high - margin:
                inner.append(value)
        ordered = inner if end > start else inner[::-1]
        return [
            {**interpolate(before, after, (value - start) / (end - start)), name: value}
            for value in ordered
        ]

    def _matrices(self, coordinates):
        poses = self._poses(coordinates)
        return np.array([poses[name] for name in self.bones])

    def _excess(self, old, new):
        """How far a step between poses (b, 4, 4) goes beyond what one sub-step may do: 1 is just
        allowed.
        """
        moved = step_excess(old, new, self._limits)
        return max(moved[0], min(moved[1], FINER * moved[0]))


@loop
def step_excess(old, new, limits):
    """How far a step between poses (b, 4, 4) takes bones, and ends that tendons hold, (2,) relative
    to what is allowed.
    """
    root, owner, corners, travel, angle, is_end, seen = limits
    most = np.zeros(2)
    first = np.empty((3, 4))
    second = np.empty((3, 4))
    for b in range(len(old)):
        if root < 0:
            first[:], second[:] = old[b, :3], new[b, :3]
        else:
            _seen_from(old[root], old[b], first)
            _seen_from(new[root], new[b], second)
        square = 0.0
        for a in range(3):
            for k in range(3):
                square += (second[a, k] - first[a, k]) ** 2
        # |A - B|² of two rotations by θ apart is 8 sin²(θ / 2).
        turned = 2.0 * np.arcsin(min(np.sqrt(square / 8.0), 1.0)) / angle
        kind = 1 if is_end[b] else 0
        most[kind] = max(most[kind], turned)
        for n in range(len(owner) if b < seen else 0):
            kind = 1 if is_end[b] or is_end[owner[n]] else 0
            _seen_from(old[b], old[owner[n]], first)
            _seen_from(new[b], new[owner[n]], second)
            for c in range(corners.shape[1]):
                away = 0.0
                for a in range(3):
                    way = second[a, 3] - first[a, 3]
                    for k in range(3):
                        way += (second[a, k] - first[a, k]) * corners[n, c, k]
                    away += way * way
                most[kind] = max(most[kind], np.sqrt(away) / travel[n])
    return most


@loop
def _seen_from(root, pose, out):
    """A pose as seen from another: root⁻¹ · pose, (3, 4)."""
    for a in range(3):
        for k in range(4):
            out[a, k] = 0.0
            for m in range(3):
                out[a, k] += root[m, a] * (pose[m, k] - (root[m, 3] if k == 3 else 0.0))


class PoseCache:
    """Poses of a scene's bones by coordinates, found once for all muscles that ask.

    Parameters
    ----------
    scene : Scene
    """

    MOST = 1024

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self._known: dict[tuple[tuple[str, float], ...], Poses] = {}

    def __call__(self, coordinates: Mapping[str, float]) -> Poses:
        """Poses (4, 4) by bone, as `bone_poses` gives them; shared, so not to be changed."""
        key = tuple(coordinates.items())
        found = self._known.get(key)
        if found is None:
            if len(self._known) >= self.MOST:
                self._known = {}
            found = self._known[key] = bone_poses(self.scene, dict(coordinates))
        return found


def _moving_apart(scene: Scene, bones: Sequence[str]) -> set[str]:
    """Coordinates that move some of these bones against others: those of the joints not common to
    all their chains.
    """
    joint_of = {joint.child: joint for joint in scene.joints}
    chains: list[set[str]] = []
    for bone in bones:
        chain: set[str] = set()
        name = bone
        while name in joint_of and joint_of[name].name not in chain:
            chain.add(joint_of[name].name)
            name = joint_of[name].parent
        chains.append(chain)
    apart = chains[0].union(*chains) - chains[0].intersection(*chains)
    found = {f"{j.name}.{name}" for j in scene.joints if j.name in apart for name in j.coordinates}
    for coupling in reversed(scene.couplings):
        if coupling.coordinate in found:
            found.update(coupling.of)
    return found


def check_substeps(scene: Scene) -> None:
    """Raise SceneError for a motion of more than `MOST_SUBSTEPS`, before anything grows with their
    number.
    """
    if not scene.bones:
        return
    cut = SubSteps(scene)
    frames = scene.motion.frames
    rest = rest_coordinates(scene)
    for name in sorted({name for frame in frames for name in frame}):
        start = rest.get(name, 0.0)
        count = cut.estimate(name, np.diff([start, *(frame.get(name, start) for frame in frames)]))
        if count > MOST_SUBSTEPS:
            raise SceneError(
                f"[motion]: {name!r} takes about {count:.3g} sub-steps, more than {MOST_SUBSTEPS} "
                "(its path is "
                f"long, contact.substep_angle = {scene.contact.substep_angle:g} is small, or "
                "muscles lie far from "
                "the joint's centre); correct these"
            )


def path_angle(
    scene: Scene,
    before: Coordinates,
    after: Coordinates,
    known: Mapping[str, Coordinate] | None = None,
) -> float:
    """How far the bones turn from one set of coordinates to another [radian].

    Angles count as they are given; where other coordinates move too, the path is followed in a few
    pieces.
    """
    known = all_coordinates(scene.joints) if known is None else known
    changes = {k: abs(after.get(k, 0.0) - before.get(k, 0.0)) for k in {*before, *after}}
    angle = max(
        (change for k, change in changes.items() if known[k].motion == "rotation"), default=0.0
    )
    if not any(change for k, change in changes.items() if known[k].motion != "rotation"):
        return angle
    stops = [interpolate(before, after, k / PIECES) for k in range(PIECES + 1)]
    return max(
        angle, sum(step_angle(scene, a, b, shifts=False) for a, b in itertools.pairwise(stops))
    )
