"""``rbfmuscle paths``: fitted muscle paths for OpenSim."""

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from rbfmuscle.cli.scenes import load_scene
from rbfmuscle.validation import UsageError


def paths(
    scene: Path,
    *,
    output: Annotated[Path, Parameter(name=["--output", "-o"])],
    samples: int = 120,
    muscles: Annotated[str | None, Parameter(name="--muscles")] = None,
    ranges: Annotated[list[str] | None, Parameter(name="--range", negative="")] = None,
    model: str | None = None,
    order: int = 7,
    settings: Annotated[list[str] | None, Parameter(name="--set", negative="")] = None,
) -> None:
    """Sample a muscle's lengths and moment arms over its coordinates and fit a path that OpenSim loads.

    Parameters
    ----------
    scene
        Scene file (TOML), or "phantom" for the embedded hip.
    output
        Folder for paths.xml and errors.csv.
    samples
        Poses for each muscle, of which every fifth is held out of the fit.
    muscles
        Names by commas; all of the scene by default.
    ranges
        COORDINATE=LOW:HIGH in degrees or scene units; else the coordinate's range, or what the motion covers.
    model
        Model for every muscle.
    order
        Highest order of the polynomials.
    settings
        KEY=VALUE, as for run; may be repeated.
    """
    from rbfmuscle.cli.sampling import parse_ranges, report_fits, sample_muscles
    from rbfmuscle.models import configure_scene
    from rbfmuscle.output.writer import check_writable
    from rbfmuscle.progress import Progress
    from rbfmuscle.scene.settings import parse_settings

    if samples < 10:
        raise UsageError(f"--samples {samples} is too few to fit anything, give 10 or more")
    changes = parse_settings(settings)
    loaded = configure_scene(load_scene(scene), changes, model=model)
    if muscles is not None:
        chosen = [loaded.muscle(name.strip()).name for name in muscles.split(",")]
        loaded.muscles = [muscle for muscle in loaded.muscles if muscle.name in chosen]
    given = parse_ranges(loaded, ranges or [])
    check_writable(output)
    with Progress(loaded.name, "pose") as progress:
        sampled = sample_muscles(loaded, given, samples=samples, progress=progress)
    for line in report_fits(loaded, sampled, output, order):
        print(line)
