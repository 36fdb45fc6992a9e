"""Where a muscle holds: at its ends, and where it lies on a bone that anatomy names.

A muscle's length is measured along its surface. Where an end lies on a bone, the patch is what touches it; where
the belly stops short of its bone, the patch is the cap of the end that points there, and the tendon is missing.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra

from rbfmuscle.scene.attachments import signed_distances

if TYPE_CHECKING:
    import trimesh


# A bone nearer than this [mm] is touched; the patch is what lies within TOUCH of the nearest.
NEAR, TOUCH = 6.0, 3.0
# A bone that only may hold a muscle does so where it is nearer than this [mm].
MAYBE = 4.0
# Length [mm] of the cap that is held where an end stops short of its bone, and as a share of the muscle.
CAP, CAP_SHARE = 8.0, 0.12
# Fewest vertices of a patch, and the greatest share of the muscle that all patches may hold.
FEWEST, LARGEST = 8, 0.6
# How far along the muscle a patch at one end may reach (0 at that end, 1 at the other).
REACH = 0.75
# How much farther a bone counts that an end does not point to.
ASIDE = 60.0
# Beyond this [mm] an end is said to be far from its bone.
FAR = 25.0


@dataclass
class AttachmentGuess:
    """Vertices of a muscle that a bone holds.

    Attributes
    ----------
    bone : Part
    vertices : (n,) ndarray of int
        Of the mended mesh.
    gap : float
        Least distance of the patch to the bone [mm].
    reason : str
    tendon : TendonGuess or None
        What carries an end far from its bone.
    """

    bone: Any
    vertices: np.ndarray
    gap: float
    reason: str
    tendon: Any = None

    @property
    def attached_bone(self) -> str:
        """Name of the bone in the scene that holds the vertices."""
        return self.tendon.name if self.tendon is not None else self.bone.name


@dataclass
class MuscleGuess:
    """A muscle, what holds it and how far to believe it.

    Attributes
    ----------
    muscle : Part
    holds : list of Hold
    confidence : float
        0 to 1; below 0.5 it wants a look.
    reasons : list of str
        Why the confidence is not higher.
    wrong : str
        Why the muscle cannot be run as guessed; empty where it can.
    """

    muscle: Any
    holds: list
    confidence: float
    reasons: list = field(default_factory=list)
    wrong: str = ""


class Ends:
    """The two ends of a closed surface: the points farthest apart along it.

    Parameters
    ----------
    mesh : trimesh.Trimesh
    """

    def __init__(self, mesh: trimesh.Trimesh) -> None:
        edges, lengths, count = mesh.edges_unique, mesh.edges_unique_length, len(mesh.vertices)
        rows, cols = np.r_[edges[:, 0], edges[:, 1]], np.r_[edges[:, 1], edges[:, 0]]
        graph = coo_matrix((np.r_[lengths, lengths], (rows, cols)), shape=(count, count)).tocsr()
        first = _farthest(dijkstra(graph, indices=0))
        away = dijkstra(graph, indices=first)
        self.tips = (first, _farthest(away))
        self.away = (away, dijkstra(graph, indices=self.tips[1]))
        self.length = float(away[self.tips[1]])

    def along(self, end: Any) -> Any:
        """Place of each vertex between an end (0) and the other one (1)."""
        total = np.maximum(self.away[0] + self.away[1], 1e-300)
        return self.away[end] / total


def _farthest(distance):
    return int(np.argmax(np.where(np.isfinite(distance), distance, -1.0)))


def guess_attachments(
    muscle: Any, bones: list[Any], bodies: dict[int, int], millimetre: float, *, named: bool = True
) -> MuscleGuess:
    """Find the bones that hold a muscle and the vertices that they hold.

    Parameters
    ----------
    muscle : Part
    bones : list of Part
    bodies : dict of int to int
        Which bones move as one: the body of each bone, by its place in the list.
    millimetre : float
        Length of a millimetre in scene units.
    named : bool
        Look at what the muscle's name tells; the nearest bones where it tells nothing.
    """
    ends = Ends(muscle.mesh)
    distances = [signed_distances(muscle.points, bone.mesh) / millimetre for bone in bones]
    reasons: list[str] = []
    places, confidence = [], 0.0
    if named and muscle.facts is not None:
        places = _named_places(muscle, bones, distances, ends, reasons)
    if not places:
        places = _nearest_places(muscle, bones, bodies, distances, ends)
        known = muscle.facts is not None
        told = "the bones of its name are not here" if known else "its name tells nothing"
        reasons[:] = [f"{told}; the bones are the nearest to its two ends"]
        confidence = 0.2 if known else 0.4
    holds = [_hold(bones[k], distances[k], ends, end, millimetre) for k, end in places]
    holds = _disjoint(
        [hold for hold in holds if len(hold.vertices)], {id(b): d for b, d in zip(bones, distances)}
    )
    if not confidence:  # by name: the nearer its ends are to the bones, the surer
        confidence = 1.0 - 0.4 * min(max((hold.gap for hold in holds), default=FAR) / FAR, 1.0)
        _compare(holds, bones, bodies, distances, reasons)
        confidence = 0.5 if reasons else confidence
    guess = MuscleGuess(muscle, holds, confidence, reasons)
    _doubt(guess, bones, bodies, len(muscle.points))
    return guess


def _compare(holds, bones, bodies, distances, reasons):
    """Name what names and distances say differently: a patch that touches another bone than that of its name."""
    place = {id(bone): k for k, bone in enumerate(bones)}
    named = {bodies[place[id(hold.bone)]] for hold in holds}
    for hold in holds:
        near = [float(distance[hold.vertices].min()) for distance in distances]
        k = int(np.argmin(near))
        if hold.gap > NEAR and near[k] < TOUCH and bodies[k] not in named:
            away = f"by its name on the {hold.bone.name}, {hold.gap:.0f} mm away"
            reasons.append(f"{away}, but it touches {bones[k].name}")


def _named_places(muscle, bones, distances, ends, reasons):
    """(bone, end) for the bones that anatomy names: origins at one end, insertions at the other."""
    groups = []
    for listed in (muscle.facts.origin, muscle.facts.insertion):
        chosen = []
        for kinds, must in listed:
            k = _best_of(kinds, muscle, bones, distances)
            if k is None and must:
                reasons.append(f"no bone here is its {' or '.join(kinds)}")
            if k is not None and (must or distances[k].min() < MAYBE):
                chosen.append(k)
        groups.append(chosen)
    cost = [sum(_tip_cost(groups, distances, ends, way)) for way in (0, 1)]
    way = int(np.argmin(cost))
    places = [(k, way) for k in groups[0]] + [(k, 1 - way) for k in groups[1] if k not in groups[0]]
    return places


def _best_of(kinds, muscle, bones, distances):
    """Place of the bone to hold at: of the first class that is there, on the muscle's side, the nearest."""
    for kind in kinds:
        fitting = [k for k, bone in enumerate(bones) if bone.kind == kind and _same_side(bone, muscle)]
        if fitting:
            return min(fitting, key=lambda k: distances[k].min())
    return None


def _same_side(bone, muscle):
    return not bone.side or not muscle.side or bone.side == muscle.side


def _tip_cost(groups, distances, ends, way):
    for group, end in zip(groups, (way, 1 - way)):
        for k in group:
            yield max(distances[k][ends.tips[end]], 0.0)


def _nearest_places(muscle, bones, bodies, distances, ends):
    """(bone, end) without names: what an end touches, else what it points to; not twice the same body."""
    places, wishes = [], []
    for end in (0, 1):
        cap = ends.along(end) < CAP_SHARE
        near = np.array([distance[cap].min() for distance in distances])
        aim = np.array([_aim(muscle.points, ends, end, bone) for bone in bones])
        score = np.where(near < NEAR, near / NEAR - 1.0, aim)
        wishes.append((float(np.min(score)), end, np.argsort(score, kind="stable")))
    for _, end, order in sorted(wishes, key=lambda wish: wish[0]):
        taken = {bodies[k] for k, _ in places}
        other = [int(k) for k in order if bodies[int(k)] not in taken]
        places.append(((other or [int(order[0])])[0], end))
    return places


def _aim(points, ends, end, bone):
    """How far an end is from a bone in the direction that it points to; what lies aside counts as farther."""
    along = ends.along(end)
    tip = points[along < 0.03].mean(axis=0)
    back = points[(along > 0.1) & (along < 0.25)].mean(axis=0)
    direction = (tip - back) / max(float(np.linalg.norm(tip - back)), 1e-300)
    way = bone.points - tip
    distance = np.maximum(np.linalg.norm(way, axis=1), 1e-300)
    return float((distance * (1.0 + ASIDE * (1.0 - way @ direction / distance))).min())


def _hold(bone, distance, ends, end, millimetre):
    """What a bone holds of an end."""
    least, along = float(distance.min()), ends.along(end)
    at_end = along <= REACH
    if least < NEAR and (at_end & (distance <= NEAR)).any():
        limit = max(float(distance[at_end].min()), 0.0) + TOUCH
        chosen = np.flatnonzero(at_end & (distance <= limit))
        reason = f"lies within {limit:.3g} mm"
        if len(chosen) >= FEWEST:
            return AttachmentGuess(bone, chosen, float(distance[chosen].min()), reason)
    length = min(CAP * millimetre, max(CAP_SHARE * ends.length, 1e-300))
    chosen = np.flatnonzero(ends.away[end] <= length)
    if len(chosen) < FEWEST:
        chosen = np.argsort(ends.away[end], kind="stable")[:FEWEST]
    gap = float(distance[chosen].min())
    return AttachmentGuess(bone, np.sort(chosen), gap, f"the end that points there, {gap:.3g} mm short of it")


def _disjoint(holds, distances):
    """Each vertex is held by one bone: the one that it lies nearer to, as its patch sees it."""
    for i, first in enumerate(holds):
        for second in holds[:i]:
            shared = np.intersect1d(first.vertices, second.vertices)
            if len(shared) == 0:
                continue
            nearer = distances[id(first.bone)][shared] < distances[id(second.bone)][shared]
            first.vertices = np.setdiff1d(first.vertices, shared[~nearer])
            second.vertices = np.setdiff1d(second.vertices, shared[nearer])
    return [hold for hold in holds if len(hold.vertices)]


def _doubt(guess, bones, bodies, count):
    """Lower the confidence, or say that the muscle cannot be run."""
    place = {id(bone): k for k, bone in enumerate(bones)}
    moving = {bodies[place[id(hold.bone)]] for hold in guess.holds}
    far = [hold for hold in guess.holds if hold.gap > FAR]
    for hold in far:
        guess.reasons.append(f"its end is {hold.gap:.0f} mm from the {hold.bone.name}: a tendon is missing")
    if far:
        guess.confidence = min(guess.confidence, 0.5)
    if not guess.muscle.sure:
        guess.confidence = min(guess.confidence, 0.3)
    held = sum(len(hold.vertices) for hold in guess.holds)
    if held > LARGEST * count:
        guess.reasons.append(f"bones hold {100 * held / count:.0f} % of its vertices")
        guess.confidence = min(guess.confidence, 0.4)
    if len(guess.holds) < 2:
        guess.wrong = "only one bone is near it"
    elif len(moving) < 2:
        guess.reasons.append("all that holds it moves as one")
        guess.confidence = min(guess.confidence, 0.4)
    if guess.wrong:
        guess.confidence = 0.0
