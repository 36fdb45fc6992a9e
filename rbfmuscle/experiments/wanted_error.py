"""The fewest centres that meet a surface to a wanted error, with the kernel and the setting.

The error falls with the number of centres by a power, but for some per cent of chance: the power
law brackets the number and a bisection narrows it to 4 %. Other kernels take part where they may
need fewer centres.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache, partial
from typing import NamedTuple

import numpy as np

from rbfmuscle.experiments import kernel_study
from rbfmuscle.experiments.kernel_rows import KernelRow
from rbfmuscle.experiments.sweep_run import OnProgress
from rbfmuscle.geometry.arrays import MeshLike
from rbfmuscle.implicit.kernels.table import Kernel
from rbfmuscle.implicit.placement.sampling import GREEDY_LARGEST, sample_surface
from rbfmuscle.validation import UsageError

# Kernels that take part by default, the quickest first.
CANDIDATES = ("cubic", "quintic", "skala_cervenka", "matern_52")
FEWEST, MOST = 20, GREEDY_LARGEST
# Numbers of centres closer than this share are alike; power of the number by which the error falls.
STEP, POWER = 0.04, 1.4


class TriedFit(NamedTuple):
    """A kernel with a number of centres, and its error [length], infinite where it is unfit."""

    kernel: str
    centres: int
    error: float


@dataclass
class CentreSearchResult:
    """What `reach_error` found.

    ``row`` is as in `KernelStudy.rows`: the one that reached the ``wanted`` error, else that of the
    smallest error; ``error`` is its [length]; ``tried`` is all that was measured, in order.
    """

    reached: bool
    row: KernelRow
    error: float
    wanted: float
    tried: list[TriedFit] = field(default_factory=list)

    def describe(self, name: str, units: str = "") -> str:
        """One line on the surface of this name: what reaches the wanted error, or what the best
        reached.
        """
        unit, said = f" {units}" if units else "", self.row.title
        if self.row.unfit:
            return f"{name}: no field is fit; take more centres or another kernel"
        if self.reached:
            return f"{name}: {said} reaches {self.error:.3g}{unit} RMS, wanted {self.wanted:g}"
        return (
            f"{name}: {self.wanted:g}{unit} RMS is not reached; the best, {said}, reaches "
            f"{self.error:.3g}; "
            "take other kernels, or a larger error"
        )


def reach_error(
    mesh: MeshLike,
    error: float,
    *,
    kernels: Sequence[str] | None = None,
    progress: OnProgress | None = None,
) -> CentreSearchResult:
    """Find the fewest centres, 20 to 1000, the kernel and its setting that meet a surface to a
    wanted error.

    Parameters
    ----------
    mesh : trimesh.Trimesh or pair of (n, 3) vertices and (m, 3) faces
        Closed, outward.
    error : float
        Root mean square distance both ways between mesh and extracted surface [length].
    kernels : list of str, optional
        By default cubic, quintic, skala_cervenka and matern_52.
    progress : callable, optional
        Called as ``progress(done, total)``; the total grows with what is found.

    Raises
    ------
    UsageError, MeshError
        On an error that is not positive, or an unknown kernel; on an unusable mesh.

    Examples
    --------
    >>> import trimesh
    >>> ball = trimesh.creation.icosphere(3, 10.0)
    >>> found = reach_error(ball, 0.1, kernels=["cubic"])
    >>> found.reached, found.row.kernel, found.error <= 0.1
    (True, 'cubic', True)
    """
    if not 0.0 < error < np.inf:
        raise UsageError(f"error must be a positive length, got {error}")
    vertices, faces, named = kernel_study.check_request(mesh, kernels or CANDIDATES)
    search = _Search(kernel_study.ReferenceSurface(vertices, faces), float(error), progress)
    for kernel in named:
        search.try_kernel(kernel)
    return search.result()


class _Search:
    """Rows by kernel and number of centres, and the best so far."""

    def __init__(
        self,
        judge: kernel_study.ReferenceSurface,
        error: float,
        progress: OnProgress | None,
    ) -> None:
        self.judge = judge
        self.error = error
        self.progress = progress
        self.sample = cache(
            partial(sample_surface, judge.vertices, judge.faces, placement="greedy")
        )
        self.found: dict[tuple[str, int], kernel_study.Measured] = {}
        self.best: tuple[str, int] | None = None

    def measure(self, kernel: Kernel, count: int) -> float:
        """Error of a kernel with so many centres [length], infinite where it broke."""
        key = kernel.name, count
        if key not in self.found:
            self.found[key] = kernel_study.measure_row(self.judge, self.sample(count), kernel)
            if self.progress is not None:
                self.progress(len(self.found), max(len(self.found) + 1, 8))
        error = self.found[key].row.error
        if error <= self.error and (self.best is None or count < self.best[1]):
            self.best = key
        return error

    def try_kernel(self, kernel: Kernel) -> None:
        """The fewest centres of a kernel, where it may need fewer than the best so far."""
        low, high = FEWEST - 1, MOST + 1
        if self.best is not None:  # only what serves with fewer than the best is worth more fits
            high = int((1.0 - STEP) * self.best[1])
            if high < FEWEST or self.measure(kernel, high) > self.error:
                return
        count = min(120, high - 1)
        while high > low + max(1, STEP * low):
            missed = self.measure(kernel, count)
            low, high = (low, count) if missed <= self.error else (count, high)
            if low >= FEWEST and high <= MOST:
                count = round(math.sqrt(low * high))
            else:  # by the power law, while one end is open
                factor = (missed / self.error) ** (1.0 / POWER) if math.isfinite(missed) else 2.0
                beyond = 0.9 if missed <= self.error else 1.1
                count = round(count * float(np.clip(factor, 0.4, 2.5)) * beyond)
            count = int(np.clip(count, low + 1, high - 1)) if high > low + 1 else high

    def result(self) -> CentreSearchResult:
        """The row of fewest centres that reaches the error, or that of the smallest error."""
        least = min(self.found, key=lambda key: self.found[key].row.error)
        found = self.found[self.best or least]
        if not found.row.unfit:
            kernel_study.time_row(found, self.judge.points)
        tried = [TriedFit(*key, one.row.error) for key, one in self.found.items()]
        return CentreSearchResult(
            self.best is not None, found.row, found.row.error, self.error, tried
        )
