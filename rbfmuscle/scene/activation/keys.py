"""The keys of a muscle that contracts, checked as they stand in a scene."""

from dataclasses import dataclass
from typing import Annotated

from pydantic import Field, model_validator

from rbfmuscle.scene.options import Positive, Table

KEYS = ("activation", "fibre_stretch_at_rest", "optimal_fibre_length", "shortening", "tendon")

Fraction = Annotated[float, Field(ge=0, le=1, allow_inf_nan=False)]


TENDON_STRAIN = 0.033


class CurveTable(Table):
    """``activation`` as a table: a ``column`` of a ``file``, by default the one named as the muscle."""

    file: str
    column: str | None = None


class TendonTable(Table):
    """``tendon`` as a table: where the tendon is, and its strain at full activation.

    ``length`` from every attachment, or from the bone ``at`` alone; or ``vertices`` of the muscle's mesh. The strain
    of 0.033 at the greatest isometric force is Zajac's (Critical Reviews in Biomedical Engineering 17, 1989).
    """

    length: Positive | None = None
    vertices: str | list[int] | None = None
    at: str | None = None
    strain: Annotated[float, Field(ge=0, le=0.5, allow_inf_nan=False)] = TENDON_STRAIN

    @model_validator(mode="after")
    def _check_one_place(self):
        if (self.length is None) == (self.vertices is None):
            raise ValueError("give one of length and vertices")
        if self.at is not None and self.vertices is not None:
            raise ValueError("at (a bone) belongs to length, not to vertices")
        return self


class ContractionTable(Table):
    """The keys of one muscle that contracts.

    Attributes
    ----------
    activation : number, list of numbers, or table
        0 to 1; waypoints are spread evenly over the motion.
    fibre_stretch_at_rest : float
        Stretch of the fibres in the scan pose against their slack length.
    optimal_fibre_length : float, optional
        The slack length itself [scene unit]; the muscle then needs ``fibres``.
    shortening : float
        Stretch, against the slack length, at which a fully activated fibre is content. The default is where
        muscle gives no active force any more: half the optimal length (Zajac 1989).
    tendon : number (a share of the length at every attachment) or table, optional
    """

    activation: Fraction | Annotated[list[Fraction], Field(min_length=1)] | CurveTable = 0.0
    fibre_stretch_at_rest: Annotated[float, Field(gt=0.2, lt=5, allow_inf_nan=False)] | None = None
    optimal_fibre_length: Positive | None = None
    shortening: Annotated[float, Field(gt=0.1, le=1, allow_inf_nan=False)] = 0.5
    tendon: Annotated[float, Field(gt=0, lt=1)] | TendonTable | None = None

    @model_validator(mode="after")
    def _check_one_length(self):
        if self.fibre_stretch_at_rest is not None and self.optimal_fibre_length is not None:
            raise ValueError("give one of fibre_stretch_at_rest and optimal_fibre_length, not both")
        return self


@dataclass(frozen=True)
class Contraction:
    """What the keys come to, for one muscle.

    Attributes
    ----------
    stretch_at_rest : float
    shortening : float
    tendon : (n,) ndarray of bool
        Vertices of the muscle's mesh that are tendon.
    tendon_strain : float
        At full activation.
    slack : bool
        Whether the scene says where passive fibres are slack; the model's own slack band holds where not.
    """

    stretch_at_rest: float
    shortening: float
    tendon: object
    tendon_strain: float
    slack: bool = False
