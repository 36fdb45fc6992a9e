"""What a comparison of models amounts to, in sentences."""

from collections.abc import Mapping

from rbfmuscle.experiments.comparison_table import Values
from rbfmuscle.experiments.measures import DEEPER, FIRST, MEASURES
from rbfmuscle.metrics.quantities import ALL, unit_text
from rbfmuscle.metrics.summary import LIMITS, shown_number
from rbfmuscle.output.run_data import RunData
from rbfmuscle.scene.objects import from_mm

# A model keeps out of bones that is no deeper in one [mm].
KEPT_OUT = 0.3
# How many quantities beyond limits are named; of depths the sentences say what is beyond rest.
MOST_TOLD = 4
_DEPTHS = ("penetration_max", "bone_penetration_max", "initial_overlap")
_TIE = 1.05  # models whose values differ by less are equally good

Beyond = Mapping[str, Mapping[str, set[str]]]


def best_models(results: dict[str, Values], quantity: str, units: str) -> list[str]:
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
    scale = from_mm(1.0, units) if measure.kind == "length" else 1.0
    limit = _TIE * min(values.values()) + measure.floor * scale
    return [name for name, value in values.items() if value <= limit]


def muscles_beyond(saved: RunData) -> dict[str, set[str]]:
    """The muscles of a run that are not within a limit, by quantity; under ``"all"`` those that are
    not within all limits, or not measured for one.
    """
    found: dict[str, set[str]] = {ALL: set()}
    pairs = [(row.muscle, row.quantity) for row in saved.info.beyond]
    pairs += [(row.muscle, row.quantity) for row in saved.info.not_measured]
    for muscle, quantity in pairs:
        if muscle in saved.muscles:
            found[ALL].add(muscle)
            found.setdefault(quantity, set()).add(muscle)
    return found


def _failures(beyond: Beyond, labels: dict[str, str]) -> list[str]:
    """For each model what its muscles are not within the limits of, most muscles first."""
    texts = []
    for model, found in beyond.items():
        named = {quantity: sorted(muscles) for quantity, muscles in found.items() if muscles}
        named.pop(ALL, None)
        most = sorted(named, key=lambda quantity: len(named[quantity]), reverse=True)[:MOST_TOLD]
        told = [f"{LIMITS[quantity].title} ({_some(named[quantity])})" for quantity in most]
        if told:
            texts.append(f"Beyond limits, {labels[model]}: {', '.join(told)}")
    return texts


def _some(names: list[str]) -> str:
    """A few of some names."""
    more = f" and {len(names) - MOST_TOLD} more" if len(names) > MOST_TOLD else ""
    return ", ".join(names[:MOST_TOLD]) + more


def _differences(
    results: dict[str, Values],
    labels: dict[str, str],
    units: str,
    beyond: Beyond,
) -> list[str]:
    """Worst values of what most muscles are beyond a limit of, and of the return error, where the
    models differ in it.
    """
    counts = {
        name: [len(beyond.get(model, {}).get(name, ())) for model in results] for name in MEASURES
    }
    told = [name for name, count in counts.items() if any(count) and name not in _DEPTHS]
    told.sort(key=lambda name: max(counts[name]) - min(counts[name]), reverse=True)
    texts = []
    for name in (*told[:MOST_TOLD], "return_rms"):
        known = [model for model in results if name in results[model][ALL]]
        best = best_models(results, name, units)
        if len(best) < len(known) and len(known) > 1:
            unit = unit_text(MEASURES[name].kind, units)
            values = [
                f"{shown_number(results[model][ALL][name], unit)} ({labels[model]})"
                for model in known
            ]
            texts.append(f"{MEASURES[name].title} {', '.join(values)}")
    return texts


def describe(results: dict[str, Values], labels: dict[str, str], units: str, beyond: Beyond) -> str:
    """How many muscles of each model are within all limits, what the others are beyond, and where
    the models differ; then whether the first keeps out of bones, its time against the quickest
    other one, which is nearest in shape.

    Arguments are those of `write_tables`, ``beyond`` is `muscles_beyond` of each model; distances
    are to the first model.
    """
    muscles = len(next(iter(results.values()))) - 1
    kept = [
        f"{muscles - len(found[ALL])} of {muscles} ({labels[name]})"
        for name, found in beyond.items()
    ]
    texts = [f"Muscles within all limits: {', '.join(kept)}"] if kept else []
    texts += _failures(beyond, labels)
    if differ := _differences(results, labels, units, beyond):
        texts.append(f"Worst values: {'; '.join(differ)}")
    whole = {name: found[ALL] for name, found in results.items()}
    texts += [*_depths(whole, labels, units), *_times_and_shapes(whole, labels, units)]
    if len(results) > 1:
        texts.append(
            "Which shape is right this cannot say; docs/validation.md compares with finite elements"
        )
    return f"{'. '.join(texts)}."


def _depths(whole: Values, labels: dict[str, str], units: str) -> list[str]:
    """Whether the first model keeps out of bones, and how deep the others are; ``whole`` are values
    of all muscles by model.
    """
    first, *others = whole
    depth = whole[first].get(DEEPER, 0.0)
    verb = "keeps out of" if depth <= from_mm(KEPT_OUT, units) else "enters"
    there = [
        f"{labels[name]}: {shown_number(whole[name].get(DEEPER, 0.0), units)}" for name in others
    ]
    texts = [
        f"{labels[first]} {verb} bones: {shown_number(depth, units)} deep at most beyond "
        "the overlap at rest" + (f" ({'; '.join(there)})" if there else "")
    ]
    before = whole[first].get("solver_penetration_max", 0.0)
    if before > whole[first].get("penetration_max", 0.0) + from_mm(0.02, units):
        texts.append(
            f"Before it is clipped along bones its points are {shown_number(before, units)} deep"
        )
    return texts


def _times_and_shapes(whole: Values, labels: dict[str, str], units: str) -> list[str]:
    """The first model's time against the quickest other one, and which is nearest in shape."""
    first, *others = whole
    texts = []
    timed = [
        name for name in others if "time_frame" in whole[name] and "time_frame" in whole[first]
    ]
    quick = min(timed, key=lambda name: whole[name]["time_frame"], default=None)
    if quick:
        ratio = whole[first]["time_frame"] / whole[quick]["time_frame"]
        name = f"{labels[quick]}{', the quickest of the others' if len(others) > 1 else ''}"
        texts.append(f"{labels[first]} takes {ratio:.2g} times the time of {name}")
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
    return texts
