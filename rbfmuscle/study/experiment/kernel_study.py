"""Which kernel, which shape parameter, how many centres: one surface fitted by all of them, and a table.

Accuracy, conditioning, time and data size are measured together, since each can be bought with the others.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from rbfmuscle.geometry.arrays import Floats, Integers, MeshLike
from rbfmuscle.geometry.surfaces import mesh_volume
from rbfmuscle.implicit.extraction.surface import extract_surface
from rbfmuscle.implicit.field import RBFField
from rbfmuscle.implicit.kernels.table import KERNELS, get_kernel
from rbfmuscle.implicit.placement.refinement import FITTED, fit_sample
from rbfmuscle.implicit.placement.sampling import PLACEMENTS, sample_surface
from rbfmuscle.implicit.selection import spacing, surface_miss
from rbfmuscle.implicit.surface_epsilon import choose_surface_epsilon
from rbfmuscle.study.experiment.kernel_choice import Bootstrap, Recommendation, mark_unfit, recommend
from rbfmuscle.study.experiment.sweep_table import pareto_front
from rbfmuscle.study.measure.mesh_distance import MeshDistance
from rbfmuscle.validation import NumericalWarning, UsageError, check_mesh

if TYPE_CHECKING:
    pass


CENTRES = (150, 300)
# Shape parameters of the map, in units of 1 / (mean distance to the nearest centre).
SCAN = np.geomspace(0.03, 3.0, 9)
# Points of the mesh at which errors are measured, and the cells along the longest side.
JUDGES, RESOLUTION = 20_000, 64
# Points of the mesh that choose epsilon.
HELD_OUT = 2000
# Points of one timed evaluation, and how often fit and evaluation are timed.
TIMED, REPEATS = 20_000, 3


@dataclass
class KernelStudy:
    """What `study_kernels` found.

    Attributes
    ----------
    rows : list of dict
        One for each kernel and number of centres, the smallest error first; unfit ones (``unfit`` says why) last.
    scan : list of dict
        ``kernel, centres, shape`` (epsilon times the spacing), ``error, condition`` over a range of shapes.
    decimated : dict of int to dict
        For each number of stored numbers, the decimated mesh that takes as many: ``vertices, rms, hausdorff``.
    surfaces : list of (vertices, faces, error)
        Of the rows, in their order; None where there is none.
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
    resolution: int = RESOLUTION,
    criterion: str = "held_out",
    scan: bool = True,
    seed: int = 0,
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
    derivatives : {"all", "normal"}
        Of Hermite fits; kernels that are not smooth enough are fitted to values on and off the surface.
    placement : {"even", "adaptive", "greedy", "fitted"}
        Fitted centres lie beside the surface, so that the whole of it is met in the least-squares sense
        (`fit_centres`); for Hermite fits to all derivatives, greedy ones for the others.
    resolution : int
        Cells along the longest side of the extracted surfaces.
    criterion : {"held_out", "loo", "gcv", "condition"}
        How epsilon is chosen: by the error at other points of the mesh, or from the centres alone.
    scan : bool
        Also measure a range of epsilons, for the map.
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

    Examples
    --------
    >>> import trimesh
    >>> ball = trimesh.creation.icosphere(3, 10.0)
    >>> study = study_kernels(ball, kernels=["cubic"], centres=[40], placement="even", resolution=16, scan=False)
    >>> study.rows[0]["kernel"]
    'cubic'
    """
    vertices, faces = check_mesh(*(mesh if isinstance(mesh, tuple) else (mesh.vertices, mesh.faces)))
    kernels = [get_kernel(name) for name in (kernels or KERNELS)]
    if placement not in (*PLACEMENTS, FITTED):
        raise UsageError(f"placement must be one of {', '.join((*PLACEMENTS, FITTED))}, got {placement!r}")
    if min(centres, default=0) < 8:
        raise UsageError(f"centres must be numbers of at least 8, got {list(centres)}")
    judge = _Judge(vertices, faces, resolution, seed)
    study, found = KernelStudy([], units=units), []
    total = len(kernels) * len(centres)
    for count in centres:
        base = "greedy" if placement == FITTED else placement
        sample = sample_surface(vertices, faces, int(count), seed=seed, placement=base)
        for kernel in kernels:
            found.append(_measure(judge, sample, kernel, derivatives, criterion, placement))
            if scan and kernel.has_epsilon:
                study.scan += _scan(judge, sample, kernel, derivatives)
            if progress is not None:
                progress(len(found), total)
    mark_unfit([row for row, _ in found], sheets=judge.sheets)
    found.sort(key=lambda pair: (bool(pair[0]["unfit"]), pair[0]["rms"] is None, pair[0]["rms"] or 0.0))
    study.rows, study.surfaces = [row for row, _ in found], [surface for _, surface in found]
    for row in study.rows:
        numbers = row["numbers"]
        if numbers not in study.decimated:
            study.decimated[numbers] = judge.decimated(numbers)
        row["decimated_rms"] = study.decimated[numbers]["rms"]
    _mark_fronts(study.rows)
    study.recommended = recommend(study.rows)
    return study


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


class _Judge:
    """The surface that is to be met, and how far another one is from it."""

    def __init__(self, vertices: Floats, faces: Integers, resolution: int, seed: int) -> None:
        self.vertices, self.faces, self.resolution = vertices, faces, resolution
        self.volume = mesh_volume(vertices, faces)
        self.distance = MeshDistance(vertices, faces)
        # What chooses is not what judges.
        self.held_out = sample_surface(vertices, faces, HELD_OUT, seed=seed, placement="even").points
        rng = np.random.default_rng(seed)
        corners = vertices[faces]
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        area = np.linalg.norm(normal, axis=1)
        which = rng.choice(len(area), JUDGES, p=area / area.sum())
        self.points = np.einsum("nk,nkj->nj", rng.dirichlet(np.ones(3), JUDGES), corners[which])
        self.normals = normal[which] / area[which, None]
        self.sheets = _sheets(faces)
        self.bootstrap = Bootstrap(JUDGES, seed)

    def apart(self, vertices: Floats, faces: Integers) -> tuple[float, float, Floats, tuple[float, float]]:
        """RMS and greatest distance, both ways, the distance of each vertex, and the interval of the RMS."""
        there = MeshDistance(vertices, faces, closed=False).unsigned(self.points)
        back = self.distance.unsigned(vertices)
        rms = float(np.sqrt(0.5 * ((there**2).mean() + (back**2).mean())))
        return rms, float(max(there.max(), back.max())), back, self.bootstrap.interval(there, back)

    def decimated(self, numbers: int) -> dict[str, float]:
        """A decimated mesh whose vertices and faces are as many numbers (9 a vertex) as a field's."""
        import pyvista

        wanted = max(4, numbers // 9)
        surface = pyvista.make_tri_mesh(self.vertices, self.faces)
        share = 1.0 - min(1.0, wanted / len(self.vertices))
        small = surface.decimate(share) if share > 0.0 else surface
        vertices = np.asarray(small.points, dtype=float)
        faces = np.asarray(small.regular_faces)
        rms, hausdorff, *_ = self.apart(vertices, faces)
        return {"vertices": len(vertices), "rms": rms, "hausdorff": hausdorff}


def _sheets(faces):
    """Parts of a mesh."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    ends = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]]])
    size = int(faces.max()) + 1
    graph = coo_matrix((np.ones(len(ends)), ends.T), shape=(size, size))
    used = np.unique(faces)
    return len(np.unique(connected_components(graph, directed=False)[1][used]))


def _fit(sample, kernel, epsilon, derivatives):
    return RBFField.fit_surface(
        sample.points, sample.normals, kernel=kernel, epsilon=epsilon, derivatives=derivatives
    )


def _choose(judge, sample, kernel, derivatives, criterion):
    return choose_surface_epsilon(
        sample.points, sample.normals, kernel=kernel, criterion=criterion, derivatives=derivatives,
        held_out=judge.held_out, distance=judge.distance.unsigned,
    ).epsilon  # fmt: skip


def _measure(judge, sample, kernel, derivatives, criterion, placement):
    """One row of the table and its surface."""
    count = len(sample.points)
    if placement == FITTED and not (kernel.hermite and derivatives == "all"):
        placement = "greedy"
    row = {
        "kernel": kernel.name, "centres": count, "placement": placement, "epsilon": 0.0, "shape": None,
        "fit": derivatives if kernel.hermite else "values", "rms": None, "low": None, "high": None,
        "hausdorff": None, "normal_error": None, "volume_error": None,
        "components": None, "spurious": None, "condition": None,
        "fit_time": None, "evaluation_time": None, "numbers": _stored(kernel, derivatives, count),
        "note": "" if kernel.hermite else "values on and off the surface, the kernel is not C2",
    }  # fmt: skip
    with warnings.catch_warnings(record=True) as said:
        warnings.simplefilter("always", NumericalWarning)
        try:
            if kernel.has_epsilon:
                row["epsilon"] = _choose(judge, sample, kernel, derivatives, criterion)
                row["shape"] = float(row["epsilon"] * spacing(sample.points).mean())
            if placement == FITTED:
                sample = fit_sample(
                    sample, judge.vertices, judge.faces, kernel=kernel, epsilon=row["epsilon"] or 1.0
                )
                if kernel.has_epsilon:  # what was best for the greedy centres need not be so for these
                    row["epsilon"] = _choose(judge, sample, kernel, derivatives, criterion)
                    row["shape"] = float(row["epsilon"] * spacing(sample.points).mean())
            surface = _fill(row, judge, sample, kernel, derivatives)
        except (ValueError, np.linalg.LinAlgError) as error:
            row["note"], surface = " ".join(str(error).split()), None
    if said and surface is not None:
        row["note"] = "; ".join([*([row["note"]] if row["note"] else []), str(said[-1].message)])
    return row, surface


def _fill(row, judge, sample, kernel, derivatives):
    epsilon = row["epsilon"] or 1.0
    spent = []
    for _ in range(REPEATS):
        start = time.perf_counter()
        fitted = _fit(sample, kernel, epsilon, derivatives)
        middle = time.perf_counter()
        fitted(judge.points[:TIMED])
        spent.append((middle - start, time.perf_counter() - middle))
    # The least, as the first may compile.
    row["fit_time"], row["evaluation_time"] = (float(t) for t in np.min(spent, axis=0))
    row["condition"] = float(fitted.condition)
    gradient = fitted.gradient(judge.points[::5])
    cosine = np.einsum("ij,ij->i", gradient, judge.normals[::5]) / np.linalg.norm(gradient, axis=1)
    row["normal_error"] = float(np.degrees(np.sqrt((np.arccos(np.clip(cosine, -1.0, 1.0)) ** 2).mean())))
    found = extract_surface(
        fitted, points=sample.points, resolution=judge.resolution, search="box", keep="largest"
    )
    row["components"], row["spurious"] = found.components, found.spurious
    row["volume_error"] = found.volume / judge.volume - 1.0
    row["rms"], row["hausdorff"], error, (row["low"], row["high"]) = judge.apart(found.vertices, found.faces)
    if found.spurious:
        row["note"] = f"{found.spurious} spurious sheets; {row['note']}".rstrip("; ")
    return found.vertices, found.faces, error


def _stored(kernel, derivatives, count):
    """Numbers that a field takes: positions, weights, and normals where the weights act along them."""
    if not kernel.hermite:
        return 3 * count * 4
    return count * (7 if derivatives == "all" else 8)


def _scan(judge, sample, kernel, derivatives):
    h = float(spacing(sample.points).mean())
    rows = []
    for shape in SCAN:
        error, condition = None, None
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NumericalWarning)
            try:
                fitted = _fit(sample, kernel, shape / h, derivatives)
                error, condition = surface_miss(fitted, judge.points[::10], h), float(fitted.condition)
            except np.linalg.LinAlgError:
                pass
        rows.append(
            {"kernel": kernel.name, "centres": len(sample.points), "shape": float(shape), "error": error,
             "condition": condition}
        )  # fmt: skip
    return rows
