"""``rbfmuscle sdf``: the distance field of one bone, measured and drawn."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from rbfmuscle.compiled.progress import Progress
from rbfmuscle.compiled.warm import compile_ahead


def sdf(
    mesh: Path,
    *,
    output: Annotated[Path | None, Parameter(name=["--output", "-o"])] = None,
    axis: str = "y",
    tolerance: float | None = None,
    units: str = "",
    cache: bool = True,
    as_json: Annotated[bool, Parameter(name="--json", negative="")] = False,
) -> None:
    """Build the distance field of a bone, measure it against exact distances and draw a slice.

    Parameters
    ----------
    mesh
        STL, OBJ, PLY, VTK or VTP.
    output
        Picture of the slice (.png); by default MESH_sdf.png in the present folder.
    axis
        Normal of the slice through the bone's middle: x, y or z.
    tolerance
        RMS error near the surface, in the unit of the mesh.
    units
        Name of that unit, for the text only.
    cache
        Take the field from the cache on disk and keep it there.
    as_json
        Print JSON and nothing else.
    """
    from rbfmuscle.validation import UsageError

    output = Path(f"{mesh.stem}_sdf.png") if output is None else output
    if output.suffix.lower() != ".png":
        raise UsageError(f"the slice is drawn to a .png file, got {str(output)!r}")
    if tolerance is not None and not tolerance > 0:
        raise UsageError(f"--tolerance must be positive, got {tolerance:g}")
    with Progress(f"sdf {mesh.name}"):
        from rbfmuscle.sim.scene.meshes import read_mesh
        from rbfmuscle.study.show.sdf_report import report_lines, sdf_report

        read = read_mesh(mesh, may_be_open=True)
        output.parent.mkdir(parents=True, exist_ok=True)
        compile_ahead(["sdf"])
        try:
            report = sdf_report(
                read.mesh, image=output, axis=axis, tolerance=tolerance, cache=cache, name=mesh.stem
            )
        except OSError as error:
            raise UsageError(f"cannot write {output}: {error.strerror or error}") from error
    report["notes"] = [*read.notes, *report["notes"]]
    print(json.dumps(report, indent=1) if as_json else "\n".join(report_lines(report, units)))
