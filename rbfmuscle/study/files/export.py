"""A saved run in other formats and units: a file a frame, an animation in one file, lengths as tables."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.sim.scene.scene import MM_PER_UNIT
from rbfmuscle.study.animation.values import VertexValues
from rbfmuscle.study.files.meshfiles import write_mesh
from rbfmuscle.study.files.saved import SavedRun
from rbfmuscle.study.files.storage import export_lengths
from rbfmuscle.study.files.vtp import Collection, write_vtp
from rbfmuscle.study.show.appearance import BONE_COLOUR, muscle_colours
from rbfmuscle.validation import SolveError, UsageError

FORMATS = ("pvd", "vtp", "ply", "stl", "obj", "glb")
ANIMATIONS = ("usd", "animated-glb", "vtkhdf", "html")
IN_METRES = ("glb", "animated-glb", "html")
SUFFIX_OF = {"usd": ".usdc", "animated-glb": ".glb", "html": ".html"}
TABLES = ("sto",)
# Those that hold values of vertices.
WITH_VALUES = ("pvd", "vtp", "ply", "usd", "vtkhdf")


def export_run(
    directory: str | Path,
    formats: list[str] | str,
    *,
    output: str | Path | None = None,
    units: str | None = None,
    frames: slice | None = None,
    ascii: bool = False,
    up: str = "z",
    values: list[str] | None = None,
) -> list[Path]:
    """Write the muscles and bones of a saved run in one or more formats.

    Parameters
    ----------
    directory : path
        Folder of the run.
    formats : str or list of str
        Of `FORMATS`, `ANIMATIONS` and `TABLES`. ``glb`` gives one file a frame with all muscles and bones as
        named, coloured nodes; the others of `FORMATS` one file a muscle (or bone) and frame. ``pvd`` is ``vtp`` and
        a collection over the frames. ``usd``, ``animated-glb`` and ``html`` (a page that turns and scrubs) give one
        file of all frames, ``vtkhdf`` one a muscle and bone. ``sto`` gives lengths and moment arms for OpenSim and
        needs no surfaces.
    output : path, optional
        ``DIR/export`` where not given; each format has its own folder there.
    units : {"m", "cm", "mm"}, optional
        The scene's unit where not given; metres for ``glb``, ``animated-glb`` and ``html``, which know no other.
    frames : slice, optional
        Of the written frames; all where not given.
    ascii : bool
        VTP as plain numbers, as OpenSim reads them.
    up : {"z", "y"}
        The axis of the scene that points up, for ``usd``, ``animated-glb`` and ``html``.
    values : list of str, optional
        What to tell of every vertex of the muscles, of ``stretch``, ``activation`` and ``bone_distance``: in ``pvd``,
        ``vtp``, ``ply``, ``usd`` and ``vtkhdf``; and ``normals`` at every time, in ``usd`` alone.

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
    _check_words(formats, units, up)
    if values and not set(formats) & set(WITH_VALUES):
        raise UsageError(
            f"values of vertices go into {', '.join(WITH_VALUES)}, not into {', '.join(formats)}"
        )
    smooth = "normals" in (values or ())
    if smooth and "usd" not in formats:
        raise UsageError(f"normals of vertices go into usd, not into {', '.join(formats)}")
    values = [name for name in values or () if name != "normals"]
    chosen = saved.frames[frames] if frames is not None else saved.frames
    if not chosen or not (saved.has_surfaces() or set(formats) <= set(TABLES)):
        raise UsageError(f"{directory} has no surfaces to export")
    told = VertexValues(saved, values) if values else None
    base = Path(output) if output is not None else saved.directory / "export"
    written = []
    try:
        for name in formats:
            wanted = units or ("m" if name in IN_METRES else saved.units)
            factor = MM_PER_UNIT[saved.units] / MM_PER_UNIT[wanted]
            if name == "sto":
                written += export_lengths(saved, base / name, chosen, factor)
                continue
            if name in ANIMATIONS:
                written += _export_animation(saved, base / name, name, chosen, (wanted, up, told, smooth))
            elif name == "glb":
                written += _export_glb(saved, base / name, chosen, factor)
            else:
                written += _export_meshes(saved, base / name, name, chosen, (factor, ascii, told))
    except OSError as error:
        raise SolveError(f"cannot write to {base}: {error.strerror}") from None
    return written


def _check_words(formats, units, up):
    known = FORMATS + ANIMATIONS + TABLES
    for name in formats:
        if name not in known:
            raise UsageError(f"unknown format {name!r}; known: {', '.join(known)}")
    if units is not None and units not in MM_PER_UNIT:
        raise UsageError(f"units must be m, cm or mm, got {units!r}")
    if up not in ("z", "y"):
        raise UsageError(f"up must be z or y, got {up!r}")
    if "usd" in formats:
        from rbfmuscle.study.animation.usd import check_usd

        check_usd()


def posed(saved: SavedRun, bone: tuple[str, Floats], frame: int) -> Floats:
    """Vertices of a bone in a frame, from its (vertices, faces) at rest and the poses."""
    pose = saved.poses[frame][bone[0]]
    return bone[1] @ pose[:3, :3].T + pose[:3, 3]


def _export_animation(saved, folder, name, frames, how):
    from rbfmuscle.study.animation.moving import read_moving

    unit, up, told, smooth = how
    gltf = name in ("animated-glb", "html")
    if gltf and unit != "m":
        raise UsageError(f"{name} is in metres by its standard; leave out --units {unit}")
    run = read_moving(saved, frames, unit=unit, up=up, values=None if gltf else told)
    folder.mkdir(parents=True, exist_ok=True)
    if name == "vtkhdf":
        from rbfmuscle.study.animation.vtkhdf import write_vtkhdf

        return write_vtkhdf(folder, run)
    path = folder / f"{run.name}{SUFFIX_OF[name]}"
    if name == "html":
        from rbfmuscle.study.animation.page import write_animated_page
        from rbfmuscle.study.show.labels import coordinate_texts

        told_of = {
            entry["frame"]: ", ".join(coordinate_texts(saved.info, entry)) for entry in saved.info["frames"]
        }
        write_animated_page(path, run, [f"frame {frame}: {told_of[frame]}" for frame in frames])
        return [path]
    if name == "usd":
        from rbfmuscle.study.animation.usd import write_usd

        write_usd(path, run, normals=smooth)
    else:
        from rbfmuscle.study.animation.gltf import write_animated_glb

        write_animated_glb(path, run)
    return [path]


def _export_meshes(saved, folder, name, frames, how):
    factor, ascii, told = how
    folder.mkdir(parents=True, exist_ok=True)
    suffix = ".vtp" if name == "pvd" else f".{name}"
    rest = {bone: saved.bone(bone) for bone in saved.bones}
    groups = {"surfaces": [], "bones": []}
    for frame in frames:
        muscles = [(muscle, *saved.surface(muscle, frame)) for muscle in saved.muscles]
        bones = [(bone, posed(saved, (bone, rest[bone][0]), frame), rest[bone][1]) for bone in saved.bones]
        for group, items in (("surfaces", muscles), ("bones", bones)):
            entries = []
            for item, vertices, faces in items:
                file, values = f"{item}_{frame:04d}{suffix}", None
                if told is not None and group == "surfaces" and name in WITH_VALUES:
                    values = told.of(item, frame, vertices, factor=factor)
                if suffix == ".vtp":
                    write_vtp(folder / file, vertices * factor, faces, ascii=ascii, values=values)
                else:
                    write_mesh(folder / file, vertices * factor, faces, values=values)
                entries.append((item, file))
            groups[group].append((frame, entries))
        if suffix == ".vtp" and saved.has_fibres():
            groups.setdefault("fibres", []).append(
                (frame, _export_fibres(saved, folder, frame, factor, ascii))
            )
    written = [folder / file for steps in groups.values() for _, entries in steps for _, file in entries]
    if name == "pvd":
        written += [
            _write_collection(folder / f"{group}.pvd", steps, saved.times or {})
            for group, steps in groups.items()
        ]
    return written


def _export_fibres(saved, folder, frame, factor, ascii):
    from rbfmuscle.study.files.vtp import write_vtp_lines

    entries = []
    for muscle in saved.muscles:
        points, cells = saved.fibres(muscle, frame)
        cells["length"] = cells["length"] * factor
        file = f"{muscle}_fibres_{frame:04d}.vtp"
        write_vtp_lines(folder / file, points * factor, cells=cells, ascii=ascii)
        entries.append((muscle, file))
    return entries


def _write_collection(path, steps, times):
    collection = Collection(path)
    for frame, entries in steps:
        collection.add(times.get(frame, frame), entries)
    collection.close()
    return path


def _export_glb(saved, folder, frames, factor):
    import trimesh

    folder.mkdir(parents=True, exist_ok=True)
    rest = {bone: saved.bone(bone) for bone in saved.bones}
    colours = muscle_colours(saved.muscles)
    written = []
    for frame in frames:
        scene = trimesh.Scene()
        items = [(m, *saved.surface(m, frame), colours[m]) for m in saved.muscles]
        items += [(b, posed(saved, (b, rest[b][0]), frame), rest[b][1], BONE_COLOUR) for b in saved.bones]
        for item, vertices, faces, colour in items:
            mesh = trimesh.Trimesh(vertices * factor, faces, process=False)
            rgba = [*(int(colour[k : k + 2], 16) for k in (1, 3, 5)), 255]
            material = trimesh.visual.material.PBRMaterial(
                name=item, baseColorFactor=np.array(rgba, np.uint8), metallicFactor=0.0, roughnessFactor=0.6
            )
            mesh.visual = trimesh.visual.TextureVisuals(material=material)
            scene.add_geometry(mesh, geom_name=item, node_name=item)
        path = folder / f"frame_{frame:04d}.glb"
        path.write_bytes(scene.export(file_type="glb"))
        written.append(path)
    return written
