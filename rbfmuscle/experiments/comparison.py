"""Models on one scene, measured alike: what each keeps, how far apart they are, what each costs."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rbfmuscle.experiments.comparison_answer import describe, muscles_beyond
from rbfmuscle.experiments.comparison_table import (
    VALUE_COLUMNS,
    Comparison,
    MeasureFacts,
    Spread,
    Values,
)
from rbfmuscle.experiments.measures import DEEPER, FROM_METRICS, MEASURES
from rbfmuscle.metrics.metrics import surface_distance
from rbfmuscle.metrics.quantities import ALL, QUANTITIES, unit_text
from rbfmuscle.metrics.summary import QuantityFacts
from rbfmuscle.output.run_data import RunData, moment_arm_coordinates
from rbfmuscle.output.writer import machine, versions, write_csv, write_json
from rbfmuscle.scene.scene import Scene
from rbfmuscle.simulation.frame import Mesh

FORMAT = 4  # of comparison.json


class Repeated(NamedTuple):
    """What a model gives beside its run: the time to build it and that of a frame on one thread
    [s]; where the motion has more than one frame, surfaces by muscle at the last pose by shorter
    sub-steps (``turn``), and back at the first after the motion there and back (``end``).
    """

    build: float
    one_thread: float
    turn: dict[str, Mesh] | None = None
    end: dict[str, Mesh] | None = None


def measure_run(saved: RunData, again: Repeated) -> Values:
    """Values of every measure but the distances for one model: muscle -> quantity -> value.

    Under ``"all"`` the worst over muscles, or the wall time.
    """
    found: Values = {}
    for muscle in saved.muscles:
        facts = saved.info.muscles.get(muscle, {})
        worst = {q: facts.get(q, QuantityFacts()).get("worst") for q in FROM_METRICS}
        values = {q: value for q, value in worst.items() if value is not None}
        values[DEEPER] = _deepened(values)
        times = saved.series(muscle, "time_frame")[1][1:]  # the first loads and compiles
        if len(times):
            values["time_frame"] = float(np.median(times))
        for name, frame, meshes in (("return", 0, again.end), ("step", -1, again.turn)):
            if meshes is not None:
                mine = saved.mesh(muscle, saved.frame_numbers[frame])
                pair = surface_distance(*mine, *meshes[muscle])
                values[f"{name}_rms"], values[f"{name}_max"] = pair
        found[muscle] = values
    together: dict[str, float] = {}
    for name, measure in MEASURES.items():
        known = [values[name] for values in found.values() if name in values]
        if known:
            together[name] = max(known, key=lambda value: abs(value - measure.ideal))
    wall = saved.series(ALL, "time_frame")[1][1:]
    if len(wall):
        together["time_frame"] = float(np.median(wall))
        together["time_frame_p95"] = float(np.percentile(wall, 95))
    together["time_build"] = again.build
    together["time_one_thread"] = again.one_thread
    found[ALL] = together
    return found


def statistics(saved: RunData) -> dict[str, dict[str, Spread]]:
    """Mean and standard deviation over the frames, by muscle and quantity; of moment arms the
    quantity is ``"moment_arm:COORDINATE"``.
    """
    found = {}
    for muscle in saved.muscles:
        whole = (*FROM_METRICS, "length", "time_frame")
        series = {name: saved.series(muscle, name)[1] for name in whole}
        for about in moment_arm_coordinates(saved, muscle):
            series[f"moment_arm:{about}"] = saved.series(muscle, "moment_arm", about)[1]
        series["time_frame"] = series["time_frame"][1:]  # the first loads and compiles
        found[muscle] = {
            name: Spread(mean=float(values.mean()), sd=float(values.std()))
            for name, values in series.items()
            if len(values) and np.isfinite(values).all()
        }
    return found


def add_distances(results: dict[str, Values], folder: Path, poses: list[int]) -> None:
    """Add the distances of each model's surfaces to those of the first, the worst of some poses of
    a folder's runs, and the differences of lengths and moment arms.
    """
    first, *others = (RunData.load(folder / name) for name in results)
    for found, run in zip(list(results.values())[1:], others):
        for muscle in first.muscles:
            pairs = [surface_distance(*first.mesh(muscle, k), *run.mesh(muscle, k)) for k in poses]
            apart = dict(zip(("distance_rms", "distance_max"), map(max, zip(*pairs))))
            apart["length_rms"] = _apart(first, run, muscle, "length", None)
            arms = [
                _apart(first, run, muscle, "moment_arm", about)
                for about in moment_arm_coordinates(first, muscle)
            ]
            apart |= {"moment_arm_rms": max(arms)} if arms else {}
            for name, value in apart.items():
                if np.isfinite(value):
                    found[muscle][name] = value
                    found[ALL][name] = max(found[ALL].get(name, 0.0), value)


def _apart(first: RunData, other: RunData, muscle: str, quantity: str, about: str | None) -> float:
    """Root mean square over the frames of the difference of a quantity; NaN where frames differ."""
    (frames, mine), (others, values) = (
        run.series(muscle, quantity, about) for run in (first, other)
    )
    if not len(frames) or not np.array_equal(frames, others):
        return float("nan")
    return float(np.sqrt(np.mean((mine - values) ** 2)))


def write_tables(
    folder: Path,
    scene: Scene,
    results: dict[str, Values],
    failed: dict[str, str],
    *,
    labels: dict[str, str],
    unknowns: dict[str, dict[str, str]],
    poses: list[int],
) -> Comparison:
    """Write ``comparison.json``, which is returned, ``comparison.csv``: values by model, muscle and
    quantity, and ``statistics.csv``: their means and standard deviations over the frames.

    ``unknowns`` are the points that each model solves for, in words, by model and muscle.
    """
    runs = {name: RunData.load(folder / name) for name in results}
    beyond = {name: muscles_beyond(run) for name, run in runs.items()}
    table = Comparison(
        format=FORMAT,
        scene=scene.name,
        units=scene.units,
        frames=len(scene.motion),
        poses=poses,
        models=list(results),
        labels={name: labels[name] for name in results},
        failed=failed,
        answer=describe(results, labels, scene.units, beyond),
        within={name: len(runs[name].muscles) - len(found[ALL]) for name, found in beyond.items()},
        unknowns={name: unknowns[name] for name in results},
        measures={
            name: MeasureFacts(
                unit=unit_text(m.kind, scene.units),
                title=m.title,
                against=m.against,
                meaning=m.meaning,
            )
            for name, m in MEASURES.items()
        },
        results=results,
        statistics={name: statistics(run) for name, run in runs.items()},
        machine=machine(),
        versions=versions(),
    )
    write_json(folder / "comparison.json", table.model_dump())
    write_csv(folder / "comparison.csv", [VALUE_COLUMNS, *table.value_rows()])
    write_csv(folder / "statistics.csv", _statistics_rows(table))
    return table


def _statistics_rows(table: Comparison) -> Iterator[tuple[object, ...]]:
    yield "model", "muscle", "quantity", "mean", "sd", "unit"
    for model, muscles in table.statistics.items():
        for muscle, quantities in muscles.items():
            for name, spread in quantities.items():
                unit = unit_text(QUANTITIES[name.partition(":")[0]][0], table.units)
                yield model, muscle, name, spread.mean, spread.sd, unit


def _deepened(values: Mapping[str, float]) -> float:
    """How deep a muscle is in a bone, or a bone in it, beyond what is left at rest."""
    deepest = max(values.get(name, 0.0) for name in ("penetration_max", "bone_penetration_max"))
    return max(0.0, deepest - values.get("initial_overlap", 0.0))
