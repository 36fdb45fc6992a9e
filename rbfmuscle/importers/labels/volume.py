"""Labels on a regular grid, in layers where labels overlap."""

from dataclasses import dataclass, field

import numpy as np

from rbfmuscle.geometry.arrays import Array, Booleans, Floats

# A label's number is its value in its layer, and this much more for each layer before.
LAYER = 1 << 16
MOST_NAMED = 10  # overlaps named one by one


@dataclass
class LabelVolume:
    """Labels (layers, i, j, k) on a regular grid, 0 for what belongs to nothing.

    One layer (i, j, k) is enough where no labels overlap. ``affine`` (4, 4) takes voxel indices to
    positions [mm, RAS]; ``names`` are those of the labels that have one; ``notes`` say what was
    assumed, rounded or empty; ``directed`` is whether the header states directions.
    """

    labels: Array
    affine: Floats
    names: dict[int, str]
    source: str
    notes: list[str] = field(default_factory=list)
    directed: bool = True

    def __post_init__(self) -> None:
        if self.labels.ndim == 3:
            self.labels = self.labels[None]

    @property
    def spacing(self) -> Floats:
        """Edges of a voxel [mm], (3,)."""
        return np.linalg.norm(self.affine[:3, :3], axis=0)

    def values(self) -> Array:
        """Labels that occur, without 0."""
        found = [np.flatnonzero(np.bincount(layer.ravel())) for layer in self.labels]
        return np.concatenate([each[each > 0] + k * LAYER for k, each in enumerate(found)])

    def mask(self, label: int) -> Booleans:
        """Voxels (i, j, k) of a label."""
        layer, value = divmod(label, LAYER)
        return self.labels[layer] == value

    def name(self, label: int) -> str:
        """Name of a label; its number where it has none."""
        layer, value = divmod(int(label), LAYER)
        where = f"_layer_{layer + 1}" if layer else ""
        return self.names.get(int(label)) or f"label_{value}{where}"

    def overlaps(self) -> list[str]:
        """One line for each two labels that have voxels in common."""
        found = []
        for b in range(1, len(self.labels)):
            for a in range(b):
                both = (self.labels[a] > 0) & (self.labels[b] > 0)
                one, other = (self.labels[k][both].astype(np.int64) for k in (a, b))
                pairs, counts = np.unique(one * LAYER + other, return_counts=True)
                for pair, count in zip(pairs.tolist(), counts.tolist()):
                    labels = pair // LAYER + a * LAYER, pair % LAYER + b * LAYER
                    found.append((count, *labels))
        lines = [self._overlap(*row) for row in sorted(found, reverse=True)[:MOST_NAMED]]
        more = len(found) - len(lines)
        return lines + ([f"{more} more pairs of labels overlap, each kept whole"] if more else [])

    def _overlap(self, count: int, one: int, other: int) -> str:
        sizes = {label: int(self.mask(label).sum()) for label in (one, other)}
        small = min(sizes, key=lambda label: sizes[label])
        share = 100 * count / sizes[small]
        pair = f"{self.name(one)} and {self.name(other)}"
        return f"{pair} overlap in {count} voxels ({share:.3g} % of {self.name(small)}), both kept"
