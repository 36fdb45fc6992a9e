"""Which bone hangs on which, and about what it turns: from the faces that look at each other.

A joint is where two bones face each other closely. The bones' tree is the one with the greatest facing area.
A ball fits where the normals of the convex face meet in one point; a hinge where they meet one line, found as
the axis of the cylinder that fits the dome of the face. Both follow from the face's slippable motions (Gelfand
and Guibas 2004, Shape segmentation using local slippage analysis).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.optimize import least_squares

from rbfmuscle.importers.guess.anatomy import PARENTS, ROOTS

# Width [mm] beyond the least gap within which faces face each other.
BAND = 8.0
# Least cosine between a face's normal and the way to the other bone, and between the two opposed normals.
LOOK, OPPOSED = 0.3, 0.0
# Faces farther apart than this [mm] are no joint.
FARTHEST = 25.0
# Closer than this [mm] all along: grown together or bound, no cartilage in between.
BOUND = 1.5
# A ball: misfit against radius, and the least share of the sphere that its face covers.
BALL_MISFIT, BALL_COVER = 0.05, 0.3
# A hinge: misfit of the cylinder against its radius.
HINGE_MISFIT = 0.15
# Cosine of the cone of normals about their mean that is the dome of a hinge, without the cheeks beside it.
DOME = 0.8


@dataclass
class JointGuess:
    """A joint and how far to believe it.

    Attributes
    ----------
    parent, child : Part
    kind : str
        ``"ball"``, ``"hinge"`` or ``"fixed"``.
    centre : (3,) ndarray [scene unit]
    axis : (3,) ndarray or None
        Unit direction of a hinge.
    radius, misfit : float
        Of what was fitted [scene unit].
    confidence : float
        0 to 1.
    reason : str
    """

    parent: Any
    child: Any
    kind: str
    centre: np.ndarray
    axis: np.ndarray | None
    radius: float
    misfit: float
    confidence: float
    reason: str


class Facing:
    """Faces of one bone that look at another nearby.

    Parameters
    ----------
    first, second : Part
    millimetre : float
        Length of a millimetre in scene units.
    band : float
        Beyond the least gap [mm].
    """

    def __init__(self, first: Any, second: Any, millimetre: float, band: float = BAND) -> None:
        a, b = first.mesh, second.mesh
        centres, normals = np.asarray(a.triangles_center), np.asarray(a.face_normals)
        reach = (FARTHEST + band) * millimetre
        low, high = np.asarray(b.bounds)
        close = np.flatnonzero(((centres > low - reach) & (centres < high + reach)).all(axis=1))
        self.points, self.normals, self.weights = np.empty((0, 3)), np.empty((0, 3)), np.empty(0)
        self.gap, self.area = np.inf, 0.0
        if len(close) == 0:
            return
        centres, normals = centres[close], normals[close]
        distance, nearest = second.tree.query(centres, distance_upper_bound=reach)
        inside = np.flatnonzero(np.isfinite(distance))
        if len(inside) == 0:
            return
        centres, normals, distance, nearest = (
            centres[inside],
            normals[inside],
            distance[inside],
            nearest[inside],
        )
        way = (b.triangles_center[nearest] - centres) / np.maximum(distance, 1e-12)[:, None]
        look = np.einsum("ij,ij->i", normals, way)
        opposed = -np.einsum("ij,ij->i", normals, b.face_normals[nearest])
        self.gap = float(distance.min()) / millimetre
        near = (distance < distance.min() + band * millimetre) & (look > LOOK) & (opposed > OPPOSED)
        self.points, self.normals = centres[near], normals[near]
        self.weights = np.asarray(a.area_faces)[close][inside][near]
        self.area = float(self.weights.sum()) / millimetre**2

    def dome(self) -> Any:
        """The part whose normals lie about their mean."""
        mean = self.weights @ self.normals
        near = self.normals @ (mean / max(float(np.linalg.norm(mean)), 1e-300)) > DOME
        return self.points[near], self.normals[near], self.weights[near]


def guess_joints(bones: list[Any], millimetre: float) -> tuple[Any, list[JointGuess]]:
    """The bone that stands still, and a joint for every other bone that has one.

    Parameters
    ----------
    bones : list of Part
    millimetre : float
        Length of a millimetre in scene units.
    """
    areas = np.zeros((len(bones), len(bones)))
    gaps = np.full(areas.shape, np.inf)
    for i, first in enumerate(bones):
        for j in range(i):
            if _far_apart(first, bones[j], millimetre):
                continue
            facing = Facing(first, bones[j], millimetre)
            gaps[i, j] = gaps[j, i] = facing.gap
            if facing.gap <= FARTHEST:
                areas[i, j] = areas[j, i] = max(facing.area, 1e-3)
    roots = [_root(bones)]
    placed, joints = list(roots), []
    while len(placed) < len(bones):
        link = _next_link(bones, placed, areas)
        if link is None:  # nothing faces what is placed: it stands by itself
            rest = [bone for bone in bones if not _among(bone, placed)]
            placed.append(_root(rest))
            continue
        parent, child = link
        i, j = _place(bones, child), _place(bones, parent)
        joints.append(_fit(parent, child, millimetre, gaps[i, j], areas[i, j]))
        placed.append(child)
    _patella_about_the_knee(joints)
    return roots[0], joints


def _patella_about_the_knee(joints):
    """The patella glides around the condyles: no face of its own tells its axis, the knee's is nearer."""
    knees = {id(j.parent): j for j in joints if j.kind == "hinge" and j.child.kind == "tibia"}
    for joint in joints:
        knee = knees.get(id(joint.parent)) if joint.child.kind == "patella" else None
        if knee is not None:
            joint.kind, joint.centre, joint.axis = "hinge", knee.centre, knee.axis
            joint.radius, joint.misfit, joint.confidence = knee.radius, knee.misfit, 0.4
            joint.reason = "it glides about the axis of the knee; its path is no exact hinge"


def _among(part, parts):
    return any(part is other for other in parts)


def _place(parts, part):
    return next(k for k, other in enumerate(parts) if other is part)


def _far_apart(first, second, millimetre):
    a, b = first.mesh.bounds, second.mesh.bounds
    return bool((np.maximum(a[0] - b[1], b[0] - a[1]) > FARTHEST * millimetre).any())


def _root(bones):
    """By name what the limb hangs on, else the largest."""
    for kind in ROOTS:
        named = [bone for bone in bones if bone.kind == kind]
        if named:
            return max(named, key=lambda bone: bone.mesh.area)
    return max(bones, key=lambda bone: bone.mesh.area)


def _next_link(bones, placed, areas):
    """Parent and child of the link to take next: one that anatomy names, else the greatest facing area."""
    best, score = None, 0.0
    for j, parent in enumerate(bones):
        if not _among(parent, placed):
            continue
        for i, child in enumerate(bones):
            if _among(child, placed) or areas[i, j] <= 0.0:
                continue
            value = areas[i, j] * _likelihood(parent, child)
            if value > score:
                best, score = (parent, child), value
    return best


def _likelihood(parent, child):
    """How much more a link counts for what the names of its bones tell."""
    if parent.side and child.side and parent.side != child.side:
        return 1e-3
    wanted = [kind for kind, _ in PARENTS.get(child.kind, ())]
    if parent.kind in wanted:
        return 100.0 / (1 + wanted.index(parent.kind))
    return 1e-2 if wanted and parent.kind else 1.0


def _fit(parent, child, millimetre, gap, area):
    """The joint between two bones: ball, hinge or fixed, by what fits and by what the names say."""
    named = next((kind for name, kind in PARENTS.get(child.kind, ()) if name == parent.kind), "")
    ball = min(
        (fit_ball(Facing(a, b, millimetre)) for a, b in ((parent, child), (child, parent))), key=_merit
    )
    fits_ball = ball[1] > 0 and ball[2] < BALL_MISFIT * ball[1] and ball[3] > BALL_COVER
    wide = max(BAND, 0.5 * np.sqrt(area))
    hinge = _rolling_face(parent, child, millimetre, wide)
    fits_hinge = hinge is not None and hinge[3] < HINGE_MISFIT * hinge[2]
    middle = (
        Facing(child, parent, millimetre).points.mean(axis=0) if area > 1.0 else child.points.mean(axis=0)
    )
    kind = named or ("ball" if fits_ball else "fixed" if gap < BOUND else "hinge" if fits_hinge else "fixed")
    if kind == "hinge" and hinge is None:
        kind = "fixed"
    if kind == "ball":
        sure = 0.9 if fits_ball else 0.3
        why = f"ball of radius {ball[1]:.4g}, misfit {ball[2]:.2g}, of a hemisphere {100 * min(ball[3], 1.0):.0f} %"
        return JointGuess(parent, child, "ball", ball[0], None, ball[1], ball[2], sure, why)
    if kind == "hinge":
        sure = 0.8 if fits_hinge and named else 0.6 if fits_hinge else 0.3
        why = f"cylinder of radius {hinge[2]:.4g}, misfit {hinge[3]:.2g}, about the dome where they face"
        return JointGuess(parent, child, "hinge", hinge[0], hinge[1], hinge[2], hinge[3], sure, why)
    close = gap < BOUND
    why = f"they are {gap:.2g} mm apart" + (", bound all over" if close else "; neither ball nor hinge fits")
    return JointGuess(parent, child, "fixed", middle, None, 0.0, 0.0, 0.8 if close or named else 0.4, why)


def _merit(ball):
    return ball[2] / max(ball[1], 1e-300)


def fit_ball(facing: Any) -> tuple[np.ndarray, float, float, float]:
    """Centre, radius, misfit (RMS) and share of a hemisphere covered, of the sphere that fits a face."""
    points, weights = facing.points, facing.weights
    if len(points) < 12:
        return np.zeros(3), 0.0, np.inf, 0.0
    middle = np.average(points, axis=0, weights=weights)
    local, root = points - middle, np.sqrt(weights)
    matrix = np.column_stack([2.0 * local, np.ones(len(local))]) * root[:, None]
    x = np.linalg.lstsq(matrix, (local**2).sum(axis=1) * root, rcond=None)[0]
    radius = float(np.sqrt(max(x[3] + x[:3] @ x[:3], 0.0)))
    away = np.linalg.norm(local - x[:3], axis=1) - radius
    misfit = float(np.sqrt(np.average(away**2, weights=weights)))
    return middle + x[:3], radius, misfit, float(weights.sum() / max(2.0 * np.pi * radius**2, 1e-300))


def _rolling_face(parent, child, millimetre, band):
    """The cylinder that fits the rounder of two faces: what rolls has the smaller radius, not its socket."""
    fits = [fit_hinge(Facing(a, b, millimetre, band)) for a, b in ((parent, child), (child, parent))]
    fits = [fit for fit in fits if fit is not None]
    return min(fits, key=lambda fit: (fit[3] > HINGE_MISFIT * fit[2], fit[2])) if fits else None


def fit_hinge(facing: Any) -> tuple[np.ndarray, np.ndarray, float, float] | None:
    """Centre, unit axis, radius and misfit (RMS) of the cylinder that fits the dome of a face."""
    points, normals, weights = facing.dome()
    if len(points) < 20:
        return None
    middle = np.average(points, axis=0, weights=weights)
    size = float(np.sqrt(np.average(((points - middle) ** 2).sum(axis=1), weights=weights)))
    root = np.sqrt(weights / weights.mean())
    _, starts = np.linalg.eigh((normals * weights[:, None]).T @ normals)
    fits = [_fit_cylinder((points - middle) / size, root, start) for start in starts.T]
    _, axis, through, radius, misfit = min(fits, key=lambda fit: fit[0])
    along = points @ axis  # the centre lies on the axis, in the middle of the face
    centre = middle + size * through
    return centre + (along.mean() - centre @ axis) * axis, axis, size * radius, size * misfit


def _fit_cylinder(points, root, start):
    """Cost, axis, point, radius and misfit of a cylinder, from a direction on; points of order one."""
    across = np.linalg.svd(start[None])[2][1:]
    flat = points @ across.T
    matrix = np.column_stack([2.0 * flat, np.ones(len(flat))]) * root[:, None]
    x = np.linalg.lstsq(matrix, (flat**2).sum(axis=1) * root, rcond=None)[0]
    radius = np.sqrt(max(x[2] + x[:2] @ x[:2], 1e-12))

    def residual(y):
        axis = start + y[:2] @ across
        offset = points - y[2:4] @ across
        axis = axis / np.linalg.norm(axis)
        return root * (np.linalg.norm(offset - np.outer(offset @ axis, axis), axis=1) - y[4])

    found = least_squares(
        residual, np.r_[0.0, 0.0, x[:2], radius], loss="soft_l1", f_scale=0.02, max_nfev=200
    )
    axis = start + found.x[:2] @ across
    misfit = float(np.sqrt(np.mean(residual(found.x) ** 2)))
    return found.cost, axis / np.linalg.norm(axis), found.x[2:4] @ across, float(found.x[4]), misfit
