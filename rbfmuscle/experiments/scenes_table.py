"""Models compared on several scenes: means over the scenes, and the worst."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
from pydantic import BaseModel

from rbfmuscle.experiments.comparison import FORMAT, latex_cells
from rbfmuscle.experiments.comparison_table import VALUE_COLUMNS, Comparison, MeasureFacts
from rbfmuscle.experiments.measures import DEEPER, MEASURES
from rbfmuscle.folders import write_whole
from rbfmuscle.metrics.quantities import ALL, unit_text
from rbfmuscle.metrics.summary import shown_number
from rbfmuscle.output.writer import versions, write_csv, write_json
from rbfmuscle.scene.objects import MM_PER_UNIT

UNITS = "mm"  # of all lengths, as scenes may have different units


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


def write_scenes(
    folder: Path, found: Mapping[str, Comparison], failed: Mapping[str, dict[str, str]]
) -> ScenesComparison:
    """Write ``scenes.json``, which is returned, ``scenes.csv``: every value by scene, model, muscle
    and quantity, and ``scenes.tex``.
    """
    tables = list(found.values())
    models = [name for name in tables[0].models if all(name in one.models for one in tables)]
    table = ScenesComparison(
        format=FORMAT,
        scenes=list(found),
        models=models,
        labels={name: tables[0].labels[name] for name in models},
        answers={scene: one.answer for scene, one in found.items()},
        failed={scene: reasons for scene, reasons in failed.items() if reasons},
        measures={
            name: MeasureFacts(
                unit=unit_text(m.kind, UNITS), title=m.title, against=m.against, meaning=m.meaning
            )
            for name, m in MEASURES.items()
        },
        summary={name: _summary(found, name) for name in models},
        versions=versions(),
    )
    table.answer = _answer(table, tables)
    write_json(folder / "scenes.json", table.model_dump())
    write_csv(folder / "scenes.csv", _rows(found))
    write_whole(folder / "scenes.tex", _latex(table))
    return table


def _answer(table: ScenesComparison, found: Sequence[Comparison]) -> str:
    """Muscles within limits, depth beyond rest and time of each model over the scenes."""
    muscles = sum(len(one.results[one.models[0]]) - 1 for one in found)
    parts = [
        f"{table.labels[name]} has {sum(one.within[name] for one in found)} of {muscles} muscles "
        f"within all limits, lies {table.text(name, DEEPER)} in bones beyond the overlap at rest "
        f"and takes {table.text(name, 'time_frame')} per frame"
        for name in table.models
    ]
    return f"Mean and standard deviation over {len(table.scenes)} scenes: {'; '.join(parts)}."


def _summary(found: Mapping[str, Comparison], model: str) -> dict[str, OverScenes]:
    summary = {}
    for name, measure in MEASURES.items():
        known = {}
        for scene, one in found.items():
            whole = one.results[model][ALL]
            if name in whole:
                factor = MM_PER_UNIT[one.units] if measure.kind == "length" else 1.0
                known[scene] = factor * whole[name]
        if known:
            values = np.array(list(known.values()))
            scene = max(known, key=lambda scene: abs(known[scene] - measure.ideal))
            summary[name] = OverScenes(
                mean=float(values.mean()),
                sd=float(values.std(ddof=1)) if len(values) > 1 else 0.0,
                worst=known[scene],
                scene=scene,
            )
    return summary


def _rows(found: Mapping[str, Comparison]) -> Iterator[tuple[object, ...]]:
    yield "scene", *VALUE_COLUMNS
    for scene, table in found.items():
        for row in table.value_rows():
            yield scene, *row


def _latex(table: ScenesComparison) -> str:
    lines = [
        f"% rbfmuscle {table.versions['rbfmuscle']}: mean and standard deviation over "
        f"{len(table.scenes)} scenes of the worst of muscles and frames",
        rf"\begin{{tabular}}{{ll{'r' * len(table.models)}}}",
        latex_cells(["", "against", *table.labels.values()]),
        r"\hline",
    ]
    for quantity, measure in table.measures.items():
        if any(quantity in values for values in table.summary.values()):
            texts = [table.text(model, quantity) for model in table.models]
            lines.append(latex_cells([measure.title, measure.against, *texts]))
    return "\n".join([*lines, r"\end{tabular}", ""])
