"""A saved run in other formats and units: files for each frame, or an animation in one file."""

from __future__ import annotations

from pathlib import Path

from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.output.animation.moving import MovingRun, read_moving
from rbfmuscle.output.saved import SavedRun
from rbfmuscle.output.vtp import Collection, write_vtp
from rbfmuscle.scene.objects import MM_PER_UNIT
from rbfmuscle.validation import SolveError, UsageError

# One file a muscle (or bone) and frame; one file a frame; one file of all frames.
MESHES = ("pvd", "vtp", "ply", "stl", "obj")
SUFFIX_OF = {"usd": ".usdc", "animated-glb": ".glb", "html": ".html"}
FORMATS = (*MESHES, "glb", *SUFFIX_OF)
IN_METRES = ("glb", "animated-glb", "html")


def export_run(
    directory: str | Path,
    formats: list[str] | str,
    *,
    output: str | Path | None = None,
    units: str | None = None,
    frames: slice | None = None,
) -> list[Path]:
    """Write the muscles and bones of a saved run in one or more formats.

    Parameters
    ----------
    directory : path
        Folder of the run.
    formats : str or list of str
        Of `FORMATS`. ``pvd`` is ``vtp`` and a collection over the frames; ``glb`` gives one file a frame, ``usd``,
        ``animated-glb`` and ``html`` (a page that turns and scrubs) one of all frames.
    output : path, optional
        ``DIR/export`` where not given; each format has its own folder there.
    units : {"m", "cm", "mm"}, optional
        The scene's unit where not given; metres for ``glb``, ``animated-glb`` and ``html``, which know no other.
    frames : slice, optional
        Of the written frames; all where not given.

    Returns
    -------
    list of pathlib.Path
        Every file written.

    Raises
    ------
    UsageError
        If the folder holds no run, or a format or unit is unknown, or a surface does not keep its vertices.
    SolveError
        If a file cannot be written.
    MissingPartError
        If a format needs a package that is absent.
    """
    saved = SavedRun(directory)
    formats = [formats] if isinstance(formats, str) else list(formats)
    _check_words(formats, units)
    chosen = saved.frames[frames] if frames is not None else saved.frames
    if not chosen or not saved.has_surfaces():
        raise UsageError(f"{directory} has no surfaces to export")
    base = Path(output) if output is not None else saved.directory / "export"
    written = []
    try:
        for name in formats:
            folder = base / name
            folder.mkdir(parents=True, exist_ok=True)
            unit = units or ("m" if name in IN_METRES else saved.units)
            if name in MESHES:
                written += _export_meshes(read_moving(saved, chosen, unit=unit), folder, name, chosen)
            elif name == "glb":
                written += [_export_frame(saved, folder, frame) for frame in chosen]
            else:
                written.append(_export_animation(saved, folder, name, chosen, unit))
    except OSError as error:
        raise SolveError(f"cannot write to {base}: {error.strerror}") from None
    return written


def _check_words(formats, units):
    for name in formats:
        if name not in FORMATS:
            raise UsageError(f"unknown format {name!r}; known: {', '.join(FORMATS)}")
        if name in IN_METRES and units not in (None, "m"):
            raise UsageError(f"{name} is in metres by its standard; leave out --units {units}")
    if units is not None and units not in MM_PER_UNIT:
        raise UsageError(f"units must be m, cm or mm, got {units!r}")
    if "usd" in formats:
        from rbfmuscle.output.animation.usd import check_usd

        check_usd()


def _export_animation(saved: SavedRun, folder: Path, name: str, frames: list[int], unit: str) -> Path:
    run = read_moving(saved, frames, unit=unit)
    path = folder / f"{run.name}{SUFFIX_OF[name]}"
    if name == "html":
        from rbfmuscle.output.animation.page import write_animated_page

        write_animated_page(path, run, [saved.caption(frame) for frame in frames])
    elif name == "usd":
        from rbfmuscle.output.animation.usd import write_usd

        write_usd(path, run)
    else:
        from rbfmuscle.output.animation.gltf import animated_glb

        path.write_bytes(animated_glb(run))
    return path


def _export_frame(saved: SavedRun, folder: Path, frame: int) -> Path:
    from rbfmuscle.output.animation.gltf import animated_glb

    path = folder / f"frame_{frame:04d}.glb"
    path.write_bytes(animated_glb(read_moving(saved, [frame], unit="m")))
    return path


def _export_meshes(run: MovingRun, folder: Path, name: str, frames: list[int]) -> list[Path]:
    written = []
    for group, parts in (("surfaces", run.muscles), ("bones", run.bones)):
        collection = Collection(folder / f"{group}.pvd") if name == "pvd" else None
        for k, frame in enumerate(frames):
            files = [
                (part.name, f"{part.name}_{frame:04d}.{'vtp' if name == 'pvd' else name}") for part in parts
            ]
            for part, (_, file) in zip(parts, files):
                write_mesh(folder / file, *part.mesh(k))
                written.append(folder / file)
            if collection is not None:
                collection.add(run.times[k] if run.timed else frame, files)
        if collection is not None:
            collection.close()
            written.append(folder / f"{group}.pvd")
    return written


def write_mesh(path: Path, vertices: Floats, faces: Integers) -> None:
    """Write a triangle mesh as ``.vtp``, ``.ply``, ``.stl`` or ``.obj``, by suffix; PLY and STL in single precision."""
    if path.suffix == ".vtp":
        write_vtp(path, vertices, faces)
        return
    import trimesh

    mesh = trimesh.Trimesh(vertices, faces, process=False)
    if path.suffix == ".obj":
        path.write_text(
            trimesh.exchange.obj.export_obj(mesh, include_normals=False, digits=12), encoding="ascii"
        )
    else:
        path.write_bytes(mesh.export(file_type=path.suffix[1:]))
