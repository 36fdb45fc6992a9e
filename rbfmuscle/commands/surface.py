"""``rbfmuscle surface``: a closed mesh from points, with normals or without."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

from cyclopts import Parameter

from rbfmuscle.compiled.progress import Progress
from rbfmuscle.validation import MeshError, UsageError


def surface(
    points: Path,
    *,
    output: Annotated[Path, Parameter(name=["--output", "-o"])],
    resolution: int = 0,
    normals: bool = True,
    as_json: Annotated[bool, Parameter(name="--json", negative="")] = False,
) -> None:
    """Make a closed mesh from a point cloud; without normals they are found by the energy of the field.

    Parameters
    ----------
    points
        A file of points: .xyz (three numbers a line, six with normals), .npy, or .ply.
    output
        The mesh: .ply, .stl, .obj or .vtp; a scene takes it as a muscle or a bone.
    resolution
        Cells along the longest side; two a spacing of the points by default.
    normals
        Use the file's own normals where it has some.
    as_json
        Print JSON and nothing else.
    """
    from rbfmuscle.implicit.reconstruction import reconstruct_surface
    from rbfmuscle.sim.formats.points import read_points
    from rbfmuscle.study.files.meshfiles import write_mesh

    if output.suffix.lower() not in (".ply", ".stl", ".obj", ".vtp"):
        raise UsageError(f"the surface is written as .ply, .stl, .obj or .vtp, got {str(output)!r}")
    with Progress(f"surface of {points.name}", what="part") as bar:
        where, given = read_points(points)
        given = given if normals else None
        try:
            found = reconstruct_surface(where, given, resolution=resolution, progress=bar)
        except ValueError as error:  # singular systems too: the points cannot be used
            kind = UsageError if isinstance(error, UsageError) else MeshError
            raise kind(f"{points}: {error}") from None
        try:
            output.parent.mkdir(parents=True, exist_ok=True)
            write_mesh(output, found.vertices, found.faces)
        except OSError as error:
            raise UsageError(f"cannot write {output}: {error.strerror}; choose another --output") from None
    facts = {
        "points": len(found.points), "left_out": len(where) - len(found.points),
        "normals": "found" if given is None else "given", "vertices": len(found.vertices),
        "faces": len(found.faces), "spurious": found.spurious, "condition": found.field.condition,
        "output": str(output),
    }  # fmt: skip
    if as_json:
        print(json.dumps(facts, indent=1))
        return
    print(
        f"{facts['points']} points ({facts['left_out']} repeats left out), normals {facts['normals']}: "
        f"{facts['vertices']} vertices, {facts['faces']} triangles"
        f"{f', {found.spurious} smaller sheets left out' if found.spurious else ''}, in {output}"
    )
