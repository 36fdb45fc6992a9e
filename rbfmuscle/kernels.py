"""Kernels compared on a surface, with tables and a page where a folder is given."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rbfmuscle.experiments.kernel_study import (
    KernelStudy,
    ReferenceSurface,
    check_request,
    measure_fits,
)
from rbfmuscle.experiments.sweep_run import OnProgress
from rbfmuscle.geometry.arrays import MeshLike
from rbfmuscle.implicit.kernels.table import KERNELS
from rbfmuscle.report.kernel_page import kernels_folder, write_studies
from rbfmuscle.validation import UsageError


def study_kernels(
    mesh: MeshLike,
    directory: str | Path | None = None,
    *,
    kernels: Sequence[str] | None = None,
    centres: Sequence[int] = (150, 300),
    resolution: int = 0,
    units: str = "",
    progress: OnProgress | None = None,
) -> KernelStudy:
    """Fit a surface with many kernels and numbers of centres, and measure each fit.

    Parameters
    ----------
    mesh : trimesh.Trimesh or pair of (n, 3) vertices and (m, 3) faces
        Closed, outward.
    directory : path, optional
        Takes ``kernels.csv``, ``kernels.json`` and the page ``kernels.html``.
    kernels : list of str, optional
        All by default.
    centres : sequence of int
    resolution : int
        Cells along the longest side of the extracted surfaces; as many as a muscle so slender needs
        by default.
    units, progress : str, callable, optional
        Name of the mesh's unit, for the page. ``progress(done, total)`` is called along the way.

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
    >>> study.rows[0].kernel
    'cubic'
    """
    if directory is not None:
        kernels_folder(directory)  # what is in the way is reported now, not after the study
    vertices, faces, chosen = check_request(mesh, kernels or KERNELS)
    if min(centres, default=0) < 8:
        raise UsageError(f"centres must be numbers of at least 8, got {list(centres)}")
    judge = ReferenceSurface(vertices, faces, resolution)
    study = measure_fits(judge, chosen, centres, progress)
    study.units = units
    if directory is not None:
        write_studies({"mesh": study}, directory)
    return study
