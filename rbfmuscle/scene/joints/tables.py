"""``[[joint]]`` and ``[[coupling]]``: from the tables of a scene to joints, and back.

Files and calls speak in degrees and scene units; inside are radians and scene units.
"""

import math
from collections.abc import Sequence
from typing import Literal

import numpy as np
from pydantic import Field, model_validator

from rbfmuscle.scene.guesses import GuessTable
from rbfmuscle.scene.joints.joint import (
    BY_TURNS,
    IDENTITY,
    KINDS,
    MOST_AXES,
    Coordinate,
    Coupling,
    Function,
    Joint,
    Linear,
    MotionKind,
    Multivariate,
    PiecewiseLinear,
    Polynomial,
    Spline,
    TransformAxis,
    all_coordinates,
    motion_of,
)
from rbfmuscle.scene.options import Axis, Finite, Table, Vector
from rbfmuscle.validation import SceneError, did_you_mean

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

    def function(self, inputs: Sequence[str], output: str, *, context: str) -> Function:
        """Return the function in inner units; ``inputs`` and ``output`` are kinds of motion, keys
        of `FACTORS`.
        """
        given = [name for name in FUNCTIONS if getattr(self, name) is not None]
        count, points = len(inputs), self.piecewise or self.spline
        if len(given) > 1:
            raise SceneError(f"{context}: give one function, not {' and '.join(given)}")
        found: Function
        if self.constant is not None:
            found = Linear((), self.constant)
        elif count != 1 and (self.polynomial or points):
            raise SceneError(f"{context}: {given[0]} is of 1 coordinate, {count} are given")
        elif self.polynomial is not None:
            found = Polynomial(tuple(self.polynomial))
        elif self.terms is not None:
            found = _multivariate(self.terms, count, context)
        elif points is not None:
            found = (Spline if self.spline else PiecewiseLinear)(tuple(points.x), tuple(points.y))
        else:
            *slopes, constant = self.linear or [1.0, 0.0]
            if len(slopes) != count:
                needed = f"a slope for each of {count} coordinates and a constant"
                raise SceneError(f"{context}: linear needs {needed}, got {self.linear}")
            found = Linear(tuple(slopes), constant)
        return found.rescaled([FACTORS[motion] for motion in inputs], FACTORS[output])

    def slope(self) -> float:
        """The first slope of a linear function, 0 of any other."""
        plain = all(getattr(self, name) is None for name in FUNCTIONS)
        return 1.0 if plain else (self.linear or [0.0])[0]


def _multivariate(terms, count, context):
    for term in terms:
        if len(term) != count + 1 or any(power < 0 or power % 1 for power in term[1:]):
            needed = f"a coefficient and the whole powers of {count} coordinates"
            raise SceneError(f"{context}: each of terms is {needed}, got {term}")
    return Multivariate(tuple((c, *map(int, powers)) for c, *powers in terms))


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
        kind = self.type or self._kind_by_turns(context)
        if self.centre is None and kind != "weld":
            raise SceneError(f"{context}: centre is missing, give the joint's place at rest")
        if (self.radii or self.arc) and (kind != "custom" or len(self.rotations) != 3):
            raise SceneError(f"{context}: radii and arc need type 'custom' with three rotations")
        groups = self._axes_of_kind(kind, context)
        tables = [(sort, table) for sort, group in groups.items() for table in group]
        named = dict.fromkeys(name for _, table in tables for name in table.coordinates)
        for name in self.coordinates:
            if name not in named:
                hint = did_you_mean(name, list(named))
                raise SceneError(f"{context}: coordinate {name!r} moves nothing, {hint}")
        slopes = [(sort, table.coordinates, table.slope()) for sort, table in tables]
        coordinates = {}
        for name in named:
            motion, table = motion_of(name, slopes), self.coordinates.get(name, CoordinateTable())
            if kind != "custom" and table.motion not in (None, motion):
                raise SceneError(f"{context}: {name!r} is a {motion} here, not a {table.motion}")
            coordinates[name] = table.coordinate(motion)

        def axis(motion, number, table):
            inputs = [coordinates[name].motion for name in table.coordinates]
            function = table.function(inputs, motion, context=f"{context}: {motion} {number}")
            return TransformAxis(unit(table.axis), tuple(table.coordinates), function)

        turns, shifts = (
            tuple(axis(motion, number, table) for number, table in enumerate(group, 1))
            for motion, group in groups.items()
        )
        return self._made(kind, coordinates, turns, shifts)

    def _made(self, kind, coordinates, turns, shifts):
        """The joint of this kind, these coordinates, rotations and translations."""
        centre = np.array(self.centre or (0.0, 0.0, 0.0))
        radii = None
        if self.radii is not None:
            x, y, z = self.radii
            radii = x, y, z
        bones = self.parent, self.child
        motions = coordinates, turns, shifts, kind, self.backward
        return Joint(self.name, *bones, centre, *motions, radii, self.arc, self.guess)

    def _kind_by_turns(self, context):
        """The kind where none is given: of one to three axes, each of which is turned about."""
        count = len(self.axes or self.coordinates)
        if self.rotations or self.translations or not 0 < count < len(BY_TURNS):
            words = "one to three axes make a hinge, universal or ball joint"
            raise SceneError(f"{context}: give its type; without one, {words}")
        return BY_TURNS[count]

    def _axes_of_kind(self, kind, context):
        """Tables of the rotations and of the translations of a kind; each is of one coordinate
        but in a custom joint.
        """
        if kind == "custom":
            if self.axes:
                words = "a custom joint has rotations and translations instead of axes"
                raise SceneError(f"{context}: {words}")
            if len(self.rotations) + len(self.translations) > MOST_AXES:
                raise SceneError(f"{context}: a custom joint has at most {MOST_AXES} axes")
            return {"rotation": self.rotations, "translation": self.translations}
        if self.rotations or self.translations:
            raise SceneError(
                f"{context}: rotations and translations belong to type 'custom', give axes"
            )
        usual = [*KINDS[kind].rotations, *KINDS[kind].translations]
        axes = self.axes or dict(zip(self.coordinates, usual))
        count = len(axes) or len(self.coordinates)
        if count != len(usual):
            words = f"{len(usual)} coordinates, {count} are given; name them in axes"
            raise SceneError(f"{context}: a {kind} joint has {words}")
        tables = [AxisTable(axis=list(axis), coordinates=[name]) for name, axis in axes.items()]
        turning = len(KINDS[kind].rotations)
        return {"rotation": tables[:turning], "translation": tables[turning:]}


class CouplingTable(FunctionTable):
    """``[[coupling]]``."""

    coordinate: str
    of: list[str] = Field(min_length=1)


def unit(axis: list[float]) -> tuple[float, float, float]:
    """Return an axis (3,), not zero, at length one."""
    x, y, z = (value / math.hypot(*axis) for value in axis)
    return x, y, z


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
    motions = [coordinates[name].motion for name in of]
    function = table.function(motions, coordinates[target].motion, context=context)
    return Coupling(target, of, function)


def joint_row(joint: Joint) -> dict[str, object]:
    """Return a joint as the plain table that makes it again [degree, scene unit]."""
    row: dict[str, object] = {"name": joint.name, "parent": joint.parent, "child": joint.child}
    row["type"] = joint.kind
    if joint.kind != "weld":
        row["centre"] = joint.centre.tolist()
    if joint.kind == "custom":
        for motion, axes in (("rotation", joint.rotations), ("translation", joint.translations)):
            if axes:
                row[f"{motion}s"] = [_axis_row(axis, joint.coordinates, motion) for axis in axes]
    elif joint.coordinates:
        axes = zip(joint.coordinates, (*joint.rotations, *joint.translations))
        row["axes"] = {name: list(axis.direction) for name, axis in axes}
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


def _axis_row(axis, coordinates, output):
    function = _function_row(
        axis.function, [coordinates[name].motion for name in axis.coordinates], output
    )
    names = {"coordinates": list(axis.coordinates)} if axis.coordinates else {}
    return {"axis": list(axis.direction), **names, **function}


def _function_row(function: Function, inputs: Sequence[str], output: str) -> dict[str, object]:
    if function == IDENTITY and inputs == [output]:
        return {}
    function = function.rescaled(
        [1.0 / FACTORS[motion] for motion in inputs], 1.0 / FACTORS[output]
    )
    if isinstance(function, Linear) and not function.slopes:
        return {"constant": function.constant}
    if isinstance(function, Linear):
        return {"linear": [*function.slopes, function.constant]}
    if isinstance(function, Polynomial):
        return {"polynomial": list(function.coefficients)}
    if isinstance(function, Multivariate):
        return {"terms": [list(term) for term in function.terms]}
    points = {"x": list(function.x), "y": list(function.y)}
    return {"spline" if isinstance(function, Spline) else "piecewise": points}
