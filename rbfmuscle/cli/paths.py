"""``rbfmuscle paths``: fitted muscle paths for OpenSim."""

import math
import re
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from rbfmuscle.cli.options import (
    Jobs,
    Model,
    Muscles,
    Output,
    Pairs,
    SceneName,
    Settings,
    chosen_muscles,
    threads,
)
from rbfmuscle.cli.printing import USUAL, Printing, print_result
from rbfmuscle.progress import Progress
from rbfmuscle.validation import SceneError, UsageError

if TYPE_CHECKING:
    from rbfmuscle.paths import Ranges
    from rbfmuscle.scene.scene import Scene


def paths(
    scene: SceneName,
    *,
    output: Output,
    samples: int = 120,
    muscles: Muscles = None,
    fibres: int = 0,
    ranges: Annotated[Pairs, Parameter(name="--range")] = None,
    names: Annotated[Pairs, Parameter(name="--coordinate")] = None,
    model: Model = None,
    settings: Settings = None,
    jobs: Jobs = None,
    printing: Printing = USUAL,
) -> int:
    """Sample muscles' lengths and moment arms over coordinates and fit paths that OpenSim loads.

    Parameters
    ----------
    samples
        Poses for each muscle, of which every fifth is held out of the fit.
    fibres
        Of each muscle, for each of which a path is fitted, in place of one for the muscle.
    ranges
        COORDINATE=LOW:HIGH in degrees or scene units, else the coordinate's range, or what the
        motion covers; may be repeated.
    names
        COORDINATE=JOINT/COORDINATE, what the OpenSim model calls a coordinate of the scene, for
        instance hip.flexion=hip_r/hip_flexion_r; may be repeated; else the scene's own names.
    """
    from rbfmuscle.models import configure_scene
    from rbfmuscle.paths import paths_folder, report_fits, sample_muscles
    from rbfmuscle.scene.phantom import open_scene
    from rbfmuscle.scene.settings import parse_settings

    if samples < 10:
        raise UsageError(f"--samples {samples} is too few to fit anything, give 10 or more")
    loaded = configure_scene(open_scene(scene), parse_settings(settings), model=model)
    loaded.muscles = chosen_muscles(loaded, muscles)
    given, targets = parse_ranges(loaded, ranges or []), parse_targets(loaded, names or [])
    paths_folder(output)
    with Progress(loaded.name, "pose") as progress, threads(jobs):
        sampled = sample_muscles(loaded, given, samples=samples, fibres=fibres, progress=progress)
    rows, lines = report_fits(loaded, sampled, output, targets=targets)
    facts = {"file": str(output / "paths.xml"), "paths": rows}
    return print_result(printing, facts, lines)


def parse_ranges(scene: "Scene", texts: list[str]) -> "Ranges":
    """Return the ranges that --range asks for, by full name [radian or scene unit]."""
    from rbfmuscle.scene.motion import inner_value

    found = {}
    for text in texts:
        name, _, ends = text.partition("=")
        try:
            low, high = (float(end) for end in ends.split(":"))
        except ValueError:
            form = "COORDINATE=LOW:HIGH, for instance hip.flexion=0:60"
            raise UsageError(f"--range {text!r} is not {form}") from None
        full = _full_name(scene, name, "--range")
        if not -math.inf < low < high < math.inf:
            raise UsageError(f"--range {text!r}: the range must go upwards between two numbers")
        found[full] = (inner_value(scene, full, low), inner_value(scene, full, high))
    return found


def parse_targets(scene: "Scene", texts: list[str]) -> dict[str, str]:
    """Return the paths in the OpenSim model that --coordinate gives, by the scene's full names."""
    found: dict[str, str] = {}
    for text in texts:
        name, _, target = text.partition("=")
        if not re.fullmatch(r"[^\s/]+/[^\s/]+", target):
            form = "COORDINATE=JOINT/COORDINATE, for instance hip.flexion=hip_r/hip_flexion_r"
            raise UsageError(f"--coordinate {text!r} is not {form}")
        path = f"/jointset/{target}"
        if path in found.values():
            raise UsageError(f"--coordinate {text!r}: {target} is given for two coordinates")
        found[_full_name(scene, name, "--coordinate")] = path
    return found


def _full_name(scene, name, context):
    from rbfmuscle.scene.joints.joint import all_coordinates
    from rbfmuscle.scene.joints.tables import full_name

    try:
        return full_name(name, list(all_coordinates(scene.joints)), context=context)
    except SceneError as error:
        raise UsageError(str(error)) from None
