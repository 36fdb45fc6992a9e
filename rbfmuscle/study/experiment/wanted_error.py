"""The fewest centres that meet a surface to a wanted error, with the kernel and the setting.

The error falls with the number of centres, by a power, but for some per cent of chance: a bisection of the power law
brackets the number, and numbers a little below are tried until sixteen fail and the law promises no more. Kernels take
part while they may need fewer centres than the best so far. The row is confirmed at points that chose nothing.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from rbfmuscle.geometry.arrays import MeshLike
from rbfmuscle.geometry.surfaces import mesh_volume
from rbfmuscle.implicit.kernels.table import Kernel, get_kernel
from rbfmuscle.implicit.placement.density import GREEDY_LARGEST
from rbfmuscle.implicit.placement.refinement import FITTED
from rbfmuscle.implicit.placement.sampling import PLACEMENTS, SurfaceSample, sample_surface
from rbfmuscle.study.experiment.kernel_choice import mark_unfit
from rbfmuscle.study.experiment.kernel_judge import SurfaceJudge
from rbfmuscle.study.experiment.kernel_row import Request, measure_row, time_row
from rbfmuscle.study.experiment.kernel_study import KernelStudy
from rbfmuscle.validation import UsageError, check_mesh

# Kernels that take part by default, the quickest first.
CANDIDATES = ("cubic", "quintic", "skala_cervenka", "matern_52")
FEWEST = 20
# Numbers of centres closer than this share are alike to the law.
STEP = 0.04
# A field in two pieces may stand between numbers that serve, more so on long, thin muscles: below the last that serves
# numbers are tried in steps of this share, until so many fail and the law promises no more.
DOWN, FAILURES = 0.01, 16
# Power of the number of centres by which the error falls, before two numbers tell.
POWER = 1.4
# What a cell's chord may take of the wanted error, and the cells that follow.
CHORD, CELLS = 0.15, (64, 160)
# Seeds of the points that choose and of those that confirm.
CHOOSING, CONFIRMING = 0, 1


@dataclass
class WantedError:
    """What `reach_error` found.

    Attributes
    ----------
    reached : bool
        Whether the error is met at points that chose nothing.
    row : dict
        As in `KernelStudy.rows`: the one that reached it, else the one of the smallest error.
    error : float
        Of that row at those points [length].
    wanted : float
    greatest : bool
        Whether the greatest distance is meant, not the root mean square.
    tried : list of dict
        ``kernel, centres, error`` of all that was measured, in order.
    """

    reached: bool
    row: dict[str, Any]
    error: float
    wanted: float
    greatest: bool
    tried: list[dict[str, Any]] = field(default_factory=list)

    def toml(self) -> str:
        """The lines of a scene file's model table that give this row."""
        return KernelStudy([]).toml(self.row)


def reach_error(
    mesh: MeshLike,
    error: float,
    *,
    greatest: bool = False,
    kernels: Sequence[str] | None = None,
    placement: str = FITTED,
    most: int = GREEDY_LARGEST,
    progress: Callable[[int, int], None] | None = None,
) -> WantedError:
    """Find the fewest centres, the kernel and its setting that meet a surface to a wanted error.

    Parameters
    ----------
    mesh : trimesh.Trimesh or pair of (n, 3) vertices and (m, 3) faces
        Closed, outward.
    error : float
        Root mean square distance both ways between mesh and extracted surface [length].
    greatest : bool
        The greatest distance is wanted instead.
    kernels : list of str, optional
        By default cubic, quintic, skala_cervenka and matern_52.
    placement : {"even", "adaptive", "greedy", "fitted"}
        As in `study_kernels`.
    most : int
        Centres at most.
    progress : callable, optional
        Called as ``progress(done, total)``; the total grows with what is found.

    Returns
    -------
    WantedError

    Raises
    ------
    UsageError
        On an error that is not positive, an unknown kernel or placement, or ``most`` out of range.
    MeshError
        On an unusable mesh.

    Examples
    --------
    >>> import trimesh
    >>> ball = trimesh.creation.icosphere(3, 10.0)
    >>> found = reach_error(ball, 0.1, kernels=["cubic"], placement="even")
    >>> found.reached, found.row["kernel"], found.error <= 0.1
    (True, 'cubic', True)
    """
    if not 0.0 < error < np.inf:
        raise UsageError(f"error must be a positive length, got {error}")
    names = [get_kernel(name) for name in (kernels or CANDIDATES)]
    if placement not in (*PLACEMENTS, FITTED):
        raise UsageError(f"placement must be one of {', '.join((*PLACEMENTS, FITTED))}, got {placement!r}")
    limit = GREEDY_LARGEST if placement in (FITTED, "greedy") else 20_000
    if not FEWEST <= most <= limit:
        raise UsageError(f"most must be from {FEWEST} to {limit} with placement {placement!r}, got {most}")
    arrays = mesh if isinstance(mesh, tuple) else (mesh.vertices, mesh.faces)
    search = Search(arrays, float(error), greatest, placement, int(most), progress)
    for kernel in names:
        search.try_kernel(kernel)
    return search.confirmed()


class Search:
    """Rows by kernel and number of centres, and the best so far.

    Parameters
    ----------
    mesh : (vertices, faces)
    error, greatest, placement, most, progress
        As in `reach_error`.
    """

    def __init__(
        self,
        mesh: tuple[Any, Any],
        error: float,
        greatest: bool,
        placement: str,
        most: int,
        progress: Callable[[int, int], None] | None = None,
    ) -> None:
        vertices, faces = check_mesh(*mesh)
        self.surface, self.error, self.greatest, self.most = (vertices, faces), error, greatest, most
        self.ask, self.progress = Request("all", "held_out", placement, np.inf), progress
        self.base = "greedy" if placement == FITTED else placement
        self.cells = _cells(vertices, faces, error)
        self.judge = SurfaceJudge(vertices, faces, self.cells, CHOOSING)
        self.samples: dict[int, Any] = {}
        self.rows: dict[tuple[str, int], dict[str, Any]] = {}
        self.placed: dict[tuple[str, int], SurfaceSample] = {}
        self.tried: list[dict[str, Any]] = []
        self.best: tuple[Kernel, int] | None = None

    def measure(self, kernel: Kernel, count: int) -> float:
        """Error of a kernel with so many centres [length], infinite where it broke."""
        key = kernel.name, count
        if key not in self.rows:
            if count not in self.samples:
                self.samples[count] = sample_surface(*self.surface, count, placement=self.base)
            found = measure_row(self.judge, self.samples[count], kernel, self.ask)
            row = found.row
            mark_unfit([row], sheets=self.judge.sheets)
            self.rows[key], self.placed[key] = row, found.sample
            self.tried.append({"kernel": kernel.name, "centres": count, "error": self._error(row)})
            if self.progress is not None:
                self.progress(len(self.tried), max(len(self.tried) + 1, 8))
        found = self._error(self.rows[key])
        if found <= self.error and (self.best is None or count < self.best[1]):
            self.best = kernel, count
        return found

    def _error(self, row):
        return math.inf if row["unfit"] else row["hausdorff" if self.greatest else "rms"]

    def try_kernel(self, kernel: Kernel) -> None:
        """Bracket the number by the power law, then go down from the first that serves."""
        high = self.most
        if self.best is not None:  # only what needs fewer than the best is worth more fits
            high = max(int((1.0 - STEP) * self.best[1]), FEWEST)
            if high >= self.best[1] or self.measure(kernel, high) > self.error:
                return
        low, high = self._bracket(kernel, high)
        if high is None:
            return
        while high > low + max(1, STEP * low):
            middle = round(math.sqrt(low * high))
            low, high = (low, middle) if self.measure(kernel, middle) <= self.error else (middle, high)
        self._go_down(kernel, high)

    def _go_down(self, kernel: Kernel, high: int) -> None:
        """Smaller numbers from one that serves on, past single ones that fail, as long as the power law promises."""
        failed = 0
        while high > FEWEST:
            promised = high * (self._error(self.rows[kernel.name, high]) / self.error) ** (1.0 / POWER)
            lower = max(min(int((1.0 - DOWN) ** (failed + 1) * high), high - failed - 1), FEWEST)
            if failed >= FAILURES and lower < promised:
                return
            if self.measure(kernel, lower) <= self.error:
                high, failed = lower, 0
            elif lower == FEWEST:
                return
            else:
                failed += 1

    def _bracket(self, kernel, most):
        """Numbers of which the lower misses the error and the higher meets it (None where none does)."""
        low, high, count = FEWEST - 1, None, min(120, most)
        while True:
            missed = self.measure(kernel, count)
            if missed <= self.error:
                high = count
                if count == FEWEST:
                    return low, high
            else:
                low = count
                if count == most:
                    return low, None
            if high is not None and low >= FEWEST and high <= 1.5 * low:
                return low, high
            factor = (missed / self.error) ** (1.0 / POWER) if math.isfinite(missed) else 2.0
            factor *= 0.9 if missed <= self.error else 1.1
            count = int(np.clip(round(count * np.clip(factor, 0.4, 2.5)), FEWEST, most))
            if high is not None and low >= FEWEST and not low < count < high:
                return low, high

    def confirmed(self) -> WantedError:
        """The best row where it holds at points that chose nothing; with more centres where it does not."""
        other = SurfaceJudge(*self.surface, self.cells, CONFIRMING)
        while self.best is not None:
            kernel, count = self.best
            found = measure_row(self.judge, self.samples[count], kernel, self.ask, confirm=other)
            row = found.row
            mark_unfit([row], sheets=self.judge.sheets)
            if self._error(row) <= self.error:
                time_row(row, found.sample, self.ask.derivatives, self.judge.points)
                return WantedError(True, row, self._error(row), self.error, self.greatest, self.tried)
            self.best, more = None, math.ceil(count * (1.0 + STEP))
            while more <= self.most and self.measure(kernel, more) > self.error:
                more = math.ceil(more * (1.0 + STEP))
        key = min(self.rows, key=lambda key: self._error(self.rows[key]))
        row = self.rows[key]
        if not row["unfit"]:
            time_row(row, self.placed[key], self.ask.derivatives, self.judge.points)
        return WantedError(False, row, self._error(row), self.error, self.greatest, self.tried)


def _cells(vertices, faces, error):
    """Cells along the longest side whose chords, c^2 / 8R with R the mean thickness, take little of the error."""
    corners = vertices[faces]
    area = (
        0.5
        * np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1).sum()
    )
    radius = 2.0 * mesh_volume(vertices, faces) / area
    wanted = np.ptp(vertices, axis=0).max() / math.sqrt(8.0 * CHORD * error * radius)
    return int(np.clip(wanted, *CELLS))
