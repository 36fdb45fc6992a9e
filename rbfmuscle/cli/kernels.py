"""``rbfmuscle kernels``: kernels on a surface or on the muscles of a scene."""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from rbfmuscle.cli.options import (
    USUAL_WORK,
    Muscles,
    Output,
    Work,
    chosen_muscles,
    print_result,
    refuse,
    split_list,
)
from rbfmuscle.progress import Progress
from rbfmuscle.validation import UsageError


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


USUAL_FITS = Fits()


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
