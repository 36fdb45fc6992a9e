"""``rbfmuscle paths``: fitted muscle paths for OpenSim."""

from __future__ import annotations

from typing import Annotated

from cyclopts import Parameter

from rbfmuscle.cli.options import Model, Output, SceneName, Settings
from rbfmuscle.validation import UsageError


def paths(
    scene: SceneName,
    *,
    output: Output,
    samples: int = 120,
    muscles: str | None = None,
    ranges: Annotated[list[str] | None, Parameter(name="--range", negative="")] = None,
    model: Model = None,
    settings: Settings = None,
) -> None:
    """Sample a muscle's lengths and moment arms over its coordinates and fit a path that OpenSim loads.

    Parameters
    ----------
    samples
        Poses for each muscle, of which every fifth is held out of the fit.
    muscles
        Names by commas; all of the scene by default.
    ranges
        COORDINATE=LOW:HIGH in degrees or scene units; else the coordinate's range, or what the motion covers.
    """
    from rbfmuscle.models import configure_scene
    from rbfmuscle.output.writer import check_writable
    from rbfmuscle.paths import parse_ranges, report_fits, sample_muscles
    from rbfmuscle.progress import Progress
    from rbfmuscle.scene.phantom import open_scene
    from rbfmuscle.scene.settings import parse_settings

    if samples < 10:
        raise UsageError(f"--samples {samples} is too few to fit anything, give 10 or more")
    loaded = configure_scene(open_scene(scene), parse_settings(settings), model=model)
    if muscles is not None:
        loaded.muscles = [loaded.muscle(name.strip()) for name in muscles.split(",")]
    given = parse_ranges(loaded, ranges or [])
    check_writable(output)
    with Progress(loaded.name, "pose") as progress:
        sampled = sample_muscles(loaded, given, samples=samples, progress=progress)
    print("\n".join(report_fits(loaded, sampled, output)))
