"""Paths of a model's muscles, and the shapes that they wrap around."""

from dataclasses import dataclass, field

import numpy as np


@dataclass
class WrapShape:
    """A cylinder (z), ellipsoid or sphere that a path goes around, in a frame (4, 4) of a body [metre]."""

    name: str
    body: str
    frame: np.ndarray
    radii: np.ndarray  # of the ellipsoid; of a cylinder two radii and half the length
    kind: str
    quadrant: str

    def put_out(self, points: np.ndarray) -> np.ndarray:
        """Points (n, 3) in the shape's frame, those inside moved to its surface."""
        count = 2 if self.kind == "WrapCylinder" else 3
        scaled = points[:, :count] / self.radii[:count]
        inside = (np.linalg.norm(scaled, axis=1) < 1.0) & (
            (count == 3) | (np.abs(points[:, 2]) <= self.radii[2])
        )
        if len(self.quadrant) and "xyz".find(self.quadrant[-1]) in range(count):
            axis, sign = "xyz".find(self.quadrant[-1]), -1.0 if self.quadrant[0] == "-" else 1.0
            scaled[:, axis] = np.where(inside & (sign * scaled[:, axis] < 0.0), 0.0, scaled[:, axis])
            scaled[:, axis] += sign * 1e-3 * inside
        size = np.maximum(np.linalg.norm(scaled, axis=1), 1e-9)
        out = points.copy()
        out[inside, :count] = (scaled / size[:, None] * self.radii[:count])[inside]
        return out


@dataclass
class ModelMuscle:
    """A muscle of the model: points by body in their frames [metre], shapes it wraps around, volume [m3]."""

    name: str
    points: list[tuple[str, np.ndarray]]
    wraps: list[WrapShape] = field(default_factory=list)
    volume: float = 0.0
