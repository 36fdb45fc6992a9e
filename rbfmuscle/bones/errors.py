"""Errors of a bone's distance field against exact distances."""

import time

import numpy as np

from rbfmuscle.bones.sdf import BoneSDF
from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.geometry.exact_distance import ExactDistance

# Points of each measurement.
COUNT = 50_000
# Half width of the band of the errors, in mean edges of the mesh.
BAND_EDGES = 1.0


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
    dict of str to float
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
    vertices: Floats, faces: Integers, count: int, *, seed: int = 0, width: float | None = None
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
