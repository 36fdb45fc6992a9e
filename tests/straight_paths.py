"""Lengths of OpenSim paths that wrap about nothing: what the points that were read say against OpenSim's answers."""

import numpy as np

from rbfmuscle.opensim.model import ModelPath, OsimModel
from rbfmuscle.opensim.paths import active_points


def straight_length(model: OsimModel, path: ModelPath, values: dict[str, float] | None = None) -> float:
    """Return the length of a path that wraps about nothing [metre]: straight between its points."""
    transforms = model.transforms(values)
    places = []
    for point, place in active_points(model, path, values):
        pose = transforms[point.body]
        places.append(pose[:3, :3] @ place + pose[:3, 3])
    return float(np.linalg.norm(np.diff(np.array(places), axis=0), axis=1).sum())
