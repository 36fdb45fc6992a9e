"""Anderson acceleration of a fixed-point iteration."""

from __future__ import annotations

import numpy as np

from rbfmuscle.geometry.arrays import Floats


class Anderson:
    """Anderson acceleration of a fixed-point map (Walker & Ni 2011), plain steps until it has memory.

    Parameters
    ----------
    memory : int
        Number of steps that are combined; 0 for plain steps.
    measured : int
        The first so many components of a state form the residual.
    """

    def __init__(self, memory: int, measured: int) -> None:
        self.memory, self.measured = memory, measured
        self.residuals: list[Floats] = []  # differences from step to step, of the residuals and of the images
        self.images: list[Floats] = []
        self.last: tuple[Floats, Floats] | None = None

    def restart(self) -> None:
        """Forget the past steps."""
        self.residuals, self.images, self.last = [], [], None

    def mix(self, state: Floats, image: Floats) -> Floats:
        """Next state (m,) from a state (m,) and its image (m,)."""
        if self.memory == 0:
            return image
        residual = (image - state)[: self.measured]
        if self.last is not None:
            self.residuals.append(residual - self.last[0])
            self.images.append(image - self.last[1])
            del self.residuals[: -self.memory], self.images[: -self.memory]
        self.last = residual, image.copy()
        if not self.residuals:
            return image
        df, dg = np.array(self.residuals), np.array(self.images)
        gram = df @ df.T
        gram[np.diag_indices_from(gram)] *= 1.0 + 1e-8
        gram[np.diag_indices_from(gram)] += 1e-300
        return image - np.linalg.solve(gram, df @ residual) @ dg
