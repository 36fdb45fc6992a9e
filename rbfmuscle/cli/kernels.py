"""``rbfmuscle kernels``: which kernel, which shape parameter, how many centres."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from rbfmuscle.cli.scenes import is_mesh, load_scene
from rbfmuscle.progress import Progress
from rbfmuscle.validation import UsageError

if TYPE_CHECKING:
    import trimesh

    from rbfmuscle.experiments.kernel_study import KernelStudy


def kernels(
    source: str,
    *,
    output: Annotated[Path, Parameter(name=["--output", "-o"])],
    names: Annotated[
        list[str] | None, Parameter(name="--kernels", negative="", consume_multiple=True)
    ] = None,
    centres: Annotated[list[str] | None, Parameter(negative="", consume_multiple=True)] = None,
    muscle: str | None = None,
    placement: str = "fitted",
    resolution: int = 0,
    units: str = "",
    error: float | None = None,
    as_json: Annotated[bool, Parameter(name="--json", negative="")] = False,
) -> int:
    """Rank kernels, shape parameters and numbers of centres on a surface, or on each muscle of a scene.

    Parameters
    ----------
    source
        A mesh (STL, OBJ, PLY, VTK, VTP), a scene file, or ``phantom``.
    output
        Folder for kernels.html, kernels.csv, kernels.json and recommended_NAME.vtp.
    names
        Kernels; all by default. Separate by commas or blanks.
    centres
        Numbers of centres; 150 and 300 by default. Separate by commas or blanks.
    muscle
        Of a scene; every one by default.
    placement
        fitted or greedy; fitted centres lie beside the surface and meet all of it best.
    resolution
        Cells along the longest side; 128, more for slender muscles, by default.
    units
        Name of the unit of a mesh, for the text only.
    error
        In place of a table: the fewest centres and the kernel that reach this RMS distance, in the mesh's unit.
    as_json
        Print JSON and nothing else.
    """
    from rbfmuscle.experiments.kernel_study import study_kernels
    from rbfmuscle.output.writer import check_writable, json_text
    from rbfmuscle.report.kernel_page import answer, write_studies

    chosen, counts = _split(names), _counts(centres)
    meshes, units = _meshes(source, muscle, units)
    check_writable(output)
    if error is not None:
        return _find_wanted(meshes, output, error, chosen, placement, units, as_json)
    studies = {}
    for name, mesh in meshes.items():
        with Progress(f"kernels of {name}", what="fit") as bar:
            studies[name] = study_kernels(
                mesh, kernels=chosen, centres=counts, placement=placement, resolution=resolution, units=units,
                progress=bar,
            )  # fmt: skip
    try:
        write_studies(studies, output, meshes)
    except OSError as failed:
        raise UsageError(f"cannot write to {output}: {failed.strerror}; choose another --output") from None
    if as_json:
        print(
            json_text({"rows": [{"surface": name, **row} for name, s in studies.items() for row in s.rows]})
        )
    else:
        for name, study in studies.items():
            _print(study, name)
        print(f"{answer(studies)}\npage in {output / 'kernels.html'}")
    return 0


def _counts(centres: list[str] | None) -> list[int]:
    """The numbers of centres."""
    counts = _split(centres) or ["150", "300"]
    if not all(count.isdecimal() and int(count) >= 8 for count in counts):
        raise UsageError(f"--centres must be whole numbers of 8 and more, got {' '.join(counts)!r}")
    return [int(count) for count in counts]


def _split(texts: list[str] | None) -> list[str] | None:
    """What stands between commas and blanks; None where nothing does."""
    return [part for text in texts or [] for part in text.split(",") if part] or None


def _meshes(source: str, muscle: str | None, units: str) -> tuple[dict[str, trimesh.Trimesh], str]:
    """Meshes by name, and their unit: of a scene the named muscle, or every one."""
    from rbfmuscle.scene.meshes.read import read_mesh

    if is_mesh(source):
        return {Path(source).stem: read_mesh(source).mesh}, units
    scene = load_scene(source)
    chosen = [scene.muscle(muscle)] if muscle else scene.muscles
    return {each.name: each.mesh for each in chosen}, scene.units


def _find_wanted(
    meshes: dict[str, trimesh.Trimesh],
    output: Path,
    error: float,
    names: list[str] | None,
    placement: str,
    units: str,
    as_json: bool,
) -> int:
    """Find, print and write what reaches an error; 0, also where it is not reached, which is said."""
    from rbfmuscle.experiments.kernel_study import row_toml
    from rbfmuscle.experiments.wanted_error import reach_error
    from rbfmuscle.output.writer import json_text

    facts = {}
    for name, mesh in meshes.items():
        with Progress(f"kernels of {name}", what="fit") as bar:
            found = reach_error(mesh, error, kernels=names, placement=placement, progress=bar)
        facts[name] = {
            "reached": found.reached, "error": found.error, "wanted": error, "units": units, "row": found.row,
            "toml": row_toml(found.row), "tried": found.tried, "said": found.describe(name, units),
        }  # fmt: skip
    try:
        output.mkdir(parents=True, exist_ok=True)
        (output / "error.json").write_text(json_text(facts), encoding="utf-8")
    except OSError as failed:
        raise UsageError(f"cannot write to {output}: {failed.strerror}; choose another --output") from None
    if as_json:
        print(json_text(facts))
        return 0
    for found in facts.values():
        print(found["said"])
    print(f"all that was tried in {output / 'error.json'}")
    for name, found in facts.items():
        if found["reached"]:
            print(f"\nto paste at the end of the [[muscle]] {json.dumps(name)}:\n\n{found['toml']}")
    return 0


def _print(study: KernelStudy, name: str) -> None:
    from rbfmuscle.experiments.kernel_study import describe, row_toml

    print(f"{name + ' [' + (study.units or 'mesh units') + ']':26s} {'centres':>7s} {'eps h':>6s} {'RMS':>8s} "
          f"{'Hausd.':>8s} {'vol %':>7s} {'cond.':>8s} {'fit ms':>7s}")  # fmt: skip
    for row in study.rows:
        shape = "" if row["shape"] is None else f"{row['shape']:.3g}"
        start = f"{row['kernel']:26s} {row['centres']:7d} {shape:>6s} "
        if row["unfit"]:
            print(f"{start} unfit: {row['unfit'][:90]}")
            continue
        print(f"{start}{row['rms']:8.3g} {row['hausdorff']:8.3g} {100 * row['volume_error']:7.3g} "
              f"{row['condition']:8.1e} {1e3 * row['fit_time']:7.3g}")  # fmt: skip
    print(describe(study.rows))
    if study.recommended is not None:
        print(f"to paste at the end of the [[muscle]] {json.dumps(name)}:\n\n{row_toml(study.recommended)}\n")
