"""The tree of the bones and their joints, from the parts of their surfaces that face each other.

A joint is where two bones face each other closely. The bones' tree is the one with the greatest
facing area. A ball fits where the normals of the convex face meet in one point; a hinge where they
meet one line, found as the axis of the cylinder that fits the dome of the face. Both follow from
the face's slippable motions (Gelfand and Guibas 2004, Shape segmentation using local slippage
analysis). Knee, ankle and patella have methods of their own.
"""

from itertools import combinations
from typing import NamedTuple

import numpy as np

from rbfmuscle.anatomy.bones import HEAD, Fit, Orientation, Part, fit_coaxial, fit_sphere
from rbfmuscle.importers.guess.anatomy import (
    JOINTS,
    PARENTS,
    ROOTS,
    JointGuess,
    make_anatomical,
    place_patellae,
    set_rest,
)
from rbfmuscle.importers.guess.sites import BoneFrame, Site, find_site
from rbfmuscle.scene.bone import Bone
from rbfmuscle.scene.check import looking_at

CLEAR = 1.5  # via points and insertions lie so far out of bones [mm]


class Skeleton(NamedTuple):
    """What muscles are held by; ``bodies`` gives of bones that move as one the one that stands for
    all, ``frames`` and ``articular`` their axes and the points (n, 3) of their joints' surfaces;
    ``tendons`` are those that have meshes.
    """

    bones: dict[Part, Bone]
    bodies: dict[Part, Part]
    joints: list[JointGuess]
    millimetre: float
    frames: dict[Part, list[BoneFrame]]
    articular: dict[Part, np.ndarray]
    tendons: list[Part]

    def frame(self, bone: Part, points: np.ndarray) -> BoneFrame | None:
        """The frame of a bone that is nearest to some points (n, 3), of several."""
        here = points.mean(axis=0)
        frames = self.frames.get(bone, [])
        return min(frames, key=lambda f: np.linalg.norm(f.origin - here), default=None)

    def site(self, name: str, bone: Part, points: np.ndarray) -> Site | None:
        """A site on a bone, for a muscle of these points (n, 3); None without landmarks."""
        frame = self.frame(bone, points)
        return frame and find_site(name, bone, frame, self.articular[bone])

    def out_of_bone(self, point: np.ndarray, bone: Part) -> np.ndarray:
        """A place (3,) of a bone's surface, moved out of it by `CLEAR`."""
        nearest = np.argmin(((bone.faces[0] - point) ** 2).sum(axis=1))
        return point + CLEAR * self.millimetre * bone.faces[1][nearest]


BAND = 8.0  # width [mm] beyond the least gap within which faces face each other
# Least cosine between a face's normal and the direction to the other bone, and between the two
# opposed normals.
LOOK, OPPOSED = 0.3, 0.0
FARTHEST = 25.0  # faces farther apart than this [mm] are no joint
BOUND = 1.5  # closer than this [mm] all along: grown together or bound, no cartilage in between
# A ball: misfit against radius, and the least share of the hemisphere that its face covers.
BALL_MISFIT, BALL_COVER = 0.05, 0.3
HINGE_MISFIT = 0.15  # a hinge: misfit of the cylinder against its radius
# Cosine of the cone of normals about their mean that is the dome of a hinge, without the cheeks
# beside it.
DOME = 0.8


class Face(NamedTuple):
    """Triangles of a bone that face another: middles (n, 3), normals (n, 3), areas (n,), and the
    least gap [mm].
    """

    points: np.ndarray
    normals: np.ndarray
    areas: np.ndarray
    gap: float = np.inf


def find_face(first: Part, second: Part, millimetre: float, band: float = BAND) -> Face | None:
    """Triangles of a bone that face another within a band [mm] beyond the least gap, None if it is
    far away.
    """
    reach = (FARTHEST + band) * millimetre
    points, normals, areas = first.faces
    close, distance, nearest, look = looking_at(
        points, normals, second.tree, second.mesh.bounds, reach
    )
    if len(close) == 0:
        return None
    opposed = -np.einsum("ij,ij->i", normals[close], second.faces[1][nearest])
    near = (distance < distance.min() + band * millimetre) & (look > LOOK) & (opposed > OPPOSED)
    chosen = close[near]
    return Face(points[chosen], normals[chosen], areas[chosen], float(distance.min()) / millimetre)


def guess_joints(
    bones: list[Part], millimetre: float, orientation: Orientation | None = None
) -> tuple[Part, list[JointGuess]]:
    """The bone that stands still, and a joint for every other bone that has one.

    Without an orientation there are balls and hinges of any sign. ``millimetre`` is the length of
    one in scene units.
    """
    areas: dict[tuple[Part, Part], float] = {}
    for first, second in combinations(bones, 2):
        face = find_face(second, first, millimetre)
        if face is not None and face.gap <= FARTHEST:
            area = max(float(face.areas.sum()) / millimetre**2, 1e-3)
            areas[first, second] = areas[second, first] = area
    root = _root(bones)
    placed, joints = [root], []
    while len(placed) < len(bones):
        waiting = [bone for bone in bones if bone not in placed]
        links = [
            (parent, child) for parent in placed for child in waiting if (parent, child) in areas
        ]
        if not links:  # nothing faces what is placed: it stands by itself
            placed.append(_root(waiting))
            continue
        parent, child = max(links, key=lambda link: areas[link] * _likelihood(*link))
        joint = _fit(parent, child, millimetre, areas[parent, child])
        if orientation is not None:
            make_anatomical(joint, bones, joints, orientation, millimetre)
        joint.name = _name(joint, bones)
        joints.append(joint)
        placed.append(child)
    if orientation is not None:
        set_rest(joints, bones)
        place_patellae(joints, millimetre)
    return root, joints


def _root(bones):
    """The bone that stands still: by its name, else the largest."""
    named = ([bone for bone in bones if bone.kind == kind] for kind in ROOTS)
    return max(next(filter(None, named), bones), key=lambda bone: bone.mesh.area)


def _likelihood(parent, child):
    """Factor on the facing area of two bones, by their names."""
    if parent.side and child.side and parent.side != child.side:
        return 1.0 if parent.kind == child.kind == "pelvis" else 1e-3
    wanted = [kind for kind, _ in PARENTS.get(child.kind, ())]
    if parent.kind in wanted:
        return 100.0 / (1 + wanted.index(parent.kind))
    return 1e-2 if wanted and parent.kind else 1.0


def _name(joint, bones):
    """The anatomical name where the joint is one, with its side where the scene has both."""
    name, child = JOINTS.get(joint.child.kind), joint.child
    if name is None or joint.parent.kind not in dict(PARENTS[child.kind]) or joint.kind == "weld":
        return f"{child.name}_joint"
    sides = [bone.side for bone in bones if bone.kind == child.kind]
    if len(sides) == 1:
        return name
    return f"{name}_{child.side if sorted(sides) == ['l', 'r'] else child.name}"


def _fit(parent, child, millimetre, area):
    """The joint between two bones: ball, hinge or fixed, by what fits and by what the names say."""
    named = dict(PARENTS.get(child.kind, ())).get(parent.kind, "")
    pairs = ((parent, child), (child, parent))
    faces = [find_face(*pair, millimetre) for pair in pairs]
    ball = min(
        (fit_ball(face) for face in faces), key=lambda fit: fit.misfit / max(fit.radii[0], 1e-300)
    )
    low, high = HEAD if child.kind == "femur" else (0.0, np.inf)
    allowed = low <= ball.radii[0] / millimetre <= high
    fits_ball = ball.misfit < BALL_MISFIT * ball.radii[0] and ball.cover > BALL_COVER and allowed
    band = max(BAND, 0.5 * np.sqrt(area))
    hinges = [
        fit for pair in pairs if (fit := fit_hinge(find_face(*pair, millimetre, band))) is not None
    ]
    # What rolls has the smaller radius, not its socket.
    hinges.sort(key=lambda fit: (fit.misfit > HINGE_MISFIT * fit.radii[0], fit.radii[0]))
    hinge = next(iter(hinges), None)
    fits_hinge = hinge is not None and hinge.misfit < HINGE_MISFIT * hinge.radii[0]
    gap = faces[0].gap
    kind = named or ("ball" if fits_ball else "hinge" if fits_hinge and gap >= BOUND else "weld")
    if kind == "ball":
        sure = 1.0 - 0.5 * ball.misfit / (BALL_MISFIT * ball.radii[0]) if fits_ball else 0.1
        share = 100 * min(ball.cover, 1.0)
        why = (
            f"sphere of radius {ball.radii[0] / millimetre:.4g} mm, misfit "
            f"{ball.misfit / millimetre:.2g} mm, "
        )
        why += f"on {share:.0f} % of a hemisphere"
        why += "" if allowed else f"; anatomy has {low:g} to {high:g} mm"
        axes = {f"rotation_{word}": axis for word, axis in zip("xyz", np.eye(3))}
        return JointGuess(parent, child, "ball", ball.centre, axes, sure, why)
    if kind == "hinge" and hinge is not None:
        sure = 0.6 * max(1.0 - 0.5 * hinge.misfit / (HINGE_MISFIT * hinge.radii[0]), 0.0)
        why = (
            f"cylinder of radius {hinge.radii[0]:.4g}, misfit {hinge.misfit:.2g}, about the "
            "dome where they face"
        )
        return JointGuess(parent, child, "hinge", hinge.centre, {"angle": hinge.axis}, sure, why)
    middle = faces[1].points.mean(axis=0) if len(faces[1].points) else child.points.mean(axis=0)
    why = f"they are {gap:.2g} mm apart, "
    why += "bound all over" if gap < BOUND else "neither ball nor hinge fits"
    return JointGuess(
        parent, child, "weld", middle, {}, 0.8 if gap < BOUND else 0.6 if named else 0.4, why
    )


def fit_ball(face: Face) -> Fit:
    """The sphere that fits a face."""
    if len(face.points) < 12:
        return Fit(np.zeros(3), np.zeros(1), np.inf)
    centre, radius = fit_sphere(face.points, face.areas)
    away = np.linalg.norm(face.points - centre, axis=1) - radius
    misfit = float(np.sqrt(np.average(away**2, weights=face.areas)))
    cover = float(face.areas.sum() / (2.0 * np.pi * radius**2))
    return Fit(centre, np.array([radius]), misfit, cover=cover)


def fit_hinge(face: Face) -> Fit | None:
    """The cylinder that fits the dome of a face, where its normals lie about their mean; None of
    too few triangles.
    """
    mean = face.areas @ face.normals
    dome = face.normals @ mean > DOME * np.linalg.norm(mean)
    points = face.points[dome]
    normals = face.normals[dome]
    areas = face.areas[dome]
    if len(points) < 20:
        return None
    axis, *plane = np.linalg.eigh((normals * areas[:, None]).T @ normals)[1].T  # across the normals
    flat, radius = fit_sphere(points @ np.transpose(plane), areas)
    middle = np.average(points, axis=0, weights=areas)
    size = float(np.sqrt(np.average(((points - middle) ** 2).sum(axis=1), weights=areas)))
    start = flat @ np.array(plane) + middle @ axis * axis
    fit = fit_coaxial([(points, areas)], start, axis, np.array([radius]), 0.02 * size)
    if fit.wrong:
        return None
    fit.centre = fit.centre + (points.mean(axis=0) - fit.centre) @ fit.axis * fit.axis
    return fit
