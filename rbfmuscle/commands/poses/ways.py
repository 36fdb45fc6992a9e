"""``rbfmuscle ways``: one pose reached by several ways, and how far apart the muscles rest."""

from __future__ import annotations

import json
from typing import Annotated, Any

from cyclopts import Parameter

from rbfmuscle.commands.scenes import load_scene
from rbfmuscle.compiled.progress import Progress
from rbfmuscle.compiled.warm import compile_ahead
from rbfmuscle.validation import UsageError

Pairs = Annotated[list[str], Parameter(negative="", consume_multiple=True)]


def ways(
    scene: str,
    *,
    pose: Pairs,
    through: Pairs | None = None,
    step: float = 2.0,
    model: str | None = None,
    settings: Annotated[list[str] | None, Parameter(name="--set", negative="")] = None,
    as_json: Annotated[bool, Parameter(name="--json", negative="")] = False,
) -> None:
    """Reach one pose by several ways and tell how far apart each muscle's shapes are there.

    Parameters
    ----------
    scene
        Scene file (TOML), or "phantom" for the embedded hip.
    pose
        COORDINATE=VALUE at the end, for instance hip.flexion=60 hip.adduction=-25; degrees, scene units for shifts.
    through
        COORDINATE=VALUE that a further way goes through, for instance hip.internal_rotation=25.
    step
        Degrees from frame to frame.
    model
        Model of every muscle, in place of the scene's.
    settings
        KEY=VALUE, for instance model.inside=300; may be repeated.
    as_json
        Print JSON and nothing else.
    """
    from rbfmuscle.sim.scene.settings import parse_settings
    from rbfmuscle.study.experiment.ways import ways_to

    changes = parse_settings(settings)
    end, aside = _values(pose, "--pose"), _values(through or [], "--through")
    ways_to(end, aside)
    with Progress("ways") as progress:
        from rbfmuscle.models import configure_scene

        made = configure_scene(load_scene(scene), changes, model=model).validate()
        found = ways_to(end, aside, _rest(made, (*end, *aside)))
        table = compare_ways(made, found, step=step, progress=progress)
    if as_json:
        print(json.dumps({"units": made.units, "ways": list(found), "muscles": table}, indent=1))
        return
    width = max(map(len, table))
    print(f"{len(found)} ways: {', '.join(found)}; distance of material points in {made.units}")
    print(f"{'':{width}}  {'RMS':>8}  {'greatest':>8}  farthest apart")
    for name, row in table.items():
        print(
            f"{name:{width}}  {row['rms']:8.3f}  {row['greatest']:8.2f}  "
            f"{row['between'][0]} / {row['between'][1]}"
        )


def compare_ways(scene: Any, ways: dict[str, Any], *, step: float, progress: Any = None) -> dict[str, Any]:
    """Return, for each muscle of a scene, how far apart the ends of some ways are.

    Parameters
    ----------
    scene : Scene
    ways : dict of str to list of dict
        From `rbfmuscle.study.experiment.ways.ways_to`.
    step : float
        [degree].
    progress : callable, optional
        Called as ``progress(done, total)`` after each way.

    Returns
    -------
    dict of str to dict
        By muscle; see `rbfmuscle.study.experiment.ways.spread`.
    """
    from rbfmuscle.interruption import check
    from rbfmuscle.models import build_models
    from rbfmuscle.sim.loop.simulate import simulate_frames
    from rbfmuscle.study.experiment.ways import spread

    compile_ahead({muscle.model for muscle in scene.muscles})
    shapes: dict[str, dict[str, Any]] = {muscle.name: {} for muscle in scene.muscles}
    for count, (name, waypoints) in enumerate(ways.items(), 1):
        moved = scene.copy()
        moved.set_motion(waypoints=waypoints, step=step)
        moved.validate()
        last = len(moved.motion.frames) - 1
        for frame in simulate_frames(moved, build_models(moved), surfaces=False, written={last}):
            for muscle, (vertices, _) in frame.carried.items():
                shapes[muscle][name] = vertices.copy()
        if progress is not None:
            progress(count, len(ways))
        check()
    return {muscle: spread(found) for muscle, found in shapes.items()}


def _rest(scene: Any, names: Any) -> dict[str, float]:
    """Values at rest of coordinates, as files have them."""
    from rbfmuscle.sim.scene.motion import coordinate_names, rest_coordinates, shown_value
    from rbfmuscle.validation import did_you_mean

    known = sorted(coordinate_names(scene.joints))
    for name in names:
        if name not in known:
            raise UsageError(f"unknown coordinate {name!r}, {did_you_mean(name, known)}")
    rest = rest_coordinates(scene)
    return {name: shown_value(scene, name, rest.get(name, 0.0)) for name in names}


def _values(texts: list[str], option: str) -> dict[str, float]:
    found = {}
    for text in texts:
        key, _, value = text.partition("=")
        try:
            found[key.strip()] = float(value)
        except ValueError:
            raise UsageError(
                f"{option} takes COORDINATE=VALUE, for instance hip.flexion=60, got {text!r}"
            ) from None
    return found
