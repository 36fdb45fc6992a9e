"""The tree of the bones and their joints, from the parts of their surfaces that face each other.

A joint is where two bones face each other closely. The bones' tree is the one with the greatest
facing area. A ball fits where the normals of the convex face meet in one point; a hinge where they
meet one line, found as the axis of the cylinder that fits the dome of the face. Both follow from
the face's slippable motions (Gelfand and Guibas 2004, Shape segmentation using local slippage
analysis). Knee, ankle and patella have methods of their own.

In the plane of knee flexion the patella turns by 0.7 of the knee's angle (Amis et al. 2006), keeps
its distance from the middle of its groove (a circle through the outline of the trochlea about the
knee's axis), and lies where the ligament from its apex to the tibial tuberosity has its length at
rest (as in the model of Yamaguchi and Zajac 1989). Points of the plane are complex numbers about
the knee's axis: forwards, and i times downwards.
"""

from dataclasses import dataclass, field
from itertools import combinations
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from rbfmuscle.anatomy.bones import (
    HEAD,
    Fit,
    Orientation,
    Part,
    fit_coaxial,
    fit_condyles,
    fit_dome,
    fit_sphere,
    long_axis,
    sole_direction,
)
from rbfmuscle.geometry.arrays import across, unit
from rbfmuscle.scene.check import looking_at

# Class of bone: its possible parents, the likeliest first, and the kind of joint between.
PARENTS = {
    "ilium": (("pelvis", "weld"), ("sacrum", "weld")),
    "ischium": (("ilium", "weld"), ("pelvis", "weld")),
    "pubis": (("ilium", "weld"), ("pelvis", "weld")),
    "pelvis": (("pelvis", "weld"), ("sacrum", "weld")),
    "sacrum": (("pelvis", "weld"), ("ilium", "weld")),
    "femur": (("pelvis", "ball"), ("ilium", "ball"), ("ischium", "ball")),
    "patella": (("femur", "hinge"),),
    "tibia": (("femur", "hinge"),),
    "fibula": (("tibia", "weld"), ("femur", "hinge")),
    "talus": (("tibia", "hinge"), ("fibula", "hinge")),
    "calcaneus": (("talus", "weld"), ("tibia", "hinge")),
    "foot": (("calcaneus", "weld"), ("talus", "weld"), ("foot", "weld"), ("tibia", "hinge")),
    "vertebra": (("vertebra", "weld"), ("sacrum", "weld"), ("pelvis", "weld")),
    "scapula": (("clavicle", "weld"), ("rib", "weld"), ("sternum", "weld")),
    "clavicle": (("sternum", "weld"), ("rib", "weld")),
    "humerus": (("scapula", "ball"),),
    "ulna": (("humerus", "hinge"),),
    "radius": (("ulna", "weld"), ("humerus", "hinge")),
    "hand": (("radius", "ball"), ("ulna", "ball"), ("hand", "weld")),
}
ROOTS = ("pelvis", "ilium", "sacrum", "scapula", "rib", "vertebra", "femur", "humerus", "tibia")
# Class of the child: name of its joint with one of its parents above.
JOINTS = dict(
    femur="hip", tibia="knee", talus="ankle", patella="patella", humerus="shoulder", ulna="elbow"
)
# Joint: coordinates and ranges [degree] (American Academy of Orthopaedic Surgeons 1965, Joint
# Motion). Positive as the International Society of Biomechanics has it (Wu et al. 2002): flexion,
# adduction, internal rotation, dorsiflexion.
COORDINATES = {
    "hip": {"flexion": (-30.0, 120.0), "adduction": (-45.0, 30.0), "rotation": (-45.0, 45.0)},
    "knee": {"flexion": (-10.0, 135.0)},
    "ankle": {"dorsiflexion": (-50.0, 20.0)},
}
CUT = 0.4  # confidence in axes of a bone that is cut off where a scan ends
MISFIT = 0.05  # greatest misfit of a condyle or a dome against its radius


@dataclass
class JointGuess:
    """A joint as guessed."""

    parent: Part
    child: Part
    kind: str  # "ball", "hinge", "custom" (the patella) or "weld"
    centre: np.ndarray  # (3,) [scene unit]
    axes: dict[str, np.ndarray]  # (3,) by coordinate
    # 0 to 1: where something was fitted, one minus half the misfit over its limit.
    confidence: float
    reason: str
    name: str = ""
    ranges: dict[str, tuple] = field(default_factory=dict)  # of coordinates [degree]
    rest: float = 0.0  # value of the first coordinate in the pose of the meshes [degree]
    tables: dict[str, list] = field(
        default_factory=dict
    )  # rotations and translations of a custom joint
    follows: str = ""  # full name of the coordinate that the first one follows
    # Ends (2, 3) of a patella's, on it and on the tibia, at rest.
    ligament: np.ndarray | None = None

    @property
    def axis(self) -> np.ndarray:
        """Axis (3,) of the first coordinate."""
        return next(iter(self.axes.values()))

    @property
    def coordinate(self) -> str:
        """Full name of the first coordinate."""
        return f"{self.name}.{next(iter(self.axes))}"

    def row(self) -> dict[str, object]:
        """The joint's table in the scene file [degree, scene unit]."""
        row: dict[str, object] = {
            "name": self.name,
            "parent": self.parent.name,
            "child": self.child.name,
            "type": self.kind,
        }
        if self.kind == "weld":
            return row
        row["centre"] = rounded(self.centre, 6)
        if not self.tables:
            row["axes"] = {name: rounded(axis, 6) for name, axis in self.axes.items()}
        facts: dict[str, dict] = {
            name: {"range": rounded(ends, 1)} for name, ends in self.ranges.items()
        }
        first = facts.setdefault(next(iter(self.axes)), {})
        first |= ({"rest": self.rest} if self.rest else {}) | (
            {"motion": "rotation"} if self.tables else {}
        )
        return row | self.tables | ({"coordinates": facts} if first else {})


def rounded(values: ArrayLike, digits: int) -> list[float]:
    """Numbers rounded for the scene file."""
    return np.round(np.asarray(values, dtype=float), digits).tolist()


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
    hinge = min(
        hinges,
        key=lambda fit: (fit.misfit > HINGE_MISFIT * fit.radii[0], fit.radii[0]),
        default=None,
    )
    fits_hinge = hinge is not None and hinge.misfit < HINGE_MISFIT * hinge.radii[0]
    gap = faces[0].gap
    kind = named or ("ball" if fits_ball else "hinge" if fits_hinge and gap >= BOUND else "weld")
    if kind == "ball":
        why = (
            f"sphere of radius {ball.radii[0] / millimetre:.4g} mm, misfit "
            f"{ball.misfit / millimetre:.2g} mm, on {100 * min(ball.cover, 1.0):.0f} % of a "
            "hemisphere"
        )
        if not allowed:
            why += f"; anatomy has {low:g} to {high:g} mm"
        return JointGuess(
            parent,
            child,
            "ball",
            ball.centre,
            axes={f"rotation_{word}": axis for word, axis in zip("xyz", np.eye(3))},
            confidence=1.0 - 0.5 * ball.misfit / (BALL_MISFIT * ball.radii[0])
            if fits_ball
            else 0.1,
            reason=why,
        )
    if kind == "hinge" and hinge is not None:
        return JointGuess(
            parent,
            child,
            "hinge",
            hinge.centre,
            axes={"angle": hinge.axis},
            confidence=0.6 * max(1.0 - 0.5 * hinge.misfit / (HINGE_MISFIT * hinge.radii[0]), 0.0),
            reason=f"cylinder of radius {hinge.radii[0]:.4g}, misfit {hinge.misfit:.2g}, about the "
            "dome where they face",
        )
    middle = faces[1].points.mean(axis=0) if len(faces[1].points) else child.points.mean(axis=0)
    sure = 0.6 if named else 0.4
    what = "neither ball nor hinge fits"
    if gap < BOUND:
        sure = 0.8
        what = "bound all over"
    why = f"they are {gap:.2g} mm apart, {what}"
    return JointGuess(parent, child, "weld", middle, {}, sure, why)


def fit_ball(face: Face) -> Fit:
    """The sphere that fits a face."""
    if len(face.points) < 12:
        return Fit(np.zeros(3), np.zeros(1), np.inf)
    centre, radius = fit_sphere(face.points, face.areas)
    away = np.linalg.norm(face.points - centre, axis=1) - radius
    return Fit(
        centre,
        np.array([radius]),
        misfit=float(np.sqrt(np.average(away**2, weights=face.areas))),
        cover=float(face.areas.sum() / (2.0 * np.pi * radius**2)),
    )


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


def make_anatomical(
    joint: JointGuess,
    bones: list[Part],
    joints: list[JointGuess],
    orientation: Orientation,
    millimetre: float,
) -> None:
    """Give a joint the method and the coordinates that anatomy has for it; ``joints`` are those
    before it.
    """
    pair, right = (joint.parent.kind, joint.child.kind), orientation.right
    if pair[1] == "femur" and joint.kind == "ball":
        lowest = joint.child.points[np.argmin(joint.child.points @ orientation.superior)]
        up = unit(across(joint.centre - lowest, right))
        if joint.child.cut is not None:
            up = unit(across(joint.child.frame.superior, right))
            joint.confidence = min(joint.confidence, CUT)
            joint.reason += f"; {joint.child.name} is cut off: its axes are those of its cut"
        inward = 1.0 if joint.child.frame.side == "r" else -1.0
        axes = (right, inward * np.cross(up, right), inward * up)
        joint.axes, joint.ranges = dict(zip(COORDINATES["hip"], axes)), COORDINATES["hip"]
    elif pair == ("femur", "tibia"):
        fit = fit_condyles(joint.parent, millimetre)
        _take(joint, fit, "posterior condyles", "knee", -right)
    elif pair == ("tibia", "talus"):
        knee = next((j for j in joints if j.child is joint.parent and j.kind == "hinge"), None)
        start = right if knee is None else -knee.axis
        fit = fit_dome(joint.child, joint.parent, long_axis(joint.parent, bones), start, millimetre)
        _take(joint, fit, "talar dome and tibial plafond", "ankle", right)
    elif joint.kind == "hinge":
        joint.axes = {"angle": joint.axis * (-1.0 if joint.axis @ right < 0.0 else 1.0)}


def _take(
    joint: JointGuess, fit: Fit | None, method: str, name: str, direction: np.ndarray
) -> None:
    """Take a fitted axis, in about a direction (3,), for a hinge."""
    joint.kind, joint.ranges = "hinge", COORDINATES[name]
    coordinate = next(iter(joint.ranges))
    if fit is None:
        joint.reason, joint.confidence = f"{method} not found: the axis is across the body", 0.1
        joint.axes = {coordinate: direction}
        return
    radii = " and ".join(f"{radius:.4g}" for radius in fit.radii)
    joint.reason = f"{method}, radii {radii}, misfit {fit.misfit:.2g}"
    joint.centre = fit.centre
    joint.axes = {coordinate: fit.axis * np.copysign(1.0, fit.axis @ direction)}
    joint.confidence = max(1.0 - 0.5 * fit.misfit / (MISFIT * min(fit.radii)), 0.1)
    joint.confidence -= 0.2 * (
        len(fit.radii) < 2
    )  # one surface alone shows the direction less well
    if fit.wrong:
        joint.reason, joint.confidence = f"{joint.reason}; {fit.wrong}: refused, correct it", 0.1


def set_rest(joints: list[JointGuess], bones: list[Part]) -> None:
    """Set the knee flexion and ankle dorsiflexion of the meshes: by axes of the bones and the sole
    of the foot.
    """
    for joint in joints:
        if joint.child.kind == "tibia" and "flexion" in joint.axes:
            thigh, shank = joint.parent.frame.superior, long_axis(joint.child, bones)
            for other in joints:  # from centre to centre where both ends have one
                if other.child is joint.parent and other.kind == "ball":
                    thigh = other.centre - joint.centre
                if other.parent is joint.child and "dorsiflexion" in other.axes:
                    shank = joint.centre - other.centre
            joint.rest = _angle_about(joint.axis, thigh, shank)
        elif "dorsiflexion" in joint.axes:
            feet = [
                b.points
                for b in bones
                if b.kind in ("foot", "calcaneus") and b.side == joint.child.side
            ]
            up = long_axis(joint.parent, bones)
            if feet:
                sole = sole_direction(np.vstack(feet), joint.axis, up)
                joint.rest = _angle_about(joint.axis, np.cross(up, joint.axis), sole)
        joint.ranges = {
            name: (min(low, joint.rest), max(high, joint.rest))
            for name, (low, high) in joint.ranges.items()
        }


def _angle_about(axis, start, end):
    """Angle [degree] about an axis from one direction to another, both seen along it."""
    start, end = across(start, axis), across(end, axis)
    return float(round(np.degrees(np.arctan2(np.cross(start, end) @ axis, start @ end)), 1))


FLEXIONS = tuple(
    range(0, 131, 10)
)  # knee flexion from the rest pose [degree] at which the path is taken
TURN = 0.7  # of the knee's flexion (Amis et al. 2006)
# Half the breadth beside the patella's middle that counts as its groove, and its part of the tibia
# [mm].
GROOVE, TUBEROSITY = 10.0, 15.0
LIGAMENT = (25.0, 80.0)  # length of the ligament that anatomy allows [mm]
# Angles about the knee's axis that the outline covers, its steps [degree], and the fewest points of
# it.
OUTLINE = (-30.0, 90.0)
STEP = 5.0
FEWEST = 6


def place_patellae(joints: list[JointGuess], millimetre: float) -> None:
    """Patellae glide in their grooves as the knee bends; about its axis where no groove is
    found.
    """
    for joint in joints:
        knee = next(
            (j for j in joints if j.child.kind == "tibia" and j.parent is joint.parent), None
        )
        if joint.child.kind != "patella" or knee is None or knee.kind != "hinge":
            continue
        joint.axes, joint.rest = {"flexion": knee.axis}, knee.rest
        if not _put_in_groove(joint, knee, millimetre):
            joint.kind = "hinge"
            joint.centre = knee.centre
            joint.confidence = 0.2
            joint.reason = "no groove or no ligament was found: it turns about the knee's axis"


def _put_in_groove(joint, knee, millimetre):
    """Make a patella's joint the custom one of its path; False where its groove or its ligament is
    not found.
    """
    femur, axis = joint.parent, knee.axis
    down = unit(across(-femur.frame.superior, axis))
    front = np.cross(down, axis)
    side = float((joint.child.points.mean(axis=0) - knee.centre) @ axis)

    def flat(points, half):
        away = points - knee.centre
        away = away[np.abs(away @ axis - side) < half * millimetre]
        return away @ front + 1j * (away @ down)

    groove = _outline(flat(np.vstack([femur.points, femur.faces[0]]), GROOVE))
    outline = flat(joint.child.points, np.inf)
    shin, apex = flat(knee.child.points, TUBEROSITY), outline[np.argmax(outline.imag)]
    gaps = np.abs(shin - apex) / millimetre
    shin = shin[(gaps > LIGAMENT[0]) & (gaps < LIGAMENT[1]) & (shin.imag > apex.imag)]
    if len(shin) == 0 or len(groove) < FEWEST:
        return False
    middle, tuberosity = outline.mean(), shin[np.argmax(shin.real)]
    centre, _ = fit_sphere(np.stack([groove.real, groove.imag], axis=1), np.ones(len(groove)))
    shifts = _follow(complex(*centre), middle, apex, tuberosity)
    flexions = np.array(FLEXIONS, dtype=float)

    def table(direction, values):
        return {
            "axis": rounded(direction, 6),
            "coordinates": ["flexion"],
            "spline": {"x": rounded(knee.rest + flexions, 3), "y": rounded(values, 6)},
        }

    def place(point):
        return knee.centre + side * axis + point.real * front + point.imag * down

    joint.tables = {
        "rotations": [table(axis, TURN * flexions)],
        "translations": [table(front, shifts.real), table(down, shifts.imag)],
    }
    joint.kind = "custom"
    joint.centre = place(middle)
    joint.confidence = 0.6
    joint.follows, joint.ligament = knee.coordinate, np.stack([place(apex), place(tuberosity)])
    length = abs(apex - tuberosity) / millimetre
    joint.reason = f"in its groove, on a ligament of {length:.3g} mm, to {FLEXIONS[-1]} degrees"
    return True


def _outline(points):
    """The outermost points of the femur about the knee's axis, step by step of the angle."""
    angle, found = np.angle(points, deg=True), []
    for low in np.arange(*OUTLINE, STEP):
        inside = np.abs(points[(angle >= low) & (angle < low + STEP)])
        if len(inside) > 3:
            found.append(np.percentile(inside, 95) * _turn(low + 0.5 * STEP))
    return np.array(found)


def _follow(centre, middle, apex, tuberosity):
    """Shifts of the patella: at each flexion the place about the groove's centre, from the one
    before on.
    """
    length = abs(apex - tuberosity)
    angle = 0.0
    shifts = []
    for flexion in FLEXIONS:
        end, tip = tuberosity * _turn(flexion), (apex - middle) * _turn(TURN * flexion)
        tried = np.arange(angle, angle + 20.0, 0.5) if flexion else np.zeros(1)
        places = centre + (middle - centre) * _turn(tried)
        best = np.argmin(np.abs(np.abs(places + tip - end) - length))
        angle = tried[best]
        shifts.append(places[best] - middle)
    return np.array(shifts)


def _turn(degrees):
    """The factor that turns points of the plane by an angle."""
    return np.exp(1j * np.radians(degrees))
