"""Reading muscle fibres: polylines from JSON."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.validation import SceneError, check_points, is_file, shown


def read_fibres(fibres: Any, *, scale: float = 1.0, muscle: str = "") -> list[Floats]:
    """Return fibres as a list of (k, 3) arrays in scene units.

    Parameters
    ----------
    fibres : path or list of (k, 3) array_like
        A JSON file holds ``{"polylines": [[[x, y, z], ...], ...]}`` or that list alone.
    scale : float
        Factor from the file's unit to the scene's.
    """
    place = f"muscle {muscle!r} fibres"
    if isinstance(fibres, (str, Path)):
        place = f"{place}: {fibres}"
        fibres = _read_lines(Path(fibres), place)
    lines = []
    for number, line in enumerate(fibres):
        try:
            points = check_points(line, name=f"polyline {number}")
        except (ValueError, TypeError) as error:
            raise SceneError(f"{place}: {error}") from None
        if len(points) < 2:
            raise SceneError(
                f"{place}: polyline {number} has {len(points)} points, a fibre needs two or more"
            )
        lines.append(points * scale)
    if not lines:
        raise SceneError(f"{place}: no polylines")
    return lines


def _read_lines(path, place):
    if not is_file(path):
        raise SceneError(f"{place}: no such file")
    try:
        found = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise SceneError(f"{place}: cannot be read: {error.strerror}") from None
    except (ValueError, RecursionError) as error:
        raise SceneError(f"{place}: not JSON ({shown(str(error))})") from None
    lines = found.get("polylines") if isinstance(found, dict) else found
    if not isinstance(lines, list):
        raise SceneError(f"{place}: needs a list 'polylines'")
    return lines
