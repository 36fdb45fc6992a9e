"""``rbfmuscle paths``: fitted muscle paths for OpenSim."""

import math
import re
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from rbfmuscle.cli.options import (
    USUAL_WORK,
    Model,
    Muscles,
    Output,
    Pairs,
    SceneName,
    Settings,
    Work,
    keep_muscles,
    print_result,
)
from rbfmuscle.progress import Progress
from rbfmuscle.validation import SceneError, SolveError, UsageError

if TYPE_CHECKING:
    from rbfmuscle.scene.scene import Scene
    from rbfmuscle.studies.paths import Ranges


FEWEST = 10  # poses from which paths are kept after an interrupt


def paths(
    scene: SceneName,
    *,
    output: Output,
    samples: int | None = None,
    fibres: int = 0,
    ranges: Annotated[Pairs, Parameter(name="--range")] = None,
    muscles: Muscles = None,
    names: Annotated[Pairs, Parameter(name="--coordinate")] = None,
    model: Model = None,
    settings: Settings = None,
    work: Work = USUAL_WORK,
) -> int:
    """Sample muscles' lengths and moment arms over coordinates and fit paths that OpenSim loads.

    Parameters
    ----------
    samples
        Poses for each muscle, of which every fifth is held out of the fit; by default 20 for each
        coordinate.
    fibres
        Of each muscle, for each of which a path is fitted, in place of one for the muscle.
    ranges
        COORDINATE=LOW:HIGH in degrees or scene units, else the coordinate's range, or what the
        motion covers; COORDINATE=VALUE holds one; may be repeated.
    names
        COORDINATE=JOINT/COORDINATE, what the OpenSim model calls a coordinate of the scene, for
        instance hip.flexion=hip_r/hip_flexion_r; may be repeated; else the scene's own names.
    """
    from rbfmuscle import interruption
    from rbfmuscle.models import configure_scene
    from rbfmuscle.scene.phantom import open_scene
    from rbfmuscle.scene.settings import parse_settings
    from rbfmuscle.studies.paths import Samples, fittable, paths_folder, report_fits, sample_muscles

    if samples is not None and samples < 10:
        raise UsageError(f"--samples {samples} is too few to fit anything, give 10 or more")
    loaded = configure_scene(open_scene(scene), parse_settings(settings), model=model)
    keep_muscles(loaded, muscles)
    spans, targets = parse_ranges(loaded, ranges), parse_targets(loaded, names or [])
    paths_folder(output)
    sampled: list[Samples] = []
    progress, said = Progress(loaded.name, "pose", estimate=True), ""

    def kept():
        return said or (
            f"paths from {progress.done} poses are in {output}" if progress.done >= FEWEST else ""
        )

    with interruption.keeping(kept):
        try:
            with progress, work.threads():
                sample_muscles(
                    loaded, spans, samples=samples, fibres=fibres, progress=progress, found=sampled
                )
        except KeyboardInterrupt:
            said = f"{progress.done} poses are too few to fit anything"
            if usable := [found for found in sampled if fittable(found)]:
                rows, _ = report_fits(loaded, usable, output, targets=targets)
                worst = max(row["arm_rms"] for row in rows)
                said = (
                    f"paths from {progress.done} poses are in {output}, "
                    f"moment arms wrong by up to {worst:.3g} {loaded.units} RMS"
                )
            raise
        rows, lines = report_fits(loaded, sampled, output, targets=targets)
    facts = {"file": str(output / "paths.xml"), "paths": rows}
    loose = [f"{row['muscle']} at {row['unsettled']} poses" for row in rows if row["unsettled"]]
    failed = None
    if loose:
        message = f"did not settle: {', '.join(loose)}; the paths are written all the same"
        failed = SolveError(message)
    return print_result(work, facts, lines, error=failed)


def parse_ranges(scene: "Scene", texts: Pairs) -> "Ranges":
    """Return the ranges that --range asks for, by full name [radian or scene unit]; of a
    coordinate that it holds, both ends are the value.
    """
    from rbfmuscle.scene.motion import inner_value

    found = {}
    for text in texts or ():
        name, _, ends = text.partition("=")
        try:
            low, *more = (float(end) for end in ends.split(":"))
            (high,) = more or [low]
        except ValueError:
            raise UsageError(
                f"--range {text!r} is not "
                "COORDINATE=LOW:HIGH, for instance hip.flexion=0:60, nor COORDINATE=VALUE"
            ) from None
        full = _full_name(scene, name, "--range")
        ordered = low < high if more else low == high
        if not (ordered and math.isfinite(low) and math.isfinite(high)):
            raise UsageError(f"--range {text!r}: the range must go upwards between two numbers")
        found[full] = (inner_value(scene, full, low), inner_value(scene, full, high))
    return found


def parse_targets(scene: "Scene", texts: list[str]) -> dict[str, str]:
    """Return the paths in the OpenSim model that --coordinate gives, by the scene's full names."""
    found: dict[str, str] = {}
    for text in texts:
        name, _, target = text.partition("=")
        if not re.fullmatch(r"[^\s/]+/[^\s/]+", target):
            raise UsageError(
                f"--coordinate {text!r} is not "
                "COORDINATE=JOINT/COORDINATE, for instance hip.flexion=hip_r/hip_flexion_r"
            )
        path = f"/jointset/{target}"
        if path in found.values():
            raise UsageError(f"--coordinate {text!r}: {target} is given for two coordinates")
        found[_full_name(scene, name, "--coordinate")] = path
    return found


def _full_name(scene, name, context):
    from rbfmuscle.scene.joints import all_coordinates, full_name

    try:
        return full_name(name, list(all_coordinates(scene.joints)), context=context)
    except SceneError as error:
        raise UsageError(str(error)) from None
