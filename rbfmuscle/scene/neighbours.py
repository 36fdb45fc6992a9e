"""Muscles that lie in each other in the input, as segmentations often have it."""

from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.geometry.mesh_distance import MeshDistance
from rbfmuscle.scene.objects import Muscle


class InputOverlap(NamedTuple):
    """Where the input meshes of two muscles overlap at rest: vertices (n, 3) of either inside the
    other, and their depths (n,) [scene unit].
    """

    places: Floats
    depths: Floats


def input_distances(muscles: Sequence[Muscle]) -> dict[str, MeshDistance]:
    """Distance to the input mesh of each muscle, by name."""
    return {m.name: MeshDistance(m.mesh.vertices, m.mesh.faces) for m in muscles}


def input_overlaps(
    distances: Mapping[str, MeshDistance],
) -> dict[tuple[str, str], InputOverlap]:
    """The pairs of muscles whose input meshes overlap, from `input_distances`."""
    found = {}
    for one, other in combinations(distances, 2):
        depths = [
            distances[other].depth(distances[one].vertices),
            distances[one].depth(distances[other].vertices),
        ]
        inside = [depth > 0.0 for depth in depths]
        if any(each.any() for each in inside):
            places = [distances[n].vertices[i] for n, i in zip((one, other), inside)]
            deep = [depth[i] for depth, i in zip(depths, inside)]
            found[one, other] = InputOverlap(np.concatenate(places), np.concatenate(deep))
    return found
