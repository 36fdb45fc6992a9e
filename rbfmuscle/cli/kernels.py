"""``rbfmuscle kernels``: kernels on a surface or on the muscles of a scene."""

import json
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from rbfmuscle.cli.options import (
    USUAL_WORK,
    Muscles,
    Output,
    Work,
    named_muscles,
    print_result,
    refuse,
    split_list,
)
from rbfmuscle.progress import Progress
from rbfmuscle.validation import UsageError


def kernels(
    source: str,
    *,
    output: Output,
    names: Annotated[str | None, Parameter(name="--kernels")] = None,
    centres: str | None = None,
    resolution: int | None = None,
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
    names
        Kernels, separated by commas; all by default.
    centres
        Numbers of centres, separated by commas; 150,300 by default.
    resolution
        Cells along the longest side of extracted surfaces; by default 128, and more for slender
        muscles.
    units
        Name of the mesh's unit, for tables and plots; nothing is converted.
    error
        Find the fewest centres, and the kernel, that reach this RMS distance (in the mesh's unit),
        in place of a table.
    """
    from rbfmuscle.studies.kernels import kernels_folder, open_surfaces, study_kernels

    if error is not None:
        refuse("--error", {"--centres": centres, "--resolution": resolution})
    counts = split_list("150,300" if centres is None else centres)
    if not counts or not all(count.isdecimal() and int(count) >= 8 for count in counts):
        raise UsageError(f"--centres must be whole numbers of 8 and more, got {centres!r}")
    kernels_folder(output)
    chosen, named = split_list(names) or None, named_muscles(muscles)
    if error is not None:
        meshes, unit = open_surfaces(source, named, units)
        with work.threads():
            return _find_wanted(meshes, output, error, chosen, unit, work)
    with Progress(f"kernels of {Path(source).stem}", what="fit") as bar:
        study = study_kernels(
            source,
            output,
            muscles=named,
            kernels=chosen,
            centres=[int(count) for count in counts],
            resolution=resolution or 0,
            units=units,
            jobs=work.jobs,
            progress=bar,
        )
    return print_result(work, study.model_dump(), _study_lines(study, output))


def _study_lines(study, output):
    from rbfmuscle.studies.kernels import describe, recommend

    for name, rows in study.by_surface.items():
        best = recommend(rows)
        if best is not None:
            yield f"{name}: {describe(rows)}"
            yield f"to paste at the end of its [[muscle]]:\n\n{best.toml()}\n"
    if len(study.meshes) > 1 or not study.recommended:
        yield study.answer()
    yield f"all rows: open {output / 'kernels.html'}"


def _find_wanted(meshes, output, error, kernels, units, printing):
    """Find, print and write what reaches an error; where it is not reached, that is said."""
    from rbfmuscle.run.writer import json_text
    from rbfmuscle.studies.kernels import kernels_folder, reach_error

    facts = {}
    for name, mesh in meshes.items():
        with Progress(f"kernels of {name}", what="fit") as bar:
            found = reach_error(mesh, error, kernels=kernels, progress=bar)
        facts[name] = {
            "reached": found.reached,
            "error": found.error,
            "wanted": found.wanted,
            "units": units,
            "row": found.row.model_dump(),
            "toml": found.row.toml(),
            "tried": [
                {"kernel": row.kernel, "centres": row.centres, "error": row.error}
                for row in found.tried
            ],
            "said": found.describe(name, units),
        }
    with kernels_folder(output).staged() as stage:
        (stage / "error.json").write_text(json_text(facts), encoding="utf-8")
    lines = [found["said"] for found in facts.values()]
    lines.append(f"all that was tried in {output / 'error.json'}")
    lines += [
        f"\nto paste at the end of the [[muscle]] {json.dumps(name)}:\n\n{found['toml']}"
        for name, found in facts.items()
        if found["reached"]
    ]
    return print_result(printing, facts, lines)
