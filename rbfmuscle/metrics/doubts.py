"""What a run shows that no limit holds and a reader should know; published moment arms of fibres,
least and greatest of each muscle by angle.
"""

import json
from collections.abc import Mapping, Sequence
from functools import cache
from importlib.resources import files
from typing import NamedTuple, TypedDict

import numpy as np

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.metrics.quantities import ALL, Row
from rbfmuscle.metrics.rows import ROUGH
from rbfmuscle.metrics.summary import Doubt, Table, shown_number
from rbfmuscle.scene.joints import all_coordinates
from rbfmuscle.scene.motion import rest_coordinates
from rbfmuscle.scene.objects import from_mm
from rbfmuscle.scene.scene import Scene

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


class _Table(TypedDict):
    """``published.json``: by kind of motion and muscle the angles and both ends of the band."""

    hip: dict[str, dict[str, dict[str, list[float]]]]
    source: str


@cache
def _table() -> "_Table":
    text = (files("rbfmuscle.metrics") / "published.json").read_text(encoding="utf-8")
    found: _Table = json.loads(text)
    return found


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
    band = _table()["hip"][kind].get(_MUSCLES.get(plain, plain))
    if band is None:
        return None
    angle, least, greatest = (np.array(band[key]) for key in ("angle", "least", "greatest"))
    return Band(angle, least, greatest, _table()["source"])


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
    found = [doubt for name in table for doubt in _moved_at_rest(scene, name, table)]
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
        alone = [row for row in mine if _others_rest(path[row.frame], coordinate, rest)]
        found += _outside_band(scene, muscle, coordinate, alone)
    turning = any(all_coordinates(scene.joints)[name].motion == "rotation" for _, name in arms)
    if turning and not any(row.quantity == "length_roughness" for row in rows):
        text = f"roughness is not measured: no frames are {ROUGH:g} degrees apart or less"
        found.append(Doubt(ALL, text))
    return found


def _moved_at_rest(scene: Scene, muscle: str, table: Table) -> list[Doubt]:
    """That a muscle's mesh lies in a bone, and how far it is moved there."""
    facts = table[muscle]
    moved, deep = (
        facts.get(name, {}).get("first") for name in ("rest_error_at_overlap", "input_overlap")
    )
    if moved is None or moved <= from_mm(MOVED, scene.units):
        return []
    depth, away = (shown_number(value, scene.units) for value in (deep, moved))
    return [
        Doubt(
            muscle, f"its mesh lies {depth} deep in a bone at rest; near there it is moved {away}"
        )
    ]


def _others_rest(here: Mapping[str, float], coordinate: str, rest: Mapping[str, float]) -> bool:
    return all(
        name == coordinate or abs(value - rest.get(name, 0.0)) < _STILL
        for name, value in here.items()
    )


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
