"""One bone's distance field: its size, its time, its errors against exact distances, and a slice to look at."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.geometry.exact_distance import ExactDistance
from rbfmuscle.sim.distance.sdf import BoneSDF
from rbfmuscle.validation import UsageError

if TYPE_CHECKING:
    import trimesh


# Points of each measurement, and pixels along the longer side of a slice.
COUNT, PIXELS = 50_000, 500
# Half width of the band of the errors, in mean edges of the mesh.
BAND_EDGES = 1.0


def sdf_report(
    mesh: trimesh.Trimesh,
    *,
    image: Path | None = None,
    axis: str = "y",
    tolerance: Any = None,
    region: Any = None,
    cache: bool = True,
    name: str = "bone",
    seed: int = 0,
) -> dict[str, Any]:
    """Build one field, measure it and draw it.

    Parameters
    ----------
    mesh : trimesh.Trimesh or pair of (n, 3) vertices and (m, 3) faces
    image : path, optional
        PNG of a slice with contour lines.
    axis : {"x", "y", "z"}
        Normal of the slice, which goes through the middle of the bone.
    tolerance, region, cache, name
        As for :meth:`BoneSDF.from_mesh`.
    seed : int
        Of the random points.

    Returns
    -------
    dict
        ``name, vertices, faces, closed, notes, build_time [s], memory [bytes], spacing, band, fine_cells`` and the
        entries of :func:`measure_field`.
    """
    if axis not in ("x", "y", "z"):
        raise UsageError(f"the slice's axis must be x, y or z, got {axis!r}")
    start = time.perf_counter()
    field = BoneSDF.from_mesh(mesh, tolerance=tolerance, region=region, cache=cache, name=name)
    report = {
        "name": name,
        "vertices": len(field.vertices),
        "faces": len(field.faces),
        "closed": field.closed,
        "notes": list(field.notes),
        "build_time": time.perf_counter() - start,
        "memory": field.memory,
        "spacing": field.spacing,
        "band": field.band,
        "fine_cells": field.fine_cells,
    }
    report.update(measure_field(field, seed=seed))
    if image is not None:
        draw_slice(field, image, axis=axis, title=name)
        report["image"] = str(image)
    return report


def measure_field(
    field: BoneSDF, *, count: int = COUNT, seed: int = 0, width: float | None = None
) -> dict[str, float]:
    """Errors of a field, or of a detector beside it, against exact distances at random points near the surface.

    Parameters
    ----------
    field : BoneSDF
        Or anything with its ``distance_and_gradient``, and ``vertices`` and ``faces``.
    count : int
    seed : int
    width : float, optional
        Points lie within this distance of the surface; by default a mean edge of the mesh.

    Returns
    -------
    dict
        ``width, error_rms, error_max, sign_wrong`` (share of the points), ``angle_median, angle_p99`` (degrees,
        between the gradient and the exact direction; the median over all points, creases included),
        ``time_value, time_gradient`` (seconds a point).
    """
    exact = ExactDistance(field.vertices, field.faces)
    points, width = points_near(field.vertices, field.faces, count, seed=seed, width=width)
    distance, closest, _, _ = exact.nearest(points)
    if not field.closed:
        # Without a mesh that tells inside from outside only sizes can be compared.
        distance = np.abs(distance) * np.sign(field.distance(points))
    field.distance_and_gradient(points[:64])
    start = time.perf_counter()
    found, gradient = field.distance_and_gradient(points)
    middle = time.perf_counter()
    field.distance(points)
    end = time.perf_counter()
    away = np.abs(distance) > 1e-3 * width
    exact_direction = (points[away] - closest[away]) / distance[away, None]
    cosine = np.einsum("ni,ni->n", gradient[away], exact_direction)
    angle = np.degrees(np.arccos(np.clip(cosine / np.linalg.norm(gradient[away], axis=1), -1.0, 1.0)))
    error = found - distance
    return {
        "width": width,
        "error_rms": float(np.sqrt(np.mean(error**2))),
        "error_max": float(np.abs(error).max()),
        "sign_wrong": float(np.mean(found * distance < 0.0)),
        "angle_median": float(np.median(angle)),
        "angle_p99": float(np.percentile(angle, 99)),
        "time_value": (end - middle) / count,
        "time_gradient": (middle - start) / count,
    }


def points_near(
    vertices: Floats, faces: Integers, count: int, *, seed: int = 0, width: Any = None
) -> tuple[Floats, float]:
    """Random points (count, 3) up to ``width`` from the surface, along the faces' normals; and the width."""
    rng = np.random.default_rng(seed)
    corners = vertices[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(normal, axis=1)
    if width is None:
        width = BAND_EDGES * float(np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).mean())
    face = rng.choice(len(area), count, p=area / area.sum())
    points = np.einsum("nk,nkj->nj", rng.dirichlet(np.ones(3), count), corners[face])
    offset = rng.uniform(-width, width, (count, 1))
    return points + offset * normal[face] / area[face, None], width


def report_lines(report: dict[str, Any], units: str = "") -> list[str]:
    """The report as lines of text for a terminal; ``units`` is the name of the mesh's unit."""
    length = (" " + units) if units else ""
    lines = [
        f"{report['name']}: {report['vertices']} vertices, {report['faces']} faces, "
        + ("closed" if report["closed"] else "signed by winding numbers"),
        *[f"  {note}" for note in report["notes"]],
        f"  built or loaded in {report['build_time']:.3f} s, {report['memory'] / 1e6:.1f} MB, "
        f"{report['fine_cells']} fine cells of {report['spacing']:.4g}{length}",
        f"  within {report['width']:.3g}{length} of the surface: {report['error_rms']:.2g}{length} RMS, "
        f"{report['error_max']:.2g}{length} worst, sign wrong for {100 * report['sign_wrong']:.4f} %",
        f"  direction of the gradient: {report['angle_median']:.2g} degrees median, "
        f"{report['angle_p99']:.2g} degrees for 99 %",
        f"  a value {1e9 * report['time_value']:.0f} ns, with gradient {1e9 * report['time_gradient']:.0f} ns",
    ]
    if "image" in report:
        lines.append(f"  slice in {report['image']}")
    return lines


def draw_slice(field: BoneSDF, path: Path, *, axis: str = "y", title: str = "", pixels: int = PIXELS) -> None:
    """Draw distances on a plane through the middle of the bone, with contour lines, to a PNG file."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    normal = "xyz".index(axis)
    across, up = [k for k in range(3) if k != normal]
    low, high = field.bounds
    margin = 0.08 * (high - low).max()
    spans = [(low[k] - margin, high[k] + margin) for k in (across, up)]
    step = max(b - a for a, b in spans) / pixels
    u, v = (np.arange(a, b, step) for a, b in spans)
    points = np.empty((len(v), len(u), 3))
    points[..., normal] = 0.5 * (low[normal] + high[normal])
    points[..., across], points[..., up] = u[None, :], v[:, None]
    values = field.distance(points.reshape(-1, 3)).reshape(len(v), len(u))

    figure = Figure(
        figsize=(2.0 + 6.0 * len(u) / max(len(u), len(v)), 1.0 + 7.0 * len(v) / max(len(u), len(v)))
    )
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    most = float(np.abs(values).max())
    picture = axes.pcolormesh(u, v, values, cmap="RdBu", vmin=-most, vmax=most, shading="nearest")
    levels = np.arange(1, 9) * most / 8
    axes.contour(u, v, values, levels=np.concatenate([-levels[::-1], levels]), colors="0.4", linewidths=0.4)
    if values.min() < 0.0 < values.max():
        axes.contour(u, v, values, levels=[0.0], colors="black", linewidths=1.2)
    axes.set(aspect="equal", xlabel="xyz"[across], ylabel="xyz"[up], title=title)
    figure.colorbar(picture, ax=axes, label="signed distance")
    figure.savefig(path, dpi=130, bbox_inches="tight")
