"""What a scene is made of: bones, joints, muscles, a motion and settings, all of it data."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from pydantic import Field

from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.scene.activation.keys import ContractionTable
from rbfmuscle.scene.bone import Bone
from rbfmuscle.scene.guesses import Guess
from rbfmuscle.scene.joints.joint import Coupling, Joint
from rbfmuscle.scene.options import (
    ContactOptions,
    DetectOptions,
    MotionOptions,
    OutputOptions,
    SlidingOptions,
    Table,
    Vector,
)
from rbfmuscle.scene.tendons import TendonEnd
from rbfmuscle.validation import SceneError, did_you_mean

if TYPE_CHECKING:
    import trimesh

MM_PER_UNIT = {"m": 1000.0, "cm": 10.0, "mm": 1.0}


class ViaTable(Table):
    """A via point of a tendon on another bone than the insertion's."""

    bone: str
    point: Vector


class LineTable(Table):
    """The tendon of an attachment: from the belly's end past ``via`` to ``to``, points at rest
    [scene unit].
    """

    to: Vector
    via: list[Vector | ViaTable] = Field(default_factory=list)


@dataclass
class Attachment:
    """Vertices (n,) of a muscle's mesh that move with a bone.

    ``tendon`` joins them to it where they end short of it. ``holder`` is the name, among the poses,
    of what they move with: the bone, or the end of the tendon.
    """

    bone: str
    vertices: Integers = field(repr=False)
    tendon: LineTable | None = None
    holder: str = ""

    def __post_init__(self) -> None:
        self.holder = self.holder or self.bone

    @property
    def bones(self) -> list[str]:
        """The bone, and those of the tendon's via points."""
        via = [] if self.tendon is None else self.tendon.via
        return [self.bone, *(point.bone for point in via if isinstance(point, ViaTable))]


@dataclass
class Muscle:
    """A closed surface (outward, rest pose) held by bones, and the model that moves it.

    ``contraction`` holds the keys of a muscle that contracts, None for any other; ``tendons`` are
    the ends that tendons hold.
    """

    name: str
    mesh: trimesh.Trimesh = field(repr=False)
    model: str = "rbf"
    options: dict[str, Any] = field(default_factory=dict)
    attachments: list[Attachment] = field(default_factory=list)
    fibres: list[Floats] | None = field(default=None, repr=False)
    source: str = ""
    notes: list[str] = field(default_factory=list)
    contraction: ContractionTable | None = None
    tendons: list[TendonEnd] = field(default_factory=list)


@dataclass(eq=False)
class Motion:
    """The frames of a motion, each a dict of "joint.coordinate" -> value [radian or scene unit];
    absent ones rest.
    """

    frames: Sequence[dict[str, float]] = ({},)
    _: KW_ONLY
    options: MotionOptions = field(default_factory=MotionOptions)  # what the frames were made from
    times: Sequence[float] | None = None  # of each frame [s], where a motion file gives it
    # Where each frame lies in the whole motion (n,), 0 to 1; even where not given.
    progress: Floats = field(default_factory=lambda: np.empty(0))
    notes: list[str] = field(
        default_factory=list
    )  # coordinates that leave their range, columns not used

    def __post_init__(self) -> None:
        if not len(self.progress):
            self.progress = np.linspace(0.0, 1.0, len(self.frames))

    @property
    def coordinates(self) -> list[str]:
        """Names of the coordinates that change, the one with the widest range first."""
        names = sorted({name for frame in self.frames for name in frame})
        spans = {name: np.ptp([frame.get(name, 0.0) for frame in self.frames]) for name in names}
        return sorted((name for name in names if spans[name] > 0), key=lambda name: -spans[name])

    def __len__(self) -> int:
        return len(self.frames)


@dataclass(eq=False, repr=False)
class SceneData:
    """The data of a scene; the class for users is `rbfmuscle.scene.scene.Scene`.

    Attributes
    ----------
    units : {"mm", "cm", "m"}
        Unit of every length in the scene.
    couplings : list of Coupling
        Coordinates that follow others.
    links : list of str
        Bones without a mesh, which carry joints only.
    path : pathlib.Path or None
        The file it was loaded from.
    left_out : list of str
        Bones of which no mesh could be used; they count in the verdict of a run.
    doubts : list of str
        What makes the scene another one than its source, in sentences; warnings of a check, and in
        the verdict of a run.
    guesses : list of Guess
        Lines of the file that are marked GUESS; the doubtful ones count in the verdict of a run.
    notes : list of str
        What was assumed about the data or left out, for `check` to repeat.
    superior, anterior : list of float or None
        Anatomical directions (3,) at rest: those of the file, or found from the bones before a run
        or a picture.
    """

    name: str = "scene"
    _: KW_ONLY
    units: str = "mm"
    bones: list[Bone] = field(default_factory=list)
    joints: list[Joint] = field(default_factory=list)
    couplings: list[Coupling] = field(default_factory=list)
    links: list[str] = field(default_factory=list)
    muscles: list[Muscle] = field(default_factory=list)
    motion: Motion = field(default_factory=Motion)
    contact: ContactOptions = field(default_factory=ContactOptions)
    sliding: SlidingOptions | None = None
    detect: DetectOptions | None = None
    output: OutputOptions = field(default_factory=OutputOptions)
    path: Path | None = None
    left_out: list[str] = field(default_factory=list)
    doubts: list[str] = field(default_factory=list)
    guesses: list[Guess] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    superior: list[float] | None = None
    anterior: list[float] | None = None

    def __post_init__(self) -> None:
        if self.units not in MM_PER_UNIT:
            raise SceneError(f"units must be m, cm or mm, got {self.units!r}")

    def length(self, millimetres: float) -> float:
        """Return a length given in millimetres in the scene's unit."""
        return millimetres / MM_PER_UNIT[self.units]

    @property
    def body(self) -> Floats:
        """Left, posterior and superior (3, 3); x, y and z where the directions are not known."""
        return body_axes(self.superior, self.anterior)

    def bone(self, name: str) -> Bone:
        """Return the bone of that name, or raise SceneError naming the nearest."""
        return find_named(self.bones, name, "bone")

    def muscle(self, name: str) -> Muscle:
        """Return the muscle of that name, or raise SceneError naming the nearest."""
        return find_named(self.muscles, name, "muscle")

    def holders(self, muscle: Muscle) -> list[str]:
        """Names of the bones, then of the ends that tendons of a muscle hold."""
        return [*(bone.name for bone in self.bones), *(end.name for end in muscle.tendons)]

    def copy(self) -> Self:
        """Return a copy whose lists and tables are its own; meshes are shared."""
        other = copy.copy(self)
        lists = ("bones", "joints", "couplings", "links", "left_out", "doubts", "guesses", "notes")
        for name in lists:
            setattr(other, name, list(getattr(self, name)))
        other.muscles = [replace(muscle, options=dict(muscle.options)) for muscle in self.muscles]
        return other

    def __repr__(self) -> str:
        muscles = (
            ", ".join(f"{muscle.name} ({muscle.model})" for muscle in self.muscles) or "no muscles"
        )
        counts = f"{len(self.bones)} bones, {muscles}, {len(self.motion)} frames"
        return f"<Scene {self.name!r}, {self.units}: {counts}>"


def body_axes(superior: Sequence[float] | None, anterior: Sequence[float] | None) -> Floats:
    """Left, posterior and superior (3, 3) of a body with these directions; x, y and z where one is
    None.
    """
    if superior is None or anterior is None:
        return np.eye(3)
    up = np.asarray(superior, dtype=float) / np.linalg.norm(superior)
    left = np.cross(up, anterior)
    left /= np.linalg.norm(left)
    return np.stack([left, np.cross(up, left), up])


def find_named(items: list[Any], name: str, what: str, *, place: str = "") -> Any:
    """Return the item of that name, or raise SceneError naming the nearest."""
    for item in items:
        if item.name == name:
            return item
    hint = did_you_mean(name, [item.name for item in items])
    raise SceneError(f"{place}unknown {what} {name!r}, {hint}")
