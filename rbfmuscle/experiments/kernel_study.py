"""Which kernel, which shape parameter, how many centres: one surface fitted by all of them, and a table.

Accuracy, conditioning and time are measured together, since each can be bought with the others.
"""

from __future__ import annotations

import threading
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from rbfmuscle.experiments.kernel_row import Measured, ReferenceSurface, check_request, measure_row, time_row
from rbfmuscle.experiments.sweep_table import pareto_front
from rbfmuscle.geometry.arrays import Floats, Integers, MeshLike
from rbfmuscle.geometry.threads import each
from rbfmuscle.implicit.kernels.table import KERNELS, Kernel
from rbfmuscle.implicit.placement.refinement import FITTED
from rbfmuscle.implicit.placement.sampling import SurfaceSample, sample_surface
from rbfmuscle.validation import NumericalWarning, UsageError

CENTRES = (150, 300)
# Errors this much apart are alike: points of another seed move them as far.
ALIKE = 1.05
# Rows beyond this condition are taken only where none that is as accurate is below it.
SOUND = 1e10
# The coarsest sensible kernel, |r|: what errs more than it is unfit.
COARSEST = "linear"


@dataclass
class KernelStudy:
    """What `study_kernels` found.

    ``rows`` holds a dict for each kernel and number of centres, the smallest error first; unfit ones (``unfit`` says
    why) last. Lengths are in the mesh's unit, times in seconds of one thread. ``surfaces`` (vertices, faces) are those
    of the rows, None where there is none. ``recommended`` is the quickest row that errs at most 5 % more than the best,
    None where every one is unfit.
    """

    rows: list[dict] = field(repr=False)
    surfaces: list[tuple[Floats, Integers] | None] = field(default_factory=list, repr=False)
    units: str = ""
    recommended: dict | None = None


def row_toml(row: dict) -> str:
    """The lines of a scene file's model table that give a row of a study."""
    lines = ["[muscle.model]", 'name = "rbf"', f'kernel = "{row["kernel"]}"', f"centres = {row['centres']}"]
    if row["epsilon"]:
        lines.append(f"epsilon = {row['epsilon']:.6g}")
    if row["bound"]:
        lines.append(f"condition = {row['bound']:g}")
    return "\n".join([*lines, f'placement = "{row["placement"]}"'])


def describe(rows: list[dict]) -> str:
    """What to use of the rows of a study, and why, in one sentence."""
    best = recommend(rows)
    if best is None:
        return "Every field is unfit; take more centres."
    good = [row for row in rows if not row["unfit"] and row["centres"] == best["centres"]]
    least = min(row["rms"] for row in good)
    tied = [row for row in good if row["rms"] <= ALIKE * least]
    use = f"use {best['kernel']} with {best['centres']} centres"
    if len(tied) == 1:
        other = min((row["rms"] for row in good if row is not best), default=None)
        behind = (
            f", whose error is {100 * (1 - best['rms'] / other):.0f} % less than the next" if other else ""
        )
        return f"{use[0].upper()}{use[1:]}{behind}."
    spread = 100 * (max(row["rms"] for row in tied) / least - 1)
    reason = "without a shape parameter to choose" if not best["epsilon"] else "of sound condition"
    return f"{len(tied)} kernels tie within {max(spread, 1):.0f} %: {use}, the quickest {reason}."


def row_name(row: dict) -> str:
    """A row in words."""
    return f"{row['kernel']}, {row['centres']} centres"


def study_kernels(
    mesh: MeshLike,
    *,
    kernels: Sequence[str] | None = None,
    centres: Sequence[int] = CENTRES,
    placement: str = FITTED,
    resolution: int = 0,
    units: str = "",
    progress: Callable[[int, int], None] | None = None,
) -> KernelStudy:
    """Fit a surface with many kernels and numbers of centres, and measure each fit.

    Parameters
    ----------
    mesh : trimesh.Trimesh or pair of (n, 3) vertices and (m, 3) faces
        Closed, outward.
    kernels : list of str, optional
        All by default.
    centres : sequence of int
    placement : {"greedy", "fitted"}
        Fitted centres lie beside the surface, so that the whole of it is met in the least-squares sense
        (`fit_sample`); kernels that are not C2 have greedy ones.
    resolution : int
        Cells along the longest side of the extracted surfaces; as many as a muscle so slender needs by default.
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

    Examples
    --------
    >>> import trimesh
    >>> ball = trimesh.creation.icosphere(3, 10.0)
    >>> study = study_kernels(ball, kernels=["cubic"], centres=[40], placement="greedy", resolution=16)
    >>> study.rows[0]["kernel"]
    'cubic'
    """
    vertices, faces, chosen = check_request(mesh, kernels or KERNELS, placement)
    if min(centres, default=0) < 8:
        raise UsageError(f"centres must be numbers of at least 8, got {list(centres)}")
    judge, calls = ReferenceSurface(vertices, faces, resolution), []
    for count in centres:
        sample = sample_surface(vertices, faces, int(count), placement="greedy")
        calls += [(sample, kernel, placement) for kernel in chosen]
    found = _measure_all(judge, calls, progress)
    _refuse_coarse([one.row for one in found])
    for one in found:  # when nothing else runs
        if not one.row["unfit"]:
            time_row(one, judge.points)
    found.sort(key=lambda one: (bool(one.row["unfit"]), one.row["rms"] is None, one.row["rms"] or 0.0))
    rows = [one.row for one in found]
    _mark_front(rows)
    return KernelStudy(rows, [one.surface for one in found], units, recommend(rows))


def _measure_all(
    judge: ReferenceSurface,
    calls: list[tuple[SurfaceSample, Kernel, str]],
    progress: Callable[[int, int], None] | None,
) -> list[Measured]:
    """What the rows of calls found, in their order, measured side by side on threads."""
    from threadpoolctl import threadpool_limits

    lock, done = threading.Lock(), []

    def measure(call: tuple[SurfaceSample, Kernel, str]) -> Measured:
        found = measure_row(judge, *call)
        with lock:
            done.append(found)
            if progress is not None:
                progress(len(done), len(calls))
        return found

    # Filters of warnings belong to all threads: what each row sets is undone here.
    with warnings.catch_warnings(), threadpool_limits(1, user_api="blas"):
        warnings.simplefilter("ignore", NumericalWarning)
        return each(measure, calls)


def _refuse_coarse(rows: list[dict]) -> None:
    """Name rows unfit that err more than `linear` with as many centres."""
    bounds = {row["centres"]: row["rms"] for row in rows if row["kernel"] == COARSEST and not row["unfit"]}
    for row in rows:
        bound = bounds.get(row["centres"])
        if not row["unfit"] and bound is not None and row["rms"] > bound:
            row["unfit"] = f"an error of {row['rms']:.3g}, beyond that of {COARSEST}, {bound:.3g}"


def cost(row: dict) -> float:
    """What a frame pays for a row's field: a fit and the values at 20,000 points [s of processor time]."""
    return float(row["fit_time"] + row["evaluation_time"])


def recommend(rows: list[dict]) -> dict | None:
    """The quickest of the rows that err at most 5 % more than the best, None where every one is unfit.

    Sound conditions come first; of rows alike in time, within 15 %, those without a parameter to choose. Rows hold
    ``rms, fit_time, evaluation_time, condition, epsilon, unfit``.
    """
    good = [row for row in rows if not row["unfit"]]
    if not good:
        return None
    least = min(row["rms"] for row in good)
    alike = [row for row in good if row["rms"] <= ALIKE * least]
    sound = [row for row in alike if row["condition"] <= SOUND] or alike
    quick = min(cost(row) for row in sound)
    return min(
        (row for row in sound if cost(row) <= 1.15 * quick),
        key=lambda row: (bool(row["epsilon"]), row["condition"]),
    )


def _mark_front(rows: list[dict]) -> None:
    """Mark what no other row beats both in error and in time."""
    good = [row for row in rows if not row["unfit"]]
    front = pareto_front([row["rms"] for row in good], [cost(row) for row in good])
    for row in rows:
        row["front"] = False
    for index in front:
        good[index]["front"] = True
