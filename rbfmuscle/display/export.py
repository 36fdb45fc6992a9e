"""A run in other formats and units: files for each frame, or an animation in one file, glTF or
USD.
"""

import json
import re
import struct
from collections.abc import Mapping, Sequence
from dataclasses import replace
from importlib.util import find_spec
from itertools import count
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import trimesh

from rbfmuscle.display.animation import (
    FRAMES_A_SECOND,
    AnimatedMesh,
    Animation,
    read_animation,
)
from rbfmuscle.folders import OutputFolder
from rbfmuscle.geometry.arrays import Floats, Integers, to_local, to_world
from rbfmuscle.geometry.solids import SolidDistance
from rbfmuscle.run.appearance import linear_rgb, rgb, stretch_colours
from rbfmuscle.run.data import RunData, open_run
from rbfmuscle.run.vtk_files import NORMALS, Collection, write_fibres, write_vtp
from rbfmuscle.run.writer import VertexArrays
from rbfmuscle.scene.objects import DEVICES, MM_PER_UNIT
from rbfmuscle.simulation.frame import FibreLines
from rbfmuscle.validation import MissingDependencyError, SolveError, UsageError

if TYPE_CHECKING:
    from pxr import Usd, UsdGeom


def write_usd(path: Path, run: Animation) -> None:
    """Write a run as one ``.usdc`` file; usd-core must be there.

    Time codes count 24 a second. A surface that keeps its vertices has its topology once and its
    points at every time; another one has both at every time. Lengths stay in the run's unit, named
    by ``metersPerUnit``; the root brings superior to z. The default value of whatever is sampled is
    that of the first frame.
    """
    from pxr import Gf, Usd, UsdGeom

    codes = (run.times * FRAMES_A_SECOND).tolist()
    stage = Usd.Stage.CreateInMemory()
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.z)
    UsdGeom.SetStageMetersPerUnit(stage, MM_PER_UNIT[run.unit] / 1000.0)
    stage.SetTimeCodesPerSecond(FRAMES_A_SECOND)
    stage.SetFramesPerSecond(FRAMES_A_SECOND)
    stage.SetStartTimeCode(codes[0])
    stage.SetEndTimeCode(codes[-1])
    place = f"/{identifier(run.name, set())}"
    root = UsdGeom.Xform.Define(stage, place)
    stage.SetDefaultPrim(root.GetPrim())
    upright = np.eye(4)
    upright[:3, :3] = run.body
    root.AddTransformOp().Set(Gf.Matrix4d(upright.T))
    used: set[str] = set()
    for part in (*run.bones, *run.muscles):
        mesh = UsdGeom.Mesh.Define(stage, f"{place}/{identifier(part.name, used)}")
        mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
        mesh.CreateOrientationAttr(UsdGeom.Tokens.rightHanded)
        _fill(mesh, part, codes)
        mesh.CreateDisplayColorAttr([Gf.Vec3f(*linear_rgb(rgb(part.colour)).tolist())])
        mesh.GetPrim().SetDisplayName(part.name)
    for name, fibres in run.fibres.items():
        curves = UsdGeom.BasisCurves.Define(stage, f"{place}/{identifier(name, used)}")
        _fill_curves(curves, fibres, codes)
        curves.GetPrim().SetDisplayName(name)
    stage.GetRootLayer().Export(str(path))


def _fill_curves(
    curves: "UsdGeom.BasisCurves", fibres: list[FibreLines], codes: list[float]
) -> None:
    """Fibres get their points and their colours, by their stretch, at each time."""
    from pxr import UsdGeom, Vt

    count, points = fibres[0].points.shape[:2]
    curves.CreateTypeAttr(UsdGeom.Tokens.linear)
    curves.CreateCurveVertexCountsAttr(Vt.IntArray(count, points))
    colours = curves.CreateDisplayColorPrimvar(UsdGeom.Tokens.vertex)
    for code, lines in zip(codes, fibres):
        places = np.ascontiguousarray(lines.points.reshape(-1, 3), dtype=np.float32)
        extent = np.stack([places.min(axis=0), places.max(axis=0)])
        shades = linear_rgb(stretch_colours(lines.local_stretch)).reshape(-1, 3)
        curves.CreatePointsAttr().Set(Vt.Vec3fArray.FromNumpy(places), code)
        curves.CreateExtentAttr().Set(Vt.Vec3fArray.FromNumpy(extent), code)
        colours.Set(Vt.Vec3fArray.FromNumpy(shades.astype(np.float32)), code)


def _fill(mesh: "UsdGeom.Mesh", part: AnimatedMesh, codes: list[float]) -> None:
    """A muscle gets its points at each time, and its faces where they change; a bone its points
    once and its poses.
    """
    from pxr import Gf, UsdGeom, Vt

    def vectors(arrays: list[np.ndarray]) -> list[Vt.Vec3fArray]:
        return [Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(a, dtype="f4")) for a in arrays]

    owned = [part.own(k) for k in range(len(part.vertices))]
    points = [np.asarray(vertices, dtype=np.float32) for vertices, _, _ in owned]
    corners = [np.ascontiguousarray(faces, dtype=np.int32).ravel() for _, faces, _ in owned]
    at = codes if part.poses is None else []
    changing_at = [] if part.keeps_vertices else at
    counts = [Vt.IntArray(len(faces), 3) for _, faces, _ in owned]
    _sample(mesh.CreateFaceVertexCountsAttr(), counts, changing_at)
    indices = [Vt.IntArray.FromNumpy(numbers) for numbers in corners]
    _sample(mesh.CreateFaceVertexIndicesAttr(), indices, changing_at)
    _sample(mesh.CreatePointsAttr(), vectors(points), at)
    extents = [np.stack([places.min(axis=0), places.max(axis=0)]) for places in points]
    _sample(mesh.CreateExtentAttr(), vectors(extents), at)
    # Without normals a surface that is no subdivision surface is drawn facet by facet.
    _sample(mesh.CreateNormalsAttr(), vectors([normals for _, _, normals in owned]), at)
    mesh.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    if part.poses is not None:
        poses = [Gf.Matrix4d(pose.T) for pose in part.poses]
        _sample(mesh.AddTransformOp(), poses, codes if part.moves else [])


def _sample(
    attribute: "Usd.Attribute | UsdGeom.XformOp", values: Sequence[object], codes: list[float]
) -> None:
    """Give an attribute its values at time codes, and the first one as its default."""
    attribute.Set(values[0])
    for code, value in zip(codes, values):
        attribute.Set(value, code)


def identifier(name: str, used: set[str]) -> str:
    """A name as USD allows it, unlike those used before."""
    from pxr import Tf

    base = Tf.MakeValidIdentifier(name)
    found = next(text for k in count(1) if (text := base if k == 1 else f"{base}_{k}") not in used)
    used.add(found)
    return found


_FLOAT, _INT = 5126, 5125  # types of numbers
_VERTICES, _INDICES = 34962, 34963  # what a view is bound as
_LINES = 1  # mode of a primitive


def animated_glb(run: Animation) -> bytes:
    """The content of an animated ``.glb``; UsageError if a muscle's surface has other vertices in
    other frames.
    """
    changing = [muscle.name for muscle in run.muscles if not muscle.keeps_vertices]
    if changing:
        raise UsageError(
            f"animated-glb needs surfaces that keep their vertices, those of {changing[0]!r} "
            "do not; "
            "run with surface = 'material', or export to usd, pvd or glb"
        )
    file = _File([_key_name(caption) for caption in run.captions])
    if len(run.times) > 1:
        file.times = file.add(run.times[:, None] - run.times[0], "SCALAR", bounds=True)
    children = [_add_part(file, part) for part in (*run.bones, *run.muscles)]
    children += [_add_fibres(file, *fibres) for fibres in run.fibres.items()]
    root: dict[str, object] = {"name": run.name, "children": children}
    left, posterior, superior = run.body  # glTF looks at what faces +z, with y up
    root["rotation"] = _quaternions(np.stack([left, superior, -posterior])[None])[0].tolist()
    return file.content({"name": run.name, "nodes": [file.append("nodes", root)]})


def _key_name(caption: str) -> str:
    """The caption of a frame as the name of a shape key, of which Blender keeps 63 bytes."""
    return caption.encode()[:63].decode(errors="ignore")


def _add_part(file: "_File", part: AnimatedMesh) -> int:
    """Number of a new node: a muscle has a morph target for each frame but the first, a bone a pose
    for each.
    """
    owned = [part.own(k) for k in range(len(part.vertices))]
    frames = [{"POSITION": vertices, "NORMAL": normals} for vertices, _, normals in owned]
    colour = [*linear_rgb(rgb(part.colour)).tolist(), 1.0]
    look = {"baseColorFactor": colour, "metallicFactor": 0.0, "roughnessFactor": 0.6}
    material = file.append("materials", {"name": part.name, "pbrMetallicRoughness": look})
    node = file.add_node(part.name, frames, owned[0][1], material=material)
    if part.poses is not None:
        turns, shifts = _quaternions(part.poses[:, :3, :3]), part.poses[:, :3, 3]
        place = {"rotation": turns[0].tolist(), "translation": shifts[0].tolist()}
        file.lists["nodes"][node] |= place
        if part.moves:
            file.animate(node, "rotation", file.add(turns, "VEC4"))
            file.animate(node, "translation", file.add(shifts, "VEC3"))
    return node


def _add_fibres(file: "_File", name: str, fibres: list[FibreLines]) -> int:
    """Number of a new node of lines, coloured by the stretch of the first frame."""
    frames = [{"POSITION": lines.points.reshape(-1, 3)} for lines in fibres]
    frames[0]["COLOR_0"] = linear_rgb(stretch_colours(fibres[0].local_stretch)).reshape(-1, 3)
    numbers = np.arange(len(frames[0]["POSITION"])).reshape(fibres[0].points.shape[:2])
    segments = np.stack([numbers[:, :-1].ravel(), numbers[:, 1:].ravel()], axis=1)
    return file.add_node(name, frames, segments, mode=_LINES)


def _quaternions(rotations):
    """Quaternions (T, 4), scalar last, none more than half a turn from the one before."""
    from scipy.spatial.transform import Rotation

    found = Rotation.from_matrix(rotations).as_quat()
    for k in range(1, len(found)):
        if found[k] @ found[k - 1] < 0.0:
            found[k] = -found[k]
    return found


class _File:
    """The content of a glTF file: the binary part and the lists that describe it; ``names`` are
    those of the frames.
    """

    def __init__(self, names: Sequence[str]) -> None:
        self.names = names
        self.parts: list[bytes] = []
        self.size, self.times = 0, 0
        keys = "bufferViews", "accessors", "meshes", "materials", "nodes"
        self.lists: dict[str, list[dict[str, object]]] = {key: [] for key in keys}
        self.samplers: list[object] = []
        self.channels: list[object] = []

    def append(self, key: str, entry: dict[str, object]) -> int:
        """Number of a new entry of a list."""
        self.lists[key].append(entry)
        return len(self.lists[key]) - 1

    def add(
        self,
        values: Floats | Integers,
        shape: str,
        *,
        target: int | None = None,
        bounds: bool = False,
    ) -> int:
        """Number of a new accessor of these rows: whole numbers as indices, others in single
        precision.
        """
        whole = np.issubdtype(values.dtype, np.integer)
        rows = np.ascontiguousarray(values, dtype="<u4" if whole else "<f4")
        view: dict[str, object] = {"buffer": 0, "byteOffset": self.size, "byteLength": rows.nbytes}
        view |= {} if target is None else {"target": target}
        self.parts.append(rows.tobytes())
        self.size += rows.nbytes
        entry = {"bufferView": self.append("bufferViews", view), "count": len(rows), "type": shape}
        entry["componentType"] = _INT if whole else _FLOAT
        if bounds:
            entry |= {"min": rows.min(axis=0).tolist(), "max": rows.max(axis=0).tolist()}
        return self.append("accessors", entry)

    def add_node(
        self, name: str, frames: Sequence[Mapping[str, Floats]], corners: Integers, **look: int
    ) -> int:
        """Number of a new node with one primitive that has these corners, and the vertices' numbers
        (n, 3) in the first frame; morph targets take it to those in the other frames.
        """
        base = frames[0]
        primitive: dict[str, object] = {
            "attributes": {key: self._add_vertices(key, values) for key, values in base.items()},
            "indices": self.add(corners.reshape(-1, 1), "SCALAR", target=_INDICES),
            **look,
        }
        targets = [
            {key: self._add_vertices(key, values - base[key]) for key, values in frame.items()}
            for frame in frames[1:]
        ]
        entry: dict[str, object] = {"name": name, "primitives": [primitive]}
        if targets:
            primitive["targets"] = targets
            entry["weights"] = [0.0] * len(targets)
            entry["extras"] = {"targetNames": list(self.names[1:])}
        node = self.append("nodes", {"name": name, "mesh": self.append("meshes", entry)})
        if targets:
            weights = np.eye(len(targets) + 1)[:, 1:]
            self.animate(node, "weights", self.add(weights.reshape(-1, 1), "SCALAR"))
        return node

    def _add_vertices(self, key: str, values: Floats) -> int:
        return self.add(values, "VEC3", target=_VERTICES, bounds=key == "POSITION")

    def animate(self, node: int, path: str, values: int) -> None:
        """Let an accessor move a node's ``path`` over the times."""
        self.samplers.append({"input": self.times, "output": values, "interpolation": "LINEAR"})
        self.channels.append(
            {"sampler": len(self.samplers) - 1, "target": {"node": node, "path": path}}
        )

    def content(self, scene: dict[str, object]) -> bytes:
        """The whole file."""
        tree: dict[str, object] = {
            "asset": {"version": "2.0", "generator": "rbfmuscle"},
            "scene": 0,
            "scenes": [scene],
            **self.lists,
            "buffers": [{"byteLength": self.size}],
        }
        if self.channels:
            tree["animations"] = [
                {"name": "motion", "samplers": self.samplers, "channels": self.channels}
            ]
        text = json.dumps(tree, separators=(",", ":")).encode()
        text += b" " * (-len(text) % 4)
        head = struct.pack("<4sIII4s", b"glTF", 2, 28 + len(text) + self.size, len(text), b"JSON")
        return b"".join([head, text, struct.pack("<I4s", self.size, b"BIN\0"), *self.parts])


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
    missing = None
    if "usd" in formats and find_spec("pxr") is None:
        missing = MissingDependencyError(
            "export to usd needs usd-core: pip install -e '.[usd]' in rbfmuscle's folder"
        )
        formats.remove("usd")
        if not formats:
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
    measure = VertexArrays({part.name: part.group for part in run.muscles})
    near = run.bones if suffix == "vtp" else []
    solids = [(SolidDistance(bone.vertices[0], bone.faces[0]), bone) for bone in near]
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
                arrays: dict[str, Floats] = {}
                if suffix == "vtp" and group == "surfaces":
                    # From the nearest bone, negative inside.
                    points = part.mesh(k)[0]
                    away = [
                        solid.signed(points if b.poses is None else to_local(points, b.poses[k]))
                        for solid, b in solids
                    ]
                    nearest = np.min(away, axis=0) if away else None
                    arrays = measure.of(part.name, part.mesh(k), nearest)
                vertices, faces, normals = part.own(k)
                if part.given is not None:
                    arrays = {key: values[part.given.source] for key, values in arrays.items()}
                if part.poses is not None:
                    vertices = to_world(vertices, part.poses[k])
                    normals = normals @ part.poses[k][:3, :3].T
                path = folder / files[part.name]
                write_mesh(path, vertices, faces, normals, arrays, name=part.name)
            written += [folder / files[part.name] for part in moved]
            if collection is not None:
                collection.add(run.times[k] if run.timed else frame, list(files.items()))
        if collection is not None:
            written.append(folder / f"{group}.pvd")
    for stem, fibres in run.fibres.items() if suffix == "vtp" else ():
        for frame, lines in zip(frames, fibres):
            written.append(folder / f"{stem}_{frame:04d}.vtp")
            write_fibres(written[-1], lines)
    return written


def write_mesh(
    path: Path,
    vertices: Floats,
    faces: Integers,
    normals: Floats,
    arrays: Mapping[str, Floats],
    *,
    name: str,
) -> None:
    """Write a triangle mesh as ``.vtp`` (with its ``name``, and arrays at the vertices), ``.ply``,
    ``.stl`` or ``.obj``, by suffix; PLY and STL in single precision, STL without normals of
    vertices.
    """
    if path.suffix == ".vtp":
        write_vtp(path, vertices, faces, {**arrays, NORMALS: normals}, name=name)
        return
    made = trimesh.Trimesh(vertices, faces, vertex_normals=normals, process=False)
    options: dict[str, dict[str, object]] = {
        ".ply": {"vertex_normal": True},
        ".obj": {"include_normals": True, "digits": DIGITS, "header": None},
    }
    made.export(path, **options.get(path.suffix, {}))
