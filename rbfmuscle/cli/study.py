"""``rbfmuscle compare``, ``kernels``, ``sweep`` and ``paths``: models, kernels, settings, and paths
for OpenSim.
"""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter

from rbfmuscle.cli.options import Frames, Model, Output, SceneName, Settings, Texts, chosen_muscle
from rbfmuscle.progress import Progress
from rbfmuscle.validation import SolveError, UsageError

if TYPE_CHECKING:
    pass


def compare(
    scene: SceneName,
    *,
    output: Output,
    models: str | None = None,
    settings: Settings = None,
    frames: Frames = None,
    pictures: bool = True,
) -> None:
    """Run models on one scene: the same motion, contacts and measures; tables, report, pictures.

    Each model's run is in a folder of its own; MODEL:KEY=VALUE is a setting for one model.

    Parameters
    ----------
    models
        Models, separated by commas, for instance rbf,pbd; distances are measured to the first. By
        default rbf, the mesh models and pbd-converged, which takes long: it sweeps
        until no vertex moves.
    pictures
        Draw pictures and the animation.
    """
    from rbfmuscle import interruption
    from rbfmuscle.compare import compare_models
    from rbfmuscle.models import COMPARED
    from rbfmuscle.scene.phantom import open_scene
    from rbfmuscle.scene.settings import parse_settings

    names = [name.strip() for name in (models or "").split(",") if name.strip()] or list(COMPARED)
    changes = parse_settings(settings)
    kept = f"finished runs are kept in {output}"
    with (
        Progress("compare") as progress,
        interruption.keeping(lambda: kept if output.exists() else ""),
    ):

        def advance(model, done, total):
            if done == 0:
                progress.show(model, done, total)
            progress(done, total)
            interruption.check()

        options: dict[str, Any] = {"frames": frames, "settings": changes, "pictures": pictures}
        table = compare_models(open_scene(scene), output, names, progress=advance, **options)
    _print_table(table, output)
    if table["failed"]:
        reasons = "; ".join(f"{name}: {reason}" for name, reason in table["failed"].items())
        raise SolveError(f"{reasons}; the other models are in {output}")


def _print_table(table, output):
    from rbfmuscle.report.comparison_page import LIGHTS, shown

    print(" " * 24 + "".join(f"{name:>18}" for name in table["models"]))
    for quantity in LIGHTS:
        values = [table["results"][name]["all"].get(quantity) for name in table["models"]]
        print(
            f"{quantity:24}" + "".join(f"{shown(table, quantity, value):>18}" for value in values)
        )
    print(table["answer"])
    print(f"{table['frames']} frames, in {output}, open {output / 'report.html'}")


def kernels(
    source: str,
    *,
    output: Output,
    names: Annotated[Texts, Parameter(name="--kernels")] = None,
    centres: Texts = None,
    muscle: str | None = None,
    placement: str = "fitted",
    resolution: int = 0,
    units: str = "",
    error: float | None = None,
) -> None:
    """Rank kernels, shape parameters and numbers of centres on a surface, or on each muscle of a
    scene.

    Parameters
    ----------
    source
        A mesh (STL, OBJ, PLY, VTK, VTP), a scene file, or ``phantom``.
    names
        Kernels; all by default. Separate them by commas or blanks.
    centres
        Numbers of centres; 150 and 300 by default. Separate them by commas or blanks.
    muscle
        Name of one muscle of a scene; all by default.
    placement
        Places of the centres: fitted (moved off the surface until the whole surface is met) or
        greedy (on it).
    resolution
        Cells along the longest side of extracted surfaces; 0 for 128, and more for slender muscles.
    units
        Name of the mesh's unit, for tables and plots; nothing is converted.
    error
        Find the fewest centres, and the kernel, that reach this RMS distance (in the mesh's unit),
        in place of a table.
    """
    from rbfmuscle.report.kernel_page import kernels_folder

    counts = _split(centres) or ["150", "300"]
    if not all(count.isdecimal() and int(count) >= 8 for count in counts):
        raise UsageError(f"--centres must be whole numbers of 8 and more, got {' '.join(counts)!r}")
    meshes, units = _meshes(source, muscle, units)
    kernels_folder(output)
    options: dict[str, Any] = {"kernels": _split(names), "placement": placement}
    if error is None:
        options |= {"centres": [int(c) for c in counts], "units": units, "resolution": resolution}
        _study(meshes, output, options)
    else:
        _find_wanted(meshes, output, error, options, units)


def _split(texts):
    """What stands between commas and blanks; None where nothing does."""
    return [part for text in texts or [] for part in text.split(",") if part] or None


def _meshes(source, muscle, units):
    """Meshes by name, and their unit: of a scene the named muscle, or every one."""
    from rbfmuscle.scene.meshes.read import read_mesh
    from rbfmuscle.scene.phantom import PHANTOM, open_scene

    if source != PHANTOM and Path(source).suffix.lower() != ".toml":
        return {Path(source).stem: read_mesh(source).mesh}, units
    scene = open_scene(source)
    chosen = [chosen_muscle(scene, muscle)] if muscle else scene.muscles
    return {each.name: each.mesh for each in chosen}, scene.units


def _study(meshes, output, options):
    from rbfmuscle.experiments.kernel_study import describe, row_toml, study_kernels
    from rbfmuscle.report.kernel_page import answer, write_studies

    studies = {}
    for name, mesh in meshes.items():
        with Progress(f"kernels of {name}", what="fit") as bar:
            studies[name] = study_kernels(mesh, **options, progress=bar)
    write_studies(studies, output)
    for name, study in studies.items():
        if study.recommended is not None:
            print(f"{name}: {describe(study.rows)}")
            print(f"to paste at the end of its [[muscle]]:\n\n{row_toml(study.recommended)}\n")
    if len(studies) > 1 or not next(iter(studies.values())).recommended:
        print(answer(studies))
    print(f"all rows: open {output / 'kernels.html'}")


def _find_wanted(meshes, output, error, options, units):
    """Find, print and write what reaches an error; where it is not reached, that is said."""
    from rbfmuscle.experiments.kernel_study import row_toml
    from rbfmuscle.experiments.wanted_error import reach_error
    from rbfmuscle.output.writer import json_text
    from rbfmuscle.report.kernel_page import kernels_folder

    facts = {}
    for name, mesh in meshes.items():
        with Progress(f"kernels of {name}", what="fit") as bar:
            found = reach_error(mesh, error, **options, progress=bar)
        facts[name] = {
            "reached": found.reached,
            "error": found.error,
            "wanted": error,
            "units": units,
            "row": found.row,
            "toml": row_toml(found.row),
            "tried": found.tried,
            "said": found.describe(name, units),
        }
    with kernels_folder(output).staged() as stage:
        (stage / "error.json").write_text(json_text(facts), encoding="utf-8")
    print("\n".join(found["said"] for found in facts.values()))
    print(f"all that was tried in {output / 'error.json'}")
    for name, found in facts.items():
        if found["reached"]:
            print(f"\nto paste at the end of the [[muscle]] {json.dumps(name)}:\n\n{found['toml']}")


def sweep(
    *scenes: str,
    output: Output,
    grid: Texts = None,
    model: Model = None,
    settings: Settings = None,
    frames: Frames = None,
    reference: Texts = None,
    jobs: int | None = None,
    cluster: str | None = None,
    error: str = "error_rms",
) -> None:
    """Run scenes under a grid of settings: errors, time per frame, Pareto front.

    Points that are already done in the folder are not run again.

    Parameters
    ----------
    scenes
        Scene files (TOML), or "phantom" for the embedded hip.
    grid
        KEY=a,b,c with keys as for run --set, for instance model.centres=100,200,300.
    reference
        KEY=VALUE settings of the reference that errors are measured against; by default the finest
        values of the grid.
    jobs
        Points that run at the same time; as many as cores by default. Each gets cores / jobs
        threads.
    cluster
        Address of a Dask scheduler, for instance tcp://127.0.0.1:8786; its workers must see the
        folder.
    error
        The error on the axis of the Pareto front; the other axis is time.
    """
    from rbfmuscle import interruption
    from rbfmuscle.experiments.sweep import parse_grid
    from rbfmuscle.models import configure_scene
    from rbfmuscle.scene.phantom import open_scene
    from rbfmuscle.scene.settings import parse_settings
    from rbfmuscle.sweeping import sweep as run_scenes

    axes, changes = parse_grid(grid or []), parse_settings(settings)
    if not scenes or (len(scenes) == 1 and not axes):
        raise UsageError(
            "a sweep needs several scenes, or a grid, for instance --grid model.centres=100,200"
        )
    opened = {name: open_scene(path) for name, path in _names(scenes).items()}
    loaded = {name: configure_scene(each, changes, model=model) for name, each in opened.items()}
    options: dict[str, Any] = {
        "frames": frames,
        "reference": parse_settings(reference),
        "jobs": jobs,
        "cluster": cluster,
        "error": error,
    }
    progress = Progress("sweep", what="point")
    with progress, interruption.keeping(lambda: f"finished points are kept in {output}"):
        table = run_scenes(loaded, axes, output, progress=progress, **options)
    _finish(table, output)


def _names(scenes):
    """Scene files by their names, or by those of their folders where names are the same."""
    folders = [Path(path).resolve().parent.name for path in scenes]
    for names in ([Path(path).stem for path in scenes], folders):
        if len(set(names)) == len(names):
            return dict(zip(names, scenes))
    raise UsageError("scenes of a sweep need different names, or folders of different names")


def _finish(table, output):
    for verdict in table["verdicts"]:
        print(verdict["text"])
    print(
        f"{table['done']} points done, {table['failed']} failed, in {output}, open "
        f"{output}/sweep.html"
    )
    bad = [row for row in table["rows"] if row["status"] != "done"]
    for row in bad[:5]:
        print(
            f"rbfmuscle: {row['scene']} {row['label']}: {row['error'] or row['status']}",
            file=sys.stderr,
        )
    if bad:
        remedy = "the others are kept, the same command runs these again"
        raise SolveError(f"{len(bad)} of {len(table['rows'])} points failed; {remedy}")


def paths(
    scene: SceneName,
    *,
    output: Output,
    samples: int = 120,
    muscles: str | None = None,
    fibres: int = 0,
    ranges: Annotated[list[str] | None, Parameter(name="--range", negative="")] = None,
    model: Model = None,
    settings: Settings = None,
) -> None:
    """Sample a muscle's lengths and moment arms over its coordinates and fit a path that OpenSim
    loads.

    Parameters
    ----------
    samples
        Poses for each muscle, of which every fifth is held out of the fit.
    muscles
        Names, separated by commas; all by default.
    fibres
        Of each muscle, for each of which a path is fitted, in place of one for the muscle.
    ranges
        COORDINATE=LOW:HIGH in degrees or scene units; else the coordinate's range, or what the
        motion covers.
    """
    from rbfmuscle.models import configure_scene
    from rbfmuscle.paths import parse_ranges, paths_folder, report_fits, sample_muscles
    from rbfmuscle.scene.phantom import open_scene
    from rbfmuscle.scene.settings import parse_settings

    if samples < 10:
        raise UsageError(f"--samples {samples} is too few to fit anything, give 10 or more")
    loaded = configure_scene(open_scene(scene), parse_settings(settings), model=model)
    if muscles is not None:
        loaded.muscles = [
            chosen_muscle(loaded, name.strip()) for name in dict.fromkeys(muscles.split(","))
        ]
    given = parse_ranges(loaded, ranges or [])
    paths_folder(output)
    with Progress(loaded.name, "pose") as progress:
        sampled = sample_muscles(loaded, given, samples=samples, fibres=fibres, progress=progress)
    print("\n".join(report_fits(loaded, sampled, output)))
