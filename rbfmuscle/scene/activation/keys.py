"""The keys of a muscle that contracts, checked as they stand in a scene."""

from collections.abc import Mapping
from typing import Annotated, Any, NamedTuple

from pydantic import BeforeValidator, Field

from rbfmuscle.geometry.arrays import Booleans
from rbfmuscle.scene.options import Positive, Table

KEYS = ("activation", "fibre_stretch_at_rest", "tendon")
TENDON_STRAIN = 0.033


class TendonTable(Table):
    """``tendon``: where the tendon is, and its strain at full activation.

    ``length`` from every attachment, or from the bone ``at`` alone. The strain of 0.033 at the
    greatest isometric force is Zajac's (Critical Reviews in Biomedical Engineering 17, 1989).
    """

    length: Positive
    at: str | None = None
    strain: Annotated[float, Field(ge=0, le=0.5)] = TENDON_STRAIN


def _check_activation(value: Any) -> Any:
    """One message in place of one for each of the forms that it may take."""
    for number in value if isinstance(value, list) and value else [value]:
        if (
            isinstance(number, bool)
            or not isinstance(number, (int, float))
            or not 0.0 <= number <= 1.0
        ):
            raise ValueError("must be a number from 0 to 1, or a list of them over the motion")
    return value


class ContractionTable(Table):
    """The keys of one muscle that contracts."""

    # 0 to 1; of a list, waypoints are spread evenly over the motion.
    activation: Annotated[float | list[float], BeforeValidator(_check_activation)] = 0.0
    # Stretch of the fibres in the scan pose against their slack length.
    fibre_stretch_at_rest: Annotated[float, Field(gt=0.2, lt=5)] | None = None
    tendon: TendonTable | None = None


def contraction_keys(given: Mapping[str, Any], *, muscle: str) -> ContractionTable | None:
    """The checked keys of one muscle, or None where it has none; a value None counts as not
    given.
    """
    found = {key: value for key, value in given.items() if value is not None}
    return ContractionTable.build(found, context=f"muscle {muscle!r} ") if found else None


class Contraction(NamedTuple):
    """What the keys of a muscle come to."""

    stretch_at_rest: float
    tendon: Booleans  # vertices (n,) of the muscle's mesh that are tendon
    tendon_strain: float = TENDON_STRAIN  # at full activation
    slack: bool = (
        False  # the scene says where passive fibres are slack, in place of the model's slack band
    )

    @property
    def shortest(self) -> float:
        """Stretch against the scan at which a fully active fibre has no tension: half its slack
        length (Zajac 1989).
        """
        return 0.5 / self.stretch_at_rest
