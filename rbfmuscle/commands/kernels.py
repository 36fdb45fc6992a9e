"""``rbfmuscle kernels``: which kernel, which shape parameter, how many centres."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from rbfmuscle.commands.scenes import is_mesh, load_scene
from rbfmuscle.compiled.progress import Progress
from rbfmuscle.compiled.warm import compile_ahead
from rbfmuscle.compiled.watch import tell_stage
from rbfmuscle.validation import UsageError


def kernels(
    source: str | None = None,
    *,
    output: Annotated[Path, Parameter(name=["--output", "-o"])],
    names: Annotated[
        list[str] | None, Parameter(name="--kernels", negative="", consume_multiple=True)
    ] = None,
    centres: Annotated[list[str] | None, Parameter(negative="", consume_multiple=True)] = None,
    muscle: str | None = None,
    derivatives: str = "all",
    placement: str = "fitted",
    criterion: str = "held_out",
    condition: float = float("inf"),
    resolution: int = 0,
    best: int = 3,
    frames: str | None = None,
    units: str = "",
    pictures: bool = True,
    error: float | None = None,
    error_max: float | None = None,
    most: int | None = None,
    extremes: Annotated[bool, Parameter(negative="")] = False,
    as_json: Annotated[bool, Parameter(name="--json", negative="")] = False,
) -> int:
    """Rank kernels, shape parameters and numbers of centres on one surface; with a scene, run the best.

    Parameters
    ----------
    source
        A mesh (STL, OBJ, PLY, VTK, VTP), a scene file, or ``phantom``.
    output
        Folder for kernels.html, kernels.csv, kernels.json and the plots.
    names
        Kernels; all by default. Separate by commas or blanks.
    centres
        Numbers of centres; 150 and 300 by default. Separate by commas or blanks.
    muscle
        Of a scene; the first by default.
    derivatives
        all or normal: what a Hermite fit asks for.
    placement
        fitted, greedy, adaptive or even; fitted centres lie beside the surface and meet all of it best.
    criterion
        How epsilon is chosen: held_out, loo, gcv or condition.
    condition
        No epsilon beyond it is chosen, as 1e10, and fits to normals keep it by a ridge.
    resolution
        Cells along the longest side; 128, more for slender muscles, by default.
    best
        Of a scene, so many of the best also run the motion.
    frames
        Of that motion, as A:B:S.
    units
        Name of the unit of a mesh, for the text only.
    pictures
        Draw the best surfaces.
    error
        In place of a table: the fewest centres and the kernel that reach this RMS distance, in the mesh's unit; of a
        scene for each muscle, or the one named.
    error_max
        The same for the greatest distance.
    most
        Centres at most for --error and --error-max, 1000 by default.
    extremes
        In place of a surface: fit an ellipsoid under every extreme, and tell what was right, warned of or refused.
    as_json
        Print JSON and nothing else.
    """
    from rbfmuscle.study.experiment.kernel_study import study_kernels
    from rbfmuscle.study.files.writer import check_writable, json_text
    from rbfmuscle.study.show.kernels.page import write_study

    names, counts = _split(names), _checked_counts(derivatives, criterion, centres)
    if extremes:
        return _extremes(names, output, as_json)
    if source is None:
        raise UsageError("which surface? give a mesh, a scene file or phantom, or --extremes")
    if error is not None or error_max is not None or most is not None:
        from rbfmuscle.commands.wanted import find_wanted

        return find_wanted(source, output, (error, error_max), muscle=muscle, units=units, as_json=as_json,
                           kernels=names, placement=placement, most=most)  # fmt: skip
    with Progress("kernels", what="fit") as bar:
        scene, mesh, title = _surface(source, muscle)
        check_writable(output)
        compile_ahead(["kernels"])
        study = study_kernels(
            mesh, kernels=names, centres=counts, derivatives=derivatives, placement=placement,
            criterion=criterion, condition=condition, resolution=resolution,
            units=units if scene is None else scene.units, progress=bar,
        )  # fmt: skip
        moved = [] if scene is None else _run_best(scene, title, study, best, frames)
        try:
            with tell_stage("drawing pictures"):
                missing = write_study(
                    study, output, title=f"Kernels for {title}", pictures=pictures, moved=moved
                )
        except OSError as error:
            raise UsageError(f"cannot write to {output}: {error.strerror}; choose another --output") from None
    if as_json:
        print(json_text({"rows": study.rows, "motion": moved}))
    else:
        _print(study, moved, output)
    if missing is not None:
        raise missing
    return 0


def _checked_counts(derivatives, criterion, centres):
    """The numbers of centres; what the words of the command cannot mean is refused."""
    from rbfmuscle.implicit.selection import CRITERIA

    if derivatives not in ("all", "normal") or criterion not in CRITERIA:
        raise UsageError(f"derivatives must be all or normal, criterion {', '.join(CRITERIA)}; "
                         f"got {derivatives!r} and {criterion!r}")  # fmt: skip
    counts = _split(centres) or ["150", "300"]
    if not all(count.isdecimal() and int(count) >= 4 for count in counts):
        raise UsageError(f"--centres must be whole numbers of 4 and more, got {' '.join(counts)!r}")
    return [int(count) for count in counts]


def _split(texts):
    """What stands between commas and blanks; None where nothing does."""
    return [part for text in texts or [] for part in text.split(",") if part] or None


def _extremes(names, output, as_json):
    from rbfmuscle.study.experiment.extremes import extremes_matrix, study_extremes, write_extremes
    from rbfmuscle.study.files.writer import json_text

    with Progress("extremes", what="fit") as bar:
        rows = study_extremes(kernels=names, progress=bar)
    write_extremes(rows, output)
    print(json_text(rows) if as_json else extremes_matrix(rows))
    return 0


def _surface(source, muscle):
    """Scene or None, the mesh to fit, and its name."""
    from rbfmuscle.sim.scene.meshes import read_mesh

    if is_mesh(source):
        return None, read_mesh(source).mesh, Path(source).stem
    scene = load_scene(source)
    chosen = scene.muscle(muscle) if muscle else scene.muscles[0]
    return scene, chosen.mesh, chosen.name


def _to_run(study, best):
    """The recommended row, the quickest and the most accurate, then the next best of the table."""
    found = study.recommended
    chosen = [found.row, found.quickest, found.most_accurate] if found else []
    chosen += [row for row in study.rows if not row["unfit"]]
    rows = []
    for row in chosen:
        if row is not None and not any(row is other for other in rows):
            rows.append(row)
    return rows[:best]


def _run_best(scene, name, study, best, frames):
    """Run one muscle's motion with the best settings; a setting that fails says so and stops no other."""
    from rbfmuscle.run import simulate
    from rbfmuscle.validation import RBFMuscleError

    moved, last, rms = [], [], []
    for row in _to_run(study, best):
        settings = {
            name: row[name.split(".")[1]] for name in ("model.kernel", "model.centres", "model.placement")
        }
        if row["epsilon"]:
            settings["model.epsilon"] = row["epsilon"]
        if row["bound"]:
            settings["model.condition"] = row["bound"]
        if row["fit"] != "values":
            settings["model.derivatives"] = row["fit"]
        facts = {"kernel": row["kernel"], "centres": row["centres"], "error": ""}
        alone = scene.with_options(settings, model="rbf", frames=frames)
        alone.muscles = [alone.muscle(name)]
        try:
            run = simulate(alone)
            table = run.summary[name]
            last.append((facts, run[name].surface(frame=-1)))
            rms.append(row["rms"])
            for quantity in (
                "volume_error",
                "penetration_max",
                "bone_penetration_max",
                "components",
                "condition",
                "time_frame",
            ):
                if quantity in table:
                    facts[quantity] = table[quantity]["median" if quantity == "time_frame" else "worst"]
        except RBFMuscleError as error:
            facts["error"] = str(error)
        moved.append(facts)
    if len(last) > 1:
        _compare_with_finest(last, last[rms.index(min(rms))][1])
    return moved


def _compare_with_finest(last, finest):
    """Write into the facts of each run how far its last surface is from that of the run of the smallest error."""
    import numpy as np

    from rbfmuscle.study.measure.mesh_distance import MeshDistance

    distance = MeshDistance(finest.vertices, finest.faces)
    for facts, surface in last:
        apart = distance.unsigned(np.asarray(surface.vertices))
        facts["apart_rms"], facts["apart_max"] = float(np.sqrt((apart**2).mean())), float(apart.max())


def _print(study, moved, output):
    from rbfmuscle.study.experiment.kernel_choice import cost, named

    unit = study.units or "mesh units"
    print(f"{'kernel':26s} {'centres':>7s} {'eps h':>6s} {'RMS':>8s} {'from':>8s} {'to':>8s} "
          f"{'Hausd.':>8s} {'vol %':>7s} "
          f"{'cond.':>8s} {'fit ms':>7s} {'numbers':>7s} {'mesh':>7s}   [{unit}]")  # fmt: skip
    for row in study.rows:
        start = f"{row['kernel']:26s} {row['centres']:7d} {_text(row['shape'], 6)} "
        if row["unfit"]:
            print(f"{start} unfit: {row['unfit'][:90]}")
            continue
        print(
            f"{start}{_text(row['rms'], 8)} {_text(row['low'], 8)} {_text(row['high'], 8)} "
            f"{_text(row['hausdorff'], 8)} "
            f"{_text(100 * row['volume_error'], 7)} {row['condition']:8.1e} {_text(1e3 * row['fit_time'], 7)} "
            f"{row['numbers']:7d} {_text(row['decimated_rms'], 7)}"
        )
    for facts in moved:
        said = facts["error"] or ", ".join(
            f"{name} {value:.3g}" for name, value in facts.items() if isinstance(value, float)
        )
        print(f"in motion, {facts['kernel']} with {facts['centres']} centres: {said}")
    print(f"page in {output / 'kernels.html'}")
    found = study.recommended
    if found is None:
        print("recommended: none, every field is unfit; try more centres")
        return
    print(f"recommended: {named(found.row)}: {found.reason}")
    if found.quickest is not None:
        times = f"{1e3 * cost(found.quickest):.3g} ms instead of {1e3 * cost(found.row):.3g}"
        print(f"for speed: {named(found.quickest)}, {found.quickest['rms']:.3g} RMS in {times}")
    if found.most_accurate is not None:
        print(f"smallest figure: {named(found.most_accurate)}, {found.most_accurate['rms']:.3g} RMS")
    print(f"to paste at the end of a [[muscle]]:\n\n{study.toml(found.row)}")


def _text(value, width):
    return f"{'':{width}s}" if value is None else f"{value:{width}.3g}"
