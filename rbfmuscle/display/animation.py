"""A run over time: the parts that exports turn into files, and the moving scene of a page."""

import base64
import json
import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from importlib import resources
from itertools import groupby

import numpy as np

from rbfmuscle.geometry.arrays import Floats, Integers, to_world
from rbfmuscle.geometry.surfaces import vertex_normals
from rbfmuscle.run import appearance as look
from rbfmuscle.run.data import RunData, frame_caption
from rbfmuscle.scene.meshes.repair import InputOrder
from rbfmuscle.scene.objects import MM_PER_UNIT
from rbfmuscle.simulation.frame import FibreLines

# Frames a second of a motion that has no times of its own: frame k of the run is frame k of the
# animation.
FRAMES_A_SECOND = 24.0


@dataclass(frozen=True)
class AnimatedMesh:
    """The surface of a muscle or of its tendons in each frame, or a rigid bone.

    Vertices (n, 3) and faces (m, 3) are those of each frame, with the same array of faces where it
    stays; of a bone there is one of each, at rest, and poses (T, 4, 4) from there to the world.
    ``colour`` is "#rrggbb"; muscles of one ``group`` cross the same joints. ``given`` is the
    vertex order of the muscle's file, where its vertices are shown in another one.
    """

    name: str
    colour: str
    vertices: list[Floats]
    faces: list[Integers]
    poses: Floats | None = None
    group: str = ""
    given: InputOrder | None = None

    @property
    def keeps_vertices(self) -> bool:
        """Whether all frames have the same triangles of the same vertices."""
        return all(faces is self.faces[0] for faces in self.faces)

    @property
    def moves(self) -> bool:
        """Whether it is a bone that is ever anywhere else than in the first frame."""
        return self.poses is not None and bool(np.ptp(self.poses, axis=0).max() > 0.0)

    def mesh(self, k: int) -> tuple[Floats, Integers]:
        """Vertices and faces in the k-th frame."""
        if self.poses is None:
            return self.vertices[k], self.faces[k]
        return to_world(self.vertices[0], self.poses[k]), self.faces[0]

    def own(self, k: int) -> tuple[Floats, Integers, Floats]:
        """Vertices (n, 3), triangles (m, 3) and unit normals (n, 3) in the k-th frame, by the order
        of the muscle's file; of a bone at rest.
        """
        rest = 0 if self.poses is not None else k
        vertices, faces = self.vertices[rest], self.faces[rest]
        normals = vertex_normals(vertices, faces)
        if self.given is None:
            return vertices, faces, normals
        return vertices[self.given.source], self.given.faces, normals[self.given.source]


@dataclass(frozen=True)
class Animation:
    """All muscles and bones of a run over time; ``name`` is the scene's, all lengths are in
    ``unit``: m, cm or mm. Fibres are those of the muscles that have them, in each frame, by the
    name of their lines; always as many of as many points.

    ``times`` (T,) of the frames [s] are the motion's own where ``timed``, ``captions`` those of the
    frames. ``body`` (3, 3) is left, posterior and superior; the motion is seen in its plane from
    ``direction`` (3,) along these.
    """

    name: str
    unit: str
    times: Floats
    timed: bool
    captions: list[str]
    muscles: list[AnimatedMesh]
    bones: list[AnimatedMesh]
    body: Floats
    direction: Floats
    fibres: dict[str, list[FibreLines]] = field(default_factory=dict)


def read_animation(run: RunData, names: list[str], frames: list[int], *, unit: str) -> Animation:
    """Some muscles and all bones in some frames of a run at once, lengths in ``unit``."""
    factor = MM_PER_UNIT[run.units] / MM_PER_UNIT[unit]
    groups = run.groups | dict.fromkeys(run.tendons, "tendons")
    colours = run.colours | dict.fromkeys(run.tendons, look.TENDON_COLOUR)
    tendons = [name for name, muscle in run.info.tendon_muscles.items() if muscle in names]
    muscles = []
    bones = []
    for name in [*names, *tendons]:
        muscle = AnimatedMesh(name, colours[name], [], [], group=groups[name])
        for frame in frames:
            points, faces = run.mesh(name, frame)
            same = muscle.faces and np.array_equal(muscle.faces[0], faces)
            muscle.vertices.append(points * factor)
            muscle.faces.append(muscle.faces[0] if same else faces)
        given = None if name in run.tendons else run.meshes.given(name)
        if given is not None and not (
            muscle.keeps_vertices and np.array_equal(given.source[given.faces], muscle.faces[0])
        ):
            given = None  # another mesh is shown
        muscles.append(replace(muscle, given=given))
    for name in run.bones:
        vertices, faces = run.meshes.bone(name)
        poses = np.array([run.frame(frame).poses[name] for frame in frames])
        poses[:, :3, 3] *= factor
        bones.append(AnimatedMesh(name, look.BONE_COLOUR, [vertices * factor], [faces], poses))
    given = run.info.scene.motion.times
    times = None if given is None else dict(zip(run.frame_numbers, given))
    if times is not None and np.any(np.diff([times[k] for k in frames]) <= 0.0):
        times = None  # no animation: they stand still, or go backwards
    at = [k / FRAMES_A_SECOND if times is None else times[k] for k in frames]
    fibres = {}
    for muscle_name in names:
        lines = [run.frame(frame).fibres.get(muscle_name) for frame in frames]
        known = [x._replace(points=factor * x.points) for x in lines if x is not None]
        if len(known) == len(frames):
            fibres[look.fibres_name(muscle_name)] = known
    return Animation(
        name=str(run.info.scene.name or (run.directory.name if run.directory else "run")),
        unit=unit,
        times=np.array(at, dtype=float),
        timed=times is not None,
        captions=[frame_caption(run, frame) for frame in frames],
        muscles=muscles,
        bones=bones,
        body=run.body,
        direction=look.motion_direction([run.frame(frame).poses for frame in frames], run.body),
        fibres=fibres,
    )


# Whole numbers of which the longest side of all that moves has so many: 0.03 mm of 900.
_STEPS = 30_000


def scene_file(name: str) -> str:
    """The script or style that shows what `pack_runs` packs: ``scene.js``, ``scene.css``."""
    return (resources.files("rbfmuscle.display") / name).read_text(encoding="utf-8")


def pack_runs(runs: Mapping[str, Animation]) -> str:
    """JSON of runs of the same frames and bones, side by side, by what stands above each, for
    ``scene.js``.
    """
    first = next(iter(runs.values()))
    drawn = [part for run in runs.values() for part in (*run.bones, *run.muscles)]
    low = np.min([points.min(axis=0) for part in drawn for points in part.vertices], axis=0)
    high = np.max([points.max(axis=0) for part in drawn for points in part.vertices], axis=0)
    step = float((high - low).max()) / _STEPS or 1.0
    stream: list[bytes] = []
    parts = [
        _pack_part(muscle, k, low, step, stream)
        for k, run in enumerate(runs.values())
        for muscle in run.muscles
    ]
    parts += [_pack_part(bone, -1, low, step, stream) for bone in first.bones]
    facts = {
        "panels": list(runs),
        "captions": first.captions,
        "parts": parts,
        "step": step,
        "views": look.VIEWS,
        "body": first.body.tolist(),
        "direction": first.direction.tolist(),
        "origin": low.tolist(),
        "rate": FRAMES_A_SECOND / 2.0,
        "bytes": base64.b64encode(zlib.compress(b"".join(stream), 4)).decode("ascii"),
    }
    # No name may end the script that holds it.
    return json.dumps(facts, separators=(",", ":")).replace("<", "\\u003c")


def _pack_part(
    part: AnimatedMesh, panel: int, origin: Floats, step: float, stream: list[bytes]
) -> dict[str, object]:
    """Facts of a muscle or bone, whose points and triangles go to a stream, in pieces: frames that
    follow each other and have the same triangles. Points are whole steps from an origin.
    """
    pieces: list[dict[str, int]] = []
    for _, group in groupby(range(len(part.faces)), key=lambda k: id(part.faces[k])):
        frames = list(group)
        faces = part.faces[frames[0]]
        points = np.array([part.vertices[k] for k in frames])
        whole = np.rint((points - origin) / step).astype(np.int32)
        for axis in (0, 0, 1):  # twice over the frames, then over the points
            whole = np.diff(whole, axis=axis, prepend=0)
        stream.append(_by_place(whole.astype("<i2")))
        corners = np.diff(np.asarray(faces, dtype="<i4").ravel(), prepend=0)
        stream.append(_by_place(corners.astype("<i4")))
        pieces.append({"frames": len(frames), "points": whole.shape[1], "faces": len(faces)})
    entry: dict[str, object] = {"name": part.name, "panel": panel, "pieces": pieces}
    entry |= {"colour": part.colour, "group": part.group}
    if part.poses is not None:
        poses = part.poses[: None if part.moves else 1, :3].round(6)
        entry["poses"] = poses.reshape(len(poses), 12).tolist()
    return entry


def _by_place(values: Integers) -> bytes:
    """The first bytes of all numbers, then the second ones: like bytes together pack better."""
    places = np.frombuffer(values.tobytes(), dtype=np.uint8).reshape(-1, values.itemsize)
    return places.T.tobytes()
