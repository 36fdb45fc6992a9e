"""Axes and size of each bone, and sites of attachment on it, by its own landmarks.

Places on bones are lateral, anterior and superior, as shares of the bone's size. So they are scaled
to the bone, and are the same on both sides of the body.

A site lies about the places that ``sites.toml`` gives in the bone's frame, moved to the landmark
that stands out there. Articular surfaces belong to no site.
"""

import itertools
import tomllib
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from rbfmuscle.anatomy.bones import Orientation, Part, fit_condyles, long_axis
from rbfmuscle.geometry.arrays import across, unit
from rbfmuscle.importers.guess.joints import JointGuess
from rbfmuscle.scene.bone import Bone

PELVIS = ("pelvis", "ilium", "ischium", "pubis")
FEET = ("talus", "calcaneus", "foot")
# Length of a thigh, from the centre of the hip to that of the knee, over the radius of the head,
# where the femur's lower end is not there (17.4 and 17.7 in two donors); a femur shorter than
# `WHOLE` of it is cut off.
THIGH, WHOLE = 17.5, 0.75
SHANK = 1.1  # distance from knee to ankle over the length of the tibia, where no ankle is found
BELIEVED = 0.2  # joints of less confidence show no landmark


class BoneFrame(NamedTuple):
    """Origin (3,), ``axes`` (3, 3) (lateral, anterior, superior) and size [scene unit] of a
    bone.
    """

    origin: np.ndarray
    axes: np.ndarray
    size: float

    def place(self, at: np.ndarray) -> np.ndarray:
        """Places (..., 3) of shares (..., 3) of the size along the axes."""
        return self.origin + self.size * np.asarray(at) @ self.axes


def bone_frames(
    bones: list[Part],
    joints: list[JointGuess],
    orientation: Orientation | None,
    millimetre: float,
) -> dict[Part, list[BoneFrame]]:
    """Frames of the bones of legs and pelvis, none where landmarks are missing.

    A pelvis and a sacrum have one frame for each hip.
    """
    found: dict[Part, list[BoneFrame]] = {}
    if orientation is None:
        return found
    for femur in [bone for bone in bones if bone.kind == "femur" and bone.frame is not None]:
        hip = next((j for j in joints if j.child is femur and j.kind == "ball"), None)
        sign = 1.0 if femur.frame.side == "r" else -1.0
        if hip is not None and hip.confidence > BELIEVED:
            _add(found, [femur], _thigh(femur, hip, sign, millimetre))
            near = [b for b in bones if b.kind in PELVIS and b.side in ("", femur.side)]
            own = [b for b in bones if b.kind == "sacrum"]
            axes = _axes(orientation.superior, orientation.right, sign)
            if near:
                points = np.vstack([b.points for b in near])
                points = points[(points - hip.centre) @ axes[0] > -0.6 * np.ptp(points @ axes[2])]
                _add(found, near + own, BoneFrame(hip.centre, axes, np.ptp(points @ axes[2])))
        _add_shank(found, femur, bones, joints, sign)
    return found


def _add(found, bones, frame):
    for bone in bones:
        found.setdefault(bone, []).append(frame)


def _axes(superior, right, sign):
    """Lateral, anterior and superior, of a right leg (``sign`` 1) or a left one (-1)."""
    right = unit(across(right, superior))
    return np.stack([sign * right, np.cross(superior, right), superior])


def _thigh(femur, hip, sign, millimetre):
    """By the centres of hip and condyles; by the head and the shaft where the lower end is not
    there.
    """
    away = np.linalg.norm(femur.points - hip.centre, axis=1)
    radius = float(np.median(np.sort(away)[: max(len(away) // 50, 8)]))
    fit = fit_condyles(femur, millimetre)
    if fit is not None and not fit.wrong and away.max() > WHOLE * THIGH * radius:
        up = hip.centre - fit.centre
        return BoneFrame(hip.centre, _axes(unit(up), fit.axis, sign), float(np.linalg.norm(up)))
    return BoneFrame(
        hip.centre, _axes(femur.frame.superior, femur.frame.right, sign), THIGH * radius
    )


def _add_shank(found, femur, bones, joints, sign):
    """Frames of patella, tibia, fibula and the bones of the foot."""
    knee = next((j for j in joints if j.child.kind == "tibia" and j.parent is femur), None)
    if knee is None or "flexion" not in knee.axes or knee.confidence <= BELIEVED:
        return
    tibia, right = knee.child, -knee.axis
    side = [b for b in bones if b.may_be_beside(femur)]
    for patella in [j.child for j in joints if j.child.kind == "patella" and j.parent is femur]:
        axes = _axes(femur.frame.superior, right, sign)
        low, high = patella.points.min(axis=0), patella.points.max(axis=0)
        size = float(np.ptp(patella.points @ axes[2]))
        _add(found, [patella], BoneFrame(0.5 * (low + high), axes, size))
    ankle = next((j for j in joints if j.parent is tibia and "dorsiflexion" in j.axes), None)
    up = long_axis(tibia, bones)
    size = SHANK * float(np.ptp(tibia.points @ up))
    if ankle is not None and ankle.confidence > BELIEVED:
        up = knee.centre - ankle.centre
        size = float(np.linalg.norm(up))
        up = up / size
    axes = _axes(up, right, sign)
    shank = [tibia, *(b for b in side if b.kind == "fibula")]
    _add(found, shank, BoneFrame(knee.centre, axes, size))
    heel = next((b for b in side if b.kind == "calcaneus"), None)
    fore = [b.points for b in side if b.kind == "foot"]
    if ankle is None or heel is None or not fore:
        return
    points = np.vstack(fore)
    lateral = axes[0]
    forward = unit(across(points.mean(axis=0) - heel.points.mean(axis=0), lateral))
    axes = np.stack([lateral, forward, sign * np.cross(lateral, forward)])
    length = float(np.ptp(np.vstack([points, heel.points]) @ forward))
    _add(found, [b for b in side if b.kind in FEET], BoneFrame(ankle.centre, axes, length))


STEPS = 20  # points along a leg of a site's line
ASIDE = 0.005  # what is nearer to an articular surface than this, in sizes of the bone, is of it
MOST = 20_000  # points of a bone among which sites are looked for


class Site(NamedTuple):
    """Where a muscle attaches: ``core`` (k, 3) are its landmarks on the bone, ``points`` (n, 3)
    all of it.
    """

    name: str
    core: np.ndarray
    points: np.ndarray


@cache
def _tables():
    return tomllib.loads((Path(__file__).parent / "sites.toml").read_text(encoding="utf-8"))


def sites_of(muscle: str, role: str) -> list[str]:
    """Names of the sites of a muscle's ``origin`` or ``insertion``, or of the places that its
    tendon passes (``via``), by its name in ``names.toml``; none where they are not known.
    """
    return _tables()["muscles"].get(muscle, {}).get(role, "").split()


def sites_on(names: list[str], bone: Part) -> list[str]:
    """Those of some sites that lie on bones of this one's class."""
    kind = "pelvis" if bone.kind in PELVIS else bone.kind
    return [name for name in names if _tables()["sites"][name]["bone"] == kind]


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

    def covering(self, bone: Part) -> np.ndarray:
        """Vertices and middles of the triangles (n, 3) of a bone off its articular surfaces,
        thinned.
        """
        points = np.concatenate([bone.points, bone.faces[0]])
        points = points[:: -(-len(points) // MOST)]
        articular = self.articular[bone]
        if len(articular):
            points = points[cKDTree(articular).query(points)[0] > ASIDE * bone.size]
        return points

    def site(self, name: str, bone: Part, muscle: Part) -> Site | None:
        """A site on a bone, in the one of its frames that is nearest to the muscle; None without
        landmarks.
        """
        here = muscle.points.mean(axis=0)
        frames = self.frames.get(bone, [])
        frame = min(frames, key=lambda f: np.linalg.norm(f.origin - here), default=None)
        if frame is None:
            return None
        row = _tables()["sites"][name]
        points = self.covering(bone)
        tree = cKDTree(points)
        stops = []
        for at in row["at"]:
            place = frame.place(at)
            if "out" in row:
                near = points[tree.query_ball_point(place, row["reach"] * frame.size)]
                if len(near):
                    out = unit(np.array(row["out"], dtype=float))
                    place = near[np.argmax(near @ (out @ frame.axes))]
            stops.append(place)
        line = np.concatenate(
            [np.linspace(a, b, STEPS) for a, b in itertools.pairwise(stops)] or [np.array(stops)]
        )
        nearest = tree.query(line)[1]
        of_site = cKDTree(line).query(points)[0] < row["radius"] * frame.size
        of_site[nearest] = True
        return Site(name, points[np.unique(nearest)], points[of_site])

    def out_of_bone(self, point: np.ndarray, bone: Part) -> np.ndarray:
        """A place (3,) of a bone's surface, moved out of it by `CLEAR`."""
        nearest = np.argmin(((bone.faces[0] - point) ** 2).sum(axis=1))
        return point + CLEAR * self.millimetre * bone.faces[1][nearest]
