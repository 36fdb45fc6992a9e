"""The verdict of a run, as data and in sentences; what a run shows that no limit holds and a reader
should know; published moment arms of fibres, least and greatest of each muscle by angle.
"""

import json
from collections.abc import Mapping, Sequence
from functools import cache
from importlib.resources import files
from typing import NamedTuple

import numpy as np

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.metrics.quantities import ALL, Row, quantity_of, split_name
from rbfmuscle.metrics.rows import ROUGH
from rbfmuscle.metrics.summary import (
    LIMITS,
    LOWER_BOUNDS,
    Doubt,
    Exceedance,
    Limits,
    Table,
    Unmeasured,
    exceeded,
    shown_number,
    unmeasured,
)
from rbfmuscle.scene.joints import all_coordinates
from rbfmuscle.scene.motion import rest_coordinates
from rbfmuscle.scene.objects import from_mm
from rbfmuscle.scene.scene import Scene
from rbfmuscle.validation import LimitExceededError, listed

MOST_NAMED = 6  # exceeded limits that a verdict names
REMEDIES = "What to do"  # head of that part of a verdict


class Verdict(NamedTuple):
    """What a run is worth: which muscles are within all limits in one sentence, what is beyond a
    limit, the limits without a value, and doubts.
    """

    outcome: str
    beyond: list[Exceedance]
    not_measured: list[Unmeasured]
    doubts: list[Doubt]


def judge(table: Table, limits: Limits, doubts: Sequence[Doubt] = ()) -> Verdict:
    """The verdict of a run's table."""
    found, missing = exceeded(table, limits), unmeasured(table, limits)
    return Verdict(_outcome(table, found, missing), found, missing, list(doubts))


def _outcome(table: Table, found: list[Exceedance], missing: list[Unmeasured]) -> str:
    """Which muscles are within all limits."""
    muscles = [name for name in table if name != ALL]
    wrong = [name for name in dict.fromkeys(row.muscle for row in found) if name != ALL]
    unknown = [name for name in dict.fromkeys(row.muscle for row in missing) if name != ALL]
    if not muscles:
        text = "nothing was measured"
    elif not wrong:
        held = "all limits that were measured" if missing else "all limits"
        text = f"every muscle is within {held} in every frame"
    elif len(muscles) == 1:
        text = f"{muscles[0]} is not within all limits"
    else:
        right = len(set(muscles).difference(wrong, unknown))
        count = (
            f"{right} of {len(muscles)} muscles {'is' if right == 1 else 'are'} within all limits"
        )
        text = f"{count}; {listed(wrong, MOST_NAMED)} {'is' if len(wrong) == 1 else 'are'} not"
    bones = any(row.muscle == ALL for row in found) and not wrong
    return f"{text}; the bones are not" if bones else text


def verdict_facts(
    table: Table,
    limits: Limits,
    doubts: Sequence[Doubt],
    missing_bones: Sequence[str],
    *,
    stopped: str = "",
) -> dict[str, object]:
    """What ``run.json`` holds of the limits of a run and of its verdict; of one that failed,
    ``stopped`` says how many frames that is of, as "3 of 5".
    """
    verdict = judge(table, limits, doubts)
    if stopped:
        outcome = f"the run stopped after {stopped} frames; in these {verdict.outcome}"
        verdict = verdict._replace(outcome=outcome)
    return {
        "limits": dict(limits.values),
        "fail_on": dict(limits.fail_on),
        "verdict": describe_verdict(verdict, table, missing_bones),
        **verdict._asdict(),
    }


def describe_verdict(verdict: Verdict, table: Table, missing_bones: Sequence[str] = ()) -> str:
    """A verdict in sentences: its outcome, then `verdict_parts`."""
    parts = verdict_parts(verdict, table, missing_bones)
    return ". ".join(
        [verdict.outcome, *(f"{head}: {'; '.join(texts)}" for head, texts in parts.items())]
    )


def verdict_parts(
    verdict: Verdict,
    table: Table,
    missing_bones: Sequence[str],
    *,
    values: int = MOST_NAMED,
    doubts: int = 1,
) -> dict[str, list[str]]:
    """What follows the outcome of a verdict, by its head: the worst of what is beyond a limit, so
    many ``values``, what to do (`REMEDIES`), what was not measured, and the first ``doubts``; bones
    ``missing_bones``.
    """
    parts: dict[str, list[str]] = {}
    named = worst_first(verdict.beyond)[:values]
    if named:
        texts = [describe_excess(row, table, missing_bones) for row in named]
        left = len(verdict.beyond) - len(named)
        parts["Worst"] = [*texts, f"and {left} more"] if left else texts
    remedies: dict[str, str] = {}
    for row in named:
        if quantity_of(row.quantity) in LIMITS:
            remedy = find_remedy(row, table)
            remedies.setdefault(remedy, remedy.replace("FRAME", str(row.frame)))
    if remedies:
        parts[REMEDIES] = list(remedies.values())
    if verdict.not_measured and set(table) - {ALL}:
        parts["Not measured"] = [describe_unmeasured(verdict.not_measured)]
    if verdict.doubts:
        texts = describe_doubts(verdict.doubts[:doubts])
        left = len(verdict.doubts) - len(texts)
        parts["Doubtful"] = [*texts, f"and {left} more"] if left else texts
    return parts


def describe_doubts(doubts: Sequence[Doubt]) -> list[str]:
    """Doubts in words, each with its muscle."""
    return [
        doubt.text if doubt.muscle == ALL else f"{doubt.muscle}: {doubt.text}" for doubt in doubts
    ]


def describe_unmeasured(missing: Sequence[tuple[str, str]]) -> str:
    """Each limit that was not measured, with the muscles of which it was not."""
    by_quantity: dict[str, list[str]] = {}
    for muscle, quantity in missing:
        by_quantity.setdefault(quantity, []).extend([] if muscle == ALL else [muscle])
    texts = [f"{q}{f' of {listed(n, MOST_NAMED)}' if n else ''}" for q, n in by_quantity.items()]
    return listed(texts, MOST_NAMED, separator="; ")


def worst_first(found: Sequence[Exceedance]) -> list[Exceedance]:
    """The worst excess of each muscle, then the others; ``found`` are the worst first."""
    first = {row.muscle: row for row in reversed(found)}.values()
    return sorted(found, key=lambda row: row not in first)


def find_remedy(row: Exceedance, table: Table) -> str:
    """What to do about one excess; smaller steps do not mend an overlap of the meshes at rest, mesh
    models have no iterations, and muscles that contract strongly do not settle with more of them.
    """
    muscle, quantity, _, limit, _ = row
    overlap = table[muscle].get("initial_overlap", {}).get("worst")
    depth = quantity in ("penetration_max", "bone_penetration_max")
    at_rest = depth and overlap is not None and overlap > limit
    limit_kind = LIMITS["initial_overlap" if at_rest else quantity_of(quantity)]
    if "unfitted_fraction" not in table[muscle]:
        return limit_kind.mesh_remedy or limit_kind.remedy
    active = table[muscle].get("activation", {}).get("worst")
    return (active and limit_kind.active_remedy) or limit_kind.remedy


def describe_excess(row: Exceedance, table: Table, missing_bones: Sequence[str] = ()) -> str:
    """One value beyond its limit, in words; bones ``missing_bones``."""
    muscle, quantity, worst, limit, frame = row
    unit = table[muscle][quantity]["unit"]
    value = shown_number(worst, unit)
    shown_limit = f"{limit:.3g}"
    # Less than is shown elsewhere, or so near to the limit that it would look the same.
    if value.startswith("<") or shown_number(worst) == shown_limit:
        value = f"{worst:.5g} {unit}".removesuffix(" 1")
        shown_limit = f"{limit:.5g}"
    place = "the bones" if muscle == ALL else muscle
    quantity, coordinate = split_name(quantity)
    title = LIMITS[quantity].title if quantity in LIMITS else quantity
    title += f" ({coordinate})" if coordinate else ""
    title += f" ({listed(missing_bones, MOST_NAMED)})" if quantity == "missing_bones" else ""
    return f"{place}, {title} {value} at frame {frame} (limit {shown_limit})"


def describe_failures(table: Table, limits: Limits) -> list[str]:
    """Everything beyond the limits of ``fail_on``, and those of them that were not measured."""
    failing = limits.failing()
    texts = [
        f"{m}: {q} = {v:.4g} {'<' if q in LOWER_BOUNDS else '>'} {limit:g} at frame {f}"
        for m, q, v, limit, f in exceeded(table, failing)
    ]
    missing = unmeasured(table, failing)
    return [*texts, f"not measured: {describe_unmeasured(missing)}"] if missing else texts


def require_limits(table: Table, limits: Limits) -> None:
    """Raise LimitExceededError with `describe_failures`, if there are any."""
    if texts := describe_failures(table, limits):
        raise LimitExceededError("; ".join(texts))


# What a coordinate of the hip may be called for each of the table's, and muscles' other names.
_COORDINATES = {
    "flexion": "flexion",
    "adduction": "adduction",
    "internal_rotation": "rotation",
    "rotation": "rotation",
}
_JOINT = "hip"
_MUSCLES = {"psoas_major": "psoas"}


class Band(NamedTuple):
    """Least and greatest moment arm (n,) [mm] over a muscle's fibres at angles (n,) [degree]."""

    angle: Floats
    least: Floats
    greatest: Floats
    source: str


@cache
def _bands() -> dict[tuple[str, str], Band]:
    """The bands of ``published.json`` by kind of motion and muscle."""
    table = json.loads((files("rbfmuscle.metrics") / "published.json").read_text(encoding="utf-8"))
    return {
        (kind, muscle): Band(
            np.array(row["angle"]),
            np.array(row["least"]),
            np.array(row["greatest"]),
            table["source"],
        )
        for kind, muscles in table["hip"].items()
        for muscle, row in muscles.items()
    }


def published_band(muscle: str, coordinate: str) -> Band | None:
    """The band of a muscle about a coordinate ("joint.coordinate"), by their names; None where
    nothing is known.

    Positive moment arms flex, adduct or rotate internally.

    Examples
    --------
    >>> published_band("iliacus_r", "hip.flexion").greatest.max()
    np.float64(52.7)
    >>> published_band("iliacus", "knee.flexion") is None
    True
    """
    joint, _, name = coordinate.lower().partition(".")
    kind = _COORDINATES.get(name.removeprefix(f"{_JOINT}_"))
    plain = muscle.lower().replace("-", "_")
    for end in ("_r", "_l", "_right", "_left"):
        plain = plain.removesuffix(end)
    if _JOINT not in joint.split("_") or kind is None:
        return None
    return _bands().get((kind, _MUSCLES.get(plain, plain)))


# A muscle that is moved by more than this out of bones at rest [mm] is not the scanned shape there.
MOVED = 0.5
# Moment arms lie outside a published band from here on [mm].
OUTSIDE = 1.0
# Coordinates that differ by less from rest [radian or scene unit] rest.
_STILL = 1e-9


def measured_doubts(
    scene: Scene, table: Table, rows: Sequence[Row], path: Mapping[int, Mapping[str, float]]
) -> list[Doubt]:
    """Doubts about a run, from its table, the rows of its moment arms, and the coordinates of its
    frames [radian or scene unit].
    """
    found = []
    for name, facts in table.items():
        # How far a muscle is moved at rest because its mesh lies in a bone.
        moved, deep = (
            facts.get(quantity, {}).get("first")
            for quantity in ("rest_error_at_overlap", "input_overlap")
        )
        if moved is not None and moved > from_mm(MOVED, scene.units):
            depth, away = (shown_number(value, scene.units) for value in (deep, moved))
            text = f"its mesh lies {depth} deep in a bone at rest; near there it is moved {away}"
            found.append(Doubt(name, text))
    arms: dict[tuple[str, str], list[Row]] = {}
    for row in rows:
        if row.quantity == "moment_arm":
            arms.setdefault((row.muscle, row.coordinate), []).append(row)
    rest = rest_coordinates(scene)
    for (muscle, coordinate), mine in arms.items():
        unknown = sum(np.isnan(row.value) for row in mine)
        if unknown:
            text = (
                f"its moment arm about {coordinate} is not defined in {unknown} of {len(mine)} "
                "frames, as its activation changes there"
            )
            found.append(Doubt(muscle, text))
        alone = [
            row
            for row in mine
            if all(
                name == coordinate or abs(value - rest.get(name, 0.0)) < _STILL
                for name, value in path[row.frame].items()
            )
        ]
        found += _outside_band(scene, muscle, coordinate, alone)
    known = all_coordinates(scene.joints)
    turning = any(
        known[name].motion == "rotation" and np.isfinite([row.value for row in mine]).any()
        for (_, name), mine in arms.items()
    )
    if turning and not any(row.quantity == "length_roughness" for row in rows):
        text = (
            "roughness is not measured: it needs three frames or more, at most "
            f"{ROUGH:g} degrees apart, that span {2 * ROUGH:g} degrees"
        )
        found.append(Doubt(ALL, text))
    return found


def _outside_band(scene: Scene, muscle: str, coordinate: str, arms: Sequence[Row]) -> list[Doubt]:
    """That moment arms leave the published band, where and by how much."""
    band = published_band(muscle, coordinate)
    if band is None:
        return []
    angles = np.array([row.coordinate_value for row in arms])
    values = np.array([row.value for row in arms]) / from_mm(1.0, scene.units)
    low, high = (
        np.interp(angles, band.angle, edge, left=np.nan, right=np.nan)
        for edge in (band.least, band.greatest)
    )
    off = np.nan_to_num(np.maximum(low - values, values - high), nan=-np.inf)
    if not np.any(off > OUTSIDE):
        return []
    worst = int(np.argmax(off))
    count = f"{(off > OUTSIDE).sum()} of {np.isfinite(off).sum()}"
    published = f"published {low[worst]:.3g} to {high[worst]:.3g}"
    text = (
        f"its moment arm about {coordinate} leaves the published band in {count} frames: "
        f"{values[worst]:.3g} mm at {angles[worst]:.3g} degrees, {published}"
    )
    return [Doubt(muscle, text)]
