"""Joints: coordinates that move one bone against another, the table of their kinds, and poses of
bones.

Every kind is rotations about axes that are carried along by those before them, and a shift along
axes that are not turned by them (Seth et al. 2010, the custom joint of Simbody); what a kind fixes
is how many there are, and that each follows one coordinate. Couplings, locks and ranges come first,
then joint after joint from the root.
"""

import bisect
import itertools
import math
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from graphlib import CycleError, TopologicalSorter
from typing import ClassVar, Literal, NamedTuple, Self, TypeAlias

import numpy as np
from numpy.typing import ArrayLike

from rbfmuscle.scene.content import Compared
from rbfmuscle.scene.guesses import GuessTable
from rbfmuscle.validation import SceneError


@dataclass(frozen=True)
class Linear:
    """``c1 q1 + ... + cn qn + constant``; without slopes a constant."""

    slopes: tuple[float, ...]
    constant: float = 0.0

    def __call__(self, *values: float) -> float:
        """Value at these coordinates."""
        return sum(slope * value for slope, value in zip(self.slopes, values)) + self.constant

    def rescaled(self, inputs: list[float], output: float) -> "Linear":
        """Return the function in other units."""
        slopes = tuple(c if output == f else c * output / f for c, f in zip(self.slopes, inputs))
        return Linear(slopes, self.constant * output)


@dataclass(frozen=True)
class Polynomial:
    """Of one coordinate, highest power first."""

    coefficients: tuple[float, ...]

    def __call__(self, *values: float) -> float:
        """Value at these coordinates."""
        return float(np.polyval(self.coefficients, values[0]))

    def rescaled(self, inputs: list[float], output: float) -> "Polynomial":
        """Return the function in other units."""
        top = len(self.coefficients) - 1
        return Polynomial(
            tuple(c * output / inputs[0] ** (top - k) for k, c in enumerate(self.coefficients))
        )


@dataclass(frozen=True)
class PiecewiseLinear:
    """Through points (x, y), straight between them; the first and the last piece go on beyond
    them.
    """

    x: tuple[float, ...]
    y: tuple[float, ...]

    degree: ClassVar[int] = 1

    @cached_property
    def _pieces(self) -> list[list[float]]:
        """Four coefficients of each piece, highest power first: before, between and beyond the
        points.
        """
        from scipy.interpolate import make_interp_spline

        x, y = np.array(self.x), np.array(self.y)
        if self.degree == 1 or len(x) < 3:
            curve = make_interp_spline(x, y, k=min(1, len(x) - 1))
        else:  # three points: one parabola
            ends = (
                [(3, 6.0 * _third(x[s], y[s]) if len(x) > 3 else 0.0)]
                for s in (np.s_[:4], np.s_[-4:])
            )
            curve = make_interp_spline(x, y, k=3, bc_type=tuple(ends))
        pieces = np.stack([curve(x, nu=n) / math.factorial(n) for n in (3, 2, 1, 0)], axis=1)
        straight = pieces * [0.0, 0.0, 1.0, 1.0]
        return np.stack([straight[0], *pieces[:-1], straight[-1]]).tolist()

    def __call__(self, *values: float) -> float:
        """Value at these coordinates."""
        k = bisect.bisect_right(self.x, values[0])
        a, b, c, d = self._pieces[k]
        t = values[0] - self.x[max(k - 1, 0)]
        return ((a * t + b) * t + c) * t + d

    def rescaled(self, inputs: list[float], output: float) -> Self:
        """Return the function in other units."""
        return replace(
            self, x=tuple(v * inputs[0] for v in self.x), y=tuple(v * output for v in self.y)
        )


class Spline(PiecewiseLinear):
    """Cubic spline through points; beyond them it goes on straight.

    It is the spline of Forsythe, Malcolm and Moler (1977), which OpenSim calls SimmSpline: the
    third derivative of the first and of the last piece is that of the cubic through the four points
    there.
    """

    degree = 3


@dataclass(frozen=True)
class Multivariate:
    """A polynomial of several coordinates: of each term the coefficient, then the power of each."""

    terms: tuple[tuple[float, ...], ...]

    def __call__(self, *values: float) -> float:
        """Value at these coordinates."""
        return sum(c * math.prod(map(pow, values, powers)) for c, *powers in self.terms)

    def rescaled(self, inputs: list[float], output: float) -> "Multivariate":
        """Return the function in other units."""
        factors = [output / math.prod(map(pow, inputs, powers)) for _, *powers in self.terms]
        return Multivariate(
            tuple((c * factor, *powers) for factor, (c, *powers) in zip(factors, self.terms))
        )


Function = Linear | Polynomial | PiecewiseLinear | Multivariate


def exponents(dimension: int, order: int) -> np.ndarray:
    """Return the exponents (m, d) of every term up to an order, the last coordinate's going
    fastest, as OpenSim's.
    """
    powers = itertools.product(range(order + 1), repeat=dimension)
    return np.array([power for power in powers if sum(power) <= order])


def scaled(function: Function, factor: float) -> Function:
    """Return ``factor`` times a function."""
    count = len(function.slopes) if isinstance(function, Linear) else 1
    if isinstance(function, Multivariate):
        count = max((len(term) - 1 for term in function.terms), default=1)
    return function.rescaled([1.0] * count, factor)


def _third(x, y):
    """Third divided difference of four points."""
    table = y
    for order in range(1, 4):
        table = np.diff(table) / (x[order:] - x[:-order])
    return float(table[0])


MotionKind: TypeAlias = Literal["rotation", "translation", "coupled"]
X = (1.0, 0.0, 0.0)  # directions
Y = (0.0, 1.0, 0.0)
Z = (0.0, 0.0, 1.0)


class Kind(NamedTuple):
    """What a kind of joint fixes: the axes of its coordinates, turning ones first."""

    rotations: tuple = ()
    translations: tuple = ()


# All that is known of a kind stands here; files, code, messages and tests read this table. What a
# custom joint has is given with it.
KINDS = {
    "weld": Kind(),
    "hinge": Kind((Z,)),
    "slide": Kind((), (X,)),
    "universal": Kind((X, Y)),
    "ball": Kind((X, Y, Z)),
    "planar": Kind((Z,), (X, Y)),
    "free": Kind((X, Y, Z), (X, Y, Z)),
    "custom": Kind(),
}
STRAIGHT = 1e-8  # radian; a smaller turn has no direction of its own
MOST_AXES = 6  # of a custom joint
BY_TURNS = ("weld", "hinge", "universal", "ball")  # where no type is given, by the number of axes

IDENTITY = Linear((1.0,))


@dataclass(frozen=True)
class Coordinate:
    """One number that moves a joint: an angle [radian], a length [scene unit], or one with no
    unit.
    """

    # What the number is; a coupled one drives several axes by functions and has no unit of its own.
    motion: MotionKind = "rotation"
    # In the pose in which the meshes are, and in a motion that does not mention it.
    rest: float = 0.0
    range: tuple[float, float] | None = None
    clamped: bool = False  # cut to the range; others may leave it, which is reported
    locked: bool = False  # stays at rest whatever is asked of it

    def clamped_value(self, value: float) -> float:
        """Return what the coordinate becomes when ``value`` is asked of it."""
        if self.locked:
            return self.rest
        if self.clamped and self.range is not None:
            return min(max(value, self.range[0]), self.range[1])
        return value

    def unit_sign(self, length: str) -> str:
        """Return what follows its value in text: the sign for degrees, the unit of length, or
        nothing.
        """
        return {"translation": f" {length}", "coupled": ""}.get(self.motion, "°")


@dataclass(frozen=True)
class TransformAxis:
    """A direction (3,), and the function of coordinates that turns about or shifts along it."""

    direction: tuple[float, float, float]
    coordinates: tuple[str, ...] = ()
    function: Function = IDENTITY

    def amount(self, values: dict[str, float]) -> float:
        """The turn [radian] or shift [scene unit] at values of the coordinates by bare name."""
        return self.function(*(values[name] for name in self.coordinates))


@dataclass(eq=False)
class Joint(Compared):
    """Moves ``child`` (and all that hangs on it) against ``parent``; all is in the scene's
    coordinates at rest.
    """

    name: str
    parent: str
    child: str
    centre: np.ndarray = field(repr=False)  # (3,), what a ball turns about
    coordinates: dict[str, Coordinate]
    rotations: tuple[TransformAxis, ...] = ()  # the first is the outermost
    translations: tuple[TransformAxis, ...] = ()
    kind: str = "custom"  # a key of KINDS
    backward: bool = False  # written from child to parent: its motion is inverted
    # What the third axis carries as the joint turns: a point of an ellipsoid with these radii along
    # the three axes, where its normal is that axis; or the end of an arc of this length.
    radii: tuple[float, float, float] | None = None
    arc: float = 0.0
    guess: GuessTable | None = None  # of a joint that nobody has confirmed

    def motion(self, values: dict[str, float], rest: dict[str, float]) -> np.ndarray:
        """Return the (4, 4) motion of the child against the parent, scene coordinates, the identity
        at rest.

        ``values`` and ``rest`` hold every coordinate of the joint by its bare name, now and in the
        rest pose.
        """
        if values == rest:
            return np.eye(4)
        transform = self.displacement(values) @ np.linalg.inv(self.displacement(rest))
        return np.linalg.inv(transform) if self.backward else transform

    def moved(self, pose: np.ndarray) -> Self:
        """Return the joint where a pose (4, 4) takes it."""
        turns, shifts = (
            tuple(
                replace(axis, direction=tuple((pose[:3, :3] @ axis.direction).tolist()))
                for axis in axes
            )
            for axes in (self.rotations, self.translations)
        )
        centre = pose[:3, :3] @ self.centre + pose[:3, 3]
        return replace(self, centre=centre, rotations=turns, translations=shifts)

    def displacement(self, values: dict[str, float]) -> np.ndarray:
        """Return the (4, 4) motion in scene coordinates from where every function is zero."""
        transform = np.eye(4)
        for axis in self.translations:
            transform[:3, 3] += axis.amount(values) * np.asarray(axis.direction)
        for axis in self.rotations:
            if angle := axis.amount(values):
                transform = transform @ rotation_about(axis.direction, angle, self.centre)
        if self.radii is not None or self.arc:
            transform[:3, 3] += self._carried(transform[:3, :3])
        return transform

    def _carried(self, turn):
        """Shift (3,) of what the third axis carries, the joint turned by ``turn`` (3, 3)."""
        axes = np.array([axis.direction for axis in self.rotations])
        ahead = turn @ axes[2]
        if self.radii is not None:
            return (self.radii * (axes @ ahead)) @ axes
        across = ahead - (ahead @ axes[2]) * axes[2]
        sine = float(np.linalg.norm(across))
        angle = math.atan2(sine, float(ahead @ axes[2]))
        if angle < STRAIGHT:
            return self.arc * axes[2]
        beside = (1.0 - math.cos(angle)) / sine * across
        return self.arc / angle * (math.sin(angle) * axes[2] + beside)


@dataclass(frozen=True)
class Coupling:
    """A coordinate that follows others: ``coordinate = function(*of)``, full names, radian and
    scene units.
    """

    coordinate: str
    of: tuple[str, ...]
    function: Function


def motion_of(name: str, axes: Iterable[tuple[MotionKind, Sequence[str], float]]) -> MotionKind:
    """What a coordinate of a custom joint is, by OpenSim's rule.

    It is an angle or a length where it alone drives an axis of that sort with a slope of 1 or -1,
    the last such axis deciding; else it is coupled. ``axes`` are the sort of each, its coordinates,
    and the first slope of its function where that is linear, else 0.
    """
    found: MotionKind = "coupled"
    for sort, coordinates, slope in axes:
        if list(coordinates) == [name] and abs(slope) == 1.0:
            found = sort
    return found


def rotation_about(axis: ArrayLike, angle: float, centre: np.ndarray) -> np.ndarray:
    """Return the (4, 4) rotation by ``angle`` [radian] about an axis through ``centre``
    (Rodrigues).
    """
    x, y, z = np.asarray(axis, dtype=float) / np.linalg.norm(axis)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    pose = np.eye(4)
    pose[:3, :3] += math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross
    pose[:3, 3] = centre - pose[:3, :3] @ centre
    return pose


def all_coordinates(joints: list[Joint]) -> dict[str, Coordinate]:
    """Return every coordinate by its full name "joint.coordinate", in order."""
    return {
        f"{joint.name}.{name}": coordinate
        for joint in joints
        for name, coordinate in joint.coordinates.items()
    }


def coordinate_values(
    asked: dict[str, float], coordinates: dict[str, Coordinate], couplings: list[Coupling]
) -> dict[str, float]:
    """Return the value that every coordinate takes when some are asked for, by the same names
    [radian or scene unit].

    Locked ones stay, clamped ones are cut to their range, those that follow others follow; absent
    ones are at rest.
    """
    values = {
        n: coordinate.clamped_value(asked[n]) if n in asked else coordinate.rest
        for n, coordinate in coordinates.items()
    }
    for coupling in couplings:  # in an order in which what they follow is known
        values[coupling.coordinate] = coupling.function(*(values[name] for name in coupling.of))
    return values


def ordered(couplings: list[Coupling]) -> list[Coupling]:
    """Return the couplings in an order in which each follows what is known by then, or raise
    SceneError.
    """
    by_name: dict[str, Coupling] = {}
    for coupling in couplings:
        if by_name.setdefault(coupling.coordinate, coupling) is not coupling:
            raise SceneError(f"coupling of {coupling.coordinate!r} is given twice")
    try:
        order = list(
            TopologicalSorter({name: one.of for name, one in by_name.items()}).static_order()
        )
    except CycleError as error:
        ring = error.args[1]
        raise SceneError(
            f"coupling of {ring[0]!r} follows itself; leave one of the ring out"
        ) from None
    return [by_name[name] for name in order if name in by_name]


def check_tree(joints: Sequence[Joint], joint: Joint) -> None:
    """Raise SceneError if the bones would be no tree with one more joint."""
    parents = {other.child: other.parent for other in joints}
    if joint.child in parents:
        raise SceneError(
            f"joint {joint.name!r}: bone {joint.child!r} is already the child of another joint"
        )
    ancestor: str | None = joint.parent
    while ancestor is not None:
        if ancestor == joint.child:
            raise SceneError(
                f"joint {joint.name!r}: {joint.child!r} would hang on itself, joints must form a "
                "tree"
            )
        ancestor = parents.get(ancestor)


def joint_poses(
    bones: list[str], joints: list[Joint], couplings: list[Coupling], coordinates: dict[str, float]
) -> dict[str, np.ndarray]:
    """Return the (4, 4) pose of every bone, rest coordinates to world; a bone without a joint is
    fixed.
    """
    now = joint_values(joints, couplings, coordinates)
    rest = joint_values(joints, couplings, {})
    joint_of = {joint.child: joint for joint in joints}
    poses = {}
    for bone in bones:
        chain, name = [], bone
        while name in joint_of and name not in poses:
            chain.append(joint_of[name])
            name = chain[-1].parent
        pose = poses.setdefault(name, np.eye(4))
        for joint in reversed(chain):
            pose = pose @ joint.motion(now[joint.name], rest[joint.name])
            poses[joint.child] = pose
    return {bone: poses[bone] for bone in bones}


def bones_between(joints: list[Joint], bones: list[str]) -> set[str]:
    """Names of these bones and of those on the way between them, from joint to joint."""
    parents, chains = {joint.child: joint.parent for joint in joints}, []
    for bone in dict.fromkeys(bones):
        chain = [bone]
        while chain[-1] in parents and parents[chain[-1]] not in chain:
            chain.append(parents[chain[-1]])
        chains.append(chain)
    common = set(chains[0]).intersection(*chains)
    root = next((bone for bone in chains[0] if bone in common), None)
    return {bone for chain in chains for bone in chain if bone not in common} | {
        root or bones[0],
        *bones,
    }


def joint_values(
    joints: list[Joint], couplings: list[Coupling], coordinates: dict[str, float]
) -> dict[str, dict[str, float]]:
    """Return the values that `coordinate_values` gives, by joint and bare name."""
    values = coordinate_values(coordinates, all_coordinates(joints), couplings)
    return {
        joint.name: {name: values[f"{joint.name}.{name}"] for name in joint.coordinates}
        for joint in joints
    }


def rigid_body(
    bone: str, joints: Sequence[Joint], moving: Collection[str] | None = None
) -> str | None:
    """The bone that stands for the rigid body of a bone: the child of its joint, None for the body
    that no joint moves.

    With ``moving`` names of joints, bones whose joint is none of these are one body with its
    parent.
    """
    joint_of = {joint.child: joint for joint in joints}
    while moving is not None and bone in joint_of and joint_of[bone].name not in moving:
        bone = joint_of[bone].parent
    return bone if bone in joint_of else None
