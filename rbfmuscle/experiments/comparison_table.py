"""What comparisons of models found, on one scene and on several."""

from collections.abc import Iterator

from pydantic import BaseModel

from rbfmuscle.metrics.summary import shown_number

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


class OverScenes(BaseModel):
    """A measure of a model over scenes: mean and standard deviation of the values of each scene
    (the worst of its muscles and frames), and the worst of them, in the scene named.
    """

    mean: float
    sd: float
    worst: float
    scene: str


class ScenesComparison(BaseModel):
    """What ``scenes.json`` holds.

    ``models`` are those that were solved on every scene that any model was solved on; ``answers``
    are by scene, ``answer`` over all of them; ``failed`` says why, by scene and model, "all" for
    all models; ``summary`` is by model and measure.
    """

    format: int
    scenes: list[str]
    models: list[str]
    labels: dict[str, str]
    answers: dict[str, str]
    answer: str = ""
    failed: dict[str, dict[str, str]]
    measures: dict[str, MeasureFacts]
    summary: dict[str, dict[str, OverScenes]]
    versions: dict[str, str]

    def text(self, model: str, quantity: str) -> str:
        """Mean ± standard deviation with its unit, a dash where it is not known."""
        found = self.summary[model].get(quantity)
        unit = self.measures[quantity].unit
        if found is None:
            return shown_number(None, unit)
        return f"{shown_number(found.mean, unit)} ± {shown_number(found.sd, unit)}"
