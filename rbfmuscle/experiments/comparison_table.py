"""What a comparison of models found."""

from collections.abc import Iterator

from pydantic import BaseModel

VALUE_COLUMNS = ("model", "muscle", "quantity", "value", "unit", "against")

# Values by muscle, "all" included, and quantity.
Values = dict[str, dict[str, float]]


class MeasureFacts(BaseModel):
    """A measure: its unit, and the words of its row of `MEASURES`."""

    unit: str
    title: str
    against: str
    meaning: str


class Spread(BaseModel):
    """Mean and standard deviation over the frames."""

    mean: float
    sd: float


class Comparison(BaseModel):
    """What ``comparison.json`` holds.

    ``poses`` are the numbers of the frames at which distances were measured, ``labels`` models as
    tables name them, ``failed`` why models were not solved, ``answer`` all of it in sentences,
    ``within`` how many muscles of each model are within all limits, ``unknowns`` the points that
    each model solves for, in words, by model and muscle. ``results`` are by model; ``statistics``
    by model, muscle and quantity, of moment arms ``"moment_arm:COORDINATE"``.
    """

    format: int
    scene: str
    units: str
    frames: int
    poses: list[int]
    models: list[str]
    labels: dict[str, str]
    failed: dict[str, str]
    answer: str
    within: dict[str, int] = {}
    unknowns: dict[str, dict[str, str]]
    measures: dict[str, MeasureFacts]
    results: dict[str, Values]
    statistics: dict[str, dict[str, dict[str, Spread]]]
    machine: dict[str, str | int | None]
    versions: dict[str, str]

    def value_rows(self) -> Iterator[tuple[str, str, str, float, str, str]]:
        """Every value, in rows of `VALUE_COLUMNS`."""
        for model, muscles in self.results.items():
            for muscle, values in muscles.items():
                for name, measure in self.measures.items():
                    if name in values:
                        yield model, muscle, name, values[name], measure.unit, measure.against
