"""Steps of the iteration that brings a muscle's elastic solid to equilibrium, compiled, and its
acceleration.
"""

import numpy as np

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.jit import compiled
from rbfmuscle.muscle.inversion import unfold_loop
from rbfmuscle.muscle.solid_loops import press_loop, stress_loop, swell_loop, target_loop


class Anderson:
    """Anderson acceleration of a fixed-point map (Walker & Ni 2011), plain steps until it has
    memory.

    ``memory`` steps are combined, 0 for plain ones; the first ``measured`` of a state's components
    are the residual.
    """

    def __init__(self, memory: int, size: int, measured: int) -> None:
        # Differences from step to step, of the residuals and of the images; then the last of
        # either.
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
    """Subtract from ``out`` the combination of past images whose residuals come nearest to the
    present one.
    """
    memory, size = len(residuals), len(last_residual)
    if steps > 0 and memory > 0:
        row = (steps - 1) % memory
        for i in range(size):
            residuals[row, i] = image[i] - state[i] - last_residual[i]
        for i in range(len(image)):
            images[row, i] = image[i] - last_image[i]
    for i in range(size):
        last_residual[i] = image[i] - state[i]
    for i in range(len(image)):
        last_image[i] = image[i]
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
    _solve_definite(gram, right)
    for k in range(count):
        for i in range(len(image)):
            out[i] -= right[k] * images[k, i]


@compiled(error_model="numpy")
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


@compiled(error_model="numpy")
def local_loop(y, cells, fibres, tension, stiffened, state, f, target, right, gradient, volume):
    """Targets, forces and volumes for nodes ``y``: how many points joined the squeezed ones, and
    the energy of these.

    ``cells`` holds nodes and slopes of the quadrature points, their weights, and their regions and
    slots, ``state`` the rotations and stretches, changed in place.
    """
    columns, slopes, weights, region, slot = cells
    quaternion, stretch = state
    target_loop(
        y, columns, slopes, fibres.direction, fibres.lower, tension, quaternion, stretch, f, target
    )
    stress_loop(f, target, fibres, weights, columns, slopes, region, slot, right, gradient, volume)
    return unfold_loop(f, stiffened, weights, columns, slopes, right)


@compiled(error_model="numpy")
def global_loop(y, force, inverse, regions, pressure, law, response, factor, step, change):
    """Nodes ``step`` under a force and the regions' pressures, volumes corrected; the whitened
    ``change`` of pressure.

    ``regions`` holds where each begins, its nodes, gradients, volumes now and at rest; ``law`` the
    bulk modulus and the pressure beyond which steps are shortened. Returns the share of a full step
    that was taken. Bouaziz et al. (2014) call it the global step.
    """
    start, node, gradient, volume, rest = regions
    bulk, calm = law
    highest = 0.0
    for r in range(len(pressure)):
        highest = max(highest, abs(pressure[r]))
    part = 1.0 / max(1.0, highest / calm)
    right = force.copy()
    press_loop(pressure, start, node, gradient, right)
    free = np.dot(inverse, right)
    for n in range(len(y)):
        for a in range(3):
            free[n, a] = part * (free[n, a] - y[n, a])
    swell_loop(free, start, node, gradient, change)
    for r in range(len(change)):
        value = rest[r] * (1.0 - pressure[r] / bulk) - volume[r] - change[r]
        for o in range(r):
            value -= factor[r, o] * change[o]
        change[r] = value / factor[r, r]
    for n in range(len(y)):
        for a in range(3):
            step[n, a] = y[n, a] + free[n, a]
    for r in range(len(change)):
        for a in range(3):
            for n in range(len(y)):
                step[n, a] += change[r] * response[r, a, n]
    return part


@compiled(error_model="numpy")
def ways_loop(y, step, push, columns, shares, margin, here, motion, reach):
    """Embedded points ``here``, their ``motion`` in a step of the nodes, and how far to look for
    obstacles.

    That is half as far again as they go in the step with the last push on top, and a margin.
    """
    size = len(y)
    ways = np.empty((size, 9))
    for n in range(size):
        for a in range(3):
            ways[n, a] = y[n, a]
            ways[n, 3 + a] = step[n, a] - y[n, a]
            ways[n, 6 + a] = push[n, a]
    total = np.empty(9)
    for s in range(len(columns)):
        total[:] = 0.0
        for k in range(columns.shape[1]):
            way, share = ways[columns[s, k]], shares[s, k]
            for a in range(9):
                total[a] += share * way[a]
        square = 0.0
        for a in range(3):
            here[s, a], motion[s, a] = total[a], total[3 + a]
            square += (total[3 + a] + total[6 + a]) ** 2
        reach[s] = 1.5 * np.sqrt(square) + margin


@compiled(error_model="numpy")
def pressure_loop(y, step, push, change, taken, factor, part, most, pressure):
    """Add the contacts' push to the step and the change to the pressures, at most ``most``.

    Returns the greatest motion of a node.
    """
    for r in range(len(change) - 1, -1, -1):
        change[r] -= taken[r]
        for o in range(r + 1, len(change)):
            change[r] -= factor[o, r] * change[o]
        change[r] /= factor[r, r]
        pressure[r] = min(max(pressure[r] + change[r] / part, -most), most)
    largest = 0.0
    for n in range(len(y)):
        square = 0.0
        for a in range(3):
            step[n, a] += push[n, a]
            square += (step[n, a] - y[n, a]) ** 2
        # Written so that NaN is not lost.
        if not square <= largest:
            largest = square
    return np.sqrt(largest)
