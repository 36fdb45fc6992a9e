"""Pictures of a comparison: models beside each other, coloured by muscle or by distance to the first model.

Drawn in a process of their own, as pictures of a run are: ``python -m rbfmuscle.report.comparison_pictures DIR``.
"""

import sys
from pathlib import Path

import numpy as np

from rbfmuscle.metrics.mesh_distance import MeshDistance
from rbfmuscle.output.saved import SavedRun
from rbfmuscle.report.appearance import neighbour_colours
from rbfmuscle.report.labels import caption, labelled
from rbfmuscle.report.paint import CHIPS, scale_chips
from rbfmuscle.report.render import main, save_images
from rbfmuscle.report.stage import Stage


def _open(folder):
    """What a job's models are found in."""
    return Path(folder)


def _draw_job(folder, job, seconds, stages):
    """Draw ``file`` from ``models`` (folders of runs), ``views`` (rows), ``frames`` and ``size``.

    With ``limit`` the muscles are coloured by their distance to those of the model ``reference``, up to it.
    """
    runs = {name: SavedRun(folder / name) for name in job["models"]}
    limit, first = job.get("limit"), next(iter(runs.values()))
    key = (*job["models"], *job["views"], *job["size"], limit)
    if key not in stages:
        paint = _distance_paint(SavedRun(folder / job["reference"]), limit) if limit else None
        rows = [[(saved, view) for saved in runs.values()] for view in job["views"]]
        stages[key] = Stage(rows, job["size"], paint)
    chips = _scale(limit, first.units) if limit else neighbour_colours(first)
    images = [
        labelled(stages[key].show(frame), caption(first, frame), list(runs), chips) for frame in job["frames"]
    ]
    save_images(images, job["file"], seconds)


def _distance_paint(reference, limit):
    def paint(saved, muscle, frame, vertices):
        away = MeshDistance(*reference.surface(muscle, frame)).unsigned(vertices)
        return np.minimum(away / limit, 1.0)

    return paint


def _scale(limit, units):
    texts = [f"{limit * share:.3g} {units}" for share in np.linspace(0, 1, CHIPS)]
    texts[-1] = f"{texts[-1]} or more"
    return scale_chips(texts)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:], _open, _draw_job))
