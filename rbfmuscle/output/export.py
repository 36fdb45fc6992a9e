"""A saved run in other formats and units: files for each frame, or an animation in one file."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.output.animation.gltf import animated_glb
from rbfmuscle.output.animation.moving import MovingRun, read_moving
from rbfmuscle.output.animation.page import write_animated_page
from rbfmuscle.output.animation.usd import check_usd, write_usd
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
            if name == "glb":
                for frame in chosen:
                    written.append(folder / f"frame_{frame:04d}.glb")
                    written[-1].write_bytes(animated_glb(read_moving(saved, [frame], unit=unit)))
                continue
            run = read_moving(saved, chosen, unit=unit)
            if name in MESHES:
                written += _export_meshes(run, folder, name, chosen)
                continue
            written.append(folder / f"{run.name}{SUFFIX_OF[name]}")
            if name == "html":
                write_animated_page(written[-1], run)
            elif name == "usd":
                write_usd(written[-1], run)
            else:
                written[-1].write_bytes(animated_glb(run))
    except OSError as error:
        raise SolveError(f"cannot write to {base}: {error.strerror}") from None
    return written


def _check_words(formats: Sequence[str], units: str | None) -> None:
    for name in formats:
        if name not in FORMATS:
            raise UsageError(f"unknown format {name!r}; known: {', '.join(FORMATS)}")
        if name in IN_METRES and units not in (None, "m"):
            raise UsageError(f"{name} is in metres by its standard; leave out --units {units}")
    if units is not None and units not in MM_PER_UNIT:
        raise UsageError(f"units must be m, cm or mm, got {units!r}")
    if "usd" in formats:
        check_usd()


def _export_meshes(run: MovingRun, folder: Path, name: str, frames: list[int]) -> list[Path]:
    written, suffix = [], "vtp" if name == "pvd" else name
    for group, parts in (("surfaces", run.muscles), ("bones", run.bones)):
        collection = Collection(folder / f"{group}.pvd") if name == "pvd" else None
        for k, frame in enumerate(frames):
            files = {part.name: f"{part.name}_{frame:04d}.{suffix}" for part in parts}
            for part in parts:
                write_mesh(folder / files[part.name], *part.mesh(k))
            written += [folder / file for file in files.values()]
            if collection is not None:
                collection.add(run.times[k] if run.timed else frame, list(files.items()))
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
