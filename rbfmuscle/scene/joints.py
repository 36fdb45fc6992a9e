"""Joints: coordinates that move one bone against another, the table of their kinds, poses of
bones, and the tables ``[[joint]]`` and ``[[coupling]]``.

Every kind is rotations about axes that are carried along by those before them, and a shift along
axes that are not turned by them (Seth et al. 2010, the custom joint of Simbody); what a kind fixes
is how many there are, and that each follows one coordinate. Couplings, locks and ranges come first,
then joint after joint from the root. Files and calls speak in degrees and scene units; inside are
radians and scene units.
"""

import bisect
import itertools
import math
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from graphlib import CycleError, TopologicalSorter
from typing import Literal, Self, TypeAlias

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field, model_validator

from rbfmuscle.scene.content import Compared
from rbfmuscle.scene.options import Axis, Finite, GuessTable, Table, Vector
from rbfmuscle.validation import SceneError, did_you_mean


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
class Curve:
    """Through points (x, y), straight between them, or a cubic spline of ``degree`` 3; beyond them
    it goes on straight.

    The spline is that of Forsythe, Malcolm and Moler (1977), which OpenSim calls SimmSpline: the
    third derivative of the first and of the last piece is that of the cubic through the four points
    there.
    """

    x: tuple[float, ...]
    y: tuple[float, ...]
    degree: int = 1  # or 3

    @cached_property
    def _pieces(self) -> list[list[float]]:
        """Four coefficients of each piece, highest power first: before, between and beyond the
        points.
        """
        from scipy.interpolate import make_interp_spline

        x, y = np.array(self.x), np.array(self.y)
        ends = []
        if self.degree == 3 and len(x) > 3:  # three points: one parabola
            for four in (np.s_[:4], np.s_[-4:]):
                divided = y[four]
                for order in (1, 2, 3):  # divided differences up to the third
                    divided = np.diff(divided) / (x[four][order:] - x[four][:-order])
                ends.append([(3, 6.0 * float(divided[0]))])
        degree = min(self.degree, len(x) - 1)
        curve = make_interp_spline(x, y, k=degree, bc_type=tuple(ends) or None)
        pieces = np.stack([curve(x, nu=n) / math.factorial(n) for n in (3, 2, 1, 0)], axis=1)
        straight = pieces * [0.0, 0.0, 1.0, 1.0]
        return np.stack([straight[0], *pieces[:-1], straight[-1]]).tolist()

    def __call__(self, *values: float) -> float:
        """Value at these coordinates."""
        k = bisect.bisect_right(self.x, values[0])
        a, b, c, d = self._pieces[k]
        t = values[0] - self.x[max(k - 1, 0)]
        return ((a * t + b) * t + c) * t + d

    def rescaled(self, inputs: list[float], output: float) -> "Curve":
        """Return the function in other units."""
        return replace(
            self, x=tuple(v * inputs[0] for v in self.x), y=tuple(v * output for v in self.y)
        )


@dataclass(frozen=True)
class Multivariate:
    """A polynomial of several coordinates: of each term the coefficient, then the power of each."""

    terms: tuple[tuple[float, ...], ...]

    def __call__(self, *values: float) -> float:
        """Value at these coordinates."""
        return sum(c * math.prod(map(pow, values, powers)) for c, *powers in self.terms)

    def rescaled(self, inputs: list[float], output: float) -> "Multivariate":
        """Return the function in other units."""
        return Multivariate(
            tuple(
                (c * (output / math.prod(map(pow, inputs, powers))), *powers)
                for c, *powers in self.terms
            )
        )


Function = Linear | Polynomial | Curve | Multivariate


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


MotionKind: TypeAlias = Literal["rotation", "translation", "coupled"]
X = (1.0, 0.0, 0.0)  # directions
Y = (0.0, 1.0, 0.0)
Z = (0.0, 0.0, 1.0)


# All that is known of a kind stands here: the axes that its coordinates turn about, then those that
# they shift along; files, code, messages and tests read this table. What a custom joint has is
# given with it.
Axes: TypeAlias = tuple[tuple[float, float, float], ...]
KINDS: dict[str, tuple[Axes, Axes]] = {
    "weld": ((), ()),
    "hinge": ((Z,), ()),
    "slide": ((), (X,)),
    "universal": ((X, Y), ()),
    "ball": ((X, Y, Z), ()),
    "planar": ((Z,), (X, Y)),
    "free": ((X, Y, Z), (X, Y, Z)),
    "custom": ((), ()),
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
    radii: tuple[float, ...] | None = None
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


def motion_of(name: str, axes: Iterable[tuple[MotionKind, TransformAxis]]) -> MotionKind:
    """What a coordinate of a custom joint is, by OpenSim's rule.

    It is an angle or a length where it alone drives an axis of that sort by a linear function with
    a slope of 1 or -1, the last such axis deciding; else it is coupled. ``axes`` are the sort of
    each and the axis.
    """
    own = [
        sort
        for sort, axis in axes
        if axis.coordinates == (name,)
        and isinstance(axis.function, Linear)
        and axis.function.slopes in ((1.0,), (-1.0,))
    ]
    return own[-1] if own else "coupled"


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
    poses = {bone: np.eye(4) for bone in bones}
    parents = {joint.child: [joint.parent] for joint in joints}
    for bone in TopologicalSorter(parents).static_order():
        poses[bone] = np.eye(4)
        if bone in joint_of:
            joint = joint_of[bone]
            motion = joint.motion(now[joint.name], rest[joint.name])
            poses[bone] = poses[joint.parent] @ motion
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


# What a number in a file is multiplied by.
FACTORS = {"rotation": math.pi / 180.0, "translation": 1.0, "coupled": 1.0}
FUNCTIONS = ("constant", "linear", "polynomial", "terms", "piecewise", "spline")


class PointsTable(Table):
    """Points of a function of one coordinate."""

    x: list[Finite] = Field(min_length=1)
    y: list[Finite] = Field(min_length=1)

    @model_validator(mode="after")
    def _check_order(self):
        if len(self.x) != len(self.y):
            raise ValueError(f"x has {len(self.x)} values and y {len(self.y)}")
        if any(b <= a for a, b in zip(self.x, self.x[1:])):
            raise ValueError("x must increase")
        return self


class FunctionTable(Table):
    """One function; without any it is the coordinate's own value."""

    constant: Finite | None = None
    linear: list[Finite] | None = Field(default=None, min_length=1)
    polynomial: list[Finite] | None = Field(default=None, min_length=1)
    terms: list[list[Finite]] | None = Field(default=None, min_length=1)
    piecewise: PointsTable | None = None
    spline: PointsTable | None = None

    def function(self, count: int, *, context: str) -> Function:
        """Return the function of ``count`` coordinates in the units of files."""
        given = [name for name in FUNCTIONS if getattr(self, name) is not None]
        points = self.piecewise or self.spline
        if len(given) > 1:
            raise SceneError(f"{context}: give one function, not {' and '.join(given)}")
        if self.constant is not None:
            return Linear((), self.constant)
        if count != 1 and (self.polynomial or points):
            raise SceneError(f"{context}: {given[0]} is of 1 coordinate, {count} are given")
        if self.polynomial is not None:
            return Polynomial(tuple(self.polynomial))
        if points is not None:
            return Curve(tuple(points.x), tuple(points.y), 3 if self.spline else 1)
        if self.terms is not None:
            for term in self.terms:
                if len(term) != count + 1 or any(power < 0 or power % 1 for power in term[1:]):
                    raise SceneError(
                        f"{context}: each of terms is a coefficient and the whole powers of "
                        f"{count} coordinates, got {term}"
                    )
            return Multivariate(tuple((c, *map(int, powers)) for c, *powers in self.terms))
        *slopes, constant = self.linear or [1.0, 0.0]
        if len(slopes) != count:
            raise SceneError(
                f"{context}: linear needs a slope for each of {count} coordinates and a "
                f"constant, got {self.linear}"
            )
        return Linear(tuple(slopes), constant)


class AxisTable(FunctionTable):
    """One axis of a custom joint."""

    axis: Axis
    coordinates: list[str] = Field(default_factory=list)


class CoordinateTable(Table):
    """``joint.coordinates.NAME`` [degree or scene unit]."""

    motion: MotionKind | None = None
    rest: Finite = 0.0
    range: list[Finite] | None = Field(default=None, min_length=2, max_length=2)
    clamped: bool = False
    locked: bool = False

    @model_validator(mode="after")
    def _check_values(self):
        if self.range is not None and self.range[0] > self.range[1]:
            raise ValueError(f"range must go upwards, got {self.range}")
        if self.clamped and self.range is None:
            raise ValueError("clamped needs a range")
        return self

    def coordinate(self, motion: MotionKind) -> Coordinate:
        """Return it in inner units."""
        kind = self.motion or motion
        factor = FACTORS[kind]
        ends = None if self.range is None else (self.range[0] * factor, self.range[1] * factor)
        return Coordinate(kind, self.rest * factor, ends, self.clamped, self.locked)


class JointTable(Table):
    """``[[joint]]``."""

    name: str
    parent: str
    child: str
    type: (
        Literal["weld", "hinge", "slide", "universal", "ball", "planar", "free", "custom"] | None
    ) = None
    centre: Vector | None = None
    axes: dict[str, Axis] | None = None
    coordinates: dict[str, CoordinateTable] = Field(default_factory=dict)
    rotations: list[AxisTable] = Field(default_factory=list, max_length=MOST_AXES)
    translations: list[AxisTable] = Field(default_factory=list, max_length=3)
    backward: bool = False
    radii: Vector | None = None
    arc: Finite = 0.0
    guess: GuessTable | None = None

    def joint(self) -> Joint:
        """Return the joint that the table describes, or raise SceneError naming it."""
        context = f"joint {self.name!r}"
        kind = self.type
        if kind is None:  # one to three axes, each of which is turned about
            count = len(self.axes or self.coordinates)
            if self.rotations or self.translations or not 0 < count < len(BY_TURNS):
                raise SceneError(
                    f"{context}: give its type; without one, "
                    "one to three axes make a hinge, universal or ball joint"
                )
            kind = BY_TURNS[count]
        if self.centre is None and kind != "weld":
            raise SceneError(f"{context}: centre is missing, give the joint's place at rest")
        if (self.radii or self.arc) and (kind != "custom" or len(self.rotations) != 3):
            raise SceneError(f"{context}: radii and arc need type 'custom' with three rotations")
        axes = []
        for sort, tables in self._axes_of_kind(kind, context).items():
            for number, row in enumerate(tables, 1):
                function = row.function(len(row.coordinates), context=f"{context}: {sort} {number}")
                direction = tuple(value / math.hypot(*row.axis) for value in row.axis)
                axes.append((sort, TransformAxis(direction, tuple(row.coordinates), function)))
        named = dict.fromkeys(name for _, axis in axes for name in axis.coordinates)
        for name in self.coordinates:
            if name not in named:
                raise SceneError(
                    f"{context}: coordinate {name!r} moves nothing, {did_you_mean(name, named)}"
                )
        coordinates = {}
        for name in named:
            motion, table = motion_of(name, axes), self.coordinates.get(name, CoordinateTable())
            if kind != "custom" and table.motion not in (None, motion):
                raise SceneError(f"{context}: {name!r} is a {motion} here, not a {table.motion}")
            coordinates[name] = table.coordinate(motion)
        moves: dict[MotionKind, list[TransformAxis]] = {"rotation": [], "translation": []}
        for sort, axis in axes:
            units = [FACTORS[coordinates[name].motion] for name in axis.coordinates]
            function = axis.function.rescaled(units, FACTORS[sort])
            moves[sort].append(replace(axis, function=function))
        return Joint(
            self.name,
            self.parent,
            self.child,
            np.array(self.centre or (0.0, 0.0, 0.0)),
            coordinates,
            tuple(moves["rotation"]),
            tuple(moves["translation"]),
            kind,
            self.backward,
            None if self.radii is None else tuple(self.radii),
            self.arc,
            self.guess,
        )

    def _axes_of_kind(self, kind, context):
        """Tables of the rotations and of the translations of a kind; each is of one coordinate
        but in a custom joint.
        """
        if kind == "custom":
            if self.axes:
                raise SceneError(
                    f"{context}: a custom joint has rotations and translations instead of axes"
                )
            if len(self.rotations) + len(self.translations) > MOST_AXES:
                raise SceneError(f"{context}: a custom joint has at most {MOST_AXES} axes")
            return {"rotation": self.rotations, "translation": self.translations}
        if self.rotations or self.translations:
            raise SceneError(
                f"{context}: rotations and translations belong to type 'custom', give axes"
            )
        turns, shifts = KINDS[kind]
        usual = [*turns, *shifts]
        axes = self.axes or dict(zip(self.coordinates, usual))
        count = len(axes) or len(self.coordinates)
        if count != len(usual):
            raise SceneError(
                f"{context}: a {kind} joint has {len(usual)} coordinates, {count} are given; name "
                "them in axes"
            )
        tables = [AxisTable(axis=list(axis), coordinates=[name]) for name, axis in axes.items()]
        return {"rotation": tables[: len(turns)], "translation": tables[len(turns) :]}


class CouplingTable(FunctionTable):
    """``[[coupling]]``."""

    coordinate: str
    of: list[str] = Field(min_length=1)


def full_name(name: str, known: list[str], *, context: str) -> str:
    """Return "joint.coordinate"; a bare coordinate may stand for the only joint that has it."""
    if name in known:
        return name
    owners = [full for full in known if full.split(".", 1)[1] == name]
    if len(owners) == 1:
        return owners[0]
    raise SceneError(f"{context}: unknown coordinate {name!r}, {did_you_mean(name, known)}")


def make_coupling(table: CouplingTable, joints: list[Joint]) -> Coupling:
    """Return the coupling that a table describes, names in full."""
    coordinates = all_coordinates(joints)
    known = list(coordinates)
    target = full_name(table.coordinate, known, context="coupling")
    context = f"coupling of {target!r}"
    of = tuple(full_name(name, known, context=context) for name in table.of)
    units = [FACTORS[coordinates[name].motion] for name in of]
    function = table.function(len(of), context=context)
    return Coupling(target, of, function.rescaled(units, FACTORS[coordinates[target].motion]))


def joint_row(joint: Joint) -> dict[str, object]:
    """Return a joint as the plain table that makes it again [degree, scene unit]."""
    row: dict[str, object] = {
        "name": joint.name,
        "parent": joint.parent,
        "child": joint.child,
        "type": joint.kind,
    }
    if joint.kind != "weld":
        row["centre"] = joint.centre.tolist()
    if joint.kind == "custom":
        for motion, axes in (("rotation", joint.rotations), ("translation", joint.translations)):
            rows: list[dict[str, object]] = []
            for axis in axes:
                inputs = [joint.coordinates[name].motion for name in axis.coordinates]
                names = {"coordinates": list(axis.coordinates)} if axis.coordinates else {}
                function = _function_row(axis.function, inputs, motion)
                rows.append({"axis": list(axis.direction), **names, **function})
            if rows:
                row[f"{motion}s"] = rows
    elif joint.coordinates:
        named = zip(joint.coordinates, (*joint.rotations, *joint.translations))
        row["axes"] = {name: list(axis.direction) for name, axis in named}
    tables = {
        name: _coordinate_row(coordinate, joint.kind)
        for name, coordinate in joint.coordinates.items()
    }
    if joint.kind == "custom" or any(tables.values()):
        row["coordinates"] = tables
    if joint.backward:
        row["backward"] = True
    if joint.radii is not None:
        row["radii"] = list(joint.radii)
    if joint.arc:
        row["arc"] = joint.arc
    if joint.guess is not None:
        row["guess"] = joint.guess.model_dump(exclude_unset=True)
    return row


def coupling_row(coupling: Coupling, joints: list[Joint]) -> dict[str, object]:
    """Return a coupling as the plain table that makes it again."""
    known = all_coordinates(joints)
    inputs = [known[name].motion for name in coupling.of]
    function = _function_row(coupling.function, inputs, known[coupling.coordinate].motion)
    return {"coordinate": coupling.coordinate, "of": list(coupling.of), **function}


def _coordinate_row(coordinate, kind):
    factor = FACTORS[coordinate.motion]
    row: dict[str, object] = {"motion": coordinate.motion} if kind == "custom" else {}
    if coordinate.rest:
        row["rest"] = coordinate.rest / factor
    if coordinate.range is not None:
        row["range"] = [end / factor for end in coordinate.range]
    row.update({key: True for key in ("clamped", "locked") if getattr(coordinate, key)})
    return row


def _function_row(function: Function, inputs: Sequence[str], output: str) -> dict[str, object]:
    if function == IDENTITY and inputs == [output]:
        return {}
    function = function.rescaled(
        [1.0 / FACTORS[motion] for motion in inputs], 1.0 / FACTORS[output]
    )
    if isinstance(function, Linear):
        linear = [*function.slopes, function.constant]
        return {"linear": linear} if function.slopes else {"constant": function.constant}
    if isinstance(function, Polynomial):
        return {"polynomial": list(function.coefficients)}
    if isinstance(function, Multivariate):
        return {"terms": [list(term) for term in function.terms]}
    points = {"x": list(function.x), "y": list(function.y)}
    return {"spline" if function.degree == 3 else "piecewise": points}
