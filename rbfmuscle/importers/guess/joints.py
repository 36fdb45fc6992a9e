"""Which bone hangs on which, and about what it turns: from the faces that look at each other.

A joint is where two bones face each other closely. The bones' tree is the one with the greatest facing area.
A ball fits where the normals of the convex face meet in one point; a hinge where they meet one line, found as
the axis of the cylinder that fits the dome of the face. Both follow from the face's slippable motions (Gelfand
and Guibas 2004, Shape segmentation using local slippage analysis). Knee, ankle and patella have methods of their own.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from rbfmuscle.importers.guess.anatomical import as_anatomy_has_it, place_patellae, set_rest
from rbfmuscle.importers.guess.anatomy import JOINTS, PARENTS, ROOTS
from rbfmuscle.importers.guess.landmarks import HEAD, fit_coaxial, fit_sphere
from rbfmuscle.importers.guess.orientation import Orientation

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
        ``"ball"``, ``"hinge"``, ``"custom"`` (the patella) or ``"fixed"``.
    centre : (3,) ndarray [scene unit]
    axes : dict of str to (3,) ndarray
        Axis of each coordinate.
    confidence : float
        0 to 1: one minus half the misfit over the greatest allowed, where something was fitted.
    reason : str
    name : str
        Of the joint in the scene.
    ranges : dict of str to (float, float)
        Of coordinates [degree].
    rest : float
        Value of the first coordinate in the pose of the meshes [degree].
    path : PatellaPath or None
    follows : tuple of str
        Full name of the coordinate that the first one follows.
    """

    parent: Any
    child: Any
    kind: str
    centre: np.ndarray
    axes: dict[str, np.ndarray]
    confidence: float
    reason: str
    name: str = ""
    ranges: dict[str, tuple] = field(default_factory=dict)
    rest: float = 0.0
    path: Any = None
    follows: tuple[str, ...] = ()

    @property
    def coordinate(self) -> str:
        """Full name of the first coordinate."""
        return f"{self.name}.{next(iter(self.axes))}"

    def pose(self, angle: float) -> np.ndarray:
        """Motion (4, 4) of the child when the first coordinate is turned by an angle [degree] from rest."""
        if self.path is not None:
            return self.path.pose(angle)
        motion = np.eye(4)
        motion[:3, :3] = Rotation.from_rotvec(np.radians(angle) * next(iter(self.axes.values()))).as_matrix()
        motion[:3, 3] = self.centre - motion[:3, :3] @ self.centre
        return motion


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
        mesh, other = first.mesh, second.mesh
        reach = (FARTHEST + band) * millimetre
        centres = np.asarray(mesh.triangles_center)
        low, high = np.asarray(other.bounds)
        close = np.flatnonzero(((centres > low - reach) & (centres < high + reach)).all(axis=1))
        self.points, self.normals, self.weights = np.empty((0, 3)), np.empty((0, 3)), np.empty(0)
        self.gap, self.area = np.inf, 0.0
        distance, nearest = second.tree.query(centres[close], distance_upper_bound=reach)
        inside = np.isfinite(distance)
        if not inside.any():
            return
        close, distance, nearest = close[inside], distance[inside], nearest[inside]
        centres, normals = centres[close], np.asarray(mesh.face_normals)[close]
        way = (other.triangles_center[nearest] - centres) / np.maximum(distance, 1e-12)[:, None]
        look = np.einsum("ij,ij->i", normals, way)
        opposed = -np.einsum("ij,ij->i", normals, other.face_normals[nearest])
        self.gap = float(distance.min()) / millimetre
        near = (distance < distance.min() + band * millimetre) & (look > LOOK) & (opposed > OPPOSED)
        self.points, self.normals = centres[near], normals[near]
        self.weights = np.asarray(mesh.area_faces)[close][near]
        self.area = float(self.weights.sum()) / millimetre**2

    def dome(self) -> Any:
        """The part whose normals lie about their mean."""
        mean = self.weights @ self.normals
        near = self.normals @ (mean / max(float(np.linalg.norm(mean)), 1e-300)) > DOME
        return self.points[near], self.normals[near], self.weights[near]


def guess_joints(
    bones: list[Any], millimetre: float, orientation: Orientation | None = None
) -> tuple[Any, list[JointGuess]]:
    """The bone that stands still, and a joint for every other bone that has one.

    Parameters
    ----------
    bones : list of Part
    millimetre : float
        Length of a millimetre in scene units.
    orientation : Orientation, optional
        Gives axes their signs; without it there are balls and hinges of any sign.
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
            placed.append(_root([bone for bone in bones if not _among(bone, placed)]))
            continue
        parent, child = link
        i, j = _place(bones, child), _place(bones, parent)
        joint = _fit(parent, child, millimetre, gaps[i, j], areas[i, j])
        if orientation is not None:
            joint = as_anatomy_has_it(joint, bones, joints, orientation, millimetre)
        joint.name = _name(joint, bones)
        joints.append(joint)
        placed.append(child)
    if orientation is not None:
        set_rest(joints, bones, orientation)
        place_patellae(joints, orientation, millimetre)
    return roots[0], joints


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
            value = 0.0 if _among(child, placed) else areas[i, j] * _likelihood(parent, child)
            if value > score:
                best, score = (parent, child), value
    return best


def _likelihood(parent, child):
    """How much more a link counts for what the names of its bones tell."""
    if parent.side and child.side and parent.side != child.side:
        return 1.0 if parent.kind == child.kind == "pelvis" else 1e-3
    wanted = [kind for kind, _ in PARENTS.get(child.kind, ())]
    if parent.kind in wanted:
        return 100.0 / (1 + wanted.index(parent.kind))
    return 1e-2 if wanted and parent.kind else 1.0


def _name(joint, bones):
    """The anatomical name where the joint is one, with its side where the scene has both."""
    name = JOINTS.get(joint.child.kind)
    if name is None or joint.parent.kind not in dict(PARENTS[joint.child.kind]) or joint.kind == "fixed":
        return f"{joint.child.name}_joint"
    same = [bone for bone in bones if bone.kind == joint.child.kind]
    if len(same) == 1:
        return name
    sides = {bone.side for bone in same}
    return (
        f"{name}_{joint.child.side}"
        if len(sides) == len(same) and "" not in sides
        else f"{name}_{joint.child.name}"
    )


def _fit(parent, child, millimetre, gap, area):
    """The joint between two bones: ball, hinge or fixed, by what fits and by what the names say."""
    named = dict(PARENTS.get(child.kind, ())).get(parent.kind, "")
    faces = [Facing(a, b, millimetre) for a, b in ((parent, child), (child, parent))]
    ball = min((fit_ball(face) for face in faces), key=lambda fit: fit[2] / max(fit[1], 1e-300))
    low, high = HEAD if child.kind == "femur" else (0.0, np.inf)
    allowed = low <= ball[1] / millimetre <= high
    fits_ball = ball[1] > 0 and ball[2] < BALL_MISFIT * ball[1] and ball[3] > BALL_COVER and allowed
    hinge = _rolling_face(parent, child, millimetre, max(BAND, 0.5 * np.sqrt(area)))
    fits_hinge = hinge is not None and hinge[3] < HINGE_MISFIT * hinge[2]
    kind = named or ("ball" if fits_ball else "fixed" if gap < BOUND else "hinge" if fits_hinge else "fixed")
    if kind == "ball":
        sure = 1.0 - 0.5 * ball[2] / (BALL_MISFIT * ball[1]) if fits_ball else 0.1
        why = f"ball of radius {ball[1]:.4g}, misfit {ball[2]:.2g}, of a hemisphere {100 * min(ball[3], 1.0):.0f} %"
        why += "" if allowed else f"; anatomy has {low:g} to {high:g} mm"
        axes = {f"rotation_{word}": axis for word, axis in zip("xyz", np.eye(3))}
        return JointGuess(parent, child, "ball", ball[0], axes, sure, why)
    if kind == "hinge" and hinge is not None:
        sure = 0.6 * max(1.0 - 0.5 * hinge[3] / (HINGE_MISFIT * hinge[2]), 0.0)
        why = f"cylinder of radius {hinge[2]:.4g}, misfit {hinge[3]:.2g}, about the dome where they face"
        return JointGuess(parent, child, "hinge", hinge[0], {"angle": hinge[1]}, sure, why)
    middle = faces[1].points.mean(axis=0) if area > 1.0 else child.points.mean(axis=0)
    why = f"they are {gap:.2g} mm apart" + (
        ", bound all over" if gap < BOUND else "; neither ball nor hinge fits"
    )
    return JointGuess(parent, child, "fixed", middle, {}, 0.8 if gap < BOUND else 0.6 if named else 0.4, why)


def fit_ball(facing: Any) -> tuple[np.ndarray, float, float, float]:
    """Centre, radius, misfit (RMS) and share of a hemisphere covered, of the sphere that fits a face."""
    points, weights = facing.points, facing.weights
    if len(points) < 12:
        return np.zeros(3), 0.0, np.inf, 0.0
    centre, radius = fit_sphere(points, weights)
    away = np.linalg.norm(points - centre, axis=1) - radius
    misfit = float(np.sqrt(np.average(away**2, weights=weights)))
    return centre, radius, misfit, float(weights.sum() / max(2.0 * np.pi * radius**2, 1e-300))


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
    up = weights @ normals
    _, starts = np.linalg.eigh((normals * weights[:, None]).T @ normals)
    fits = []
    for start in starts.T:
        across = [
            v / np.linalg.norm(v)
            for v in (np.cross(start, up), np.cross(np.cross(start, up), start))
            if v.any()
        ]
        if len(across) == 2:
            flat = np.column_stack([points @ v for v in across])
            centre, radius = fit_sphere(flat, weights)
            begin = middle + np.column_stack(across) @ (centre - middle @ np.column_stack(across))
            fits.append(
                fit_coaxial([(points, weights)], begin, start, across[1], np.array([radius]), 0.02 * size)
            )
    centre, axis, radii, misfit = min(fits, key=lambda fit: fit[3])
    return centre + (points.mean(axis=0) - centre) @ axis * axis, axis, float(radii[0]), misfit
