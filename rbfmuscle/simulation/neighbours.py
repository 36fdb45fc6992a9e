"""Which muscles may touch, and where they do.

What overlaps at rest, as segmentations often do, keeps that overlap as the zero of its contact.
Where a scene asks for it, what touches at rest is held together at the distance that it has there,
muscle on muscle or muscle on bone.
"""

from collections.abc import Mapping, Sequence
from functools import cache
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.geometry.threads import each
from rbfmuscle.scene.objects import from_mm
from rbfmuscle.scene.scene import Scene
from rbfmuscle.simulation.contact_pairs import sampled_poses, swept_boxes
from rbfmuscle.simulation.held_bone import NO_POINTS, HeldBone
from rbfmuscle.simulation.stepper import MuscleStepper
from rbfmuscle.simulation.touching import Body, Meeting, Moving, surface_points

Link = tuple[int, int]

# Muscles may touch whose swept boxes come nearer to each other than this [mm].
REACH = 3.0
# Points nearer than this at rest [mm] are held, where that is asked for; these are so far apart, of
# the size: what a solid does between them its nodes decide.
TOUCHED, HOLDING = 1.0, 0.05
# How near points of one muscle are to those of another that may meet it in a sub-step, or whose
# shown surface may, of the size of the smaller one.
SEARCHED = 0.06
NEAR = 0.02  # gap of points that are looked at in a sub-step, of that size
MET = 0.01  # gap up to which a contact takes part in an iteration, of that size
HELD = 0.05  # the same of one that holds muscles together
NONE = np.zeros(0, dtype=np.int64)


class NeighbourState(NamedTuple):
    """How the last solve of a group ended: forces (k,) of the points of one muscle at another, the
    bodies, none before the first, and which point of another muscle was the nearest to each (k,) of
    one, -1 where none was near. Nothing is changed in place.
    """

    forces: Mapping[Link, Floats]
    bodies: Sequence[Moving]
    near: Mapping[Link, Integers]


NEVER_MET = NeighbourState({}, (), {})


class Neighbours:
    """The contacts between the muscles of a group, in their rest state.

    Parameters
    ----------
    steppers : list of MuscleStepper
    links : sequence of (int, int)
        Which of them may touch which, by number.

    Attributes
    ----------
    state : NeighbourState
    bones : list of HeldBone
        Bodies beside the muscles, whose numbers go on from theirs.
    """

    def __init__(self, steppers: Sequence[MuscleStepper], links: Sequence[Link]) -> None:
        self.links = sorted({*links, *(link[::-1] for link in links)})
        self.state = NEVER_MET
        self.bodies: list[Body] = []
        # By muscle, for each of its shown points the nearest of those that meet neighbours; they
        # stay so, as they move together.
        self._own: dict[int, Integers] = {}
        self.overlaps: dict[Link, Floats] = {}
        self.held: dict[Link, Floats] = {}  # gaps (k,) that points keep, NaN where they are free
        holders, self.bones = _held_bones(steppers)
        if not links and not holders:
            return
        self.bodies = each(lambda stepper: stepper.model.body(), steppers)
        solids = [stepper.model.begin(stepper.contacts) for stepper in steppers]
        sizes = [solid.size for solid in solids]
        self.bodies += [NO_POINTS] * len(self.bones)
        scene = steppers[0].scene
        touched = from_mm(TOUCHED, scene.units)
        bodies = [*solids, *self.bones]
        meeting = self.find(bodies)
        if meeting is not None:
            meeting.ask(bodies)
            gap = np.where(np.isfinite(meeting.gap), meeting.gap, np.nan)
            self.overlaps = self._by_link(meeting, np.fmax(-gap, 0.0), 0.0)
            if scene.neighbours is not None and scene.neighbours.together:
                self.held = self._by_link(meeting, gap, np.nan)
        points = [s.feet_of(body.points).of(s.nodes) for s, body in zip(solids, self.bodies)]
        for number, (m, bone) in enumerate(zip(holders, self.bones), len(steppers)):
            self.held[m, number] = bone.ask(points[m], self.bodies[number].places)[0]
        for (m, _), gap in self.held.items():
            near = np.flatnonzero(gap < touched)
            here = points[m][near]
            # However high the surface rises between them.
            even = surface_points(here, np.zeros_like(here), HOLDING * sizes[m], np.inf)
            some = near[even]
            gap[np.setdiff1d(np.arange(len(gap)), some)] = np.nan

    def find(self, solids: Sequence[Moving]) -> Meeting | None:
        """The points that may meet another muscle in a sub-step; None where there are none."""
        if not self.bodies:
            return None
        own = [solid.feet_of(body.points) for solid, body in zip(solids, self.bodies)]
        points = [feet.of(solid.nodes) for feet, solid in zip(own, solids)]
        trees = [cKDTree(here) for here in points]
        size = [solid.size for solid in solids]
        found: list[tuple[int, int, Integers, Integers]] = []
        near: dict[Link, Integers] = {}
        for one, other in self.links:
            reach = SEARCHED * min(size[one], size[other])
            which, nearest = _near_points(trees[one], trees[other], reach)
            if len(which) == 0:
                continue
            near[one, other] = np.full(len(points[one]), -1)
            near[one, other][which] = nearest
            found.append((one, other, which, nearest))
        self.state = self.state._replace(near=near)
        muscles = len(solids) - len(self.bones)
        for (one, other), gap in self.held.items():
            if other >= muscles:
                which = np.flatnonzero(np.isfinite(gap))
                found.append((one, other, which, np.zeros(len(which), dtype=np.int64)))
        found.sort(key=lambda row: row[:2])
        if not found:
            return None
        counts = [len(which) for _, _, which, _ in found]
        ones, others = [one for one, *_ in found], [other for _, other, *_ in found]
        which = {m: [row[2] for row in found if row[0] == m] for m in range(len(solids))}
        nearest = {m: [row[3] for row in found if row[1] == m] for m in range(len(solids))}
        law = [
            solids[one].contact_law(self.bodies[one].points[rows], self.bodies[one].area[rows])
            for one, _, rows, _ in found
        ]
        overlap, held, force = (
            np.concatenate([self._known(known, *row[:3], empty) for row in found])
            for known, empty in (
                (self.overlaps, 0.0),
                (self.held, np.nan),
                (self.state.forces, 0.0),
            )
        )
        holds = np.isfinite(held)
        smaller = np.repeat([min(size[one], size[other]) for one, other, *_ in found], counts)
        meeting = Meeting(
            np.repeat(ones, counts),
            np.repeat(others, counts),
            np.concatenate([self.bodies[one].points[rows] for one, _, rows, _ in found]),
            [own[m].some(np.concatenate(rows or [NONE])) for m, rows in which.items()],
            [self.bodies[m].places[np.concatenate(rows or [NONE])] for m, rows in nearest.items()],
            (
                np.concatenate([most for most, _ in law]),
                np.concatenate([softness for _, softness in law]),
            ),
            holds,
            np.where(holds, -held, overlap),
            np.where(holds, HELD, MET) * smaller,
            force,
        )
        meeting.ask(solids)
        far = ~(meeting.gap < np.where(holds, HELD, NEAR) * smaller)
        return meeting.without(far & (meeting.force == 0.0))

    def keep(self, meeting: Meeting | None, solids: Sequence[Moving]) -> None:
        """Keep how a solve ended."""
        forces = {} if meeting is None else self._by_link(meeting, meeting.force, 0.0)
        self.state = NeighbourState(forces, solids, self.state.near)

    def out_of_neighbours(self, number: int, points: Floats) -> Floats:
        """Displacements (n, 3) that take the points (n, 3) of the shown surface of a muscle, always
        the same ones, to where its own distance is that to a neighbour, as the last solve left
        both, where the neighbour is nearer: so both are shown up to the same surface (Gascuel
        1993). What overlapped at rest stays so deep.
        """
        out, state = np.zeros_like(points), self.state
        others = [other for one, other in state.near if one == number] if state.bodies else []
        if others and number not in self._own:
            solid = state.bodies[number]
            places = solid.feet_of(self.bodies[number].points).of(solid.nodes)
            self._own[number] = cKDTree(places).query(points)[1]
        for other in others:
            # Those that hang near a point that is near the neighbour.
            nearest = state.near[number, other][self._own[number]]
            which = np.flatnonzero(nearest >= 0)
            if len(which) == 0:
                continue
            here, own = points[which], self._own[number][which]
            mine, _, _ = state.bodies[number].ask(here, self.bodies[number].places[own])
            foot = self.bodies[other].places[nearest[which]]
            gap, normal, _ = state.bodies[other].ask(here, foot)
            gap += self._known(self.overlaps, number, other, own, 0.0)
            nearer = np.isfinite(gap) & np.isfinite(mine) & (mine > gap)
            away = 0.5 * (mine[nearer] - gap[nearer])
            out[which[nearer]] += away[:, None] * normal[nearer]
        return out

    def _known(
        self, known: Mapping[Link, Floats], one: int, other: int, which: Integers, empty: float
    ) -> Floats:
        """Values of some points of a muscle at another, ``empty`` where there are none."""
        found = known.get((one, other))
        return np.full(len(which), empty) if found is None else found[which]

    def _by_link(self, meeting: Meeting, values: Floats, empty: float) -> dict[Link, Floats]:
        """Values (K,) of points, for all points (k,) of a muscle at another: ``empty`` where there
        are none.
        """
        found: dict[Link, Floats] = {}
        for k in np.flatnonzero(np.isfinite(values) & (values != empty)):
            one, other = int(meeting.one[k]), int(meeting.other[k])
            body = self.bodies[one]
            full = found.setdefault((one, other), np.full(len(body.points), empty))
            full[np.searchsorted(body.points, meeting.point[k])] = values[k]
        return found


def _held_bones(steppers: Sequence[MuscleStepper]) -> tuple[list[int], list[HeldBone]]:
    """The bones within reach that hold muscles, and the number of the muscle of each."""
    options = steppers[0].scene.neighbours
    wanted = [] if options is None else options.bones
    muscles, bones = [], []
    for number, stepper in enumerate(steppers):
        contacts = stepper.contacts
        for row, (name, field) in enumerate(zip(contacts.bones.names, contacts.bones.fields)):
            if [stepper.name, name] in wanted:
                muscles.append(number)
                bones.append(HeldBone(field, contacts.placed[row]))
    return muscles, bones


def _near_points(own: cKDTree, other: cKDTree, reach: float) -> tuple[Integers, Integers]:
    """Which (k,) of the points of a muscle are near those of another, and the number (k,) of the
    nearest of these.
    """
    points, low, high = own.data, other.mins - reach, other.maxes + reach
    if (own.mins > high).any() or (own.maxes < low).any():
        return NONE, NONE
    which = np.flatnonzero(((points >= low) & (points <= high)).all(axis=1))
    if len(which) == 0:
        return which, which
    away, nearest = other.query(points[which], distance_upper_bound=reach)
    found = np.isfinite(away)
    return which[found], nearest[found]


def find_links(scene: Scene, names: Sequence[str]) -> list[Link]:
    """Which of the named muscles may touch in the scene's motion: those of its ``pairs``, or all,
    as far as their swept boxes come near each other.
    """
    options = scene.neighbours
    if options is None:
        return []
    wanted = None if options.pairs is None else [frozenset(pair) for pair in options.pairs]
    muscles = [scene.muscle(name) for name in names]
    poses, reach = sampled_poses(scene), from_mm(REACH, scene.units)

    @cache
    def box(k: int, bone: str) -> Floats:
        return swept_boxes(muscles[k], [bone], poses)[0]

    def meet(i: int, k: int) -> bool:
        """Whether the swept boxes meet in the coordinates of every bone that holds one of both."""
        bones = {held.attachment_frame for m in (i, k) for held in muscles[m].attachments}
        boxes = ((box(i, bone), box(k, bone)) for bone in bones)
        return all((a[0] - reach <= b[1]).all() and (b[0] - reach <= a[1]).all() for a, b in boxes)

    return [
        (k, i)
        for i in range(len(muscles))
        for k in range(i)
        if (wanted is None or frozenset((names[k], names[i])) in wanted) and meet(i, k)
    ]


def connected(count: int, links: Sequence[Link]) -> list[list[int]]:
    """The sets of muscles, of so many, that links join, each in order."""
    group = list(range(count))
    for one, other in links:
        old, new = max(group[one], group[other]), min(group[one], group[other])
        group = [new if g == old else g for g in group]
    return [[k for k in range(count) if group[k] == g] for g in sorted(set(group))]
