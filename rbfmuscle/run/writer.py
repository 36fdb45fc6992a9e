"""Writes a run to a folder while it goes on: whatever ends it, the frames so far can be read;
``run.json``.
"""

import csv
import hashlib
import importlib.metadata
import os
import platform
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path

import numpy as np

import rbfmuscle
from rbfmuscle.cache import content_key, load_arrays, store_arrays
from rbfmuscle.folders import OutputFolder, write_whole
from rbfmuscle.geometry.arrays import Floats, Integers, to_world
from rbfmuscle.geometry.surfaces import EdgeLengths, simplified
from rbfmuscle.geometry.threads import each, thread_count
from rbfmuscle.metrics.quantities import ALL, Row
from rbfmuscle.metrics.summary import QuantityFacts
from rbfmuscle.run.appearance import muscle_groups, tendon_mesh
from rbfmuscle.run.data import given_file
from rbfmuscle.run.info import FORMAT, RunInfo, record_scene
from rbfmuscle.run.vtk_files import Collection, frame_end, frame_file, write_fibres, write_vtp
from rbfmuscle.scene.motion import shown_value
from rbfmuscle.scene.objects import from_mm
from rbfmuscle.scene.scene import Scene
from rbfmuscle.scene.tendons import tendon_name
from rbfmuscle.simulation.frame import Frame, Mesh
from rbfmuscle.validation import SolveError, UsageError

FARTHEST = 20.0  # distance to the bones that is told from others [mm]


class VertexArrays:
    """Arrays at the vertices of muscles, frame by frame: the number of a muscle's ``group``;
    ``stretch``, the mean change of the edges about each vertex against the first frame, where the
    triangles are the same; ``bone_distance`` to the nearest bone, negative inside.

    ``groups`` are those of the muscles by name.
    """

    def __init__(self, groups: Mapping[str, str]) -> None:
        numbers = sorted(set(groups.values()))
        self._groups = {name: float(numbers.index(group)) for name, group in groups.items()}
        self._first: dict[str, tuple[Integers, EdgeLengths]] = {}

    def of(self, muscle: str, mesh: Mesh, distance: Floats | None) -> dict[str, Floats]:
        """Arrays (n,) of a muscle; no distance where no bone is in reach."""
        vertices, faces = mesh
        if muscle not in self._first:
            self._first[muscle] = faces, EdgeLengths(*mesh)
        first, lengths = self._first[muscle]
        found = {"group": np.full(len(vertices), self._groups[muscle])}
        if faces is first or np.array_equal(faces, first):
            found["stretch"] = lengths.stretch(vertices)
        if distance is not None:
            found["bone_distance"] = distance
        return found


TABLES = {
    "poses.csv": ("frame", "bone", *(f"m{i}{j}" for i in range(4) for j in range(4))),
    "events.csv": ("frame", "muscle", "bone", "count", "action"),
    "metrics.csv": tuple("angle" if x == "coordinate_value" else x for x in Row._fields),
    "fibres.csv": ("frame", "muscle", "fibre", "length", "stretch"),
}

LIGHT = 1600  # triangles of a bone that moves
PAGES = ("report.html", "preview.webp")
MESHES = ("surfaces", "bones")
# Every file of a run, and every folder of its files.
_COLLECTIONS = tuple(f"{name}.pvd" for name in MESHES)
_PLACES = ("run.json", *TABLES, *PAGES, *MESHES, *_COLLECTIONS, "fibres")
_PACKAGES = ("numpy", "scipy", "numba", "scikit-image", "trimesh", "pyvista", "vtk", "libigl")


def run_folder(directory: str | Path) -> OutputFolder:
    """The folder of a run; UsageError if something in it is in the way, or it cannot be written
    to.
    """
    return OutputFolder(directory, "run", _PLACES)


class RunWriter:
    """Streams frames to a folder and keeps none of them; the scene's ``output`` table says which
    parts are written.

    The folder is that of `run_folder`; a run that lies there already is replaced.
    """

    def __init__(self, directory: str | Path, scene: Scene) -> None:
        self.directory = Path(directory)
        self.folder = run_folder(directory)
        self.scene = scene
        self.meshes = bool(scene.output.surfaces)
        self.count, self._failed = 0, False
        held = {m.name: [end.bone for end in m.attachments] for m in scene.muscles}
        self._arrays = VertexArrays(muscle_groups(scene.joints, held))
        self._farthest = from_mm(FARTHEST, scene.units)
        # Pose and file that show a bone now, and its mesh for a series.
        self._bones: dict[str, tuple[Floats, str]] = {}
        self._light: dict[str, tuple[Floats, Integers]] = {}
        names = MESHES if self.meshes else ()
        pages = PAGES if scene.output.report else ()
        tables = [name for name in TABLES if scene.output.fibres or name != "fibres.csv"]
        # The vertex order of muscles' own files, where it is another one than that of the mesh.
        orders = {m.name: m.given for m in scene.muscles if self.meshes and m.given is not None}
        try:
            self.folder.clear()
            self.folder.add("run.json", *tables, *pages, *(f"{name}.pvd" for name in names))
            for name in tables:
                write_csv(self.directory / name, [TABLES[name]])
            self._collections = {name: Collection(self.directory / f"{name}.pvd") for name in names}
            for name, order in orders.items():
                self.folder.add(given_file(name))
                np.savez_compressed(self.directory / given_file(name), **order._asdict())
        except OSError as error:
            raise UsageError(
                f"cannot write to {self.directory}: {error.strerror}; choose another folder"
            ) from None

    def write(self, frame: Frame, rows: Sequence[Sequence[object]] = ()) -> None:
        """Write one frame, and the rows of metrics that are complete; SolveError if the disk
        refuses.
        """
        try:
            self._write(frame, rows)
        except OSError as error:
            self._failed = True
            for name in self.folder.listed:
                if name.endswith(frame_end(frame.index)):
                    (self.directory / name).unlink(missing_ok=True)
            raise SolveError(
                f"cannot write frame {frame.index}: {error.strerror}; "
                f"{self.count} frames are kept in {self.directory}"
            ) from None
        self.count += 1

    def close(self, rows: Sequence[Sequence[object]] = ()) -> None:
        """Write the last rows of metrics; after a frame that could not be written, nothing."""
        try:
            write_csv(self.directory / "metrics.csv", () if self._failed else rows, mode="a")
        except OSError as error:
            raise SolveError(
                f"cannot finish the tables in {self.directory}: {error.strerror}"
            ) from None

    def write_info(self, info: RunInfo) -> None:
        """Write ``run.json`` in one piece; while the run goes on with the coordinates of all frames
        to come.
        """
        if info.status == "running":
            frames = self.scene.motion.frames
            planned = [
                {name: shown_value(self.scene, name, x) for name, x in k.items()} for k in frames
            ]
            info = info.model_copy(update={"planned": planned})
        write_json(self.directory / "run.json", info.to_dict())

    def _write(self, frame, rows):
        if self.meshes:
            time = self.scene.motion.time(frame.index)
            step = frame.index if time is None else time
            surfaces = self._write_surfaces(frame)
            self._collections["bones"].add(step, self._write_bones(frame))
            self._collections["surfaces"].add(step, surfaces)
        fibres = []
        for name, lines in frame.fibres.items():
            file = frame_file("fibres", name, frame.index)
            self.folder.add(file)
            write_fibres(self.directory / file, lines)
            values = zip(lines.lengths.tolist(), lines.stretch.tolist())
            fibres += [(frame.index, name, number, *row) for number, row in enumerate(values)]
        # A frame's surfaces are on the disk before its poses: readers of a run that was killed rely
        # on it.
        poses = [
            (frame.index, bone.name, *frame.poses[bone.name].ravel().tolist())
            for bone in self.scene.bones
        ]
        events = [(e.frame, e.muscle, e.bone, e.count, e.action) for e in frame.events]
        tables = {"poses": poses, "events": events, "metrics": rows, "fibres": fibres}
        for name, table in tables.items():
            if table:
                write_csv(self.directory / f"{name}.csv", table, mode="a")

    def _write_surfaces(self, frame):
        """Surfaces of a frame, side by side: most of the time goes into packing them."""
        meshes = {
            name: (surface.vertices, surface.faces) for name, surface in frame.surfaces.items()
        }
        for muscle in self.scene.muscles:
            tendon = tendon_mesh(muscle, frame.tendons)
            if tendon is not None:
                meshes[tendon_name(muscle.name)] = tendon
        entries = [(name, frame_file("surfaces", name, frame.index)) for name in meshes]
        self.folder.add(*(file for _, file in entries))

        def write(entry):
            name, file = entry
            arrays = {}
            if name in frame.surfaces:
                bones = frame.bones.get(name)
                distance = None
                # Distances to bones that the muscle can reach, and what its model adds, as
                # ``level_offset``.
                if bones is not None and bones.names:
                    distance, _ = bones.nearest(meshes[name][0], frame.poses, self._farthest)
                    distance = np.minimum(distance, self._farthest)
                arrays = self._arrays.of(name, meshes[name], distance)
                arrays |= dict(frame.surfaces[name].arrays)
            write_vtp(self.directory / file, *meshes[name], arrays, name=name)

        each(write, entries)
        return entries

    def _write_bones(self, frame):
        """Bones where they are now: the mesh at rest once, and few triangles of one that has moved,
        in a series.
        """
        for bone in self.scene.bones:
            name = bone.name
            mesh = bone.mesh
            pose = frame.poses[name]
            if name not in self._bones:
                file = f"bones/{name}.vtp"
                self._write_bone(name, np.eye(4), file, mesh.vertices, mesh.faces)
            if not np.array_equal(self._bones[name][0], pose):
                if name not in self._light:
                    self._light[name] = _light_mesh(mesh.vertices, mesh.faces)
                vertices, faces = self._light[name]
                moved = to_world(vertices, pose).astype(np.float32)
                file = frame_file("bones", name, frame.index)
                self._write_bone(name, pose.copy(), file, moved, faces)
        return [(bone.name, self._bones[bone.name][1]) for bone in self.scene.bones]

    def _write_bone(self, name, pose, file, vertices, faces):
        self._bones[name] = pose, file
        self.folder.add(file)
        write_vtp(self.directory / file, vertices, faces, name=name)


def _light_mesh(vertices: Floats, faces: Integers) -> tuple[Floats, Integers]:
    """A bone of `LIGHT` triangles, from the cache where it is there."""
    key = content_key(vertices, faces, ("light mesh", LIGHT))
    found = load_arrays(key)
    if found is None:
        light = simplified(vertices, faces, LIGHT)
        found = {"vertices": light[0], "faces": light[1]}
        store_arrays(key, found)
    return np.asarray(found["vertices"], float), np.asarray(found["faces"], np.int64)


def write_csv(path: Path, rows: Iterable[Sequence[object]], *, mode: str = "w") -> None:
    """Write rows to a CSV file, or add them in mode "a"."""
    with path.open(mode, encoding="utf-8", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows(rows)


def write_json(path: Path, data: Mapping[str, object]) -> None:
    """Write JSON in one move, so that whoever reads it finds the old or the new; NaN and infinity
    become null.
    """
    try:
        write_whole(Path(path), json_text(data) + "\n")
    except OSError as error:
        raise SolveError(f"cannot write {path}: {error.strerror}") from None


def json_text(data: object) -> str:
    """JSON that every reader takes: NaN and infinity become null, what has no form in JSON its
    text.
    """
    from pydantic_core import to_json

    def plain(value: object) -> object:
        return value.tolist() if isinstance(value, (np.generic, np.ndarray)) else str(value)

    return to_json(data, indent=1, inf_nan_mode="null", fallback=plain).decode()


def build_info(
    scene: Scene,
    started: datetime,
    summary: dict[str, dict[str, QuantityFacts]],
    **facts: object,
) -> RunInfo:
    """Assemble the facts of a run; ``summary`` is from `Summary.table`.

    Other facts are kept as they are: ``status`` ("running", "complete", "interrupted" or "failed"),
    ``message`` (why it did not complete), ``options`` of the caller, ``kernels`` by muscle,
    ``epsilons`` (shape parameters of those kernels that have one, by muscle [1 / scene unit]),
    ``neighbours`` (`NeighbourMeasures.table`),
    ``times`` of the parts of the run [s], ``limits``, ``fail_on`` (those that it may fail on, None
    for the default), ``verdict``, ``beyond`` (muscle, quantity, worst value, limit, frame),
    ``not_measured`` (muscle, quantity), ``frames`` (`frame_facts`).
    """
    sources = [
        scene.path,
        scene.motion.options.file,
        *(b.source for b in scene.bones),
        *(m.source for m in scene.muscles),
    ]
    paths = [Path(source) for source in dict.fromkeys(str(source) for source in sources if source)]
    table = {
        "format": FORMAT,
        "started": started.isoformat(timespec="seconds"),
        "written": datetime.now(UTC).isoformat(timespec="seconds"),
        "scene": record_scene(scene),
        "versions": versions(),
        "machine": machine(),
        # Files that are gone are left out.
        "inputs": {
            str(path): hashlib.sha256(path.read_bytes()).hexdigest()
            for path in paths
            if path.is_file()
        },
        "muscles": {name: found for name, found in summary.items() if name != ALL},
        "frame_time": summary.get(ALL, {}).get("time_frame"),
        **facts,
    }
    # In memory as a reader of the file has them.
    return RunInfo.model_validate_json(json_text(table))


def frame_facts(scene: Scene, frame: Frame) -> dict:
    """What ``run.json`` says of a written frame; coordinates in degrees, those of shifts in scene
    units.
    """
    time = scene.motion.time(frame.index)
    return {
        "frame": frame.index,
        **({} if time is None else {"time": time}),
        "coordinates": {
            name: shown_value(scene, name, value) for name, value in frame.coordinates.items()
        },
        "wall": frame.wall,
    }


def versions() -> dict[str, str]:
    """Versions of Python, this library and what it computes with."""
    found = {"python": platform.python_version(), "rbfmuscle": rbfmuscle.__version__}
    for name in _PACKAGES:
        # Some distributions of VTK bring no metadata.
        with suppress(importlib.metadata.PackageNotFoundError):
            found[name] = importlib.metadata.version(name)
    return found


def machine() -> dict[str, object]:
    """What the times belong to."""
    return {
        "system": platform.platform(),
        "processor": platform.processor() or platform.machine(),
        "cores": len(os.sched_getaffinity(0))
        if hasattr(os, "sched_getaffinity")
        else os.cpu_count(),
        "threads": thread_count(),
    }
