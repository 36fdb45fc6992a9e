"""How deep the shown surfaces of muscles lie in each other, and how far those that touched at rest
have parted.

Depths are exact distances of the vertices of either surface to the triangles of the other. The
input meshes of a scan often overlap: what they do near a place at rest counts as nothing there.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.spatial import cKDTree

from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.geometry.mesh_distance import MeshDistance
from rbfmuscle.geometry.threads import each
from rbfmuscle.scene.check import InputOverlap, input_distances, input_overlaps
from rbfmuscle.scene.objects import Muscle, from_mm

# Surfaces that are nearer than this at rest [mm] touch there.
TOUCHING = 1.0
# An overlap at rest counts so far around [mm] as what is there: more than the vertices of a scan
# are apart, less than a muscle is wide.
AROUND = 5.0
# Touching places of which the gap is taken, at most, of each side of a pair.
MOST_PLACES = 100
# Share of the touching places that have parted by less than the gap that is stated.
GAP_PERCENTILE = 95.0


class Shown:
    """The surface of a muscle in a frame, and where its vertices (n, 3) lie at rest."""

    def __init__(self, distance: MeshDistance, at_rest: Floats) -> None:
        self.distance, self.at_rest = distance, at_rest
        # Column by column, which takes a tenth of the time of all at once.
        columns = distance.vertices.T
        self.box = np.array([[end(column) for column in columns] for end in (np.min, np.max)])


@dataclass(frozen=True)
class Side:
    """What is known from rest of one muscle's vertices beside another muscle.

    ``touching`` (k,) are those that touch it, ``gap`` (k,) their distances to it; ``allowed`` (n,)
    is how deep each may lie in it, as the input does, None where the input does not overlap.
    """

    touching: Integers
    gap: Floats
    allowed: Floats | None


class InputNeighbours:
    """Muscles as the input has them: distances to their meshes, and which of these overlap."""

    def __init__(self, muscles: Sequence[Muscle], units: str) -> None:
        self.touching, self.around = from_mm(TOUCHING, units), from_mm(AROUND, units)
        self.distances = input_distances(muscles)
        self.bounds = {
            name: np.array([d.vertices.min(axis=0), d.vertices.max(axis=0)])
            for name, d in self.distances.items()
        }
        self.overlaps = input_overlaps(self.distances)

    def deepest(self, name: str) -> float:
        """Deepest overlap of a muscle's input mesh with that of another [scene unit]."""
        deepest = [
            float(overlap.depths.max()) for pair, overlap in self.overlaps.items() if name in pair
        ]
        return max(deepest, default=0.0)

    def side(self, one: str, other: str, at_rest: Floats) -> Side:
        """What vertices (n, 3) of one muscle do beside another at rest."""
        low, high = self.bounds[other]
        near = np.flatnonzero(
            np.all((at_rest > low - self.touching) & (at_rest < high + self.touching), axis=1)
        )
        distance = self.distances[other].signed(at_rest[near])
        touching = distance < self.touching
        near, distance = near[touching], distance[touching]
        thinned = slice(None, None, -(-len(near) // MOST_PLACES) or 1)
        pair = (one, other) if (one, other) in self.overlaps else (other, one)
        allowed = None
        if pair in self.overlaps:
            allowed = _spread(self.overlaps[pair], at_rest, self.around)
        return Side(near[thinned], np.maximum(distance[thinned], 0.0), allowed)


class NeighbourMeasures:
    """Measures every pair of some surfaces of a scene's muscles, frame by frame."""

    def __init__(self, given: InputNeighbours) -> None:
        self.input = given
        self._places: dict[str, Floats] = {}
        self._sides: dict[tuple[str, str], Side] = {}
        self._touched: set[tuple[str, str]] = set()
        # Of pairs that met or touched: frame, overlap beyond rest, gap.
        self._met: dict[tuple[str, str], list[tuple[int, float, float]]] = {}

    def measure(self, index: int, shown: Mapping[str, Shown]) -> dict[str, dict[str, float]]:
        """Values of each muscle that is shown, in the frame of this number."""
        names = list(shown)
        if not names:
            return {}
        # Those that are shown by other vertices than in the frame before.
        fresh = [n for n, surface in shown.items() if self._places.get(n) is not surface.at_rest]
        each(lambda name: self._renew(name, shown[name].at_rest, names), fresh)
        low, high = np.swapaxes([surface.box for surface in shown.values()], 0, 1)
        met = np.all((low[:, None] <= high) & (low <= high[:, None]), axis=2)
        near = [
            (one, other, bool(met[i, k]))
            for (i, one), (k, other) in combinations(enumerate(names), 2)
            if met[i, k] or (one, other) in self._touched
        ]
        found = each(lambda row: self._pair(row, shown), near)
        overlap = dict.fromkeys(names, 0.0)
        gaps: dict[str, list[Floats]] = {name: [] for name in names}
        for (one, other, _), (deepest, parted) in zip(near, found):
            for name, gap in zip((one, other), parted):
                overlap[name] = max(overlap[name], deepest)
                gaps[name].append(gap)
            if deepest > 0.0 or (one, other) in self._touched:
                values = index, deepest, _percentile(parted)
                self._met.setdefault((one, other), []).append(values)
        return {
            name: {"neighbour_overlap_max": overlap[name], "neighbour_gap": _percentile(gaps[name])}
            for name in names
        }

    def table(self) -> list[dict[str, object]]:
        """Pairs that met or touched, the deepest overlap first [scene unit]."""
        rows = []
        for pair, met in self._met.items():
            frames, overlaps, gaps = zip(*met)
            deepest = int(np.argmax(overlaps))
            widest = int(np.argmax(gaps))
            at_rest = self.input.overlaps.get(pair)
            row = {
                "muscles": list(pair),
                "overlap_max": overlaps[deepest],
                "overlap_frame": frames[deepest],
                "overlap_rest": 0.0 if at_rest is None else float(at_rest.depths.max()),
                "gap": gaps[widest],
                "gap_frame": frames[widest],
            }
            rows.append(row)
        return sorted(rows, key=lambda row: -row["overlap_max"])

    def _pair(
        self, row: tuple[str, str, bool], shown: Mapping[str, Shown]
    ) -> tuple[float, list[Floats]]:
        """Deepest overlap beyond rest of a pair, and how far touching places of either parted."""
        deepest, parted = 0.0, []
        first, second, met = row
        for one, other in ((first, second), (second, first)):
            side, there = self._sides[one, other], shown[other].distance
            vertices = shown[one].distance.vertices
            if met:
                inside = np.flatnonzero(there.inside(vertices))
                depth = there.unsigned(vertices[inside])
                if side.allowed is not None:
                    depth = depth - side.allowed[inside]
                deepest = max(deepest, float(depth.max(initial=0.0)))
            points = vertices[side.touching]
            away = np.where(there.inside(points), 0.0, there.unsigned(points))
            parted.append(np.maximum(away - side.gap, 0.0))
        return deepest, parted

    def _renew(self, one: str, at_rest: Floats, names: Sequence[str]) -> None:
        """Find what a muscle's vertices (n, 3) do beside the others at rest."""
        self._places[one] = at_rest
        for other in names:
            if other != one:
                self._sides[one, other] = side = self.input.side(one, other, at_rest)
                if len(side.touching):
                    self._touched |= {(one, other), (other, one)}


def _spread(overlap: InputOverlap, points: Floats, reach: float) -> Floats:
    """Greatest depth (n,) of what overlaps within ``reach`` of each point (n, 3)."""
    allowed = np.zeros(len(points))
    near = cKDTree(points).query_ball_point(overlap.places, reach)
    for depth, around in zip(overlap.depths, near):
        allowed[around] = np.maximum(allowed[around], depth)
    return allowed


def _percentile(parted: Iterable[Floats]) -> float:
    """`GAP_PERCENTILE` of what has parted; 0 where nothing touched."""
    values = np.concatenate([[], *parted])
    return float(np.percentile(values, GAP_PERCENTILE)) if len(values) else 0.0
