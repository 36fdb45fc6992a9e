"""The tables of a scene that hold settings; the same rules hold for a file, for code and for
``--set``.
"""

import itertools
import math
import re
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import Annotated, ClassVar, Literal, NamedTuple, Self

import numpy as np
from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    ValidationError,
    ValidationInfo,
    model_validator,
)
from pydantic_core import PydanticCustomError

from rbfmuscle.geometry.arrays import Booleans
from rbfmuscle.validation import SceneError, did_you_mean, shown

# How deep tables and lists of a scene file may lie in each other, and how large a whole number may
# be: beyond 2^53 it is no longer the number that was written once it meets a float.
DEEPEST = 20
LARGEST_INTEGER = 2**53
MAX_FRAMES = 100_000

Finite = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0, allow_inf_nan=False)]


def _listed(vector: object) -> object:
    """An array or a tuple as a list; anything else as it is."""
    return np.asarray(vector).tolist() if isinstance(vector, (np.ndarray, tuple)) else vector


Vector = Annotated[list[Finite], Field(min_length=3, max_length=3), BeforeValidator(_listed)]


def in_folder(name: object, info: ValidationInfo) -> Path:
    """A file's path; names are relative to the folder of the scene file."""
    if isinstance(name, Path):
        return name
    if not isinstance(name, str):
        raise ValueError("must be the name of a file")
    return ((info.context or {}).get("folder") or Path()) / name


# A file: relative to the scene file, where there is one.
FileName = Annotated[Path, BeforeValidator(in_folder)]


def _check_length(vector):
    if not any(vector):
        raise ValueError("must not be the zero vector")
    return vector


Axis = Annotated[Vector, AfterValidator(_check_length)]


def check_plain(value: object, *, context: str, depth: int = 0) -> None:
    """Raise SceneError where TOML holds what no key can mean: deep nesting, vast integers, nan or
    inf.
    """
    if depth > DEEPEST:
        raise SceneError(f"{shown(context)}: tables or lists are nested more than {DEEPEST} deep")
    if isinstance(value, (dict, list)):
        dot = "." if depth else ""
        for key, item in value.items() if isinstance(value, dict) else enumerate(value, 1):
            if not isinstance(item, str):
                check_plain(item, context=f"{context}{dot}{shown(str(key))}", depth=depth + 1)
    elif isinstance(value, int) and abs(value) > LARGEST_INTEGER:
        raise SceneError(
            f"{context}: a whole number must be at most 2^53 in size, got {shown(value)}"
        )
    elif isinstance(value, float) and not math.isfinite(value):
        raise SceneError(f"{context}: must be a finite number, got {value}")


class Table(BaseModel):
    """A table whose unknown keys are errors that name the nearest right one, or what ``hints`` say
    of them: keys of earlier formats or of other tables.
    """

    hints: ClassVar[Mapping[str, str]] = {}
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True, populate_by_name=True)

    @model_validator(mode="before")
    @classmethod
    def _name_unknown_keys(cls, data: object) -> object:
        if not isinstance(data, dict):
            return data
        known = [field.alias or name for name, field in cls.model_fields.items()]
        for key in data:
            if key not in known and key not in cls.model_fields:
                raise PydanticCustomError(
                    "unknown_key",
                    "unknown key '{key}', {hint}",
                    {
                        "key": shown(str(key)),
                        "hint": cls.hints.get(key) or did_you_mean(key, known),
                    },
                )
        return data

    @classmethod
    def build(
        cls,
        values: Mapping[str, object],
        *,
        context: str,
        folder: Path | None = None,
        name_row: Callable[[tuple[str | int, ...]], str] | None = None,
    ) -> Self:
        """Return the table made from a mapping, or raise SceneError that begins with ``context``.

        Relative names of files are relative to ``folder``; ``name_row`` turns pydantic's location
        into words.
        """
        try:
            return cls.model_validate(values, context={"folder": folder})
        except ValidationError as error:
            raise SceneError(f"{context}{_describe_error(error, name_row)}") from None


def set_dotted(table: dict[str, object], key: str, value: object, *, context: str) -> None:
    """Set the dotted ``key`` of nested tables, in place; ``context`` begins the message where a
    value is no table.
    """
    *parents, last = key.split(".")
    for parent in parents:
        inner = table.get(parent, {})
        if not isinstance(inner, dict):
            raise SceneError(f"{context}: {parent!r} is not a table")
        copied: dict[str, object] = dict(inner)
        table[parent] = copied
        table = copied
    table[last] = value


def _describe_error(error, name_row):
    """The first problem of a pydantic error as "where: what, given value"."""
    first = error.errors(include_url=False)[0]
    # Of a value of several types, pydantic's place names the class that it tried.
    parts = [str(part) for part in first["loc"] if not str(part).endswith(("Options", "]"))]
    where = name_row(first["loc"]) if name_row else ".".join(parts)
    message = first["msg"].removeprefix("Value error, ")
    message = re.sub(
        r"a valid dictionary( or instance of \w+)?", "a table", message[0].lower() + message[1:]
    )
    given = first.get("input")
    value = ""
    if first["type"] not in ("unknown_key", "missing") and not isinstance(given, dict):
        value = f", got {shown(repr(given) if isinstance(given, str) else given)}"
    return f"{where}: {message}{value}" if where else message + value


class GuessTable(Table):
    """``guess`` of a joint or an attachment: that it is one, how sure, and why."""

    confidence: Annotated[float, Field(ge=0.0, le=1.0)]
    reason: str = ""


class ContactOptions(Table):
    """``[contact]``: how muscles meet bones."""

    initial: Literal["keep", "error"] = "keep"
    substep_angle: Annotated[float, Field(gt=0, le=90)] = 2.0


Pair = Annotated[list[str], Field(min_length=2, max_length=2)]


class NeighbourOptions(Table):
    """``[neighbours]``: muscles that touch; ``neighbours = false`` lets them pass through."""

    pairs: list[Pair] | None = None
    together: bool = False
    bones: list[Pair] = Field(default_factory=list)  # muscle, bone

    def among(self, names: Collection[str]) -> "NeighbourOptions":
        """The same for some of the muscles."""
        bones = [pair for pair in self.bones if pair[0] in names]
        pairs = self.pairs and [pair for pair in self.pairs if set(pair) <= set(names)]
        return self.model_copy(update={"pairs": pairs, "bones": bones})


# False stands for none, true for the usual ones.
Neighbours = Annotated[
    NeighbourOptions | None,
    BeforeValidator(lambda x: (NeighbourOptions() if x else None) if isinstance(x, bool) else x),
]


class TunnellingOptions(Table):
    """``detect.tunnelling``: points that pass through a bone in one step."""

    angle: Annotated[float, Field(gt=0, lt=180)] | None = None
    action: Literal["substep", "report", "off"] = "substep"


class DetectOptions(Table):
    """``[detect]``: what is looked for while a motion runs."""

    tunnelling: TunnellingOptions = TunnellingOptions()


def _accept_format(value: object) -> object:
    """Scene files may say ``{ format = "pvd" }`` in place of true."""
    if isinstance(value, dict):
        if value != {"format": "pvd"}:
            raise ValueError(
                'must be true, false or { format = "pvd" }; rbfmuscle export writes other formats'
            )
        return True
    return value


DEFAULT_FIBRES, MOST_FIBRES = 32, 1000  # of each muscle


class OutputOptions(Table):
    """``[output]``: which files a run writes, and how many fibres of each muscle it follows."""

    surfaces: Annotated[bool, BeforeValidator(_accept_format)] = True
    # True stands for the usual number of fibres, false for none.
    fibres: Annotated[
        int,
        Field(ge=0, le=MOST_FIBRES),
        BeforeValidator(lambda x: DEFAULT_FIBRES * x if isinstance(x, bool) else x),
    ] = 0
    report: bool = True


class RampOptions(Table):
    """One coordinate from one value to another [degree or scene unit]."""

    start: Finite | None = Field(alias="from", default=None)
    end: Finite = Field(alias="to")
    step: Positive


class MotionOptions(Table):
    """``[motion]``: a ramp, waypoints or an OpenSim file; without any, the rest pose alone."""

    ramp: dict[str, RampOptions] | None = None
    waypoints: Annotated[list[dict[str, Finite]], Field(min_length=1)] | None = None
    step: Positive | None = None
    file: FileName | None = None

    @model_validator(mode="after")
    def _check_one_source(self):
        given = [key for key in ("ramp", "waypoints", "file") if getattr(self, key) is not None]
        if len(given) > 1:
            raise ValueError(f"give one of ramp, waypoints and file, not {' and '.join(given)}")
        if self.waypoints is not None and len(self.waypoints) > 1 and self.step is None:
            raise ValueError("waypoints need a step (degrees between frames)")
        if self.step is not None and self.waypoints is None:
            raise ValueError("step belongs to waypoints; a ramp has its own step")
        return self


KEYS = ("activation", "fibre_stretch_at_rest", "tendon_region")
TENDON_STRAIN = 0.033  # at full activation (Zajac 1989)


class TendonRegionTable(Table):
    """``tendon_region``: where the tendon is, and its strain at full activation.

    ``length`` from every attachment, or from the bone ``at`` alone. The strain of 0.033 at the
    greatest isometric force is Zajac's (Critical Reviews in Biomedical Engineering 17, 1989).
    """

    length: Positive
    at: str | None = None
    strain: Annotated[float, Field(ge=0, le=0.5)] = TENDON_STRAIN


Share = Annotated[float, Field(ge=0.0, le=1.0)]


class ActivationTable(Table):
    """``activation``: values, 0 to 1, at frames of the motion, counted from 0, or at times [s], or
    a column of an OpenSim storage file; straight between them, and constant beyond.
    """

    frames: list[Annotated[int, Field(ge=0)]] | None = Field(default=None, min_length=1)
    times: list[Finite] | None = Field(default=None, min_length=1)
    values: list[Share] | None = None
    file: FileName | None = None
    column: str | None = None

    @model_validator(mode="after")
    def _check_places(self) -> Self:
        given = [key for key in ("frames", "times", "file") if getattr(self, key) is not None]
        if len(given) != 1:
            raise ValueError(f"give one of frames, times and file, got {' and '.join(given) or 0}")
        if self.file is None and self.column is not None:
            raise ValueError("column belongs to file")
        if (self.values is None) != (self.file is not None):
            raise ValueError("values belong to frames or times, a file has its own")
        at = self.frames or self.times or []
        if self.values is not None and len(self.values) != len(at):
            raise ValueError(f"{given[0]} has {len(at)} numbers and values {len(self.values)}")
        if any(b <= a for a, b in itertools.pairwise(at)):
            raise ValueError(f"{given[0]} must increase")
        return self


def _check_activation(value: object) -> object:
    """One message in place of one for each of the forms that it may take."""
    if isinstance(value, (dict, ActivationTable)):
        return value
    for number in value if isinstance(value, list) and value else [value]:
        if (
            isinstance(number, bool)
            or not isinstance(number, (int, float))
            or not 0.0 <= number <= 1.0
        ):
            raise ValueError(
                "must be a number from 0 to 1, a list of them over the motion, or a table"
            )
    return value


class ContractionTable(Table):
    """The keys of one muscle that contracts."""

    # 0 to 1; of a list, waypoints are spread evenly over the motion.
    activation: Annotated[
        ActivationTable | float | list[float],
        Field(union_mode="left_to_right"),
        BeforeValidator(_check_activation),
    ] = 0.0
    # Stretch of the fibres in the scan pose against their slack length.
    fibre_stretch_at_rest: Annotated[float, Field(gt=0.2, lt=5)] | None = None
    tendon_region: TendonRegionTable | None = None


class Contraction(NamedTuple):
    """What the keys of a muscle come to."""

    stretch_at_rest: float
    tendon: Booleans  # vertices (n,) of the muscle's mesh that are tendon
    tendon_strain: float = TENDON_STRAIN  # at full activation
    # The scene says where passive fibres are slack, in place of the model's slack band.
    slack: bool = False

    @property
    def shortest(self) -> float:
        """Stretch against the scan at which a fully active fibre has no tension: half its slack
        length (Zajac 1989).
        """
        return 0.5 / self.stretch_at_rest
