"""Load steps of a quasi-static solid, what its Newton iterations solve with, and the bones that it
meets.
"""

import time
from dataclasses import dataclass

import numpy as np
from scipy.sparse.linalg import splu

from rbfmuscle.validation import SolveError


@dataclass(frozen=True)
class SolidState:
    """A solved state: displacement of the nodes (n, 3), Newton iterations, relative residual."""

    displacement: np.ndarray
    iterations: int
    residual: float


def positive_factor(matrix):
    """What solves with a symmetric sparse matrix.

    Raises
    ------
    numpy.linalg.LinAlgError
        If the matrix is not positive definite: pivots are taken from the diagonal, and some are not
        positive.
    """
    try:
        factor = splu(
            matrix.tocsc(),
            permc_spec="MMD_AT_PLUS_A",
            diag_pivot_thresh=0.0,
            options={"SymmetricMode": True},
        )
    except RuntimeError as error:  # exactly singular
        raise np.linalg.LinAlgError(str(error)) from None
    if not (factor.U.diagonal() > 0.0).all():
        raise np.linalg.LinAlgError("the matrix is not positive definite")
    return factor


def follow(advance, displacement, goals, steps):
    """Solve from place to place, in shorter steps where one fails; yield each goal and the
    displacement there.

    Parameters
    ----------
    advance : callable
        ``advance(displacement, place, target)`` returns the `SolidState` at the target.
    displacement : (n, 3) ndarray
        At place 0.
    goals : sequence of float
        Places, ascending.
    steps : (largest, smallest)

    Raises
    ------
    SolveError
        Where the smallest step fails.
    """
    (largest, smallest), place = steps, 0.0
    step = largest
    for goal in goals:
        while place < goal:
            target, began = min(place + step, goal), time.process_time()
            try:
                state = advance(displacement, place, target)
            except SolveError as error:
                step *= 0.5
                if step < smallest:
                    raise SolveError(f"{error} (on the way to {target})") from None
                continue
            displacement = state.displacement
            place = target
            step = min(largest, 2 * step)
            spent = time.process_time() - began
            print(
                f"  {place:7.3f}: {state.iterations} iterations, {state.residual:.1e}, "
                f"{spent:.0f} s",
                flush=True,
            )
        yield goal, displacement


def nearest_bone(fields, poses, points):
    """Smallest distance (n,) of points to bones given by name, and its unit gradient (n, 3)."""
    found = [field.distance_and_gradient(points, poses[name]) for name, field in fields.items()]
    distance = np.stack([d for d, _ in found])
    which, here = np.argmin(distance, axis=0), np.arange(len(points))
    direction = np.stack([g for _, g in found])[which, here]
    length = np.linalg.norm(direction, axis=1, keepdims=True)
    return distance[which, here], direction / np.maximum(length, 1e-12)
