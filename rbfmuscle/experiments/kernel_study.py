"""Which kernel, which shape parameter, how many centres: one surface fitted by all of them, and a
table.

Accuracy, conditioning and time are measured together, since each can be bought with the others.
"""

import threading
import time
import warnings
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np

from rbfmuscle.experiments.front import pareto_front
from rbfmuscle.experiments.kernel_rows import KernelRow, recommend
from rbfmuscle.experiments.sweep_run import OnProgress
from rbfmuscle.geometry.arrays import Floats, Integers, MeshLike
from rbfmuscle.geometry.mesh_distance import MeshDistance
from rbfmuscle.geometry.rest_frame import principal_axes
from rbfmuscle.geometry.surfaces import face_normals, mesh_hash, mesh_volume, vertex_areas
from rbfmuscle.geometry.threads import blas_limited, each, threads_limited
from rbfmuscle.implicit.extraction.surface import extract_surface, find_sheets
from rbfmuscle.implicit.field import FieldFit, RBFField, overlapping_parts
from rbfmuscle.implicit.kernels.table import Kernel, get_kernel
from rbfmuscle.implicit.placement.sampling import SurfaceSample, sample_surface, spread_points
from rbfmuscle.implicit.selection import BOUND, choose_epsilon, spacing
from rbfmuscle.validation import NumericalWarning, UsageError, check_mesh

# Points of the mesh at which errors are measured, and others that choose epsilon.
JUDGES, HELD_OUT = 20_000, 2000
# Cells along the longest side (so many a mean radius, between two bounds). With too few thin rims
# fall between the nodes: iliacus seems to miss 1.7 mm with 64, sartorius 7.3 with 128, where they
# miss 0.9 and 1.2.
CELLS, RANGE = 5.0, (128, 320)
# Points of one timed evaluation, and the processor time after which enough of them, or of fits, are
# made [s].
TIMED, MEASURED = 20_000, 0.05
# A level zero that encloses so much more or less than the mesh has lost or gained a part of it.
VOLUME_BOUND = 0.1


class ReferenceSurface:
    """The surface (vertices (n, 3), faces (m, 3)) that is to be met, and how far another one is
    from it.

    ``resolution`` counts cells along the longest side of extracted surfaces; as many as one so
    slender needs where 0.
    """

    def __init__(self, vertices: Floats, faces: Integers, resolution: int = 0) -> None:
        self.vertices = vertices
        self.faces = faces
        self.volume = mesh_volume(vertices, faces)
        radius = 2.0 * self.volume / vertex_areas(vertices, faces).sum()
        self.axes = principal_axes(vertices)
        if resolution and resolution < 4:
            raise UsageError(f"resolution must be at least 4 cells, got {resolution}")
        self.resolution = resolution or int(
            np.clip(CELLS * np.ptp(vertices @ self.axes[0]) / radius, *RANGE)
        )
        self.distance = MeshDistance(vertices, faces)
        self.points, which = spread_points(vertices, faces, JUDGES)
        normal = face_normals(vertices, faces)[which]
        self.normals = normal / np.linalg.norm(normal, axis=1)[:, None]
        self.held_out = spread_points(vertices, faces, HELD_OUT, seed=1)[0]

    def apart(self, vertices: Floats, faces: Integers) -> tuple[float, float]:
        """RMS and greatest distance of a surface, both ways [length]."""
        there = MeshDistance(vertices, faces, closed=False).unsigned(self.points)
        back = self.distance.unsigned(vertices)
        rms = float(np.sqrt(0.5 * ((there**2).mean() + (back**2).mean())))
        return rms, float(max(there.max(), back.max()))


def check_request(mesh: MeshLike, kernels: Iterable[str]) -> tuple[Floats, Integers, list[Kernel]]:
    """Vertices and faces of a mesh, and kernels by name; MeshError and UsageError for what cannot
    be studied.
    """
    named = [get_kernel(name) for name in kernels]
    return *check_mesh(*(mesh if isinstance(mesh, tuple) else (mesh.vertices, mesh.faces))), named


class Measured(NamedTuple):
    """What one row found: a row of `KernelStudy.rows` without times, the fitted centres, how, and
    the surface.
    """

    row: KernelRow
    sample: SurfaceSample
    fit: FieldFit
    surface: tuple[Floats, Integers] | None


def measure_row(judge: ReferenceSurface, sample: SurfaceSample, kernel: Kernel) -> Measured:
    """One row of the table, its times left open, and its surface."""
    fit = FieldFit(kernel, 1.0, BOUND if kernel.has_epsilon else np.inf)
    note = "" if kernel.hermite else "values on and off the surface, the kernel is not C2"
    row = KernelRow(kernel=kernel.name, centres=len(sample.points), note=note)
    surface = None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NumericalWarning)
        try:
            fit = _chosen_fit(row, judge, sample, fit)
            surface = _measure(row, judge, sample, fit.fit(sample.points, sample.normals))
        except (ValueError, np.linalg.LinAlgError) as error:
            row.unfit = " ".join(str(error).split())
    return Measured(row, sample, fit, surface)


def _chosen_fit(
    row: KernelRow, judge: ReferenceSurface, sample: SurfaceSample, fit: FieldFit
) -> FieldFit:
    """The fit with the epsilon of the least error, or with a bounded condition where it needs one;
    both are written into the row.
    """
    points, normals = sample.points, sample.normals
    if fit.kernel.has_epsilon:
        choice = choose_epsilon(
            points, normals, fit, held_out=judge.held_out, distance=judge.distance.unsigned
        )
        row.trials = [(shape, error) for shape, error in choice.trials.tolist()]
        row.epsilon = choice.epsilon
        row.shape = choice.epsilon * float(spacing(points).mean())
        if choice.broken:
            raise ValueError(choice.broken)
        return replace(fit, epsilon=choice.epsilon)
    if fit.fit(points, normals).condition > BOUND:
        row.bound = BOUND
        return replace(fit, condition=BOUND)
    return fit


def _measure(
    row: KernelRow, judge: ReferenceSurface, sample: SurfaceSample, field: RBFField
) -> tuple[Floats, Integers]:
    """Write what is measured of a field into the row; its surface."""
    row.condition = float(field.condition)
    gradient = field.gradient(judge.points[::5])
    cosine = np.einsum("ij,ij->i", gradient, judge.normals[::5])
    cosine /= np.maximum(np.linalg.norm(gradient, axis=1), np.finfo(float).tiny)
    row.normal_error = float(
        np.degrees(np.sqrt((np.arccos(np.clip(cosine, -1.0, 1.0)) ** 2).mean()))
    )
    sheets = find_sheets(field, sample.points, judge.distance.unsigned)
    if sheets.is_open:
        raise ValueError(
            "the level set is open: it leaves the box of the muscle; take more centres"
        )
    if sheets.stray:
        raise ValueError(f"{sheets.stray} sheets beside those of the mesh; take more centres")
    found = extract_surface(
        field, points=sample.points, resolution=judge.resolution, axes=judge.axes
    )
    row.volume_error = found.volume / judge.volume - 1.0
    if abs(row.volume_error) > VOLUME_BOUND:
        row.unfit = f"{100 * row.volume_error:+.3g} % of volume, beyond {100 * VOLUME_BOUND:g}"
    row.rms, row.hausdorff = judge.apart(found.vertices, found.faces)
    return found.vertices, found.faces


def time_row(found: Measured, points: Floats) -> None:
    """Write into a row what a fit, and values at 20,000 points (n, 3), cost [s of processor time,
    one thread].
    """
    row = found.row
    sample = found.sample
    parts = overlapping_parts(found.sample.points)
    with warnings.catch_warnings(), threads_limited(1):
        warnings.simplefilter("ignore", NumericalWarning)  # it stands in the row's condition
        field = found.fit.fit(sample.points, sample.normals, parts)
        row.fit_time = _spent(lambda: found.fit.fit(sample.points, sample.normals, parts))
        field(points[:TIMED])
        row.evaluation_time = _spent(lambda: field(points[:TIMED]))


def _spent(work: Callable[[], object]) -> float:
    """Processor time of some work, done as often as a coarse clock needs [s]."""
    start, runs = time.process_time(), 0
    while runs == 0 or time.process_time() - start < MEASURED:
        work()
        runs += 1
    return (time.process_time() - start) / runs


@dataclass
class KernelStudy:
    """What `rbfmuscle.study_kernels` found.

    ``rows`` are `KernelRow` for each kernel and number of centres, the smallest error first, unfit
    ones last. ``surfaces`` (vertices, faces) are those of the rows, None where there is none.
    ``recommended`` is the quickest row that errs at most 5 % more than the best, None where every
    one is unfit. ``sha256`` is that of the mesh.
    """

    rows: list[KernelRow] = field(repr=False)
    surfaces: list[tuple[Floats, Integers] | None] = field(default_factory=list, repr=False)
    units: str = ""
    recommended: KernelRow | None = None
    sha256: str = ""


def measure_fits(
    judge: ReferenceSurface,
    kernels: Sequence[Kernel],
    counts: Sequence[int],
    progress: OnProgress | None,
) -> KernelStudy:
    """Fit a surface with each kernel and number of centres, and measure each fit."""
    calls = []
    for count in counts:
        sample = sample_surface(judge.vertices, judge.faces, int(count), placement="greedy")
        calls += [(sample, kernel) for kernel in kernels]
    found = _measure_all(judge, calls, progress)
    _refuse_coarse([one.row for one in found])
    for one in found:  # when nothing else runs
        if not one.row.unfit:
            time_row(one, judge.points)
    found.sort(
        key=lambda one: (bool(one.row.unfit), np.inf if one.row.rms is None else one.row.rms)
    )
    rows = [one.row for one in found]
    good = [row for row in rows if not row.unfit]
    front = pareto_front([row.error for row in good], [row.cost for row in good])
    for row in rows:  # no other row beats those of the front both in error and in time
        row.front = any(row is good[index] for index in front)
    surfaces = [one.surface for one in found]
    sha256 = mesh_hash(judge.vertices, judge.faces)
    return KernelStudy(rows, surfaces, recommended=recommend(rows), sha256=sha256)


def _measure_all(
    judge: ReferenceSurface,
    calls: list[tuple[SurfaceSample, Kernel]],
    progress: OnProgress | None,
) -> list[Measured]:
    """What the rows of calls found, in their order, measured side by side on threads."""
    lock, done = threading.Lock(), []

    def measure(call: tuple[SurfaceSample, Kernel]) -> Measured:
        found = measure_row(judge, *call)
        with lock:
            done.append(found)
            if progress is not None:
                progress(len(done), len(calls))
        return found

    # Filters of warnings belong to all threads: what each row sets is undone here.
    with warnings.catch_warnings(), blas_limited(1):
        warnings.simplefilter("ignore", NumericalWarning)
        return each(measure, calls)


def _refuse_coarse(rows: list[KernelRow]) -> None:
    """Name rows unfit that err more than `linear`, the coarsest sensible kernel, with as many
    centres.
    """
    bounds = {row.centres: row.error for row in rows if row.kernel == "linear" and not row.unfit}
    for row in rows:
        bound = bounds.get(row.centres)
        if not row.unfit and bound is not None and row.error > bound:
            row.unfit = f"an error of {row.error:.3g}, beyond that of linear, {bound:.3g}"
