"""``rbfmuscle kernels`` and ``sweep``: kernels and settings."""

from __future__ import annotations

import json
import sys
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from rbfmuscle.cli.options import (
    UNCHANGED,
    USUAL_WORK,
    Changes,
    FailOn,
    Frames,
    Jobs,
    Muscles,
    Output,
    Pairs,
    Work,
    chosen_muscles,
    named_scenes,
    refuse,
    split_list,
)
from rbfmuscle.cli.printing import USUAL, Printing, one_line, print_result
from rbfmuscle.progress import Progress
from rbfmuscle.validation import LimitExceededError, RBFMuscleError, SolveError, UsageError


@Parameter(name="*")
@dataclass(frozen=True)
class Fits:
    """Which fits are tried."""

    names: Annotated[
        str | None,
        Parameter(name="--kernels", help="Kernels, separated by commas; all by default."),
    ] = None
    centres: Annotated[
        str | None,
        Parameter(help="Numbers of centres, separated by commas; 150,300 by default."),
    ] = None
    resolution: Annotated[
        int | None,
        Parameter(
            help="Cells along the longest side of extracted surfaces; by default 128, and more for "
            "slender muscles."
        ),
    ] = None


@Parameter(name="*")
@dataclass(frozen=True)
class Axes:
    """What a sweep varies, and the error that it measures."""

    grid: Annotated[
        Pairs,
        Parameter(
            help="KEY=a,b,c with keys as for run --set, for instance model.centres=100,200,300; "
            "may be repeated."
        ),
    ] = None
    reference: Annotated[
        Pairs,
        Parameter(
            help="KEY=VALUE of the reference that errors are measured against; may be repeated; by "
            "default the finest values of the grid."
        ),
    ] = None
    error: Annotated[
        str | None,
        Parameter(
            help="The error on the axis of the Pareto front, error_rms by default; the other axis "
            "is time."
        ),
    ] = None


@Parameter(name="*")
@dataclass(frozen=True)
class Workers:
    """Where the points of a sweep are run."""

    jobs: Jobs = None
    cluster: Annotated[
        str | None,
        Parameter(
            help="Address of a Dask scheduler, for instance tcp://127.0.0.1:8786; its workers must "
            "see the folder."
        ),
    ] = None


USUAL_FITS = Fits()
NO_AXES = Axes()
USUAL_WORKERS = Workers()


def kernels(
    source: str,
    *,
    output: Output,
    fits: Fits = USUAL_FITS,
    muscles: Muscles = None,
    units: str | None = None,
    error: float | None = None,
    work: Work = USUAL_WORK,
) -> int:
    """Rank kernels, shape parameters and numbers of centres on a surface or a scene's muscles.

    Parameters
    ----------
    source
        A mesh (STL, OBJ, PLY, VTK, VTP), a scene file, or ``phantom``.
    units
        Name of the mesh's unit, for tables and plots; nothing is converted.
    error
        Find the fewest centres, and the kernel, that reach this RMS distance (in the mesh's unit),
        in place of a table.
    """
    from rbfmuscle.studies.kernels import kernels_folder, reach_error, study_kernels

    if error is not None:
        refuse("--error", {"--centres": fits.centres, "--resolution": fits.resolution})
    counts = split_list("150,300" if fits.centres is None else fits.centres)
    if not counts or not all(count.isdecimal() and int(count) >= 8 for count in counts):
        raise UsageError(f"--centres must be whole numbers of 8 and more, got {fits.centres!r}")
    meshes, units = _meshes(source, muscles, units)
    kernels_folder(output)
    chosen = split_list(fits.names) or None
    with work.threads():
        if error is not None:
            find = partial(reach_error, error=error, kernels=chosen)
            return _find_wanted(meshes, output, find, units, work)
        study = partial(
            study_kernels,
            kernels=chosen,
            centres=[int(count) for count in counts],
            resolution=fits.resolution or 0,
            units=units,
        )
        return _study(meshes, output, study, work)


def _meshes(source, muscles, units):
    """Meshes by name, and their unit: of a scene the named muscles, or every one."""
    from rbfmuscle.scene.meshes.read import read_mesh
    from rbfmuscle.scene.phantom import PHANTOM, open_scene

    if source != PHANTOM and Path(source).suffix.lower() != ".toml":
        if muscles is not None:
            raise UsageError(f"--muscles names muscles of a scene, {source} is a mesh")
        return {Path(source).stem: read_mesh(source).mesh}, units or ""
    if units is not None:
        raise UsageError(f"--units names the unit of a mesh, {source} says its own")
    scene = open_scene(source)
    return {each.name: each.mesh for each in chosen_muscles(scene, muscles)}, scene.units


def _study(meshes, output, study, printing):
    from rbfmuscle.studies.kernels import write_studies

    studies = {}
    for name, mesh in meshes.items():
        with Progress(f"kernels of {name}", what="fit") as bar:
            studies[name] = study(mesh, progress=bar)
    write_studies(studies, output)
    facts = json.loads((output / "kernels.json").read_text(encoding="utf-8"))
    return print_result(printing, facts, _study_lines(studies, output))


def _study_lines(studies, output):
    from rbfmuscle.studies.kernels import answer, describe

    for name, study in studies.items():
        if study.recommended is not None:
            yield f"{name}: {describe(study.rows)}"
            yield f"to paste at the end of its [[muscle]]:\n\n{study.recommended.toml()}\n"
    if len(studies) > 1 or not next(iter(studies.values())).recommended:
        yield answer(studies)
    yield f"all rows: open {output / 'kernels.html'}"


def _find_wanted(meshes, output, find, units, printing):
    """Find, print and write what reaches an error; where it is not reached, that is said."""
    from rbfmuscle.run.writer import json_text
    from rbfmuscle.studies.kernels import kernels_folder

    facts = {}
    for name, mesh in meshes.items():
        with Progress(f"kernels of {name}", what="fit") as bar:
            found = find(mesh, progress=bar)
        facts[name] = {
            "reached": found.reached,
            "error": found.error,
            "wanted": found.wanted,
            "units": units,
            "row": found.row.model_dump(),
            "toml": found.row.toml(),
            "tried": [one._asdict() for one in found.tried],
            "said": found.describe(name, units),
        }
    with kernels_folder(output).staged() as stage:
        (stage / "error.json").write_text(json_text(facts), encoding="utf-8")
    return print_result(printing, facts, _wanted_lines(facts, output))


def _wanted_lines(facts, output):
    for found in facts.values():
        yield found["said"]
    yield f"all that was tried in {output / 'error.json'}"
    for name, found in facts.items():
        if found["reached"]:
            yield f"\nto paste at the end of the [[muscle]] {json.dumps(name)}:\n\n{found['toml']}"


def sweep(
    *scenes: str,
    output: Output,
    axes: Axes = NO_AXES,
    changes: Changes = UNCHANGED,
    frames: Frames = None,
    workers: Workers = USUAL_WORKERS,
    fail_on: FailOn = None,
    printing: Printing = USUAL,
) -> int:
    """Run scenes under a grid of settings: errors, time per frame, Pareto front.

    Points that are already done in the folder are not run again.

    Parameters
    ----------
    scenes
        Scene files (TOML), or "phantom" for a hip made by formulas.
    """
    from rbfmuscle import interruption
    from rbfmuscle.metrics.summary import parse_limits
    from rbfmuscle.models import configure_scene
    from rbfmuscle.scene.phantom import open_scene
    from rbfmuscle.scene.settings import parse_settings
    from rbfmuscle.studies.sweep import parse_grid
    from rbfmuscle.studies.sweep import sweep as run_scenes

    grid, settings = parse_grid(axes.grid or []), changes.parse_settings()
    if not grid:
        refuse("a sweep without --grid", {"--reference": axes.reference, "--error": axes.error})
    if workers.cluster is not None:
        refuse("--cluster", {"--jobs": workers.jobs})
    if not scenes or (len(scenes) == 1 and not grid):
        raise UsageError(
            "a sweep needs several scenes, or a grid, for instance --grid model.centres=100,200"
        )
    opened = {name: open_scene(path) for name, path in named_scenes(scenes).items()}
    loaded = {
        name: configure_scene(each, settings, model=changes.model) for name, each in opened.items()
    }
    limits = {name: parse_limits(fail_on, each) for name, each in loaded.items()}
    progress = Progress("sweep", what="point")
    with progress, interruption.keeping(lambda: f"finished points are kept in {output}"):
        table = run_scenes(
            loaded,
            grid,
            output,
            frames=frames,
            reference=parse_settings(axes.reference),
            jobs=workers.cluster or workers.jobs,
            error=axes.error or "error_rms",
            progress=progress,
        )
    return _finish(table, output, limits, printing)


def _beyond(table, output, limits):
    """What the points hold beyond the limits of their scenes, and what they did not measure, in
    words.
    """
    from rbfmuscle.metrics.summary import exceeded, shown_number, unmeasured
    from rbfmuscle.studies.sweep import SweepFolder

    folder = SweepFolder(output)
    for row in table.rows:
        facts, held = folder.read(row.key).get("summary", {}), limits[row.scene].failing()
        for found in exceeded(facts, held):
            value = shown_number(found.value)
            yield (
                f"{row.scene} {row.label}: {found.muscle}, {found.quantity} {value} (limit "
                f"{shown_number(found.limit)})"
            )
        for lacking in unmeasured(facts, held):
            yield f"{row.scene} {row.label}: {lacking.quantity} was not measured"


def _finish(table, output, limits, printing):
    bad = [row for row in table.rows if row.status != "done"]
    for row in bad[:5]:
        reason = one_line(row.error or row.status)
        print(f"rbfmuscle: {row.scene} {row.label}: {reason}", file=sys.stderr)
    remedy = "the others are kept, the same command runs these again"
    failed: RBFMuscleError | None = None
    if bad:
        failed = SolveError(f"{len(bad)} of {len(table.rows)} points failed; {remedy}")
    elif beyond := list(_beyond(table, output, limits)):
        failed = LimitExceededError("; ".join(beyond[:5]))
    lines = [
        *(verdict.text for verdict in table.verdicts),
        f"{table.done} points done, {table.failed} failed, in {output}, open {output}/sweep.html",
    ]
    return print_result(printing, table.model_dump(), lines, error=failed)
