"""Anderson acceleration of a fixed-point iteration."""

from __future__ import annotations

import numpy as np

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.jit import compiled


class Anderson:
    """Anderson acceleration of a fixed-point map (Walker & Ni 2011), plain steps until it has memory.

    Parameters
    ----------
    memory : int
        Number of steps that are combined; 0 for plain steps.
    size, measured : int
        Components of a state; the first so many form the residual.
    """

    def __init__(self, memory: int, size: int, measured: int) -> None:
        # Differences from step to step, of the residuals and of the images; then the last of either.
        self._residuals, self._images = np.empty((memory, measured)), np.empty((memory, size))
        self._last_residual, self._last_image = np.empty(measured), np.empty(size)
        self._steps = 0

    def restart(self) -> None:
        """Forget the past steps."""
        self._steps = 0

    def mix(self, state: Floats, image: Floats) -> Floats:
        """Next state (m,) from a state (m,) and its image (m,)."""
        out = image.copy()
        _mix_loop(
            state,
            image,
            self._steps,
            self._residuals,
            self._images,
            self._last_residual,
            self._last_image,
            out,
        )
        self._steps += 1
        return out


@compiled(error_model="numpy")
def _mix_loop(state, image, steps, residuals, images, last_residual, last_image, out):
    """Subtract from ``out`` the combination of past images whose residuals come nearest to the present one."""
    memory, size = len(residuals), len(last_residual)
    if steps > 0 and memory > 0:
        row = (steps - 1) % memory
        for i in range(size):
            residuals[row, i] = image[i] - state[i] - last_residual[i]
        for i in range(len(image)):
            images[row, i] = image[i] - last_image[i]
    for i in range(size):
        last_residual[i] = image[i] - state[i]
    last_image[:] = image
    count = min(steps, memory)
    if count == 0:
        return
    gram, right = np.empty((count, count)), np.empty(count)
    for k in range(count):
        right[k] = 0.0
        for i in range(size):
            right[k] += residuals[k, i] * last_residual[i]
        for m in range(k + 1):
            value = 0.0
            for i in range(size):
                value += residuals[k, i] * residuals[m, i]
            gram[k, m], gram[m, k] = value, value
        gram[k, k] = gram[k, k] * (1.0 + 1e-8) + 1e-300
    weight = np.linalg.solve(gram, right)
    for k in range(count):
        for i in range(len(image)):
            out[i] -= weight[k] * images[k, i]
