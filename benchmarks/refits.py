"""Whether a fit that knows the frame before, or less of its digits, can be quicker than a factorisation.

python benchmarks/refits.py .../hip/gluteus.toml

The system of each frame is solved by conjugate gradients until the weights err by 1e-9 of a full Cholesky factor's,
preconditioned by an earlier frame's inverse in double or single precision, by an earlier frame's factor, or by the
frame's own factor in single precision, also for kernels of greater condition. Times are the least of several, on one
thread; an iteration is a product with the matrix, one with the inverse or two solutions with a factor, and two
projections. Last, what share of a factorisation the centres that one bone holds would save, whose part of the matrix
does not change.
"""

import sys
import time
from pathlib import Path

import numpy as np
from followed import record
from scipy.linalg import blas, lapack
from threadpoolctl import threadpool_limits

from rbfmuscle.implicit.fit import fitting
from rbfmuscle.implicit.fit.systems import hermite_system
from rbfmuscle.implicit.kernels.table import get_kernel
from rbfmuscle.sim.scene.scene import Scene

MOST = 80


def least(act, rounds: int = 30) -> float:
    """Least processor time of a call [ms]."""
    found = []
    for _ in range(rounds):
        started = time.process_time()
        act()
        found.append(time.process_time() - started)
    return 1e3 * min(found)


def iterations(matrix, directions, right, start, near, goal) -> int:
    """Iterations of preconditioned conjugate gradients until the weights are within 1e-9 of the goal."""

    def part(vector):
        return vector - directions @ (directions.T @ vector)

    x = part(start)
    r = part(right - blas.dsymv(1.0, matrix, x, lower=1))
    z = part(near(r))
    p, rz = z, r @ z
    for count in range(1, MOST + 1):
        q = part(blas.dsymv(1.0, matrix, p, lower=1))
        x, r = x + rz / (p @ q) * p, r - rz / (p @ q) * q
        if not np.linalg.norm(x - goal) >= 1e-9 * np.linalg.norm(goal):
            return count if np.isfinite(x).all() else MOST
        z = part(near(r))
        p, rz = z + (r @ z) / rz * p, r @ z
    return MOST


def by_inverse(inverse):
    """What multiplies by an inverse, in its own precision."""
    return lambda vector: (inverse @ vector.astype(inverse.dtype)).astype(float)


def by_factor(lower):
    """What solves with a Cholesky factor, in its own precision."""
    solve = lapack.spotrs if lower.dtype == np.float32 else lapack.dpotrs
    return lambda vector: solve(lower, vector.astype(lower.dtype), lower=1)[0].astype(float)


def single_factor(basis, factor):
    """The factor of the projected matrix in single precision, shifted until there is one; and the shift's share."""
    matrix = np.tril(basis.matrix())
    matrix += np.tril(matrix, -1).T
    q = factor.directions
    matrix -= q @ (q.T @ matrix)
    matrix -= (matrix @ q) @ q.T
    matrix += factor.gamma * q @ q.T
    mean = np.trace(matrix) / len(matrix)
    for share in (0.0, 1e-7, 1e-6, 1e-5, 1e-4):
        shifted = matrix.astype(np.float32)
        shifted[np.diag_indices(len(matrix))] += np.float32(share * mean)
        lower, info = lapack.spotrf(shifted, lower=1)
        if info == 0:
            return lower, share
    raise RuntimeError("no factor in single precision")


def print_single(made) -> None:
    """Iterations with the frame's own factor in single precision, by kernel and so by condition."""
    drawer, now, _ = made[len(made) // 2]
    print("\n| kernel | condition | shift | iterations |\n|---|---|---|---|")
    wide = [("gaussian", epsilon) for epsilon in (0.1, 0.04, 0.03, 0.025)]
    for name, epsilon in [("cubic", 1.0), ("quintic", 1.0), *wide]:
        kernel = get_kernel(name)
        basis, right = hermite_system(now.centres, now.normals, kernel, epsilon, drawer.rest.fit.derivatives)[
            :2
        ]
        factor = fitting.factorise(basis)
        if factor is None:
            print(f"| {name} {epsilon} | no factor | | |")
            continue
        goal, _, condition = factor.solve(right)
        lower, share = single_factor(basis, factor)
        count = iterations(
            basis.matrix(), factor.directions, right, np.zeros(len(right)), by_factor(lower), goal
        )
        print(
            f"| {name} {epsilon} | {condition:.0e} | {share:.0e} | {count}{' (not reached)' * (count == MOST)} |"
        )


def main() -> None:
    """Print iterations by how old the inverse is, and what one takes."""
    made, _ = record(Scene.load(Path(sys.argv[1])))
    systems = []
    for drawer, now, _ in made:
        fit = drawer.rest.fit
        systems.append(hermite_system(now.centres, now.normals, fit.kernel, fit.epsilon, fit.derivatives)[:2])
    with threadpool_limits(1):
        print("| frames since the factor | inverse, double | inverse, single | factor |\n|---|---|---|---|")
        for age in (1, 2, 4):
            counts: dict = {np.float64: [], np.float32: [], 0: []}
            for old in range(0, len(systems) - age, 5):
                factor = fitting.factorise(systems[old][0])
                start = factor.solve(systems[old][1])[0]
                lower = np.linalg.inv(np.tril(factor.lower))
                basis, right = systems[old + age]
                now = fitting.factorise(basis)
                goal, matrix = now.solve(right)[0], basis.matrix()
                for kind, found in counts.items():
                    near = by_inverse((lower.T @ lower).astype(kind)) if kind else by_factor(factor.lower)
                    found.append(iterations(matrix, now.directions, right, start, near, goal))
            print(f"| {age} | " + " | ".join(f"{np.median(found):.0f}" for found in counts.values()) + " |")
        print_single(made)
        basis, right = systems[0]
        matrix, factor, vector = basis.matrix(), fitting.factorise(basis), np.ones(basis.size)
        inverse = np.linalg.inv(factor.lower)
        single, narrow = inverse.astype(np.float32), factor.lower.astype(np.float32)
        positive = np.tril(factor.lower) @ np.tril(factor.lower).T
        half = positive.astype(np.float32)
        parts = {
            "factor of its matrix": lambda: lapack.dpotrf(positive, lower=1),
            "the same in single precision": lambda: lapack.spotrf(half, lower=1),
            "solution with a factor": lambda: lapack.dpotrs(factor.lower, vector, lower=1),
            "the same in single": lambda: lapack.spotrs(narrow, vector.astype(np.float32), lower=1),
            "whole fit": lambda: fitting.solve(basis, right),
            "its matrix": basis.matrix,
            "product with the matrix": lambda: blas.dsymv(1.0, matrix, vector, lower=1),
            "product with an inverse": lambda: inverse @ vector,
            "with one in single": lambda: single @ vector.astype(np.float32),
            "inverse from a factor": lambda: lapack.dpotri(factor.lower, lower=1),
        }
        condition = factor.solve(right)[2]
        print(f"{basis.size} unknowns, condition {condition:.0e}; ms: " + ", ".join(
            f"{name} {least(act):.2f}" for name, act in parts.items()
        ))  # fmt: skip
        holder = made[0][0].rest.holder[: len(made[0][1].centres)]
        held = np.bincount(holder[holder >= 0]).max(initial=0) / len(holder)
        print(f"centres held by one bone: {held:.0%}, which would save {held**3:.1%} of a factorisation")


if __name__ == "__main__":
    main()
