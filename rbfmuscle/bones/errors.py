"""Errors of a bone's distance field against exact distances."""

import numpy as np

from rbfmuscle.bones.mesh import mean_edge, points_near
from rbfmuscle.bones.sdf import BoneSDF
from rbfmuscle.geometry.exact_distance import ExactDistance


def measure_field(field: BoneSDF, *, count: int = 50_000) -> dict[str, float]:
    """Errors of a field against exact distances at random points near the surface.

    ``width`` is a mean edge of the mesh, up to which points lie away; ``error_rms``, ``error_max``;
    ``sign_wrong`` a share of the points; ``angle_median`` [degree] between the gradient and the
    exact direction.
    """
    exact = ExactDistance(field.vertices, field.faces)
    width = mean_edge(field.vertices, field.faces)
    points = points_near(field.vertices, field.faces, count, width)
    distance, closest, _, _ = exact.nearest(points)
    found, gradient = field.distance_and_gradient(points)
    if not field.closed:  # only sizes can be compared
        distance = np.abs(distance) * np.sign(found)
    away = np.abs(distance) > 1e-3 * width
    direction = (points[away] - closest[away]) / distance[away, None]
    cosine = np.einsum("ni,ni->n", gradient[away], direction) / np.linalg.norm(
        gradient[away], axis=1
    )
    error = found - distance
    return {
        "width": width,
        "error_rms": float(np.sqrt(np.mean(error**2))),
        "error_max": float(np.abs(error).max()),
        "sign_wrong": float(np.mean(found * distance < 0.0)),
        "angle_median": float(np.median(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))),
    }
