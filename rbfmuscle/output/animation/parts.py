"""The muscles, tendons and bones of a run over time, which exports turn into files."""

from dataclasses import dataclass, field, replace

import numpy as np

from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.geometry.surfaces import vertex_normals
from rbfmuscle.geometry.vectors import to_world
from rbfmuscle.output import appearance as look
from rbfmuscle.output.run_data import RunData, frame_caption
from rbfmuscle.scene.meshes.input_mesh import InputOrder
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
class AnimatedFibres:
    """The fibres of a muscle in each frame, always as many lines of as many points."""

    name: str
    lines: list[FibreLines]

    @property
    def segments(self) -> Integers:
        """Numbers (s, 2) of the points that each piece of the lines joins, line by line."""
        count, points = self.lines[0].points.shape[:2]
        first = np.arange(count * points).reshape(count, points)
        return np.stack([first[:, :-1].ravel(), first[:, 1:].ravel()], axis=1)


@dataclass(frozen=True)
class Animation:
    """All muscles and bones of a run over time; ``name`` is the scene's, all lengths are in
    ``unit``: m, cm or mm. Fibres are those of the muscles that have them.

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
    fibres: list[AnimatedFibres] = field(default_factory=list)


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
    name = str(run.info.scene.name or (run.directory.name if run.directory else "run"))
    if times is not None and np.any(np.diff([times[k] for k in frames]) <= 0.0):
        times = None  # no animation: they stand still, or go backwards
    at = np.array([k / FRAMES_A_SECOND if times is None else times[k] for k in frames], dtype=float)
    captions = [frame_caption(run, frame) for frame in frames]
    direction = look.motion_direction([run.frame(frame).poses for frame in frames], run.body)
    return Animation(
        name,
        unit,
        at,
        times is not None,
        captions,
        muscles,
        bones,
        run.body,
        direction,
        _animated_fibres(run, names, frames, factor),
    )


def _animated_fibres(
    run: RunData, names: list[str], frames: list[int], factor: float
) -> list[AnimatedFibres]:
    """Fibres of those muscles that have them in all of some frames, lengths scaled."""
    found = []
    for name in names:
        lines = [run.frame(frame).fibres.get(name) for frame in frames]
        known = [x._replace(points=factor * x.points) for x in lines if x is not None]
        if len(known) == len(frames):
            found.append(AnimatedFibres(look.fibres_name(name), known))
    return found
