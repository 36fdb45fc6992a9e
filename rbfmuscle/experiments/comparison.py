"""Models on one scene, measured alike: what each keeps, how far apart they are, what each costs."""

from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rbfmuscle.metrics.metrics import surface_distance
from rbfmuscle.metrics.quantities import ALL, unit_text
from rbfmuscle.output.run_data import RunData
from rbfmuscle.output.writer import machine, versions, write_csv, write_json
from rbfmuscle.scene.objects import MM_PER_UNIT
from rbfmuscle.scene.scene import Scene

FORMAT = 3
LAW = "law"
MESH = "input mesh"
FIRST = "first model"
COST = "cost"
# A model keeps out of bones that is no deeper in one [mm].
KEPT_OUT = 0.3


class Measure(NamedTuple):
    """A row of the table.

    ``against`` says what a value is an error of or against; a value is better the smaller its
    magnitude, and differences of less than ``floor`` (millimetres for lengths) do not count.
    ``ideal`` is the perfect value.
    """

    title: str
    kind: str
    against: str
    floor: float
    meaning: str
    ideal: float = 0.0


MEASURES = {
    "volume_error": Measure("volume error", "1", LAW, 1e-5, "relative to the input mesh"),
    "penetration_max": Measure(
        "surface in a bone", "length", LAW, 0.02, "deepest surface vertex in a bone"
    ),
    "bone_penetration_max": Measure(
        "bone in the muscle", "length", LAW, 0.02, "deepest bone vertex in it"
    ),
    "solver_penetration_max": Measure(
        "before the cut", "length", LAW, 0.02, "model in a bone by then"
    ),
    "initial_overlap": Measure(
        "overlap left at rest", "length", LAW, 0.02, "of muscle and bones at first"
    ),
    "bowing": Measure("bowing", "1", LAW, 0.005, "centreline over shortest path", 1.0),
    "components": Measure(
        "pieces", "1", LAW, 0.0, "connected pieces of the surface, most in any frame"
    ),
    "euler_characteristic": Measure(
        "Euler characteristic", "1", LAW, 0.0, "2 for a sphere, two less for a handle", 2.0
    ),
    "self_crossings": Measure(
        "self-crossings", "1", LAW, 0.0, "triangles that cross others of the surface"
    ),
    "flicker": Measure(
        "flicker", "length", LAW, 0.05, "surface against material mesh, frame to frame"
    ),
    "tunnelled": Measure("tunnelled points", "1", LAW, 0.0, "points beyond a bone"),
    "return_rms": Measure(
        "return error (RMS)", "length", LAW, 0.02, "first pose before and after motion"
    ),
    "return_max": Measure(
        "return error (greatest)", "length", LAW, 0.1, "the same, greatest distance"
    ),
    "step_rms": Measure("step dependence (RMS)", "length", LAW, 0.02, "last pose by coarser steps"),
    "step_max": Measure(
        "step dependence (greatest)", "length", LAW, 0.1, "the same, greatest distance"
    ),
    "rest_error_rms": Measure(
        "rest error (RMS)", "length", MESH, 0.02, "surface to input mesh at rest"
    ),
    "rest_error_max": Measure(
        "rest error (greatest)", "length", MESH, 0.1, "the same, greatest distance"
    ),
    "distance_rms": Measure(
        "distance (RMS)", "length", FIRST, 0.0, "to the first model's, worst pose"
    ),
    "distance_max": Measure(
        "distance (greatest)", "length", FIRST, 0.0, "the same, greatest distance"
    ),
    "time_frame": Measure(
        "time per frame", "s", COST, 0.0, "median of all muscles together, with surfaces"
    ),
    "time_frame_p95": Measure(
        "time per frame (95 %)", "s", COST, 0.0, "exceeded by one frame in 20"
    ),
    "time_build": Measure(
        "build", "s", COST, 0.0, "models of all muscles, once, with filled caches"
    ),
}
_FROM_METRICS = [name for name, m in MEASURES.items() if m.against in (LAW, MESH)]
_TIE = 1.05


def measure_run(saved: RunData, extra: dict[str, Any]) -> dict[str, Any]:
    """Values of every measure but the distances for one model: muscle -> quantity -> value.

    Under ``"all"`` the worst over muscles, or the wall time. ``extra`` holds ``build`` [s], and
    where the motion has more than one frame ``turn`` and ``end``: surfaces by muscle (vertices,
    faces) at the last pose and back at the first, by coarser steps.
    """
    found = {}
    for muscle in saved.muscles:
        facts = saved.info.muscles.get(muscle, {})
        values = {q: facts[q]["worst"] for q in _FROM_METRICS if "worst" in facts.get(q, {})}
        times = saved.series(muscle, "time_frame")[1][1:]  # the first loads and compiles
        if len(times):
            values["time_frame"] = float(np.median(times))
        for name, frame, part in (("return", 0, "end"), ("step", -1, "turn")):
            if part in extra:
                pair = surface_distance(
                    *saved.mesh(muscle, saved.frame_numbers[frame]), *extra[part][muscle]
                )
                values[f"{name}_rms"], values[f"{name}_max"] = pair
        found[muscle] = values
    together = {}
    for name, measure in MEASURES.items():
        known = [values.get(name) for values in found.values()]
        worst = [value for value in known if value is not None]
        together[name] = max(worst, key=lambda v: abs(v - measure.ideal), default=None)
    wall = saved.series(ALL, "time_frame")[1][1:]
    if len(wall):
        together.update(
            time_frame=float(np.median(wall)), time_frame_p95=float(np.percentile(wall, 95))
        )
    together["time_build"] = extra["build"]
    found[ALL] = {name: value for name, value in together.items() if value is not None}
    return found


def add_distances(results: dict[str, Any], folder: Path, poses: list[int]) -> None:
    """Add the distances of each model's surfaces to those of the first, the worst of some poses of
    a folder's runs.
    """
    first, *others = (RunData.load(folder / name) for name in results)
    for found, run in zip(list(results.values())[1:], others):
        for muscle in first.muscles:
            pairs = [surface_distance(*first.mesh(muscle, k), *run.mesh(muscle, k)) for k in poses]
            for name, values in zip(("distance_rms", "distance_max"), zip(*pairs)):
                found[muscle][name] = max(values)
                found[ALL][name] = max(found[ALL].get(name, 0.0), max(values))


def write_tables(
    folder: Path,
    scene: Scene,
    results: dict[str, Any],
    failed: dict[str, str],
    *,
    labels: dict[str, str],
    poses: list[int],
) -> dict[str, Any]:
    """Write ``comparison.json``, which is returned, and ``comparison.csv``: values by model, muscle
    and quantity.
    """
    units = {name: unit_text(m.kind, scene.units) for name, m in MEASURES.items()}
    facts = ("title", "against", "meaning")
    measures = {
        n: {"unit": units[n], **{key: getattr(m, key) for key in facts}}
        for n, m in MEASURES.items()
    }
    table = {
        "format": FORMAT,
        "scene": scene.name,
        "units": scene.units,
        "frames": len(scene.motion),
        "poses": poses,
        "models": list(results),
        "labels": {name: labels[name] for name in results},
        "failed": failed,
        "answer": describe(results, labels, scene.units),
        "measures": measures,
        "results": results,
        "machine": machine(),
        "versions": versions(),
    }
    write_json(folder / "comparison.json", table)
    rows: list[tuple[Any, ...]] = [("model", "muscle", "quantity", "value", "unit", "against")]
    for model, muscles in results.items():
        for muscle, values in muscles.items():
            known = [(name, m.against) for name, m in MEASURES.items() if name in values]
            rows += [
                (model, muscle, name, values[name], units[name], against) for name, against in known
            ]
    write_csv(folder / "comparison.csv", rows)
    return table


def best_models(results: dict[str, Any], quantity: str, units: str) -> list[str]:
    """Models that are as good as the best in a measure: within 5 %, or within what does not
    count.
    """
    measure = MEASURES[quantity]
    known = {
        name: found[ALL][quantity] for name, found in results.items() if quantity in found[ALL]
    }
    values = {name: abs(value - measure.ideal) for name, value in known.items()}
    if measure.against == FIRST or len(values) < 2:
        return []
    scale = 1.0 / MM_PER_UNIT[units] if measure.kind == "length" else 1.0
    limit = _TIE * min(values.values()) + measure.floor * scale
    return [name for name, value in values.items() if value <= limit]


def _deepened(values: dict[str, float]) -> float:
    """How deep a muscle is in a bone, or a bone in it, beyond what the surface has at rest."""
    surface = values.get("penetration_max", 0.0) - values.get("initial_overlap", 0.0)
    return max(surface, values.get("bone_penetration_max", 0.0))


def describe(results: dict[str, Any], labels: dict[str, str], units: str) -> str:
    """Whether the first model keeps out of bones, its time against the quickest other one, which is
    nearest in shape.

    Arguments are those of `write_tables`; distances are to the first model.
    """
    first, *others = results
    whole = {name: found[ALL] for name, found in results.items()}
    depth = {name: max(map(_deepened, found.values())) for name, found in results.items()}
    verb = "keeps out of" if depth[first] <= KEPT_OUT / MM_PER_UNIT[units] else "enters"
    texts = [
        f"{labels[first]} {verb} bones: {depth[first]:.2g} {units} deep at most, without the "
        "overlap at rest"
    ]
    timed = [
        name for name in others if "time_frame" in whole[name] and "time_frame" in whole[first]
    ]
    quick = min(timed, key=lambda name: whole[name]["time_frame"], default=None)
    if quick:
        ratio = whole[first]["time_frame"] / whole[quick]["time_frame"]
        name = f"{labels[quick]}{', the quickest of the others' if len(others) > 1 else ''}"
        texts.append(
            f"It takes {ratio:.2g} times the time of {name} ({depth[quick]:.2g} {units} deep)"
        )
    apart = {name: whole[name]["distance_rms"] for name in others if "distance_rms" in whole[name]}
    if apart:
        near = min(apart, key=apart.__getitem__)
        away = f"{apart[near]:.2g} {units} RMS"
        if len(others) == 1:
            texts.append(f"The two surfaces are {away} apart")
        else:
            texts.append(f"Nearest to it in shape is {labels[near]} ({away})")
            if near in timed and near != quick:
                ratio = whole[near]["time_frame"] / whole[first]["time_frame"]
                texts[-1] += f", which takes {ratio:.2g} times the time of {labels[first]}"
    return f"{'. '.join(texts)}."
