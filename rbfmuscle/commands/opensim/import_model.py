"""``rbfmuscle import``: a scene from an OpenSim model."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from rbfmuscle.validation import UsageError


def import_(
    model: Path,
    *,
    output: Annotated[Path, Parameter(name=["--output", "-o"])],
    units: Literal["m", "cm", "mm"] = "m",
    geometry: Annotated[list[Path] | None, Parameter(negative="")] = None,
    bodies: Annotated[list[str] | None, Parameter(negative="")] = None,
    motion: Path | None = None,
    muscles: Annotated[Path | None, Parameter(name="--muscles")] = None,
    bones: Annotated[Path | None, Parameter(name="--bones")] = None,
    matches: Path | None = None,
    force: Annotated[bool, Parameter(negative="")] = False,
) -> None:
    """Write a scene file and its meshes from an OpenSim model (.osim).

    Parameters
    ----------
    model
        The model, of version 2 to 4; OpenSim itself is not needed.
    output
        Folder for scene.toml and the bones.
    units
        Unit of the scene's lengths.
    geometry
        Folder with meshes, besides the model's own and its Geometry; repeatable.
    bodies
        Take this body and what lies between it and the ground; repeatable, all by default.
    motion
        A .mot or .sto file for the scene's motion.
    muscles
        Folder with muscle meshes in the model's default pose and the scene's unit, matched to its muscles by name.
    bones
        Folder with own bones in the scene's unit; the model's bodies are fitted onto them and its joints come along.
    matches
        matches.csv of an import, corrected.
    force
        Replace a scene file that exists.
    """
    from rbfmuscle.opensim.folder import write_scene
    from rbfmuscle.opensim.match import write_table
    from rbfmuscle.opensim.scene import import_osim

    target = output / "scene.toml"
    if target.exists() and not force:
        raise UsageError(f"{target} exists; give another --output, or --force to replace it")
    for folder in geometry or []:
        if not folder.is_dir():
            raise UsageError(f"--geometry {folder}: no such folder")
    found = import_osim(model, units=units, geometry=geometry, bodies=bodies)
    rows = _bring(found, bones)
    held = _match(found, muscles, matches)
    written = write_scene(found, output, motion=motion, matches=held)
    if rows:
        from rbfmuscle.opensim.register import write_rows

        write_rows(rows, output / "bones.csv")
    if held:
        write_table(held, output / "matches.csv")
        for match in held:
            names = " ".join(path.name for path in match.paths) or match.note
            ends = ", ".join(f"{len(vertices)} on {bone}" for bone, vertices in match.ends)
            print(f"guess: {match.file.name}: {names}" + (f"; held by {ends}" if ends else ""))
    for note in found.notes:
        print(f"note: {note}")
    scene = found.scene
    counts = f"{len(scene.bones)} bones, {len(scene.links)} without a mesh, {len(scene.joints)} joints"
    print(f"{written}: {counts}, {len(scene.couplings)} couplings")
    print(
        f"next: rbfmuscle check {written}"
        + ("" if held else "; give it muscles with --muscles DIR, or by hand")
    )


def _bring(found, folder):
    if folder is None:
        return []
    if not folder.is_dir():
        raise UsageError(f"--bones {folder}: no such folder")
    from rbfmuscle.opensim.register import bring_to_bones

    rows = bring_to_bones(found, folder)
    for row in rows:
        if row["file"]:
            name = f"bone {row['what']}: {row['file']}, scale {row['scale']:.4g}"
            print(f"{name}, {row['rms_mm']:.3g} mm RMS, {row['max_mm']:.3g} at most")
        else:
            print(
                f"{row['what']}: parent and child {row['rms_mm']:.3g} mm and {row['max_mm']:.3g} degrees apart"
            )
    return rows


def _match(found, folder, table):
    if folder is None:
        if table is not None:
            raise UsageError("--matches belongs to --muscles; give the folder of the meshes too")
        return []
    if not folder.is_dir():
        raise UsageError(f"--muscles {folder}: no such folder")
    from rbfmuscle.opensim.match import attach, match_meshes

    held = match_meshes(found, folder, table)
    for match in held:
        attach(found, match)
    return held
