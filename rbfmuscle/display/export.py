"""A run in other formats and units: files for each frame, or an animation in one file."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from rbfmuscle.display.animation import AnimatedMesh, Animation, read_animation
from rbfmuscle.display.gltf import animated_glb
from rbfmuscle.display.usd import check_usd, write_usd
from rbfmuscle.folders import OutputFolder
from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.geometry.solids import SolidDistance
from rbfmuscle.geometry.vectors import to_local, to_world
from rbfmuscle.run.data import RunData, open_run
from rbfmuscle.run.vtk_files import NORMALS, Collection, write_fibres, write_vtp
from rbfmuscle.run.writer import VertexArrays
from rbfmuscle.scene.names import DEVICES
from rbfmuscle.scene.objects import MM_PER_UNIT
from rbfmuscle.validation import MissingDependencyError, SolveError, UsageError

# One file a muscle (or bone) and frame.
MESHES = ("pvd", "vtp", "ply", "stl", "obj")
ANIMATIONS = ("animated-glb", "usd")
DIGITS = 12  # after the point, of lengths in OBJ files
FASTEST = 1000.0  # frames per second
FORMATS = (*MESHES, "glb", *ANIMATIONS)


def export_run(
    run: RunData | str | Path,
    formats: list[str] | str,
    *,
    output: str | Path | None = None,
    units: str | None = None,
    muscles: Sequence[str] | None = None,
    frames: slice | None = None,
    fps: float | None = None,
) -> list[Path]:
    """Write the muscles and bones of a run in one or more formats; every file written.

    Parameters
    ----------
    run : RunData or path
        The run, or its folder.
    formats : str or list of str
        Of `FORMATS`. ``pvd`` is ``vtp`` and a collection over the frames; ``glb`` gives one file a
        frame, ``usd`` and ``animated-glb`` one of all frames.
    output : path, optional
        ``DIR/export`` of a run in a folder where not given; each format has its own folder there,
        in which an earlier export is replaced. ``files.txt`` lists what was written.
    units : {"m", "cm", "mm"}, optional
        The scene's unit where not given; metres for ``glb`` and ``animated-glb``, which know no
        other.
    muscles : sequence of str, optional
        Muscles of the run, with their tendons and fibres; all where not given.
    frames : slice, optional
        Of the written frames; all where not given.
    fps : float, optional
        Frames of the motion per second in ``animated-glb`` and ``usd``; where not given, the times
        of the motion's file, or 24.

    Raises
    ------
    UsageError
        If the folder holds no run, or a format, unit or muscle is unknown, or a surface does not
        keep its vertices, or the folder of a format holds anything but an earlier export.
    SolveError
        If a file cannot be written.
    MissingDependencyError
        If a format needs a package that is absent; the other formats are written, and its
        ``written`` are their files.
    """
    run = open_run(run)
    formats = list(dict.fromkeys([formats] if isinstance(formats, str) else formats))
    _check_words(formats, units, fps)
    names = run.muscles if muscles is None else [run[name].name for name in muscles]
    if not names:
        raise UsageError("muscles names no muscle; leave it out for all")
    chosen = run.frame_numbers[frames] if frames is not None else run.frame_numbers
    if not chosen or not run.has_surfaces:
        raise UsageError(f"{run.directory or 'the run'} has no surfaces to export")
    if output is None and run.directory is None:
        raise UsageError("the run is in memory; name the folder to export to")
    missing = _missing_part(formats)
    if missing is not None:
        formats.remove("usd")
    if missing is not None and not formats:
        raise missing
    base = Path(output) if output is not None else Path(run.directory or "", "export")
    folder = OutputFolder(base, "export", formats, beside=True)
    written: list[Path] = []
    try:
        with folder.staged(replaces=formats) as stage:
            for name in formats:
                unit = units or ("m" if "glb" in name else run.units)
                (stage / name).mkdir()
                for part in [[frame] for frame in chosen] if name == "glb" else [chosen]:
                    moving = read_animation(run, names, part, unit=unit)
                    if fps is not None and name in ANIMATIONS:
                        moving = replace(moving, times=np.array(part) / fps)
                    written += _export(moving, stage / name, name, part)
    except OSError as error:
        raise SolveError(f"cannot write to {base}: {error.strerror}") from None
    files = [base / path.relative_to(stage) for path in written]
    if missing is not None:
        missing.written = files
        raise missing
    return files


def _missing_part(formats: Sequence[str]) -> MissingDependencyError | None:
    """What a package lacks that one of the formats needs."""
    try:
        if "usd" in formats:
            check_usd()
    except MissingDependencyError as error:
        return error
    return None


def _check_words(formats: Sequence[str], units: str | None, fps: float | None) -> None:
    if not formats:
        raise UsageError(f"no format is given; known: {', '.join(FORMATS)}")
    for name in formats:
        if name not in FORMATS:
            raise UsageError(f"unknown format {name!r}; known: {', '.join(FORMATS)}")
        if "glb" in name and units not in (None, "m"):
            raise UsageError(f"{name} is in metres by its standard; leave out units {units}")
    if units is not None and units not in MM_PER_UNIT:
        raise UsageError(f"units must be m, cm or mm, got {units!r}")
    if fps is not None and not set(formats) & set(ANIMATIONS):
        raise UsageError(f"fps is for {' and '.join(ANIMATIONS)} alone")
    if fps is not None and not 0.0 < fps <= FASTEST:
        raise UsageError(f"fps must be a number from 0 to 1000, got {fps:g}")


def _export(run: Animation, folder: Path, name: str, frames: list[int]) -> list[Path]:
    """Write a run in one format, and return the files."""
    if name in MESHES:
        return _export_meshes(run, folder, name, frames)
    if name == "usd":
        path = folder / f"{_file_name(run.name)}.usdc"
        write_usd(path, run)
    else:
        path = folder / (
            f"frame_{frames[0]:04d}.glb" if name == "glb" else f"{_file_name(run.name)}.glb"
        )
        path.write_bytes(animated_glb(run))
    return [path]


def _file_name(name: str) -> str:
    """The name of a run as that of a file, without what leads to other folders or names a
    device.
    """
    found = re.sub(r"[^\w .-]+", "_", name).strip(". ") or "run"
    return f"{found}_run" if found.partition(".")[0].rstrip().lower() in DEVICES else found


def _export_meshes(run: Animation, folder: Path, name: str, frames: list[int]) -> list[Path]:
    written, suffix = [], "vtp" if name == "pvd" else name
    measure = SurfaceArrays(run) if suffix == "vtp" else None
    taken = {part.name.lower() for part in run.muscles}
    for group, parts in (("surfaces", run.muscles), ("bones", run.bones)):
        # No name of a part holds a full stop.
        same = {p.name for p in parts if group == "bones" and p.name.lower() in taken}
        stems = {p.name: f"{p.name}.bone" if p.name in same else p.name for p in parts}
        collection = Collection(folder / f"{group}.pvd") if name == "pvd" else None
        files: dict[str, str] = {}
        for k, frame in enumerate(frames):
            # A bone that never moves is written once, under the first frame's number.
            moved = [p for p in parts if k == 0 or p.poses is None or p.moves]
            files |= {p.name: f"{stems[p.name]}_{frame:04d}.{suffix}" for p in moved}
            for part in moved:
                arrays = measure.of(part, k) if measure and group == "surfaces" else {}
                vertices, faces, normals = part.own(k)
                if part.given is not None:
                    arrays = {key: values[part.given.source] for key, values in arrays.items()}
                if part.poses is not None:
                    vertices = to_world(vertices, part.poses[k])
                    normals = normals @ part.poses[k][:3, :3].T
                write_mesh(folder / files[part.name], vertices, faces, normals, arrays)
            written += [folder / files[part.name] for part in moved]
            if collection is not None:
                collection.add(run.times[k] if run.timed else frame, list(files.items()))
        if collection is not None:
            written.append(folder / f"{group}.pvd")
    return written + (_export_fibres(run, folder, frames) if suffix == "vtp" else [])


def _export_fibres(run: Animation, folder: Path, frames: list[int]) -> list[Path]:
    """Write the fibres of a run as polylines, and return the files."""
    written = []
    for part in run.fibres:
        for frame, lines in zip(frames, part.lines):
            written.append(folder / f"{part.name}_{frame:04d}.vtp")
            write_fibres(written[-1], lines)
    return written


class SurfaceArrays:
    """Arrays at the vertices of muscles: those of `VertexArrays` against the first frame, and the
    distance to the nearest bone, negative inside.
    """

    def __init__(self, run: Animation) -> None:
        self._bones = [(SolidDistance(bone.vertices[0], bone.faces[0]), bone) for bone in run.bones]
        self._groups = sorted({part.group for part in run.muscles})
        self._first: dict[str, VertexArrays] = {}

    def of(self, part: AnimatedMesh, k: int) -> dict[str, Floats]:
        """Arrays (n,) of a muscle in frame ``k``; no stretch where triangles change."""
        mesh = part.mesh(k)
        if part.name not in self._first:
            self._first[part.name] = VertexArrays(part.mesh(0), self._groups.index(part.group))
        found = self._first[part.name].of(mesh)
        distances = [
            field.signed(mesh[0] if bone.poses is None else to_local(mesh[0], bone.poses[k]))
            for field, bone in self._bones
        ]
        if distances:
            found["bone_distance"] = np.min(distances, axis=0)
        return found


def write_mesh(
    path: Path,
    vertices: Floats,
    faces: Integers,
    normals: Floats,
    arrays: Mapping[str, Floats],
) -> None:
    """Write a triangle mesh as ``.vtp`` (with arrays at the vertices), ``.ply``, ``.stl`` or
    ``.obj``, by suffix; PLY and STL in single precision, STL without normals of vertices.
    """
    if path.suffix == ".vtp":
        write_vtp(path, vertices, faces, {**arrays, NORMALS: normals})
        return
    import trimesh

    made = trimesh.Trimesh(vertices, faces, vertex_normals=normals, process=False)
    options: dict[str, dict[str, object]] = {
        ".ply": {"vertex_normal": True},
        ".obj": {"include_normals": True, "digits": DIGITS, "header": None},
    }
    made.export(path, **options.get(path.suffix, {}))
