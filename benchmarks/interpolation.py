"""Fits and evaluation of the fields, as ratios: ``make bench``.

Both sides of a row work in one process, in turns, and the least of several rounds counts: on a
shared machine ratios hold, milliseconds do not.
"""

import argparse
import time
import warnings
from pathlib import Path

import numpy as np
from evidence import machine, write_evidence
from scipy.interpolate import RBFInterpolator

from rbfmuscle.implicit.field import RBFField
from rbfmuscle.implicit.kernels import KERNELS
from rbfmuscle.validation import NumericalWarning

SHARED = {
    "linear": 1.0,
    "cubic": 1.0,
    "quintic": 1.0,
    "thin_plate_spline": 1.0,
    "multiquadric": 4.0,
    "inverse_multiquadric": 4.0,
    "inverse_quadratic": 4.0,
    "gaussian": 6.0,
}
COUNTS = (500, 1000, 2000)
ROUNDS = 5


def least_times(*works):
    """Least time [s] of each piece of work, run in turns; the first turn warms up."""
    best = [np.inf] * len(works)
    for turn in range(ROUNDS + 1):
        for k, work in enumerate(works):
            start = time.perf_counter()
            work()
            if turn:
                best[k] = min(best[k], time.perf_counter() - start)
    return best


def compare(work, ours, theirs, *, apart=False):
    """Time ``ours`` against SciPy's ``theirs``, print the line and return it.

    ``apart`` times all rounds of one, then of the other: BLAS threads of a peer go on waiting on
    the cores for some 20 ms after their work, which would be counted to ours.
    """
    mine, yours = (least_times(ours) + least_times(theirs)) if apart else least_times(ours, theirs)
    print(
        f"{work:40}{1e3 * mine:9.2f} ms, SciPy {1e3 * yours:9.2f} ms, ratio {yours / mine:6.2f}",
        flush=True,
    )
    return {"work": work, "ours": mine, "theirs": yours, "ratio": yours / mine}


def scattered(count):
    """Points (count, 3) in a cube and a smooth function there."""
    points = np.random.default_rng(count).uniform(-1, 1, (count, 3))
    return points, np.sin(2 * points[:, 0]) + points[:, 1] * points[:, 2]


def both_fits(kernel, count):
    """Our fit and SciPy's, to be called."""
    points, values = scattered(count)
    given, degree = {"kernel": kernel, "epsilon": SHARED[kernel]}, KERNELS[kernel].degree
    return (
        lambda: RBFField.fit(points, values, **given),
        lambda: RBFInterpolator(points, values, **given, degree=degree),
    )


def fits():
    """Rows of fits, after a look at whether they agree."""
    where = np.random.default_rng(0).uniform(-0.9, 0.9, (500, 3))
    for count in COUNTS:
        for kernel in SHARED:
            ours, theirs = both_fits(kernel, count)
            apart = np.abs(ours()(where) - theirs()(where)).max()
            if apart > 1e-8:
                print(f"{kernel}, {count}: SciPy and we differ by {apart:.1e}")
            yield compare(f"fit: {kernel}, {count} values", ours, theirs)


def evaluations():
    """Rows of 64^3 points, 1000 centres."""
    where = np.random.default_rng(0).uniform(-1, 1, (64**3, 3))
    for kernel in ("cubic", "gaussian"):
        ours, theirs = (make() for make in both_fits(kernel, 1000))
        yield compare(
            f"64^3 points: {kernel}, 1000 centres",
            lambda f=ours: f(where),
            lambda f=theirs: f(where),
            apart=True,
        )


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--output", type=Path)
    chosen = parser.parse_args()
    print(machine())
    warnings.simplefilter("ignore", NumericalWarning)
    rows = [*fits(), *evaluations()]
    if chosen.output:
        cells = []
        for kind in ("fit", "64^3 points"):
            ratios = [row["ratio"] for row in rows if row["work"].startswith(kind)]
            cells.append([kind, len(ratios), min(ratios), float(np.median(ratios)), max(ratios)])
        heads = ["work", "cases", "SciPy's time over ours, least", "median", "greatest"]
        write_evidence(chosen.output, ["benchmarks/interpolation.py"], cells, heads)


if __name__ == "__main__":
    main()
