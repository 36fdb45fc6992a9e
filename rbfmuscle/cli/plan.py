"""``rbfmuscle plan``: what a run of a scene would build and solve."""

from __future__ import annotations

import json
from time import perf_counter
from typing import TYPE_CHECKING

from rbfmuscle.cli.options import Flag, Json, SceneName
from rbfmuscle.progress import Progress, stage

if TYPE_CHECKING:
    from rbfmuscle.scene.scene import Scene


def plan(scene: SceneName, *, time: Flag = False, as_json: Json = False) -> None:
    """List what a run of the scene would build, without building it.

    Parameters
    ----------
    time
        Also build the muscles, solve two frames after the first, and extrapolate to the whole motion.
    """
    from rbfmuscle.models import check_models, solved_points
    from rbfmuscle.scene.phantom import open_scene
    from rbfmuscle.simulation.plan import plan_scene

    with Progress(f"plan {scene.name}"):
        loaded = open_scene(scene)
        check_models(loaded)
        made = plan_scene(loaded)
        for muscle, facts in zip(loaded.muscles, made["muscles"]):
            facts["points"] = solved_points(muscle, loaded)
        if time:
            with stage("solving two frames"):
                made["time"] = measure_time(loaded)
    print(json.dumps(made, indent=1) if as_json else "\n".join(_lines(made)))


def measure_time(scene: Scene) -> dict[str, float]:
    """Wall time of a run [s], from its first three frames: ``build`` (with the first frame), ``frame``, ``total``.

    Report, pictures and files are not in it.
    """
    from rbfmuscle.run import simulate

    start = perf_counter()
    frames = simulate(scene, frames=slice(0, 3)).frames
    spent, count = perf_counter() - start, len(scene.motion)
    frame = spent / count if len(frames) < 2 else sum(f.wall for f in frames[1:]) / (len(frames) - 1)
    build = max(0.0, spent - frame * (len(frames) - 1))
    return {"build": build, "frame": frame, "total": build + frame * (count - 1)}


def _lines(made):
    yield f"{made['frames']} frames in {made['substeps']} sub-steps"
    for muscle in made["muscles"]:
        yield (
            f"muscle {muscle['name']}: {muscle['model']}, {muscle['points']}, can meet "
            f"{', '.join(muscle['bones']) or 'no bone'}; solved in {muscle['substeps']} sub-steps"
        )
    for field in made["fields"]:
        yield f"field of {field['bone']}: {field['share']:.0%} of its box, {field['triangles']} triangles"
    if "time" in made:
        spent = made["time"]
        yield (
            f"expected time: {spent['total']:.3g} s without report, pictures and files; build and first frame "
            f"{spent['build']:.2g} s, {1e3 * spent['frame']:.3g} ms per frame"
        )
