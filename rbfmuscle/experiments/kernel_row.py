"""One row of a kernel study: a kernel, its shape parameter chosen, its centres fitted, its surface measured."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from rbfmuscle.experiments.workers import threads_limited
from rbfmuscle.geometry.arrays import Floats, Integers, MeshLike
from rbfmuscle.geometry.surfaces import face_normals, mesh_volume, vertex_areas
from rbfmuscle.implicit.extraction.marching import find_sheets
from rbfmuscle.implicit.extraction.surface import extract_surface
from rbfmuscle.implicit.field import RBFField
from rbfmuscle.implicit.field_fit import FieldFit, wanted_derivatives
from rbfmuscle.implicit.kernels.table import Kernel, get_kernel
from rbfmuscle.implicit.placement.refinement import FITTED, fit_sample
from rbfmuscle.implicit.placement.sampling import SurfaceSample, spread_points
from rbfmuscle.implicit.selection import BOUND, EpsilonChoice, choose_epsilon, spacing
from rbfmuscle.metrics.mesh_distance import MeshDistance
from rbfmuscle.validation import NumericalWarning, UsageError, check_mesh

# Points of the mesh at which errors are measured, and cells along the longest side (so many a mean radius, between two
# bounds). With too few thin rims fall between the nodes: iliacus seems to miss 1.7 mm with 64, sartorius 7.3 with 128,
# where they miss 0.9 and 1.2.
JUDGES, CELLS, RANGE = 20_000, 5.0, (128, 320)
# Placements of the centres of a muscle.
PLACEMENTS = ("greedy", FITTED)
# Points of the mesh that choose epsilon.
HELD_OUT = 2000
# Points of one timed evaluation, and the processor time after which enough of them, or of fits, are made [s].
TIMED, MEASURED = 20_000, 0.05
# A level zero that encloses so much more or less than the mesh has lost or gained a part of it.
VOLUME_BOUND = 0.1


class ReferenceSurface:
    """The surface (vertices (n, 3), faces (m, 3)) that is to be met, and how far another one is from it.

    ``resolution`` counts cells along the longest side of extracted surfaces; as many as a muscle so slender needs where
    0.
    """

    def __init__(self, vertices: Floats, faces: Integers, resolution: int = 0) -> None:
        self.vertices, self.faces, self.volume = vertices, faces, mesh_volume(vertices, faces)
        radius = 2.0 * self.volume / vertex_areas(vertices, faces).sum()
        self.axes = np.linalg.svd(vertices - vertices.mean(axis=0), full_matrices=False)[2]
        self.axes[2] *= np.sign(np.linalg.det(self.axes))
        self.resolution = resolution or int(np.clip(CELLS * np.ptp(vertices @ self.axes[0]) / radius, *RANGE))
        self.distance = MeshDistance(vertices, faces)
        self.points, which = spread_points(vertices, faces, JUDGES)
        normal = face_normals(vertices, faces)[which]
        self.normals = normal / np.linalg.norm(normal, axis=1)[:, None]
        # What chooses is not what judges.
        self.held_out = spread_points(vertices, faces, HELD_OUT, seed=1)[0]

    def apart(self, vertices: Floats, faces: Integers) -> tuple[float, float]:
        """RMS and greatest distance of a surface, both ways [length]."""
        there = MeshDistance(vertices, faces, closed=False).unsigned(self.points)
        back = self.distance.unsigned(vertices)
        rms = float(np.sqrt(0.5 * ((there**2).mean() + (back**2).mean())))
        return rms, float(max(there.max(), back.max()))


def check_request(
    mesh: MeshLike, kernels: Iterable[str], placement: str
) -> tuple[Floats, Integers, list[Kernel]]:
    """Vertices and faces of a mesh, and kernels by name; MeshError and UsageError for what cannot be studied."""
    named = [get_kernel(name) for name in kernels]
    if placement not in PLACEMENTS:
        raise UsageError(f"placement must be one of {', '.join(PLACEMENTS)}, got {placement!r}")
    return *check_mesh(*(mesh if isinstance(mesh, tuple) else (mesh.vertices, mesh.faces))), named


class Measured(NamedTuple):
    """What one row found: a row of `KernelStudy.rows` without times, the fitted centres, how, and the surface."""

    row: dict
    sample: SurfaceSample
    fit: FieldFit
    surface: tuple[Floats, Integers] | None


def measure_row(judge: ReferenceSurface, sample: SurfaceSample, kernel: Kernel, placement: str) -> Measured:
    """One row of the table, its times left open, and its surface; ``sample`` holds greedy centres."""
    placement = placement if kernel.hermite else "greedy"
    derivatives = wanted_derivatives(len(sample.points), fitted=placement == FITTED)
    fit = FieldFit(kernel, 1.0, derivatives, BOUND if kernel.has_epsilon else np.inf)
    row = {
        "kernel": kernel.name, "centres": len(sample.points), "placement": placement, "epsilon": 0.0, "shape": None,
        "condition": None, "bound": 0.0, "rms": None, "hausdorff": None, "normal_error": None, "volume_error": None,
        "fit_time": None, "evaluation_time": None, "unfit": "",
        "note": "" if kernel.hermite else "values on and off the surface, the kernel is not C2",
    }  # fmt: skip
    surface = None
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NumericalWarning)
        try:
            if placement == FITTED:
                if kernel.has_epsilon:
                    fit = replace(fit, epsilon=_choose(judge, sample, fit, look=False).epsilon)
                sample = fit_sample(sample, judge.vertices, judge.faces, fit=fit)
            if kernel.has_epsilon:  # what was best for the greedy centres need not be so for these
                choice = _choose(judge, sample, fit, look=True)
                fit = replace(fit, epsilon=choice.epsilon)
                row["epsilon"], row["shape"] = fit.epsilon, fit.epsilon * float(spacing(sample.points).mean())
                if choice.broken:
                    raise ValueError(choice.broken)
            elif fit.fit(sample.points, sample.normals).condition > BOUND:
                fit, row["bound"] = replace(fit, condition=BOUND), BOUND
            surface = _measure(row, judge, sample, fit.fit(sample.points, sample.normals))
        except (ValueError, np.linalg.LinAlgError) as error:
            row["unfit"] = " ".join(str(error).split())
    return Measured(row, sample, fit, surface)


def _choose(judge: ReferenceSurface, sample: SurfaceSample, fit: FieldFit, *, look: bool) -> EpsilonChoice:
    distance = judge.distance.unsigned if look else None
    return choose_epsilon(sample.points, sample.normals, fit, held_out=judge.held_out, distance=distance)


def _measure(
    row: dict, judge: ReferenceSurface, sample: SurfaceSample, field: RBFField
) -> tuple[Floats, Integers]:
    """Write what is measured of a field into the row; its surface."""
    row["condition"] = float(field.condition)
    gradient = field.gradient(judge.points[::5])
    cosine = np.einsum("ij,ij->i", gradient, judge.normals[::5])
    cosine /= np.maximum(np.linalg.norm(gradient, axis=1), np.finfo(float).tiny)
    row["normal_error"] = float(np.degrees(np.sqrt((np.arccos(np.clip(cosine, -1.0, 1.0)) ** 2).mean())))
    sheets = find_sheets(field, sample.points, judge.distance.unsigned)
    if sheets.is_open:
        raise ValueError("the level set is open: it leaves the box of the muscle; take more centres")
    if sheets.stray:
        raise ValueError(f"{sheets.stray} sheets beside those of the mesh; take more centres")
    found = extract_surface(field, points=sample.points, resolution=judge.resolution, axes=judge.axes)
    row["volume_error"] = found.volume / judge.volume - 1.0
    if abs(row["volume_error"]) > VOLUME_BOUND:
        row["unfit"] = f"{100 * row['volume_error']:+.3g} % of volume, beyond {100 * VOLUME_BOUND:g}"
    row["rms"], row["hausdorff"] = judge.apart(found.vertices, found.faces)
    return found.vertices, found.faces


def time_row(found: Measured, points: Floats) -> None:
    """Write into a row what a fit, and values at 20,000 of the points (n, 3), cost [processor s, one thread]."""
    row, sample = found.row, found.sample
    with warnings.catch_warnings(), threads_limited(1):
        warnings.simplefilter("ignore", NumericalWarning)  # it stands in the row's condition
        field = found.fit.fit(sample.points, sample.normals)
        row["fit_time"] = _spent(lambda: found.fit.fit(sample.points, sample.normals))
        field(points[:TIMED])
        row["evaluation_time"] = _spent(lambda: field(points[:TIMED]))


def _spent(work: Callable[[], object]) -> float:
    """Processor time of some work, done as often as a coarse clock needs [s]."""
    start, runs = time.process_time(), 0
    while runs == 0 or time.process_time() - start < MEASURED:
        work()
        runs += 1
    return (time.process_time() - start) / runs
