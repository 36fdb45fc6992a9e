"""Models compared on several scenes: means over the scenes, and the worst."""

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from rbfmuscle.experiments.comparison import FORMAT, latex_table, measure_facts
from rbfmuscle.experiments.comparison_table import (
    VALUE_COLUMNS,
    Comparison,
    OverScenes,
    ScenesComparison,
)
from rbfmuscle.experiments.measures import DEEPER, MEASURES
from rbfmuscle.folders import write_whole
from rbfmuscle.metrics.quantities import ALL
from rbfmuscle.output.writer import versions, write_csv, write_json
from rbfmuscle.scene.objects import MM_PER_UNIT

UNITS = "mm"  # of all lengths, as scenes may have different units


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
        measures=measure_facts(UNITS),
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
    rows = {
        quantity: [table.text(model, quantity) for model in table.models]
        for quantity in table.measures
        if any(quantity in values for values in table.summary.values())
    }
    scenes = f"{len(table.scenes)} scenes of the worst of muscles and frames"
    return latex_table(table, rows, f"mean and standard deviation over {scenes}")
