"""Anderson acceleration of a fixed-point map (Walker & Ni 2011)."""

from typing import NamedTuple

import numpy as np

from rbfmuscle.jit import compiled


class Memory(NamedTuple):
    """The last steps of an iteration, of which the first components are the residual."""

    residuals: np.ndarray  # (memory, measured) differences of residuals from step to step
    images: np.ndarray  # (memory, size) differences of images
    residual: np.ndarray  # (measured,) the last of either
    image: np.ndarray  # (size,)
    steps: np.ndarray  # (1,) since the last restart: plain steps until there is memory


@compiled
def no_memory(memory, size, measured):
    """Memory of ``memory`` steps, 0 for plain ones, of states (size,)."""
    return Memory(
        np.empty((memory, measured)),
        np.empty((memory, size)),
        np.empty(measured),
        np.empty(size),
        np.zeros(1, np.int64),
    )


@compiled
def mix(memory, state, image):
    """Next state (size,) from a state and its image: the image less the combination of past images
    whose residuals come nearest to the present one.
    """
    room, size = len(memory.residuals), len(memory.residual)
    steps, out = memory.steps[0], image.copy()
    memory.steps[0] += 1
    if steps > 0 and room > 0:
        row = (steps - 1) % room
        for i in range(size):
            memory.residuals[row, i] = image[i] - state[i] - memory.residual[i]
        for i in range(len(image)):
            memory.images[row, i] = image[i] - memory.image[i]
    for i in range(size):
        memory.residual[i] = image[i] - state[i]
    for i in range(len(image)):
        memory.image[i] = image[i]
    count = min(steps, room)
    gram, right = np.empty((count, count)), np.empty(count)
    for k in range(count):
        right[k] = 0.0
        for i in range(size):
            right[k] += memory.residuals[k, i] * memory.residual[i]
        for m in range(k + 1):
            value = 0.0
            for i in range(size):
                value += memory.residuals[k, i] * memory.residuals[m, i]
            gram[k, m] = value
            gram[m, k] = value
        gram[k, k] = gram[k, k] * (1.0 + 1e-8) + 1e-300
    _solve_definite(gram, right)
    for k in range(count):
        for i in range(len(image)):
            out[i] -= right[k] * memory.images[k, i]
    return out


@compiled
def _solve_definite(matrix, right):
    """Solve a small system with a positive definite matrix by elimination, both in place.

    ``np.linalg.solve`` takes a second to compile.
    """
    count = len(right)
    for k in range(count):
        for row in range(k + 1, count):
            share = matrix[row, k] / matrix[k, k]
            for column in range(k, count):
                matrix[row, column] -= share * matrix[k, column]
            right[row] -= share * right[k]
    for k in range(count - 1, -1, -1):
        for column in range(k + 1, count):
            right[k] -= matrix[k, column] * right[column]
        right[k] /= matrix[k, k]
