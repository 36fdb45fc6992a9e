"""``rbfmuscle kernels``: which kernel, which shape parameter, how many centres."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter

from rbfmuscle.cli.options import Output, Texts
from rbfmuscle.progress import Progress
from rbfmuscle.validation import UsageError


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
    """Rank kernels, shape parameters and numbers of centres on a surface, or on each muscle of a scene.

    Parameters
    ----------
    source
        A mesh (STL, OBJ, PLY, VTK, VTP), a scene file, or ``phantom``.
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
    """
    from rbfmuscle.output.writer import check_writable

    counts = _split(centres) or ["150", "300"]
    if not all(count.isdecimal() and int(count) >= 8 for count in counts):
        raise UsageError(f"--centres must be whole numbers of 8 and more, got {' '.join(counts)!r}")
    meshes, units = _meshes(source, muscle, units)
    check_writable(output)
    options: dict[str, Any] = {"kernels": _split(names), "placement": placement}
    try:
        if error is None:
            options |= {"centres": [int(c) for c in counts], "units": units, "resolution": resolution}
            _study(meshes, output, options)
        else:
            _find_wanted(meshes, output, error, options, units)
    except OSError as failed:
        raise UsageError(f"cannot write to {output}: {failed.strerror}; choose another --output") from None


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
    chosen = [scene.muscle(muscle)] if muscle else scene.muscles
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
    print(f"{answer(studies)}\npage in {output / 'kernels.html'}")


def _find_wanted(meshes, output, error, options, units):
    """Find, print and write what reaches an error; where it is not reached, that is said."""
    from rbfmuscle.experiments.kernel_study import row_toml
    from rbfmuscle.experiments.wanted_error import reach_error
    from rbfmuscle.output.writer import json_text

    facts = {}
    for name, mesh in meshes.items():
        with Progress(f"kernels of {name}", what="fit") as bar:
            found = reach_error(mesh, error, **options, progress=bar)
        facts[name] = {
            "reached": found.reached, "error": found.error, "wanted": error, "units": units, "row": found.row,
            "toml": row_toml(found.row), "tried": found.tried, "said": found.describe(name, units),
        }  # fmt: skip
    output.mkdir(parents=True, exist_ok=True)
    (output / "error.json").write_text(json_text(facts), encoding="utf-8")
    print("\n".join(found["said"] for found in facts.values()))
    print(f"all that was tried in {output / 'error.json'}")
    for name, found in facts.items():
        if found["reached"]:
            print(f"\nto paste at the end of the [[muscle]] {json.dumps(name)}:\n\n{found['toml']}")
