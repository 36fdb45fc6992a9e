"""``rbfmuscle paths``: fitted muscle paths for OpenSim."""

import math
import re
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from rbfmuscle.cli.options import (
    UNCHANGED,
    USUAL_WORK,
    Changes,
    Muscles,
    Output,
    Pairs,
    SceneName,
    Work,
    chosen_muscles,
)
from rbfmuscle.cli.printing import print_result
from rbfmuscle.progress import Progress
from rbfmuscle.validation import SceneError, UsageError

if TYPE_CHECKING:
    from rbfmuscle.paths import Ranges
    from rbfmuscle.scene.scene import Scene


@Parameter(name="*")
@dataclass(frozen=True)
class Sampling:
    """What is sampled."""

    samples: Annotated[
        int, Parameter(help="Poses for each muscle, of which every fifth is held out of the fit.")
    ] = 120
    fibres: Annotated[
        int,
        Parameter(
            help="Of each muscle, for each of which a path is fitted, in place of one for the "
            "muscle."
        ),
    ] = 0
    ranges: Annotated[
        Pairs,
        Parameter(
            name="--range",
            help="COORDINATE=LOW:HIGH in degrees or scene units, else the coordinate's range, or "
            "what the motion covers; may be repeated.",
        ),
    ] = None


USUAL_SAMPLING = Sampling()


def paths(
    scene: SceneName,
    *,
    output: Output,
    sampling: Sampling = USUAL_SAMPLING,
    muscles: Muscles = None,
    names: Annotated[Pairs, Parameter(name="--coordinate")] = None,
    changes: Changes = UNCHANGED,
    work: Work = USUAL_WORK,
) -> int:
    """Sample muscles' lengths and moment arms over coordinates and fit paths that OpenSim loads.

    Parameters
    ----------
    names
        COORDINATE=JOINT/COORDINATE, what the OpenSim model calls a coordinate of the scene, for
        instance hip.flexion=hip_r/hip_flexion_r; may be repeated; else the scene's own names.
    """
    from rbfmuscle.models import configure_scene
    from rbfmuscle.paths import paths_folder, report_fits, sample_muscles
    from rbfmuscle.scene.phantom import open_scene

    samples = sampling.samples
    if samples < 10:
        raise UsageError(f"--samples {samples} is too few to fit anything, give 10 or more")
    loaded = configure_scene(open_scene(scene), changes.parse_settings(), model=changes.model)
    loaded.muscles = chosen_muscles(loaded, muscles)
    ranges, targets = parse_ranges(loaded, sampling.ranges), parse_targets(loaded, names or [])
    paths_folder(output)
    with Progress(loaded.name, "pose") as progress, work.threads():
        sampled = sample_muscles(
            loaded, ranges, samples=samples, fibres=sampling.fibres, progress=progress
        )
    rows, lines = report_fits(loaded, sampled, output, targets=targets)
    facts = {"file": str(output / "paths.xml"), "paths": rows}
    return print_result(work, facts, lines)


def parse_ranges(scene: "Scene", texts: Pairs) -> "Ranges":
    """Return the ranges that --range asks for, by full name [radian or scene unit]."""
    from rbfmuscle.scene.motion import inner_value

    found = {}
    for text in texts or ():
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
