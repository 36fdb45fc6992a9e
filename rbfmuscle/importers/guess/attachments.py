"""Where a muscle holds: at the sites that anatomy names, else where its ends lie on bones.

A muscle's length is measured along its surface. Where an end lies on its site, the patch is what
touches it; where the belly stops short of it, the patch is what lies nearest, or the cap of the
end, and a tendon goes to the site.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import combinations
from pathlib import Path
from typing import NamedTuple

import numpy as np
import trimesh
from scipy.spatial import cKDTree

from rbfmuscle.anatomy.bones import Part
from rbfmuscle.geometry.arrays import unit
from rbfmuscle.geometry.surfaces import geodesic, surface_graph
from rbfmuscle.importers.guess.sites import (
    PELVIS,
    Site,
    Skeleton,
    sites_of,
    sites_on,
)


class Ends:
    """The two ends of a closed surface: the points farthest apart along it."""

    def __init__(self, mesh: trimesh.Trimesh) -> None:
        graph = surface_graph(mesh)

        def away_from(vertex):
            distance = geodesic(graph, vertex)
            return distance, int(np.argmax(np.where(np.isfinite(distance), distance, -1.0)))

        first = away_from(0)[1]
        away, second = away_from(first)
        self.tips, self.away = (first, second), (away, away_from(second)[0])
        self.length = float(away[second])

    def along(self, end: int) -> np.ndarray:
        """Place of each vertex between an end (0) and the other one (1)."""
        return self.away[end] / np.maximum(self.away[0] + self.away[1], 1e-300)


# The muscle whose tendon is drawn on, in front of the patella and along its ligament; the patella's
# poles and front.
ALONG_LIGAMENT = "rectus femoris"
POLES = "patella_base", "patella_front", "patella_apex"
# A mesh is the tendon between an end of a muscle and a bone that it reaches this closely [mm].
REACHES = 15.0
# Lengths as shares of a tendon's: what is so much farther than the nearest joins too; its end
# begins here; places at which its middle is taken, each as the mean of what lies so near; middles
# so close to the line of the others are left out.
JOINS = 0.02
LAST = 0.97
SECTIONS = np.linspace(0.1, 0.9, 9)
HALF = 0.04
STRAIGHT = 0.04

BonePlace = tuple[Part, np.ndarray]


class TendonGuess(NamedTuple):
    """Bone and place (3,) of a tendon's insertion; (bone, place) of its via points from the muscle
    on [scene unit]; its mesh, if it has one.
    """

    bone: Part
    to: np.ndarray
    via: tuple[BonePlace, ...] = ()
    mesh: Part | None = None


def tendon_to_site(
    bone: Part,
    sites: tuple[Site, ...],
    via: tuple[BonePlace, ...],
    end: np.ndarray,
    muscle: Part,
    skeleton: Skeleton,
) -> TendonGuess:
    """A tendon from an end (3,) to the nearest landmark of the sites, or to the nearest place of
    the bone, past the places that anatomy names.
    """
    last = via[-1][1] if via else end
    points = np.concatenate([site.core for site in sites] or [bone.points])
    to = points[np.argmin(((points - last) ** 2).sum(axis=1))]
    guess = TendonGuess(bone, skeleton.out_of_bone(to, bone), via)
    if bone.kind == "patella" and muscle.facts is not None and muscle.facts.name == ALONG_LIGAMENT:
        return _past_patella(bone, muscle, skeleton) or guess
    return guess


def _past_patella(patella, muscle, skeleton):
    """A tendon in front of a patella that follows its knee, on along its ligament to the tibia;
    else None.
    """
    follows = {j.child: j.parent for j in skeleton.joints if j.ligament is not None}
    shins = {j.parent: j.child for j in skeleton.joints if j.child.kind == "tibia"}
    tibia = shins.get(follows.get(patella))
    tuberosity = tibia and skeleton.site("tibial_tuberosity", tibia, muscle)
    if tuberosity is None:
        return None
    poles = [skeleton.site(name, patella, muscle).core[0] for name in POLES]
    via = tuple((patella, skeleton.out_of_bone(pole, patella)) for pole in poles)
    return TendonGuess(tibia, skeleton.out_of_bone(tuberosity.core[0], tibia), via)


def _via_places(muscle, skeleton):
    """(bone, place) that the tendon of an insertion passes, out of the bones."""
    found = []
    for name in sites_of(muscle.facts.name, "via"):
        bones = (b for b in skeleton.bones if sites_on([name], b) and b.may_be_beside(muscle))
        for bone in bones:
            site = skeleton.site(name, bone, muscle)
            if site is not None:
                found.append((bone, skeleton.out_of_bone(site.core[0], bone)))
                break
    return tuple(found)


def unused_tendons(
    tendons: list[Part], muscles: list[Part], used: set[Part], skeleton: Skeleton
) -> dict[str, str]:
    """Why tendons that have meshes are of no use, by their files."""
    reasons = {}
    for tendon in tendons:
        if tendon in used:
            continue
        mine = [m for m in muscles if m.facts is not None and m.facts.name in tendon.tendon_of]
        if not mine:
            reasons[tendon.file] = "a tendon by its name, but no muscle here has that name"
            continue
        seen = (see_tendon(tendon, muscle) for muscle in mine)
        end, _, _, gap = min(seen, key=lambda one: one[-1])
        away = min(float(bone.distances(end[None])[0]) for bone in skeleton.bones.values())
        gaps = f"{gap / skeleton.millimetre:.0f} mm from its muscle"
        gaps += f" and ends {away / skeleton.millimetre:.0f} mm from a bone"
        reasons[tendon.file] = f"a tendon that begins {gaps}, at most {REACHES:g} mm are believed"
    return reasons


def see_tendon(tendon: Part, muscle: Part) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """How a tendon's mesh runs, from a muscle on: its end (3,), its middles (k, 3) on the way
    there, the vertices of the muscle where it begins, and the distance between the two
    [scene unit].
    """
    points = tendon.points
    away_from_muscle = cKDTree(muscle.points).query(points)[0]
    near = np.flatnonzero(away_from_muscle <= away_from_muscle.min() + JOINS * tendon.size)
    graph = surface_graph(tendon.mesh)
    along = geodesic(graph, near)
    along[~np.isfinite(along)] = 0.0
    last = np.flatnonzero(along >= LAST * along.max())
    back = geodesic(graph, last)
    share = along / np.maximum(along + back, 1e-300)
    middles = [points[np.abs(share - place) < HALF] for place in SECTIONS]
    line = np.array([points[near].mean(axis=0), *(m.mean(axis=0) for m in middles if len(m))])
    line = np.vstack([line, points[last].mean(axis=0)])
    kept = _corners(line, STRAIGHT * tendon.size)
    distance = cKDTree(points).query(muscle.points)[0]
    gap = float(distance.min())
    begins = np.flatnonzero(distance <= gap + JOINS * tendon.size)
    return line[-1], line[kept[1:-1]], begins, gap


def _corners(line, most):
    """Places in a line (n, 3) that no straight line between others comes nearer to than ``most``
    (Douglas and Peucker 1973).
    """
    if len(line) < 3:
        return list(range(len(line)))
    chord = line[-1] - line[0]
    share = np.clip((line - line[0]) @ chord / max(chord @ chord, 1e-300), 0.0, 1.0)
    off = np.linalg.norm(line - line[0] - share[:, None] * chord, axis=1)
    worst = int(np.argmax(off))
    if off[worst] <= most:
        return [0, len(line) - 1]
    after = [worst + k for k in _corners(line[worst:], most)]
    return [*_corners(line[: worst + 1], most), *after[1:]]


# A site nearer than this [mm] is touched; the patch is what lies within TOUCH of the nearest.
NEAR, TOUCH = 6.0, 3.0
AROUND = 6.0  # of an end beside its site, what lies so much farther than the nearest [mm] is held
MAYBE = 4.0  # a bone that only may hold a muscle does so where it is nearer than this [mm]
# Length [mm] of the cap that is held where an end stops short of its bone, and as a share of the
# muscle.
CAP, CAP_SHARE = 8.0, 0.12
# Fewest vertices of a patch, and the greatest share of the muscle that all patches may hold.
FEWEST, LARGEST = 8, 0.6
# How far along the muscle a patch at one end may reach (0 at that end, 1 at the other).
REACH = 0.75
# Shares of a muscle's length, from an end: its tip, and what gives the tip its direction.
TIP, TURN = 0.03, (0.1, 0.25)
ASIDE = 60.0  # how much farther a bone counts that an end does not point to
# An end farther than this from its site gets a tendon: [mm], and as a share of the muscle.
FAR, FAR_SHARE = 25.0, 0.1
FAR_FROM_PATELLA = 5.0  # the same at the patella, where the tendon takes the muscle round the knee
LONG = 100.0  # a tendon longer than this [mm] is less sure
# How much of a muscle is held where bones that are not here would hold it along its length.
UPPER = 0.25
# Confidence where a muscle touches its site, lies beside it, has a tendon, a long one; where its
# site is not known; where a bone stands for one that is not here; where not even its bones are.
TOUCHES = 1.0
BESIDE = 0.9
TENDON = 0.8
LONG_TENDON = 0.7
NO_SITE = 0.5
STAND_IN = 0.4
NO_BONE = 0.2
NO_NAME = 0.4


@dataclass
class AttachmentGuess:
    """Vertices of a muscle's mended mesh that a bone holds, their least distance to it [mm], why,
    and how sure that is.
    """

    bone: Part
    vertices: np.ndarray
    gap: float
    reason: str
    confidence: float = 1.0
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
    doubted: bool = False  # whether more than one attachment is in doubt

    def doubt(self, confidence: float, reason: str) -> None:
        """Add a reason why the confidence is at most so much."""
        self.confidence = min(self.confidence, confidence)
        self.reasons.append(reason)
        self.doubted = True


class Place(NamedTuple):
    """A bone, the end of the muscle that it holds, the sites there, none where they are not known,
    the first place that the tendon passes, and whether the bone stands for one that is not here.
    """

    bone: Part
    end: int
    sites: tuple[Site, ...] = ()
    via: tuple[BonePlace, ...] = ()
    stands_in: bool = False


def guess_attachments(muscle: Part, skeleton: Skeleton, *, named: bool = True) -> MuscleGuess:
    """Find the bones that hold a muscle, by its name where ``named``, else the nearest, and the
    vertices they hold.
    """
    ends, millimetre = Ends(muscle.mesh), skeleton.millimetre
    distances = {
        b: bone.distances(muscle.points) / millimetre for b, bone in skeleton.bones.items()
    }
    guess = MuscleGuess(muscle, [], 1.0)
    places: list[Place] = []
    if named and muscle.facts is not None:
        places = _named_places(guess, distances, ends, skeleton)
    by_name = bool(places)
    if not by_name:
        places = _nearest_places(muscle, skeleton, distances, ends)
        known = muscle.facts is not None
        why = "the bones of its name are not here" if known else "its name is not known"
        guess.reasons = []
        guess.doubt(
            NO_BONE if known else NO_NAME, f"{why}; the bones are the nearest to its two ends"
        )
    holds = [_hold(place, distances[place.bone], ends, muscle, skeleton) for place in places]
    # Each vertex is held by one bone: the one that it lies nearer to, as its patch sees it.
    for second, first in combinations(holds, 2):
        shared = np.intersect1d(first.vertices, second.vertices)
        nearer = distances[first.bone][shared] < distances[second.bone][shared]
        first.vertices = np.setdiff1d(first.vertices, shared[~nearer])
        second.vertices = np.setdiff1d(second.vertices, shared[nearer])
    guess.holds = [hold for hold in holds if len(hold.vertices)]
    if by_name:
        _say_touched(guess, distances, skeleton.bodies)
    _doubt(guess, skeleton.bodies)
    return guess


def _say_touched(guess, distances, bodies):
    """Say where an end that is farther than `NEAR` from its bone touches another, as it may where
    its name is wrong.
    """
    named = {bodies[hold.bone] for hold in guess.holds}
    for hold in guess.holds:
        near = {bone: float(distance[hold.vertices].min()) for bone, distance in distances.items()}
        nearest = min(near, key=near.__getitem__)
        if hold.gap > NEAR and near[nearest] < TOUCH and bodies[nearest] not in named:
            guess.reasons.append(
                f"by its name on the {hold.bone.name}, {hold.gap:.0f} mm away, but it touches "
                f"{nearest.name}"
            )


def _named_places(guess, distances, ends, skeleton):
    """Places on the bones that anatomy names: origins at one end, insertions at the other."""
    muscle, groups = guess.muscle, []
    for side in ("origin", "insertion"):
        chosen: dict[Part, Place] = {}
        for kinds, must in getattr(muscle.facts, side):
            bone = _best_of(kinds, muscle, distances)
            if bone is None and must:
                guess.reasons.append(f"no bone here is its {' or '.join(kinds)}")
            if bone is not None and (must or distances[bone].min() < MAYBE):
                stands_in = bone.kind != kinds[0] and not {bone.kind, kinds[0]} <= {*PELVIS}
                if stands_in:
                    guess.doubt(STAND_IN, f"no {kinds[0]} is here, the {bone.name} stands for it")
                names = sites_on(sites_of(muscle.facts.name, side), bone)
                sites = (skeleton.site(name, bone, muscle) for name in names)
                via = _via_places(muscle, skeleton) if names and side == "insertion" else ()
                chosen[bone] = Place(bone, 0, tuple(filter(None, sites)), via, stands_in)
        groups.append(chosen)

    def cost(first):
        tips = (muscle.points[ends.tips[k]] for k in (first, 1 - first))
        return sum(_away(place, tip) for g, tip in zip(groups, tips) for place in g.values())

    first = min((0, 1), key=cost)
    return [
        place._replace(end=end)
        for group, end in zip(groups, (first, 1 - first))
        for bone, place in group.items()
        if group is groups[0] or bone not in groups[0]
    ]


def _away(place, tip):
    """Distance of a tip (3,) from the landmarks of sites, or from a bone where there are none."""
    points = place.bone.points
    if place.sites:
        points = np.concatenate([site.core for site in place.sites])
    return float(np.sqrt(((points - tip) ** 2).sum(axis=1).min()))


def _best_of(kinds, muscle, distances):
    """The bone to hold at: of the first class that is there, on the muscle's side, the nearest."""
    for kind in kinds:
        fitting = [bone for bone in distances if bone.kind == kind and bone.may_be_beside(muscle)]
        if fitting:
            return min(fitting, key=lambda bone: distances[bone].min())
    return None


def _nearest_places(muscle, skeleton, distances, ends):
    """Places without names: what the ends touch, else what they point to, not both the same body.

    Both ends are chosen together: what an end that touches nothing leaves to the other counts too.
    An end that points away from its bone is held whole.
    """
    bodies = skeleton.bodies
    scores = []
    for end in (0, 1):
        cap = ends.along(end) < CAP_SHARE
        score = {}
        for bone, distance in distances.items():
            near = distance[cap].min()
            away, ahead = _aim(muscle.points, ends.along(end), bone)
            score[bone] = (
                (near / NEAR - 1.0, True) if near < NEAR else (away / skeleton.millimetre, ahead)
            )
        scores.append(score)

    def cost(pair):
        return scores[0][pair[0]][0] + scores[1][pair[1]][0]

    pairs = [(one, other) for one in distances for other in distances]
    apart = [pair for pair in pairs if bodies[pair[0]] != bodies[pair[1]]]
    chosen = min(apart or pairs, key=cost)
    return [Place(bone, end, stands_in=not scores[end][bone][1]) for end, bone in enumerate(chosen)]


def _aim(points, along, bone):
    """How far an end is from a bone in the direction that it points to, where what lies aside
    counts as farther [scene unit]; whether it points there rather than away.
    """
    tip = points[along < TIP].mean(axis=0)
    direction = unit(tip - points[(along > TURN[0]) & (along < TURN[1])].mean(axis=0))
    away = bone.points - tip
    distance = np.maximum(np.linalg.norm(away, axis=1), 1e-300)
    ahead = away @ direction / distance
    cost = distance * (1.0 + ASIDE * (1.0 - ahead))
    best = int(np.argmin(cost))
    return float(cost[best]), bool(ahead[best] > 0.0)


def _hold(place, distance, ends, muscle, skeleton):
    """What a bone holds of an end."""
    bone, millimetre = place.bone, skeleton.millimetre
    by_tendon = _hold_by_tendon(place, ends, muscle, skeleton)
    if by_tendon is not None:
        return by_tendon
    if place.stands_in:
        # The end moves with a bone that is not here, wherever it lies; not what passes it on the
        # way.
        chosen = np.flatnonzero(ends.along(place.end) <= UPPER)
        gap = max(float(distance[chosen].min()), 0.0)
        reason = f"the whole end, {gap:.3g} mm from the {bone.name}, as its own bone is missing"
        return AttachmentGuess(bone, chosen, gap, reason, NO_SITE)
    points = muscle.points
    sites = place.sites
    if not sites:
        whole = skeleton.covering(bone)
        sites = (Site(bone.name, whole, whole),)
    near = cKDTree(np.concatenate([site.points for site in sites])).query(points)[0] / millimetre
    # The nearest place of the bone belongs to a site whose points are hardly aside of it.
    coarse = np.sqrt(bone.mesh.area / len(bone.faces[0])) / millimetre
    on_site = near <= np.hypot(np.maximum(distance, 0.0), TOUCH + coarse)
    touching = np.where(on_site & (ends.along(place.end) <= REACH), distance, np.inf)
    gap = max(float(touching.min()), 0.0)
    chosen = np.flatnonzero(touching <= (gap + TOUCH if gap <= NEAR else -np.inf))
    where = " and ".join(site.name.replace("_", " ") for site in sites)
    confidence = TOUCHES
    far = min(FAR, FAR_SHARE * ends.length / millimetre)
    if bone.kind == "patella":
        far = FAR_FROM_PATELLA
    reason = f"within {gap + TOUCH:.3g} mm of the {where}"
    if len(chosen) < FEWEST:
        chosen = _end(near, ends, place, muscle, millimetre)
        gap, confidence = float(near[chosen].min()), BESIDE
        reason = f"at the end that points to the {where}, {gap:.3g} mm from it"
    hold = AttachmentGuess(bone, chosen, gap, reason, confidence)
    if confidence == BESIDE and gap > far:
        end = muscle.points[hold.vertices].mean(axis=0)
        hold.tendon = tendon_to_site(bone, place.sites, place.via, end, muscle, skeleton)
        hold.confidence = TENDON if hold.gap < LONG else LONG_TENDON
    if not place.sites:
        hold.confidence = min(hold.confidence, NO_SITE)
    return hold


def _hold_by_tendon(place, ends, muscle, skeleton):
    """What a tendon that has a mesh holds of an end, None where there is none."""
    if muscle.facts is None or place.stands_in:
        return None
    for part in skeleton.tendons:
        if muscle.facts.name not in part.tendon_of or not part.may_be_beside(muscle):
            continue
        end, middles, begins, gap = see_tendon(part, muscle)
        begins = begins[ends.along(place.end)[begins] <= UPPER]
        away = float(skeleton.bones[place.bone].distances(end[None])[0])
        if len(begins) < FEWEST or max(gap, away) > REACHES * skeleton.millimetre:
            continue
        # The tendon runs along its mesh, through middles that are held by the nearest bones.
        via = []
        for middle in middles:
            off = {b: float(d.distances(middle[None])[0]) for b, d in skeleton.bones.items()}
            nearest = min(off, key=off.__getitem__)
            inside = off[nearest] < 0.0
            via.append((nearest, skeleton.out_of_bone(middle, nearest) if inside else middle))
        points = place.bone.faces[0]
        to = points[np.argmin(((points - end) ** 2).sum(axis=1))]
        tendon = TendonGuess(place.bone, to, tuple(via), part)
        reason = f"where {Path(part.file).stem} begins, which ends on the {place.bone.name}"
        gap /= skeleton.millimetre
        return AttachmentGuess(place.bone, begins, gap, reason, BESIDE, tendon)
    return None


def _end(near, ends, place, muscle, millimetre):
    """Vertices of an end that does not touch its site: what is nearest to it, or to the first place
    that its tendon passes, or the cap where that is far.
    """
    if place.via:
        near = np.linalg.norm(muscle.points - place.via[0][1], axis=1) / millimetre
    near = np.where(ends.along(place.end) <= REACH, near, np.inf)
    if place.sites and near.min() < FAR:
        chosen = np.flatnonzero(near <= near.min() + AROUND)
    else:
        share = min(CAP * millimetre, CAP_SHARE * ends.length)
        chosen = np.flatnonzero(ends.away[place.end] <= share)
        near = ends.away[place.end]
    return chosen if len(chosen) >= FEWEST else np.sort(np.argsort(near, kind="stable")[:FEWEST])


def _doubt(guess, bodies):
    """Lower the confidence, or say that the muscle cannot be run."""
    for hold in guess.holds:
        guess.confidence = min(guess.confidence, hold.confidence)
        if hold.confidence == NO_SITE:
            guess.reasons.append(
                f"its site on the {hold.bone.name} is not known: the nearest place"
            )
        if hold.tendon is not None and not hold.confidence > NO_SITE:
            guess.reasons.append(
                f"the mesh ends {hold.gap:.0f} mm from the {hold.bone.name}: a straight tendon "
                "was added"
            )
    if guess.muscle.doubt:
        guess.confidence = min(guess.confidence, 0.3)
    share = sum(len(hold.vertices) for hold in guess.holds) / len(guess.muscle.points)
    if share > LARGEST:
        guess.doubt(0.4, f"bones hold {100 * share:.0f} % of its vertices")
    if len(guess.holds) < 2:
        guess.wrong, guess.confidence = "only one bone is near it", 0.0
    elif len({bodies[hold.bone] for hold in guess.holds}) < 2:
        guess.doubt(0.4, "all that holds it moves as one")
