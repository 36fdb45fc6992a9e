"""Tendons that meshes of bellies lack: from an end far from its bone straight to the nearest place of it.

From a patella that follows its knee the tendon goes on, as the patellar ligament, to the tibia.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from rbfmuscle.importers.guess.attachments import FAR


@dataclass
class TendonGuess:
    """The tendon of an end that stops short of its bone.

    Attributes
    ----------
    bone : Part
        Of the insertion.
    to : (3,) ndarray
        [scene unit]
    via : list of (Part, (3,) ndarray)
        Via points on other bones, from the end on.
    """

    bone: Any
    to: np.ndarray
    via: list[tuple[Any, np.ndarray]] = field(default_factory=list)


def guess_tendons(guess: Any) -> None:
    """Give a tendon to each hold far from its bone.

    Parameters
    ----------
    guess : SceneGuess
        With its muscles.
    """
    for muscle in guess.muscles:
        for hold in muscle.holds:
            if hold.gap > FAR and not muscle.wrong:
                hold.tendon = _tendon(guess.joints, muscle, hold)


def _tendon(joints, muscle, hold):
    end = muscle.muscle.points[hold.vertices].mean(axis=0)
    place = hold.bone.points[np.argmin(((hold.bone.points - end) ** 2).sum(axis=1))]
    patella = next((j for j in joints if j.child is hold.bone and j.ligament is not None), None)
    if patella is None:
        return TendonGuess(hold.bone, place)
    tibia = next(j.child for j in joints if j.child.kind == "tibia" and j.parent is patella.parent)
    apex, tuberosity = patella.ligament
    return TendonGuess(tibia, tuberosity, [(hold.bone, place), (hold.bone, apex)])
