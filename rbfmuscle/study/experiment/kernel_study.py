"""Which kernel, which shape parameter, how many centres: one surface fitted by all of them, and a table.

Accuracy, conditioning, time and data size are measured together, since each can be bought with the others.
"""

from __future__ import annotations

import functools
import pickle
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from rbfmuscle.compiled.child import calls_apart
from rbfmuscle.geometry.arrays import MeshLike
from rbfmuscle.implicit import shape_search
from rbfmuscle.implicit.kernels.table import KERNELS, get_kernel
from rbfmuscle.implicit.placement.refinement import FITTED
from rbfmuscle.implicit.placement.sampling import PLACEMENTS, SurfaceSample, sample_surface
from rbfmuscle.study.experiment.kernel_choice import Recommendation, mark_unfit, recommend
from rbfmuscle.study.experiment.kernel_judge import SurfaceJudge
from rbfmuscle.study.experiment.kernel_row import Measured, Request, measure_row, time_row
from rbfmuscle.study.experiment.sweep_table import pareto_front
from rbfmuscle.validation import UsageError, check_mesh

CENTRES = (150, 300)
# Rows that are worth the start of other processes.
MANY = 6


@dataclass
class KernelStudy:
    """What `study_kernels` found.

    Attributes
    ----------
    rows : list of dict
        One for each kernel and number of centres, the smallest error first; unfit ones (``unfit`` says why) last.
    scan : list of dict
        ``kernel, centres, shape`` (epsilon times the spacing), ``error, condition`` of all that the search tried.
    decimated : dict of int to dict
        For each number of stored numbers, the decimated mesh that takes as many: ``vertices, rms, hausdorff``.
    surfaces : list of (vertices, faces, error)
        Of the rows, in their order, the error signed, positive outside the mesh; None where there is none.
    units : str
    recommended : Recommendation or None
        The row to take and why; None where every one is unfit.
    """

    rows: list
    scan: list = field(default_factory=list)
    decimated: dict = field(default_factory=dict)
    surfaces: list = field(default_factory=list)
    units: str = ""
    recommended: Recommendation | None = None

    def toml(self, row: dict[str, Any]) -> str:
        """The lines of a scene file's model table that give this row."""
        lines = [
            "[muscle.model]",
            'name = "rbf"',
            f'kernel = "{row["kernel"]}"',
            f"centres = {row['centres']}",
        ]
        if row["epsilon"]:
            lines.append(f"epsilon = {row['epsilon']:.6g}")
        if row["bound"]:
            lines.append(f"condition = {row['bound']:g}")
        if row["fit"] != "values":
            lines.append(f'derivatives = "{row["fit"]}"')
        lines.append(f'placement = "{row["placement"]}"')
        return "\n".join(lines)


def study_kernels(
    mesh: MeshLike,
    *,
    kernels: Sequence[str] | None = None,
    centres: Sequence[int] = CENTRES,
    derivatives: str = "all",
    placement: str = FITTED,
    resolution: int = 0,
    criterion: str = "held_out",
    condition: float = np.inf,
    seed: int = 0,
    units: str = "",
    progress: Callable[[int, int], None] | None = None,
) -> KernelStudy:
    """Fit a surface with many kernels and numbers of centres, and measure each fit.

    Six rows and more are measured in as many processes as there are threads.

    Parameters
    ----------
    mesh : trimesh.Trimesh or pair of (n, 3) vertices and (m, 3) faces
        Closed, outward.
    kernels : list of str, optional
        All by default.
    centres : sequence of int
    derivatives : {"all", "normal"}
        Of Hermite fits; kernels that are not smooth enough are fitted to values on and off the surface.
    placement : {"even", "adaptive", "greedy", "fitted"}
        Fitted centres lie beside the surface, so that the whole of it is met in the least-squares sense
        (`fit_centres`); for Hermite fits to all derivatives, greedy ones for the others.
    resolution : int
        Cells along the longest side of the extracted surfaces; as many as a muscle so slender needs by default.
    criterion : {"held_out", "loo", "gcv", "condition"}
        How epsilon is chosen: by the error at other points of the mesh, or from the centres alone.
    condition : float
        No epsilon beyond it is chosen, and a ridge keeps it in fits to normals; others beyond it are unfit.
    seed : int
    units : str
        Name of the mesh's unit, for the page.
    progress : callable, optional
        Called as ``progress(done, total)``.

    Returns
    -------
    KernelStudy

    Raises
    ------
    UsageError
        On an unknown kernel or placement, or a number of centres below 8.
    MeshError
        On an unusable mesh.
    SolveError
        If a process was ended.

    Examples
    --------
    >>> import trimesh
    >>> ball = trimesh.creation.icosphere(3, 10.0)
    >>> study = study_kernels(ball, kernels=["cubic"], centres=[40], placement="even", resolution=16)
    >>> study.rows[0]["kernel"]
    'cubic'
    """
    vertices, faces = check_mesh(*(mesh if isinstance(mesh, tuple) else (mesh.vertices, mesh.faces)))
    kernels = [get_kernel(name) for name in (kernels or KERNELS)]
    if placement not in (*PLACEMENTS, FITTED):
        raise UsageError(f"placement must be one of {', '.join((*PLACEMENTS, FITTED))}, got {placement!r}")
    if min(centres, default=0) < 8:
        raise UsageError(f"centres must be numbers of at least 8, got {list(centres)}")
    if not condition >= 1.0:
        raise UsageError(f"condition must be a bound of at least 1, got {condition:g}")
    surface = (vertices, faces, resolution, seed)
    judge, study, found = SurfaceJudge(*surface), KernelStudy([], units=units), []
    ask = Request(derivatives, criterion, placement, float(condition))
    base = "greedy" if placement == FITTED else placement
    calls = []
    for count in centres:
        sample = sample_surface(vertices, faces, int(count), seed=seed, placement=base)
        calls += [(sample, kernel.name, ask) for kernel in kernels]
    for one in _measured(judge, surface, calls):
        study.scan += one.tried
        found.append(one)
        if progress is not None:
            progress(len(found), len(calls))
    mark_unfit([one.row for one in found], sheets=judge.sheets, condition=condition)
    for one in found:  # when nothing else runs
        if not one.row["unfit"]:
            time_row(one.row, one.sample, derivatives, judge.points)
    found.sort(key=lambda one: (bool(one.row["unfit"]), one.row["rms"] is None, one.row["rms"] or 0.0))
    study.rows, study.surfaces = [one.row for one in found], [one.surface for one in found]
    for row in study.rows:
        numbers = row["numbers"]
        if numbers not in study.decimated:
            study.decimated[numbers] = judge.decimated(numbers)
        row["decimated_rms"] = study.decimated[numbers]["rms"]
    _mark_fronts(study.rows)
    study.recommended = recommend(study.rows)
    return study


def processes_for(rows: int) -> int:
    """Processes that share so many rows: one for each thread, where they are worth their start."""
    import numba

    return min(numba.get_num_threads(), rows) if rows >= MANY else 1


def _measured(judge: SurfaceJudge, surface: tuple[Any, ...], calls: Sequence[Any]) -> Iterator[Measured]:
    """What the rows of calls (sample, kernel's name, ask) found, in their order."""
    jobs = processes_for(len(calls))
    if jobs == 1:
        return (measure_row(judge, sample, get_kernel(name), ask) for sample, name, ask in calls)
    pickled = pickle.dumps(surface)
    return calls_apart(_row_apart, [(pickled, *call) for call in calls], jobs)


def _row_apart(surface: bytes, sample: SurfaceSample, kernel: str, ask: Request) -> Measured:
    """One row, in a process of its own: its searches are bounded by its processor time, however busy the machine."""
    shape_search.CLOCK = time.process_time
    return measure_row(_judge(surface), sample, get_kernel(kernel), ask)


@functools.lru_cache(maxsize=1)
def _judge(surface: bytes) -> SurfaceJudge:
    """The judge of a pickled surface, made once in a process."""
    return SurfaceJudge(*pickle.loads(surface))


def _mark_fronts(rows):
    """Mark what no other row beats both in error and in time (or in size)."""
    good = [row for row in rows if not row["unfit"]]
    for row in rows:
        row["front_time"] = row["front_size"] = False
    if not good:
        return
    errors = np.array([row["rms"] for row in good])
    times = np.array([row["fit_time"] + row["evaluation_time"] for row in good])
    for name, cost in (("front_time", times), ("front_size", np.array([float(r["numbers"]) for r in good]))):
        for index in pareto_front(errors, cost):
            good[index][name] = True
