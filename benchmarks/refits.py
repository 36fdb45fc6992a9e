"""Whether a fit that knows the frame before can be quicker than a factorisation: conjugate gradients, preconditioned.

python benchmarks/refits.py .../hip/gluteus.toml

The system of each frame is solved by conjugate gradients from the weights of an earlier one, with that one's inverse in
double or single precision as the preconditioner, until the weights err by 1e-9 of a full Cholesky factor's. Times are
the least of several, on one thread; an iteration is a product with the matrix, one with the inverse and two
projections.
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


def iterations(matrix, directions, right, start, inverse, goal) -> int:
    """Iterations of preconditioned conjugate gradients until the weights are within 1e-9 of the goal."""

    def part(vector):
        return vector - directions @ (directions.T @ vector)

    def pre(vector):
        return part((inverse @ vector.astype(inverse.dtype)).astype(float))

    x = part(start)
    r = part(right - blas.dsymv(1.0, matrix, x, lower=1))
    z = pre(r)
    p, rz = z, r @ z
    for count in range(1, MOST + 1):
        q = part(blas.dsymv(1.0, matrix, p, lower=1))
        x, r = x + rz / (p @ q) * p, r - rz / (p @ q) * q
        if np.linalg.norm(x - goal) < 1e-9 * np.linalg.norm(goal):
            return count
        z = pre(r)
        p, rz = z + (r @ z) / rz * p, r @ z
    return MOST


def main() -> None:
    """Print iterations by how old the inverse is, and what one takes."""
    made, _ = record(Scene.load(Path(sys.argv[1])))
    systems = []
    for drawer, now, _ in made:
        fit = drawer.rest.fit
        systems.append(hermite_system(now.centres, now.normals, fit.kernel, fit.epsilon, fit.derivatives)[:2])
    with threadpool_limits(1):
        print("| frames since the factor | double | single |\n|---|---|---|")
        for age in (1, 2, 4):
            counts = {np.float64: [], np.float32: []}
            for old in range(0, len(systems) - age, 5):
                factor = fitting.factorise(systems[old][0])
                start = factor.solve(systems[old][1])[0]
                lower = np.linalg.inv(np.tril(factor.lower))
                basis, right = systems[old + age]
                now = fitting.factorise(basis)
                for kind, found in counts.items():
                    inverse = (lower.T @ lower).astype(kind)
                    found.append(
                        iterations(basis.matrix(), now.directions, right, start, inverse, now.solve(right)[0])
                    )
            print(f"| {age} | {np.median(counts[np.float64]):.0f} | {np.median(counts[np.float32]):.0f} |")
        basis, right = systems[0]
        matrix, factor, vector = basis.matrix(), fitting.factorise(basis), np.ones(basis.size)
        inverse = np.linalg.inv(factor.lower)
        single = inverse.astype(np.float32)
        parts = {
            "whole fit": lambda: fitting.solve(basis, right),
            "its matrix": basis.matrix,
            "product with the matrix": lambda: blas.dsymv(1.0, matrix, vector, lower=1),
            "product with an inverse": lambda: inverse @ vector,
            "the same in single precision": lambda: single @ vector.astype(np.float32),
            "inverse from a factor": lambda: lapack.dpotri(factor.lower, lower=1),
        }
        condition = factor.solve(right)[2]
        print(f"{basis.size} unknowns, condition {condition:.0e}; ms: " + ", ".join(
            f"{name} {least(act):.2f}" for name, act in parts.items()
        ))  # fmt: skip


if __name__ == "__main__":
    main()
