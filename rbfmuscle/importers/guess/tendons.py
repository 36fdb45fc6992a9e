"""Tendons as guessed: to the landmark of a site past the places that anatomy names, or along a mesh
of the tendon.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from rbfmuscle.anatomy.bones import Part
from rbfmuscle.geometry.surfaces import geodesic, surface_graph
from rbfmuscle.importers.guess.joints import Skeleton
from rbfmuscle.importers.guess.sites import Anatomy, Site, sites_on

if TYPE_CHECKING:
    import trimesh


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
    points = np.vstack([site.nearest(last) for site in sites] or [bone.points])
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
    tuberosity = tibia and skeleton.site("tibial_tuberosity", tibia, muscle.points)
    if tuberosity is None:
        return None
    poles = [skeleton.site(name, patella, muscle.points).core[0] for name in POLES]
    via = tuple((patella, skeleton.out_of_bone(pole, patella)) for pole in poles)
    return TendonGuess(tibia, skeleton.out_of_bone(tuberosity.core[0], tibia), via)


def via_places(known: Anatomy, muscle: Part, skeleton: Skeleton) -> tuple[BonePlace, ...]:
    """(bone, place) that the tendon of an insertion passes, out of the bones."""
    found = []
    for name in known.via:
        bones = [b for b in skeleton.bones if sites_on((name,), b)]
        bones = [b for b in bones if b.may_be_beside(muscle)]
        sites = ((b, skeleton.site(name, b, muscle.points)) for b in bones)
        bone, site = next(((b, s) for b, s in sites if s is not None), (None, None))
        if bone is not None and site is not None:
            found.append((bone, skeleton.out_of_bone(site.core[0], bone)))
    return tuple(found)


def tendon_by_mesh(tendon: TendonMesh, bone: Part, skeleton: Skeleton) -> TendonGuess:
    """A tendon along its mesh, through middles that are held by the nearest bones."""
    via = []
    for middle in tendon.middles:
        away = {b: float(d.distances(middle[None])[0]) for b, d in skeleton.bones.items()}
        nearest = min(away, key=away.__getitem__)
        inside = away[nearest] < 0.0
        via.append((nearest, skeleton.out_of_bone(middle, nearest) if inside else middle))
    return TendonGuess(bone, tendon.end_on(bone), tuple(via), tendon.part)


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
        seen = min((see_tendon(tendon, muscle) for muscle in mine), key=lambda one: one.gap)
        away = min(float(bone.distances(seen.end[None])[0]) for bone in skeleton.bones.values())
        gaps = f"{seen.gap / skeleton.millimetre:.0f} mm from its muscle"
        gaps += f" and ends {away / skeleton.millimetre:.0f} mm from a bone"
        reasons[tendon.file] = f"a tendon that begins {gaps}, at most {REACHES:g} mm are believed"
    return reasons


class TendonMesh(NamedTuple):
    """A tendon's mesh as one muscle sees it: its end (3,), its middles (k, 3) on the way there, the
    vertices of the muscle where it begins, and the distance between the two [scene unit].
    """

    part: Part
    end: np.ndarray
    middles: np.ndarray
    begins: np.ndarray
    gap: float

    def end_on(self, bone: Part) -> np.ndarray:
        """The place (3,) of a bone's surface that is nearest to the tendon's end."""
        points = bone.faces[0]
        return points[np.argmin(((points - self.end) ** 2).sum(axis=1))]


def see_tendon(tendon: Part, muscle: Part) -> TendonMesh:
    """How a tendon's mesh runs, from a muscle on."""
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
    return TendonMesh(tendon, line[-1], line[kept[1:-1]], begins, gap)


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
