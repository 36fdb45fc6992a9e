"""Published moment arms of fibres, to compare with: least and greatest of each muscle by angle."""

import json
from functools import cache
from importlib.resources import files
from typing import NamedTuple, TypedDict

import numpy as np

from rbfmuscle.geometry.arrays import Floats

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
