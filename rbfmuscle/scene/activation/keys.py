"""The keys of a muscle that contracts, checked as they stand in a scene."""

import itertools
from collections.abc import Mapping
from typing import Annotated, NamedTuple, Self

from pydantic import BeforeValidator, Field, model_validator

from rbfmuscle.geometry.arrays import Booleans
from rbfmuscle.scene.motion_file import read_storage
from rbfmuscle.scene.options import FileName, Finite, Positive, Table
from rbfmuscle.validation import SceneError, did_you_mean

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

    def read(self, muscle: str) -> "ActivationTable":
        """The table with the numbers of its file, those of the column of a muscle where none is
        named.
        """
        if self.file is None:
            return self
        context = f"muscle {muscle!r} activation: "
        _, labels, rows = read_storage(self.file, context=context)
        name = self.column or muscle
        forms = (name, f"{name}/activation", f"/forceset/{name}/activation", f"{name}.activation")
        column = next((labels.index(form) for form in forms if form in labels), -1)
        if column < 0 or "time" not in labels:
            wanted = name if column < 0 else "time"
            hint = did_you_mean(wanted, labels)
            raise SceneError(f"{context}{self.file} has no column {wanted!r}, {hint}")
        values = {
            "times": rows[:, labels.index("time")].tolist(),
            "values": rows[:, column].tolist(),
        }
        return ActivationTable.build(values, context=f"{context}{self.file} column {name!r}: ")


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
            words = "a number from 0 to 1, a list of them over the motion, or a table"
            raise ValueError(f"must be {words}")
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


def contraction_keys(given: Mapping[str, object], *, muscle: str) -> ContractionTable | None:
    """The checked keys of one muscle, or None where it has none; a value None counts as not
    given.
    """
    found = {key: value for key, value in given.items() if value is not None}
    if not found:
        return None
    table = ContractionTable.build(found, context=f"muscle {muscle!r} ")
    if isinstance(table.activation, ActivationTable):
        table = table.model_copy(update={"activation": table.activation.read(muscle)})
    return table


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
