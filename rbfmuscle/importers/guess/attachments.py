"""Where a muscle holds: at its ends, and where it lies on a bone that anatomy names.

A muscle's length is measured along its surface. Where an end lies on a bone, the patch is what
touches it; where the belly stops short of its bone, the patch is the cap of the end that points
there, and a tendon goes straight to the nearest place of the bone. At a patella that follows its
knee, the tendon goes on along the patellar ligament to the tibia.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import combinations
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra

from rbfmuscle.importers.guess.anatomy import JointGuess
from rbfmuscle.importers.guess.landmarks import unit
from rbfmuscle.importers.guess.parts import Part
from rbfmuscle.scene.bone import Bone

if TYPE_CHECKING:
    import trimesh

# A bone nearer than this [mm] is touched; the patch is what lies within TOUCH of the nearest.
NEAR, TOUCH = 6.0, 3.0
MAYBE = 4.0  # a bone that only may hold a muscle does so where it is nearer than this [mm]
# Length [mm] of the cap that is held where an end stops short of its bone, and as a share of the
# muscle.
CAP, CAP_SHARE = 8.0, 0.12
# Fewest vertices of a patch, and the greatest share of the muscle that all patches may hold.
FEWEST, LARGEST = 8, 0.6
REACH = (
    0.75  # how far along the muscle a patch at one end may reach (0 at that end, 1 at the other)
)
ASIDE = 60.0  # how much farther a bone counts that an end does not point to
FAR = 25.0  # an end farther than this [mm] from its bone gets a tendon


class TendonGuess(NamedTuple):
    """Bone and place (3,) of a tendon's insertion; (bone, place) of its via points from the muscle
    on [scene unit].
    """

    bone: Part
    to: np.ndarray
    via: tuple[tuple[Part, np.ndarray], ...] = ()


@dataclass
class AttachmentGuess:
    """Vertices of a muscle's mended mesh that a bone holds, their least distance to it [mm], and
    why.
    """

    bone: Part
    vertices: np.ndarray
    gap: float
    reason: str
    tendon: TendonGuess | None = None


@dataclass
class MuscleGuess:
    """A muscle, its attachments, its confidence (0 to 1), and the reasons why that is not higher.

    ``wrong`` says why the muscle cannot be run as guessed; empty where it can.
    """

    muscle: Part
    holds: list[AttachmentGuess]
    confidence: float
    reasons: list[str] = field(default_factory=list)
    wrong: str = ""

    def doubt(self, confidence: float, reason: str) -> None:
        """Add a reason why the confidence is at most so much."""
        self.confidence = min(self.confidence, confidence)
        self.reasons.append(reason)


class Skeleton(NamedTuple):
    """What muscles are held by; ``bodies`` gives of bones that move as one the one that stands for
    all.
    """

    bones: dict[Part, Bone]
    bodies: dict[Part, Part]
    joints: list[JointGuess]
    millimetre: float


class Ends:
    """The two ends of a closed surface: the points farthest apart along it."""

    def __init__(self, mesh: trimesh.Trimesh) -> None:
        count = len(mesh.vertices)
        graph = coo_matrix(
            (mesh.edges_unique_length, mesh.edges_unique.T), shape=(count, count)
        ).tocsr()

        def away_from(vertex):
            distance = dijkstra(graph, directed=False, indices=vertex)
            return distance, int(np.argmax(np.where(np.isfinite(distance), distance, -1.0)))

        first = away_from(0)[1]
        away, second = away_from(first)
        self.tips, self.away = (first, second), (away, away_from(second)[0])
        self.length = float(away[second])

    def along(self, end: int) -> np.ndarray:
        """Place of each vertex between an end (0) and the other one (1)."""
        return self.away[end] / np.maximum(self.away[0] + self.away[1], 1e-300)


def guess_attachments(muscle: Part, skeleton: Skeleton, *, named: bool = True) -> MuscleGuess:
    """Find the bones that hold a muscle, by its name where ``named``, else the nearest, and the
    vertices they hold.
    """
    ends, millimetre = Ends(muscle.mesh), skeleton.millimetre
    distances = {
        b: bone.distances(muscle.points) / millimetre for b, bone in skeleton.bones.items()
    }
    guess = MuscleGuess(muscle, [], 1.0)
    places = _named_places(guess, distances, ends) if named and muscle.facts is not None else []
    by_name = bool(places)
    if not by_name:
        places = _nearest_places(muscle, skeleton.bodies, distances, ends)
        known = muscle.facts is not None
        why = "the bones of its name are not here" if known else "its name is not known"
        guess.reasons = []
        guess.doubt(0.2 if known else 0.4, f"{why}; the bones are the nearest to its two ends")
    holds = [_hold(bone, distances[bone], ends, end, millimetre) for bone, end in places]
    guess.holds = _disjoint(holds, distances)
    if by_name:  # the nearer its ends are to the bones, the surer
        worst = max((hold.gap for hold in guess.holds), default=FAR)
        guess.confidence = 1.0 - 0.4 * min(worst / FAR, 1.0)
        _compare(guess, skeleton.bodies, distances)
        guess.confidence = 0.5 if guess.reasons else guess.confidence
    _doubt(guess, skeleton.bodies)
    for hold in guess.holds:
        if hold.gap > FAR and not guess.wrong:
            hold.tendon = _tendon(hold, muscle, skeleton.joints)
    return guess


def _compare(guess, bodies, distances):
    """Name what names and distances say differently: a patch that touches another bone than that of
    its name.
    """
    named = {bodies[hold.bone] for hold in guess.holds}
    for hold in guess.holds:
        near = {bone: float(distance[hold.vertices].min()) for bone, distance in distances.items()}
        nearest = min(near, key=near.__getitem__)
        if hold.gap > NEAR and near[nearest] < TOUCH and bodies[nearest] not in named:
            away = f"by its name on the {hold.bone.name}, {hold.gap:.0f} mm away"
            guess.reasons.append(f"{away}, but it touches {nearest.name}")


def _named_places(guess, distances, ends):
    """(bone, end) for the bones that anatomy names: origins at one end, insertions at the other."""
    groups, facts = [], guess.muscle.facts
    for listed in (facts.origin, facts.insertion):
        chosen = []
        for kinds, must in listed:
            bone = _best_of(kinds, guess.muscle, distances)
            if bone is None and must:
                guess.reasons.append(f"no bone here is its {' or '.join(kinds)}")
            if bone is not None and (must or distances[bone].min() < MAYBE):
                chosen.append(bone)
        groups.append(chosen)

    def cost(first):
        tips = ends.tips[first], ends.tips[1 - first]
        return sum(
            max(distances[bone][tip], 0.0) for group, tip in zip(groups, tips) for bone in group
        )

    first = min((0, 1), key=cost)
    insertions = [(bone, 1 - first) for bone in groups[1] if bone not in groups[0]]
    return [(bone, first) for bone in groups[0]] + insertions


def _best_of(kinds, muscle, distances):
    """The bone to hold at: of the first class that is there, on the muscle's side, the nearest."""
    for kind in kinds:
        here = [bone for bone in distances if bone.kind == kind]
        fitting = [
            bone for bone in here if not bone.side or not muscle.side or bone.side == muscle.side
        ]
        if fitting:
            return min(fitting, key=lambda bone: distances[bone].min())
    return None


def _nearest_places(muscle, bodies, distances, ends):
    """(bone, end) without names: what an end touches, else what it points to; not twice the same
    body.
    """
    places, wishes = [], []
    for end in (0, 1):
        cap = ends.along(end) < CAP_SHARE
        score = {}
        for bone, distance in distances.items():
            near = distance[cap].min()
            score[bone] = (
                near / NEAR - 1.0 if near < NEAR else _aim(muscle.points, ends.along(end), bone)
            )
        order = sorted(score, key=score.__getitem__)
        wishes.append((score[order[0]], end, order))
    for _, end, order in sorted(wishes, key=lambda wish: wish[0]):
        taken = {bodies[bone] for bone, _ in places}
        places.append((next((bone for bone in order if bodies[bone] not in taken), order[0]), end))
    return places


def _aim(points, along, bone):
    """How far an end is from a bone in the direction that it points to; what lies aside counts as
    farther.
    """
    tip = points[along < 0.03].mean(axis=0)
    direction = unit(tip - points[(along > 0.1) & (along < 0.25)].mean(axis=0))
    away = bone.points - tip
    distance = np.maximum(np.linalg.norm(away, axis=1), 1e-300)
    return float((distance * (1.0 + ASIDE * (1.0 - away @ direction / distance))).min())


def _hold(bone, distance, ends, end, millimetre):
    """What a bone holds of an end."""
    at_end = ends.along(end) <= REACH
    least = float(distance[at_end].min())
    if least <= NEAR:
        limit = max(least, 0.0) + TOUCH
        chosen = np.flatnonzero(at_end & (distance <= limit))
        if len(chosen) >= FEWEST:
            return AttachmentGuess(bone, chosen, least, f"within {limit:.3g} mm of the bone")
    chosen = np.flatnonzero(ends.away[end] <= min(CAP * millimetre, CAP_SHARE * ends.length))
    if len(chosen) < FEWEST:
        chosen = np.sort(np.argsort(ends.away[end], kind="stable")[:FEWEST])
    gap = float(distance[chosen].min())
    return AttachmentGuess(
        bone, chosen, gap, f"at the end that points to the bone, {gap:.3g} mm from it"
    )


def _tendon(hold, muscle, joints):
    end = muscle.points[hold.vertices].mean(axis=0)
    place = hold.bone.points[np.argmin(((hold.bone.points - end) ** 2).sum(axis=1))]
    patella = next((j for j in joints if j.child is hold.bone and j.ligament is not None), None)
    if patella is None:
        return TendonGuess(hold.bone, place)
    tibia = next(j.child for j in joints if j.child.kind == "tibia" and j.parent is patella.parent)
    apex, tuberosity = patella.ligament
    return TendonGuess(tibia, tuberosity, ((hold.bone, place), (hold.bone, apex)))


def _disjoint(holds, distances):
    """Each vertex is held by one bone: the one that it lies nearer to, as its patch sees it."""
    for second, first in combinations(holds, 2):
        shared = np.intersect1d(first.vertices, second.vertices)
        nearer = distances[first.bone][shared] < distances[second.bone][shared]
        first.vertices = np.setdiff1d(first.vertices, shared[~nearer])
        second.vertices = np.setdiff1d(second.vertices, shared[nearer])
    return [hold for hold in holds if len(hold.vertices)]


def _doubt(guess, bodies):
    """Lower the confidence, or say that the muscle cannot be run."""
    for hold in guess.holds:
        if hold.gap > FAR:
            away = f"{hold.gap:.0f} mm from the {hold.bone.name}"
            guess.doubt(0.5, f"the mesh ends {away}: a straight tendon was added, check its path")
    if guess.muscle.doubt:
        guess.confidence = min(guess.confidence, 0.3)
    share = sum(len(hold.vertices) for hold in guess.holds) / len(guess.muscle.points)
    if share > LARGEST:
        guess.doubt(0.4, f"bones hold {100 * share:.0f} % of its vertices")
    if len(guess.holds) < 2:
        guess.wrong, guess.confidence = "only one bone is near it", 0.0
    elif len({bodies[hold.bone] for hold in guess.holds}) < 2:
        guess.doubt(0.4, "all that holds it moves as one")
