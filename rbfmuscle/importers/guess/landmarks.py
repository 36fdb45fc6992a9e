"""Axes of the knee and of the ankle from the shapes of the bones.

Knee: the line through the centres of spheres fitted to the posterior part of both condyles (Kurosawa et al. 1985;
Iwaki et al. 2000; the cylindrical axis of Eckhoff et al. 2005). Ankle: the cylinder of the talar dome, fitted with the
tibial plafond above it, each with its own radius (Singh et al. 1992; Siegler et al. 2014).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import least_squares
from scipy.spatial import ConvexHull

# Radii that anatomy allows [mm]: head of the femur, posterior condyle, talar dome, all from child to large adult.
HEAD, CONDYLE, DOME = (12.0, 35.0), (11.0, 30.0), (11.0, 27.0)
# Fewest triangles that a fit takes its points from.
FEWEST = 3000
# Share of the femur's length that holds an end, and its condyles.
END, CONDYLES = 0.12, 0.16
# Normals of a condyle that count: from above (-) to below the backward direction [degree], greatest cosine sideways.
POSTERIOR, SIDEWAYS = (-30.0, 60.0), 0.5
# Of the dome: half its arc [degree], band beyond the least gap [mm], least cosine of a normal and its radius.
ARC, BAND, RADIAL = 45.0, 8.0, 0.95


@dataclass
class Frame:
    """Directions of a long bone, unit (3,): ``superior`` along its shaft, ``anterior``, ``right``; and its middle."""

    superior: np.ndarray
    anterior: np.ndarray
    right: np.ndarray
    middle: np.ndarray


@dataclass
class AxisFit:
    """An axis: point on it, unit direction, radii and misfit (RMS) [scene unit]; why it is refused, if it is."""

    centre: np.ndarray
    axis: np.ndarray
    radii: tuple
    misfit: float
    wrong: str = ""


def _faces(part):
    """Middles, normals and areas of the triangles; those of a coarse mesh are divided."""
    mesh = part.mesh
    while len(mesh.faces) < FEWEST:
        mesh = mesh.subdivide()
    return np.asarray(mesh.triangles_center), np.asarray(mesh.face_normals), np.asarray(mesh.area_faces)


def main_axes(points: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Weighted mean (3,) and principal directions in columns, the shortest first."""
    middle = np.average(points, axis=0, weights=weights)
    away = points - middle
    return middle, np.linalg.eigh((away * weights[:, None]).T @ away)[1]


def long_axis(part: Any, below: list[Any], above: list[Any]) -> tuple[np.ndarray, np.ndarray]:
    """Middle and direction (up) of a long bone; up is away from the bones ``below``, or towards those ``above``."""
    points, _, areas = _faces(part)
    middle, axes = main_axes(points, areas)
    up = axes[:, 2]
    others = [
        (other.points.mean(axis=0) - middle) @ up * sign
        for group, sign in ((below, -1), (above, 1))
        for other in group
    ]
    if others:
        return middle, up * np.sign(sum(others) or 1.0)
    along = points @ up
    low, high = along.min(), along.max()
    width = END * (high - low)  # the broad end: condyles of the femur
    return middle, up if areas[along < low + width].sum() > areas[along > high - width].sum() else -up


def femur_frame(femur: Any, below: list[Any], above: list[Any]) -> Frame:
    """Directions of a femur by its own shape: shaft, breadth of the condyles, which lie behind the shaft."""
    points, _, areas = _faces(femur)
    _, up = long_axis(femur, below, above)
    along = points @ up
    low, length = along.min(), np.ptp(along)
    shaft = (along > low + 0.3 * length) & (along < low + 0.7 * length)
    middle, axes = main_axes(points[shaft], areas[shaft])
    up = axes[:, 2] * np.sign(axes[:, 2] @ up)
    end = along < low + 0.1 * length
    across = points[end] - middle
    across = across - np.outer(across @ up, up)
    behind, axes = main_axes(across, areas[end])
    anterior = np.cross(up, axes[:, 2])
    anterior *= -np.sign(anterior @ behind) / np.linalg.norm(anterior)
    return Frame(up, anterior, np.cross(anterior, up), middle)


def femur_side(femur: Any, frame: Frame) -> str:
    """``"l"`` or ``"r"``: the head lies to the body's middle."""
    points, _, areas = _faces(femur)
    along = points @ frame.superior
    top = along > along.max() - END * np.ptp(along)
    return (
        "r" if (np.average(points[top], axis=0, weights=areas[top]) - frame.middle) @ frame.right < 0 else "l"
    )


def sole_direction(points: np.ndarray, right: np.ndarray, up: np.ndarray) -> np.ndarray:
    """Direction (3,) forwards on the sole of a foot: the longest side below its outline, seen from the side."""
    top = up - up @ right * right
    top = top / np.linalg.norm(top)
    front = np.cross(top, right)
    flat = np.column_stack([points @ front, points @ top])
    corners = flat[ConvexHull(flat).vertices]  # in the plane, against the clock: forwards below
    sides = np.roll(corners, -1, axis=0) - corners
    longest = sides[np.argmax(np.where(sides[:, 0] > 0.0, np.hypot(*sides.T), 0.0))]
    return longest[0] * front + longest[1] * top


def fit_sphere(points: np.ndarray, weights: np.ndarray) -> tuple[np.ndarray, float]:
    """Centre and radius of the sphere, or circle, that fits weighted points: algebraic least squares."""
    middle, root = np.average(points, axis=0, weights=weights), np.sqrt(weights)
    local = points - middle
    matrix = np.column_stack([2.0 * local, np.ones(len(local))]) * root[:, None]
    *x, last = np.linalg.lstsq(matrix, (local**2).sum(axis=1) * root, rcond=None)[0]
    return middle + x, float(np.sqrt(max(last + np.dot(x, x), 0.0)))


def fit_condyles(femur: Any, frame: Frame, millimetre: float) -> AxisFit | None:
    """The knee's axis, pointing to the body's right; None where a condyle has too few triangles."""
    points, normals, areas = _faces(femur)
    along = points @ frame.superior
    near = along < along.min() + CONDYLES * np.ptp(along)
    points, normals, areas, right = points[near], normals[near], areas[near], frame.right
    for _ in range(12):
        anterior = np.cross(frame.superior, right)
        anterior /= np.linalg.norm(anterior)
        angle = np.degrees(np.arctan2(-normals @ np.cross(right, anterior), -normals @ anterior))
        chosen = (np.abs(normals @ right) < SIDEWAYS) & (angle > POSTERIOR[0]) & (angle < POSTERIOR[1])
        if chosen.sum() < 24:
            return None
        side = points @ right - 0.5 * sum(f(points[chosen] @ right) for f in (np.min, np.max))
        groups = [chosen & (side < 0), chosen & (side > 0)]
        if min(group.sum() for group in groups) < 12:
            return None
        fits = [_fit_condyle(points[g], normals[g], areas[g], millimetre) for g in groups]
        before, right = right, fits[1][0] - fits[0][0]
        right = right / np.linalg.norm(right)
        if right @ before > 1.0 - 1e-9:
            break
    radii = tuple(fit[1] for fit in fits)
    misfit = float(np.sqrt(np.mean([fit[2] ** 2 for fit in fits])))
    wrong = _refused("condyle", radii, CONDYLE, millimetre)
    return AxisFit(0.5 * (fits[0][0] + fits[1][0]), right, radii, misfit, wrong)


def _fit_condyle(points, normals, areas, millimetre):
    """Centre, radius and misfit of a sphere; what does not lie on it loses its weight."""
    weights = areas
    for _ in range(15):
        centre, radius = fit_sphere(points, weights)
        away = np.linalg.norm(points - centre, axis=1)
        cosine = np.einsum("ij,ij->i", normals, points - centre) / np.maximum(away, 1e-12)
        off = (away - radius) / (1.5 * millimetre)
        weights = areas * (np.exp(-(off**2)) * (cosine > 0.8) + 1e-9)
    return centre, radius, float(np.sqrt(np.average((away - radius) ** 2, weights=weights)))


def _refused(what, radii, allowed, millimetre):
    low, high = allowed
    bad = [radius / millimetre for radius in radii if not low <= radius / millimetre <= high]
    return f"a {what} of radius {bad[0]:.3g} mm, anatomy has {low:g} to {high:g}" if bad else ""


def fit_dome(talus: Any, tibia: Any, up: np.ndarray, right: np.ndarray, millimetre: float) -> AxisFit | None:
    """The ankle's axis, pointing to the body's right; None where talus and tibia show no dome.

    Parameters
    ----------
    talus, tibia : Part
    up : (3,) ndarray
        Along the tibia.
    right : (3,) ndarray
        About along the axis.
    """
    patches = [_near_faces(talus, tibia, millimetre, 1.0), _near_faces(tibia, talus, millimetre, -1.0)]
    right = right - right @ up * up
    right = right / np.linalg.norm(right)
    points, normals, areas = patches[0]
    top = normals @ up > 0.8
    if top.sum() < 6:
        return None
    radii = np.array([20.0, 23.0]) * millimetre
    centre, before = np.average(points[top], axis=0, weights=areas[top]) - radii[0] * up, None
    for _ in range(40):
        chosen = [_on_cylinder(patch, centre, right, up, radius) for patch, radius in zip(patches, radii)]
        if len(chosen) == 2 and chosen[1].sum() < 8:  # no plafond: the dome alone
            patches, radii, chosen, before = patches[:1], radii[:1], chosen[:1], None
        if chosen[0].sum() < 8:
            return None
        used = [(patch[0][c], patch[2][c]) for patch, c in zip(patches, chosen)]
        centre, right, radii, misfit = fit_coaxial(used, centre, right, up, radii, 0.5 * millimetre)
        key = np.concatenate(chosen)
        if before is not None and (key == before).all():
            break
        before = key
    middle = used[0][0] @ right
    centre = centre + (middle.mean() - centre @ right) * right
    return AxisFit(
        centre, right, tuple(radii.tolist()), misfit, _refused("talar dome", radii[:1], DOME, millimetre)
    )


def _near_faces(part, other, millimetre, sign):
    points, normals, areas = _faces(part)
    distance, _ = other.tree.query(points)
    near = distance < distance.min() + BAND * millimetre
    return points[near], sign * normals[near], areas[near]


def _on_cylinder(patch, centre, right, up, radius):
    """Which faces lie on a cylinder, about its top."""
    points, normals, _ = patch
    top = up - up @ right * right
    away = points - centre
    away = away - np.outer(away @ right, right)
    distance = np.maximum(np.linalg.norm(away, axis=1), 1e-12)
    cosine = away @ top / (distance * np.linalg.norm(top))
    radial = np.einsum("ij,ij->i", normals, away) / distance
    level = np.abs(normals @ right) < SIDEWAYS
    return (
        level
        & (cosine > np.cos(np.radians(ARC)))
        & (radial > RADIAL)
        & (np.abs(distance - radius) < 0.25 * radius)
    )


def fit_coaxial(
    patches: list[tuple],
    centre: np.ndarray,
    right: np.ndarray,
    up: np.ndarray,
    radii: np.ndarray,
    soft: float,
) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Centre, axis, radii and misfit (RMS) of cylinders with one axis, from a start on.

    Parameters
    ----------
    patches : list of (points, weights)
        One cylinder each.
    up : (3,) ndarray
        Any direction across the axis.
    soft : float
        Distance from which on a point loses its weight.
    """
    top = up - up @ right * right
    top = top / np.linalg.norm(top)
    front, unit = np.cross(top, right), float(radii[0])
    roots = [np.sqrt(weights / weights.sum() / len(patches)) for _, weights in patches]

    def residual(x):
        axis = right + x[0] * front + x[1] * top
        axis = axis / np.linalg.norm(axis)
        rows = []
        for k, ((points, _), root) in enumerate(zip(patches, roots)):
            away = points - centre - unit * (x[2] * front + x[3] * top)
            rows.append(np.linalg.norm(away - np.outer(away @ axis, axis), axis=1) / unit - x[4 + k])
            rows[-1] *= root * np.sqrt(len(root))
        return np.concatenate(rows)

    found = least_squares(
        residual, np.r_[0.0, 0.0, 0.0, 0.0, radii / unit], loss="soft_l1", f_scale=soft / unit, max_nfev=200
    )
    axis = right + found.x[0] * front + found.x[1] * top
    centre = centre + unit * (found.x[2] * front + found.x[3] * top)
    misfit = np.sqrt(
        np.sum(
            [np.average(r**2) for r in np.split(residual(found.x), np.cumsum([len(r) for r in roots])[:-1])]
        )
    )
    return centre, axis / np.linalg.norm(axis), found.x[4:] * unit, float(misfit) * unit
