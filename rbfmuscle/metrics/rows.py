"""Rows of ``metrics.csv``, made from what was recorded: of a frame, and of moment arms along the motion."""

import math
from collections.abc import Mapping, Sequence

from rbfmuscle.metrics.moment_arms import REACH, moment_arms
from rbfmuscle.metrics.quantities import ALL, QUANTITIES, Row, unit_text
from rbfmuscle.scene.joints.skeleton import all_coordinates
from rbfmuscle.scene.motion import shown_value
from rbfmuscle.scene.objects import MM_PER_UNIT
from rbfmuscle.scene.scene import Scene
from rbfmuscle.simulation.frame import Frame

Coordinates = Mapping[str, float]


def frame_rows(
    scene: Scene, frame: Frame, before: Coordinates | None, measured: Mapping[str, Mapping[str, float]]
) -> list[Row]:
    """Rows of one frame.

    ``before`` are the coordinates of the frame before [radian or scene unit], None at the first; ``measured`` the
    values by muscle (`ALL` for the whole scene) and quantity.
    """
    name, angle = _leading_coordinate(scene, frame, before)
    together = dict(measured.get(ALL, {}))
    if scene.motion.times is not None:
        together["time"] = scene.motion.times[frame.index]
    together["time_frame"] = frame.wall
    unit = {quantity: unit_text(kind, scene.units) for quantity, (kind, _) in QUANTITIES.items()}
    return [
        Row(frame.index, name, angle, muscle, quantity, value, unit[quantity])
        for muscle, values in {**measured, ALL: together}.items()
        for quantity, value in values.items()
    ]


def moment_arm_rows(
    scene: Scene, path: Mapping[int, Coordinates], lengths: Mapping[str, Mapping[int, float]]
) -> list[Row]:
    """Rows of the moment arms of all frames.

    ``path`` holds the coordinates of each frame [radian or scene unit], in the order of the motion; ``lengths`` the
    length of each muscle in each frame [scene unit].
    """
    facts, rows = all_coordinates(scene.joints), []
    shifts = {name for name, fact in facts.items() if fact.motion == "translation"}
    reach = {
        name: REACH / MM_PER_UNIT[scene.units] if name in shifts else math.radians(REACH)
        for coordinates in path.values()
        for name in coordinates
    }
    for muscle, found in lengths.items():
        along: Sequence[float] = [found.get(index, math.nan) for index in path]
        moments_along = moment_arms(list(path.values()), along, reach)
        for (index, coordinates), moments in zip(path.items(), moments_along):
            for name, moment_arm in moments.items():
                angle = shown_value(scene, name, coordinates.get(name, 0.0))
                unit = "1" if name in shifts else scene.units
                rows.append(Row(index, name, angle, muscle, "moment_arm", moment_arm, unit))
    return rows


def _leading_coordinate(scene, frame, before):
    """The coordinate that moved most to reach a frame, and its value there [degree or scene unit]."""
    names = scene.motion.coordinates or list(frame.coordinates)
    if not names:
        return "", 0.0
    now = frame.coordinates
    name = names[0]
    if before is not None:
        name = max(names, key=lambda n: abs(now.get(n, 0.0) - before.get(n, 0.0)))
    return name, shown_value(scene, name, now.get(name, 0.0))
