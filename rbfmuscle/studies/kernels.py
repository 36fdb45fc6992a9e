"""Which kernel, which shape parameter, how many centres: a surface fitted by all of them; tables
and a page.

Accuracy, conditioning and time are measured together, since each can be bought with the others.
"""

from __future__ import annotations

import datetime
import math
import threading
import time
import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, partial
from itertools import cycle
from pathlib import Path
from typing import ClassVar, NamedTuple

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from rbfmuscle.display.page import (
    BAD,
    GOOD,
    PLAIN,
    Cell,
    CheckRow,
    ReportPage,
    Section,
    Table,
    number_cell,
)
from rbfmuscle.display.plots import Point, Track, front_plot, line_plot
from rbfmuscle.folders import OutputFolder
from rbfmuscle.geometry.arrays import Floats, Integers, MeshLike, unit
from rbfmuscle.geometry.frames import principal_axes
from rbfmuscle.geometry.mesh_distance import MeshDistance
from rbfmuscle.geometry.surfaces import (
    even_points,
    face_normals,
    mesh_hash,
    mesh_volume,
    vertex_areas,
)
from rbfmuscle.geometry.threads import blas_limited, cores_limited, each, threads_limited
from rbfmuscle.implicit.extraction import extract_surface, find_sheets
from rbfmuscle.implicit.field import FieldFit, RBFField, overlapping_parts
from rbfmuscle.implicit.kernels import KERNELS, Kernel, get_kernel
from rbfmuscle.implicit.placement import GREEDY_LARGEST, SurfaceSample, sample_surface
from rbfmuscle.implicit.selection import BOUND, SCAN, SPAN, choose_epsilon, spacing
from rbfmuscle.metrics.summary import shown_number
from rbfmuscle.progress import stage
from rbfmuscle.run.appearance import MUSCLE_COLOURS
from rbfmuscle.run.data import as_table, csv_rows
from rbfmuscle.run.writer import json_text, versions, write_csv
from rbfmuscle.scene.meshes.read import read_mesh
from rbfmuscle.scene.phantom import PHANTOM, open_scene
from rbfmuscle.scene.scene import Scene
from rbfmuscle.studies.result import OnProgress, Study, part_progress, study_folder
from rbfmuscle.studies.sweep import pareto_front
from rbfmuscle.validation import NumericalWarning, UsageError, check_mesh


def study_kernels(
    scene: Scene | MeshLike | str | Path,
    directory: str | Path | None = None,
    *,
    muscles: Sequence[str] | None = None,
    kernels: Sequence[str] | None = None,
    centres: Sequence[int] = (150, 300),
    resolution: int = 0,
    units: str | None = None,
    jobs: int | None = None,
    progress: OnProgress | None = None,
) -> KernelStudy:
    """Fit a surface, or the muscles of a scene, with many kernels and numbers of centres, and
    measure each fit.

    Parameters
    ----------
    scene : Scene, path, "phantom", trimesh.Trimesh or pair of (n, 3) vertices and (m, 3) faces
        A scene or a closed, outward mesh, or the file of either.
    directory : path, optional
        Takes ``kernels.csv``, ``kernels.json`` and the page ``kernels.html``.
    muscles : list of str, optional
        Of a scene, all by default.
    kernels : list of str, optional
        All by default.
    centres : sequence of int
    resolution : int
        Cells along the longest side of the extracted surfaces; as many as a muscle so slender needs
        by default.
    units : str, optional
        Name of a mesh's unit, for the page.
    jobs : int, optional
        Cores to use, all by default.
    progress : callable, optional
        Called as ``progress(done, total)`` after each fit.

    Returns
    -------
    KernelStudy
        ``rows`` and ``recommended``, with ``table()``, ``save(directory)`` and ``show()``.

    Raises
    ------
    UsageError, MeshError
        On an unknown kernel, a number of centres below 8, or a folder that holds something else; on
        an unusable mesh.

    Examples
    --------
    >>> import trimesh
    >>> ball = trimesh.creation.icosphere(3, 10.0)
    >>> study = study_kernels(ball, kernels=["cubic"], centres=[40], resolution=16)
    >>> study.rows[0].kernel, len(study.table())
    ('cubic', 1)
    """
    if directory is not None:
        kernels_folder(directory)  # what is in the way is reported now, not after the study
    if min(centres, default=0) < 8:
        raise UsageError(f"centres must be numbers of at least 8, got {list(centres)}")
    meshes, units = open_surfaces(scene, muscles, units)
    checked = {name: check_request(mesh, kernels or KERNELS) for name, mesh in meshes.items()}
    study = KernelStudy(
        units=units,
        version=versions()["rbfmuscle"],
        date=datetime.date.today().isoformat(),
        meshes={name: mesh_hash(points, faces) for name, (points, faces, _) in checked.items()},
    )
    with cores_limited(jobs), study_folder(directory) as folder:
        for k, (name, (vertices, faces, chosen)) in enumerate(checked.items()):
            fits = len(chosen) * len(centres)
            count = part_progress(progress, k * fits, len(meshes) * fits)
            judge = ReferenceSurface(vertices, faces, resolution)
            with stage(name):
                found = measure_fits(judge, chosen, centres, count)
            for one in found:
                one.row.surface = name
            study.rows += [one.row for one in found]
            study.surfaces += [one.surface for one in found]
        with kernels_folder(folder).staged() as staged:
            write_csv(staged / "kernels.csv", csv_rows(study.table()))
            text = json_text(study.model_dump())
            (staged / "kernels.json").write_text(text, encoding="utf-8")
            write_page(staged, study)
        return study.kept_in(folder, own=directory is None)


def open_surfaces(
    scene: Scene | MeshLike | str | Path, muscles: Sequence[str] | None, units: str | None
) -> tuple[dict[str, MeshLike], str]:
    """Meshes by name, and their unit: one mesh or its file, or of a scene the muscles of some
    names, or all.
    """
    if not isinstance(scene, (Scene, str, Path)):
        named, source = {"mesh": scene}, "what was given"
    elif not isinstance(scene, Scene) and scene != PHANTOM and Path(scene).suffix != ".toml":
        named, source = {Path(scene).stem: read_mesh(scene).mesh}, str(scene)
    else:
        opened = open_scene(scene)
        if units is not None:
            raise UsageError(f"units names the unit of a mesh, {opened.name} says its own")
        chosen = opened.muscles if muscles is None else [opened.muscle(m) for m in muscles]
        return {muscle.name: muscle.mesh for muscle in chosen}, opened.units
    if muscles is not None:
        raise UsageError(f"muscles names muscles of a scene, {source} is a mesh")
    return named, units or ""


# Errors this much apart are alike: points of another seed move them as far.
ALIKE = 1.05
# Rows beyond this condition are taken only where none that is as accurate is below it.
SOUND = 1e10
ENDS = "epsilon lies at an end of its search"


class KernelRow(BaseModel):
    """A kernel with a number of centres: what its field and that field's surface miss.

    ``shape`` is epsilon times the spacing, ``bound`` that of the condition, 0 for none. Errors are
    in the mesh's unit, of normals in degrees, of the volume relative; ``fit_time`` and
    ``evaluation_time`` (of 20,000 values) in seconds of processor time. ``trials`` are pairs of a
    shape and its error, ``unfit`` says why the row cannot be used; ``front`` rows are beaten by no
    other both in error and in time. What was not measured is None.
    """

    surface: str = ""
    kernel: str
    centres: int
    epsilon: float = 0.0
    shape: float | None = None
    condition: float | None = None
    bound: float = 0.0
    rms: float | None = None
    hausdorff: float | None = None
    normal_error: float | None = None
    volume_error: float | None = None
    fit_time: float | None = None
    evaluation_time: float | None = None
    trials: list[tuple[float, float]] = []
    unfit: str = ""
    note: str = ""
    front: bool = False

    @property
    def error(self) -> float:
        """The RMS error, infinite where there is none or the row is unfit."""
        return math.inf if self.unfit or self.rms is None else self.rms

    @property
    def cost(self) -> float:
        """What a frame pays for the field: a fit and the values at 20,000 points [s of processor
        time]; NaN where they were not timed.
        """
        return math.nan if self.fit_time is None else self.fit_time + (self.evaluation_time or 0.0)

    @property
    def title(self) -> str:
        """The row in words."""
        return f"{self.kernel}, {self.centres} centres"

    def toml(self) -> str:
        """The lines of a scene file's model table that give the row."""
        lines = [
            "[muscle.model]",
            'name = "rbf"',
            f'kernel = "{self.kernel}"',
            f"centres = {self.centres}",
        ]
        if self.epsilon:
            lines.append(f"epsilon = {self.epsilon:.6g}")
        if self.bound:
            lines.append(f"condition = {self.bound:g}")
        return "\n".join(lines)


def at_end(shape: float) -> bool:
    """Whether epsilon times the spacing lies at an end of its search, within a scan's step."""
    low, high = SPAN
    step = (high / low) ** (1.0 / (SCAN - 1))
    return shape <= low * step or shape >= high / step


def describe(rows: list[KernelRow]) -> str:
    """What to use of the rows of a study, and why."""
    best = recommend(rows)
    if best is None:
        return "Every field is unfit; take more centres."
    good = [row for row in rows if not row.unfit and row.centres == best.centres]
    least = min(row.error for row in good)
    tied = [row for row in good if row.error <= ALIKE * least]
    use = f"Use {best.kernel} with {best.centres} centres"
    counts = {row.centres for row in rows}
    nearest = min((row for row in rows if not row.unfit), key=lambda row: row.error)
    most = len(counts) > 1 and nearest.centres == max(counts)
    more = " More centres may lower the error further." if most else ""
    if len(tied) == 1:
        less = 100 * (
            1 - best.error / min((row.error for row in good if row is not best), default=math.inf)
        )
        behind = (
            f": its error is {less:.0f} % less than that of the next kernel"
            if len(good) > 1
            else ""
        )
        return f"{use}{behind}.{more}"
    names = ", ".join(row.kernel for row in tied)
    near = f"the errors of {names} are within {100 * (ALIKE - 1):.0f} % of the least"
    shape = "" if best.epsilon else " and needs no shape parameter"
    return f"{use}: {near}, and of these {best.kernel} is among the quickest{shape}.{more}"


def recommend(rows: Sequence[KernelRow]) -> KernelRow | None:
    """The quickest of the rows that err at most 5 % more than the best, None where every one is
    unfit.

    Sound conditions come first; of rows alike in time, within 15 %, those without a parameter to
    choose.
    """
    good = [row for row in rows if not row.unfit]
    if not good:
        return None
    least = min(row.error for row in good)
    alike = [row for row in good if row.error <= ALIKE * least]
    sound = [row for row in alike if (row.condition or math.inf) <= SOUND] or alike
    quick = min(row.cost for row in sound)
    alike = [row for row in sound if row.cost <= 1.15 * quick]
    return min(alike, key=lambda row: (bool(row.epsilon), row.condition or math.inf))


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
        self.points, which = even_points(vertices, faces, JUDGES)
        self.normals = unit(face_normals(vertices, faces)[which])
        self.held_out = even_points(vertices, faces, HELD_OUT)[0]

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
    points = sample.points
    normals = sample.normals
    fit = FieldFit(kernel, 1.0, BOUND if kernel.has_epsilon else np.inf)
    note = "" if kernel.hermite else "values on and off the surface, the kernel is not C2"
    row = KernelRow(kernel=kernel.name, centres=len(points), note=note)
    surface = None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NumericalWarning)
        try:
            # The epsilon of the least error, or a bounded condition where one is needed.
            if kernel.has_epsilon:
                choice = choose_epsilon(
                    points, normals, fit, held_out=judge.held_out, distance=judge.distance.unsigned
                )
                row.trials = [(shape, error) for shape, error in choice.trials.tolist()]
                row.epsilon = choice.epsilon
                row.shape = choice.epsilon * float(spacing(points).mean())
                if choice.broken:
                    raise ValueError(choice.broken)
                fit = replace(fit, epsilon=choice.epsilon)
            elif fit.fit(points, normals).condition > BOUND:
                row.bound = BOUND
                fit = replace(fit, condition=BOUND)
            surface = _measure(row, judge, sample, fit.fit(points, normals))
        except (ValueError, np.linalg.LinAlgError) as error:
            row.unfit = " ".join(str(error).split())
    return Measured(row, sample, fit, surface)


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
    parts = overlapping_parts(sample.points)
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


class KernelStudy(BaseModel, Study):
    """What `rbfmuscle.study_kernels` found, as ``kernels.json`` holds it: the unit of lengths, the
    library's version, the date, the hash of each mesh by the name of its surface, and a row for
    each kernel and number of centres of each surface, of each the smallest error first and unfit
    ones last.

    ``surfaces`` are vertices and faces of each row's surface, None where there is none; a study
    that is read from a file has none.
    """

    model_config = ConfigDict(arbitrary_types_allowed=True)
    command: ClassVar[str] = "kernels"
    page: ClassVar[str] = "kernels.html"

    units: str
    version: str
    date: str
    meshes: dict[str, str]
    rows: list[KernelRow] = []
    surfaces: list[tuple[np.ndarray, np.ndarray] | None] = Field(
        default=[], exclude=True, repr=False
    )

    @property
    def by_surface(self) -> dict[str, list[KernelRow]]:
        """The rows of each surface."""
        return {name: [row for row in self.rows if row.surface == name] for name in self.meshes}

    def best(self) -> dict[str, KernelRow | None]:
        """What `recommend` gives of the rows of each surface."""
        return {name: recommend(rows) for name, rows in self.by_surface.items()}

    @property
    def recommended(self) -> KernelRow | None:
        """The quickest row that errs at most 5 % more than the best, None where every one is unfit;
        of several surfaces that of the first for which it is the kernel that serves most.
        """
        kernel = self._kernel()[0]
        return next((row for row in self.best().values() if row and row.kernel == kernel), None)

    def table(self) -> np.ndarray:
        """The rows as a structured ndarray, with the columns of ``kernels.csv``."""
        names = [name for name in KernelRow.model_fields if name != "trials"]
        return as_table({name: [getattr(row, name) for row in self.rows] for name in names})

    def answer(self) -> str:
        """What to use and why: of one surface its own sentence, of several the kernel that is near
        the best on most.
        """
        if len(self.meshes) == 1:
            return describe(self.rows)
        kernel, tied, chosen = self._kernel()
        if not kernel:
            return "Every field is unfit on every surface; take more centres."
        return (
            f"Use {kernel}: within 5 % of the least error on {tied} of {len(self.meshes)} "
            f"muscles, and the quickest such kernel on {chosen}."
        )

    def _kernel(self) -> tuple[str, int, int]:
        """The kernel that is near the best on most surfaces, on how many, and on how many it is
        recommended; "" where every field is unfit.
        """
        tied: Counter[str] = Counter()
        for rows in self.by_surface.values():
            good = [row for row in rows if not row.unfit]
            tied.update({row.kernel for row in good if row.error <= ALIKE * good[0].error})
        chosen = Counter(row.kernel for row in self.best().values() if row)
        kernel = max(chosen, key=lambda name: (tied[name], chosen[name]), default="")
        return kernel, tied[kernel], chosen[kernel]


def measure_fits(
    judge: ReferenceSurface,
    kernels: Sequence[Kernel],
    counts: Sequence[int],
    progress: OnProgress | None,
) -> list[Measured]:
    """Fit a surface with each kernel and number of centres, and measure each fit; the smallest
    error first, unfit ones last.
    """
    calls = []
    for count in counts:
        sample = sample_surface(judge.vertices, judge.faces, int(count), placement="greedy")
        calls += [(sample, kernel) for kernel in kernels]
    lock = threading.Lock()
    done = 0

    def measure(call: tuple[SurfaceSample, Kernel]) -> Measured:
        nonlocal done
        one = measure_row(judge, *call)
        with lock:
            done += 1
            if progress is not None:
                progress(done, len(calls))
        return one

    # Filters of warnings belong to all threads: what each row sets is undone here.
    with warnings.catch_warnings(), blas_limited(1):
        warnings.simplefilter("ignore", NumericalWarning)
        found = each(measure, calls)
    _refuse_coarse([one.row for one in found])
    for one in found:  # when nothing else runs
        if not one.row.unfit:
            time_row(one, judge.points)
    found.sort(
        key=lambda one: (bool(one.row.unfit), np.inf if one.row.rms is None else one.row.rms)
    )
    good = [one.row for one in found if not one.row.unfit]
    # No other row beats those of the front both in error and in time.
    for k in pareto_front([row.error for row in good], [row.cost for row in good]):
        good[k].front = True
    return found


def _refuse_coarse(rows: list[KernelRow]) -> None:
    """Name rows unfit that err more than `linear`, the coarsest sensible kernel, with as many
    centres.
    """
    bounds = {row.centres: row.error for row in rows if row.kernel == "linear" and not row.unfit}
    for row in rows:
        bound = bounds.get(row.centres)
        if not row.unfit and bound is not None and row.error > bound:
            row.unfit = f"an error of {row.error:.3g}, beyond that of linear, {bound:.3g}"


# Kernels that take part by default, the quickest first.
CANDIDATES = ("cubic", "quintic", "skala_cervenka", "matern_52")
FEWEST, MOST = 20, GREEDY_LARGEST
# Numbers of centres closer than this share are alike; power of the number by which the error falls.
STEP, POWER = 0.04, 1.4


@dataclass
class CentreSearchResult:
    """What `reach_error` found.

    ``row`` is as in `KernelStudy.rows`: the one that reached the ``wanted`` error, else that of the
    smallest error; ``error`` is its [length]; ``tried`` are the rows of all that was measured, in
    order.
    """

    reached: bool
    row: KernelRow
    error: float
    wanted: float
    tried: list[KernelRow] = field(default_factory=list)

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
    >>> egg = trimesh.creation.icosphere(3).apply_scale([40.0, 10.0, 10.0])
    >>> found = reach_error(egg, 1.0, kernels=["cubic"])
    >>> found.reached, found.row.kernel, found.error <= 1.0
    (True, 'cubic', True)
    """
    if not 0.0 < error < np.inf:
        raise UsageError(f"error must be a positive length, got {error}")
    vertices, faces, named = check_request(mesh, kernels or CANDIDATES)
    wanted = float(error)
    judge = ReferenceSurface(vertices, faces)
    sample = cache(partial(sample_surface, vertices, faces, placement="greedy"))
    found: dict[tuple[str, int], Measured] = {}

    def measure(kernel: Kernel, count: int) -> float:
        key = kernel.name, count
        if key not in found:
            found[key] = measure_row(judge, sample(count), kernel)
            if progress is not None:
                progress(len(found), max(len(found) + 1, 8))
        return found[key].row.error

    best: tuple[str, int] | None = None
    for kernel in named:
        _search_centres(partial(measure, kernel), wanted, None if best is None else best[1])
        reached = [key for key, one in found.items() if one.row.error <= wanted]
        best = min(reached, key=lambda key: key[1], default=None)
    chosen = found[best or min(found, key=lambda key: found[key].row.error)]
    if not chosen.row.unfit:
        time_row(chosen, judge.points)
    return CentreSearchResult(
        best is not None,
        chosen.row,
        chosen.row.error,
        wanted,
        [one.row for one in found.values()],
    )


def _search_centres(measure: Callable[[int], float], wanted: float, best: int | None) -> None:
    """Measure the errors of a kernel with numbers of centres until the fewest that meet a wanted
    one is among these, where it may need fewer than the ``best`` so far; errors are infinite where
    fits broke.
    """
    low, high = FEWEST - 1, MOST + 1
    if best is not None:  # only what serves with fewer than the best is worth more fits
        high = int((1.0 - STEP) * best)
        if high < FEWEST or measure(high) > wanted:
            return
    count = min(120, high - 1)
    while high > low + max(1, STEP * low):
        missed = measure(count)
        low, high = (low, count) if missed <= wanted else (count, high)
        if low >= FEWEST and high <= MOST:
            count = round(math.sqrt(low * high))
        else:  # by the power law, while one end is open
            factor = (missed / wanted) ** (1.0 / POWER) if math.isfinite(missed) else 2.0
            beyond = 0.9 if missed <= wanted else 1.1
            count = round(count * float(np.clip(factor, 0.4, 2.5)) * beyond)
        count = int(np.clip(count, low + 1, high - 1)) if high > low + 1 else high


# Quantity: heading, factor.
COLUMNS = {
    "centres": ("centres", 1.0),
    "shape": ("epsilon times spacing", 1.0),
    "rms": ("RMS error", 1.0),
    "hausdorff": ("greatest error", 1.0),
    "normal_error": ("normals [°]", 1.0),
    "volume_error": ("volume [%]", 100.0),
    "condition": ("condition", 1.0),
    "fit_time": ("fit [ms]", 1e3),
    "evaluation_time": ("20,000 values [ms]", 1e3),
}
FILES = ("kernels.csv", "kernels.json", "kernels.html")
_MOST_LIGHTS = 5  # rows at the top of the page
_READING = """A kernel's shape parameter is chosen by the error at other points of the mesh.
Distances are measured both ways between mesh and extracted surface, root mean square and
greatest. Recommended is the quickest row (a fit and 20,000 values) whose error is at most 5 %
more than the least one; of rows with the same time, one without a shape parameter, then the
best-conditioned one. No other row has both a smaller error and a shorter time than a row on the
front. A kernel that is not C2 cannot be fitted to normals: it is fitted to values on and off the
surface."""


def kernels_folder(directory: str | Path) -> OutputFolder:
    """The folder of a kernel study; UsageError if something in it is in the way."""
    return OutputFolder(directory, "kernels", (*FILES, "error.json"))


def write_page(directory: Path, study: KernelStudy) -> None:
    """Write ``kernels.html`` of what ``kernels.json`` holds."""
    surfaces, units = study.by_surface, study.units
    several = len(surfaces) > 1
    title = f"all {len(surfaces)} muscles" if several else next(iter(surfaces)).replace("_", " ")
    counts = ", ".join(map(str, sorted({row.centres for row in study.rows})))
    best = study.best()
    code = "\n\n".join(f"# {name}\n{row.toml()}" for name, row in best.items() if row)
    hint = f"distances in {units or 'mesh units'}"
    ReportPage(
        f"Kernels for {title}",
        [
            f"{len({row.kernel for row in study.rows})} kernels",
            f"{counts} centres",
            *["every muscle of the scene, or those that are named"][:several],
            f"rbfmuscle {study.version}, {study.date}",
        ],
        study.answer(),
        GOOD if any(best.values()) else BAD,
        plot=_plot(study),
        lights=_lights(study),
        heads=["RMS error", "fit and 20,000 values"],
        sections=[
            *(
                Section(
                    f"Fitted rows of {name}",
                    f"{hint}; mesh {study.meshes[name][:12]}",
                    table=_rows(rows),
                )
                for name, rows in surfaces.items()
            ),
            *(
                Section(f"Unfit rows of {name}", hint, table=_rows(rows, unfit=True))
                for name, rows in surfaces.items()
                if any(row.unfit for row in rows)
            ),
            *(
                Section(f"Error against epsilon: {name}", plots=_curves(rows, units))
                for name, rows in surfaces.items()
                if any(row.trials for row in rows)
            ),
            Section("To paste at the end of a [[muscle]]", code=code),
            Section("How to read this", text=_READING),
        ],
    ).write(directory / "kernels.html")


def _lights(study: KernelStudy) -> list[CheckRow]:
    """Of one surface its best rows, each with whether it ties; of several what is recommended for
    each.
    """
    chosen = [(name, row, GOOD) for name, row in study.best().items() if row is not None]
    if len(study.meshes) == 1 and chosen:
        ((_, best, _),) = chosen
        good = [row for row in study.rows if not row.unfit]
        others = [
            ("", row, GOOD if row.error <= ALIKE * good[0].error else PLAIN)
            for row in good
            if row is not best
        ]
        chosen = [("recommended", best, GOOD), *others][:_MOST_LIGHTS]
    return [
        CheckRow(
            row.title,
            [number_cell(row.rms, study.units, state), number_cell(row.cost, "s")],
            note=note,
        )
        for note, row, state in chosen
    ]


def _plot(study: KernelStudy) -> str:
    """Error against the time of a fit and 20,000 values: a colour a surface, or of one a number of
    centres.
    """
    points = []
    best = study.best()
    for row in study.rows:
        if not row.unfit:
            group = row.surface if len(study.meshes) > 1 else f"{row.centres} centres"
            place = 1e3 * row.cost, row.error, row.kernel, group
            points.append(Point(*place, row is best[row.surface], row.front))
    unit = study.units or "mesh units"
    return front_plot(points, ("a fit and 20,000 values [ms of one thread]", f"RMS error [{unit}]"))


def _curves(rows: Sequence[KernelRow], units: str) -> list[str]:
    """For each number of centres the error at the held-out points against epsilon, by kernel."""
    pictures = []
    for count in dict.fromkeys(row.centres for row in rows):
        tried = [row for row in rows if row.centres == count and row.trials]
        tracks = []
        for row, colour in zip(tried, cycle(MUSCLE_COLOURS)):
            shapes, errors = np.array(row.trials).T
            tracks.append(Track(row.kernel, colour, np.log10(shapes), np.log10(errors)))
        error = f"log10 of the RMS error [{units or 'mesh units'}]"
        if tracks:
            labels = "log10 of epsilon times spacing", error
            pictures.append(line_plot(f"{count} centres", tracks, labels, legend=True))
    return pictures


def _rows(rows: Sequence[KernelRow], *, unfit: bool = False) -> Table:
    lines, best = [], recommend(rows)
    for row in (row for row in rows if bool(row.unfit) == unfit):
        state = GOOD if row is best else BAD if row.unfit else PLAIN
        front = "on the front" if row.front else ""
        verdict = row.unfit or ("recommended" if row is best else front)
        verdict = "; ".join(
            filter(None, [verdict, ENDS if row.shape and at_end(row.shape) else ""])
        )
        values = [(getattr(row, name), factor) for name, (_, factor) in COLUMNS.items()]
        texts = [
            shown_number(x * factor) if isinstance(x, float) else str(x or "")
            for x, factor in values
        ]
        lines.append([Cell(row.kernel), Cell(verdict, state), *map(Cell, texts)])
    return Table(["kernel", "verdict", *(head for head, _ in COLUMNS.values())], lines)
