"""Comparing models on one scene: the same motion, contacts and measures for each."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from rbfmuscle.experiments.comparison import Repeated, add_distances, measure_run, write_tables
from rbfmuscle.experiments.comparison_table import Comparison
from rbfmuscle.folders import OutputFolder, given_folder
from rbfmuscle.geometry.threads import threads_limited
from rbfmuscle.models import (
    build_models,
    configure_scene,
    model_kind,
    model_title,
    solved_points,
)
from rbfmuscle.output.run_data import RunData
from rbfmuscle.output.writer import run_folder
from rbfmuscle.progress import stage
from rbfmuscle.run import stream_run
from rbfmuscle.scene.frames import pick_frames
from rbfmuscle.scene.options import OutputOptions
from rbfmuscle.scene.phantom import open_scene
from rbfmuscle.scene.scene import require_complete
from rbfmuscle.scene.settings import chooses_model
from rbfmuscle.simulation.frame_loop import simulate_frames
from rbfmuscle.validation import SolveError, UsageError

if TYPE_CHECKING:
    from rbfmuscle.scene.scene import Scene


FILES = ("comparison.json", "comparison.csv", "statistics.csv", "report.html")
COARSER = 5  # the motion is repeated with frames this many times as far apart
FINER = 4  # and its last pose with sub-steps this many times as short, which every model solves by
ONE_THREAD = 5  # frames that are timed on one thread, the first of which does not count


def compare_models(
    scene: Scene | str | Path,
    directory: str | Path | None = None,
    models: Sequence[str] = ("rbf", "pbd"),
    *,
    frames: slice | str | None = None,
    settings: Mapping[str, object] | None = None,
    pictures: bool = True,
    progress: Callable[[str, int, int], object] | None = None,
) -> Comparison:
    """Run every model on a scene, measure all alike, and write tables, a report and pictures.

    Parameters
    ----------
    scene : Scene, path or "phantom"
    directory : path, optional
        Takes ``comparison.json``, tables, ``report.html`` and the run of each model; without one
        nothing is kept but what is returned.
    models : list of str
        Distances are to the first. One that cannot be solved is left out, and named in the tables.
    frames : slice or str, optional
        Frames of the motion, a slice or "A:B:S".
    settings : dict, optional
        Dotted keys with their values, for all models, or as "MODEL:KEY" for one.
    pictures : bool
    progress : callable, optional
        Called as ``progress(model, done, total)``.

    Returns
    -------
    Comparison
        What ``comparison.json`` holds.

    Raises
    ------
    UsageError
        On an unknown model or setting, or a folder that holds something else.
    SolveError
        If no model could be solved.

    Examples
    --------
    >>> from rbfmuscle import phantom_scene
    >>> table = compare_models(phantom_scene(end=2.0), models=["pbd", "xpbd"])
    >>> sorted(table.models)
    ['pbd', 'xpbd']
    """
    variants = _variants(open_scene(scene), list(models), settings or {}, frames)
    with given_folder(directory) as folder:
        return _compare(variants, folder, pictures and directory is not None, progress)


def _compare(
    variants: Mapping[str, Scene],
    folder: Path,
    pictures: bool,
    progress: Callable[[str, int, int], object] | None,
) -> Comparison:
    """Run the scene of each model in a folder of its name, and write tables and a report."""
    output = OutputFolder(folder, "compare", FILES)
    for name in variants:
        run_folder(folder / name)
    output.clear()
    output.add(*FILES)
    first = next(iter(variants.values()))
    last = len(first.motion) - 1
    poses = [int(first.motion.numbers[k]) for k in sorted({0, last // 2, last})]
    results, failed = {}, {}
    for name, variant in variants.items():
        try:
            results[name] = _measure(name, variant, folder / name, progress)
        except SolveError as error:
            failed[name] = str(error)
    if not results:
        raise SolveError("; ".join(f"{name}: {reason}" for name, reason in failed.items()))
    with stage("distances between models"):
        add_distances(results, folder, poses)
    labels = {name: model_title(variant.muscles[0]) for name, variant in variants.items()}
    unknowns = {
        name: {muscle.name: solved_points(muscle, variant) for muscle in variant.muscles}
        for name, variant in variants.items()
    }
    table = write_tables(
        folder, first, results, failed, labels=labels, unknowns=unknowns, poses=poses
    )

    from rbfmuscle.report.comparison_page import write_page

    with stage("drawing pictures" if pictures else "writing the report"):
        write_page(folder, table, pictures=pictures)
    return table


def _variants(scene, models, settings, frames):
    """The scene for each model; every name and setting is checked before anything is run."""
    if len(models) < 2 or len(set(models)) < len(models):
        raise UsageError(f"give two or more different models, got {', '.join(models) or 'none'}")
    for name in models:
        model_kind(name)
    for key in settings:
        model = key.rpartition(":")[0]
        if model and model not in models:
            raise UsageError(f"{key}: model {model!r} is not compared; models: {', '.join(models)}")
        if model and key.removeprefix(f"{model}:").startswith("motion."):
            raise UsageError(f"{key}: all models have the same motion; leave out {model}:")
    variants = {}
    for name in models:
        mine = {
            k.rpartition(":")[2]: v
            for k, v in settings.items()
            if k.rpartition(":")[0] in ("", name)
        }
        # As in the scene file, a model given for all is the model whose settings these are; each
        # then takes its turn.
        whole = {key: value for key, value in mine.items() if chooses_model(key)}
        own = {key: value for key, value in mine.items() if not chooses_model(key)}
        variant = configure_scene(scene, whole).with_options(model=name)
        variants[name] = require_complete(configure_scene(variant, own, frames=frames))
        variants[name].output = OutputOptions(report=False)
    return variants


def _measure(name, scene, folder, progress):
    """One model: compile its loops, run, then there and back by fewer frames, and to the last pose
    by shorter sub-steps.
    """
    last = len(scene.motion) - 1
    _surfaces(scene, [*range(min(last, 1) + 1)])
    report = None if progress is None else (lambda done, total: progress(name, done, total))
    stream_run(scene, folder, pictures=False, progress=report)
    coarse = [*range(0, last, COARSER)]
    with stage(f"{name}: there and back"):
        build, shown, _ = _surfaces(scene, [*coarse, last, *coarse[::-1]])
    with stage(f"{name}: by shorter sub-steps"):
        angle = scene.contact.substep_angle / FINER
        finer = scene.with_options({"contact.substep_angle": angle})
        turn = _surfaces(finer, [*coarse, last])[1][-1]
    with stage(f"{name}: on one thread"), threads_limited(1):
        walls = _surfaces(scene, [*range(min(last + 1, ONE_THREAD))])[2]
    again = Repeated(build, float(np.median(walls[1:] or walls)))
    if coarse:
        again = again._replace(turn=turn, end=shown[-1])
    with stage(f"{name}: measuring"):
        return measure_run(RunData.load(folder), again)


def _surfaces(scene, chosen):
    """Time to build the models, the surfaces of all muscles in frames of these numbers, in this
    order, and the wall time of each frame.
    """
    changed = scene.with_options()
    changed.motion = pick_frames(scene.motion, chosen)
    start = time.perf_counter()
    models = build_models(changed)
    build = time.perf_counter() - start
    frames = list(simulate_frames(changed, models))
    surfaces = [
        {name: (s.vertices, s.faces) for name, s in frame.surfaces.items()} for frame in frames
    ]
    return build, surfaces, [frame.wall for frame in frames]
