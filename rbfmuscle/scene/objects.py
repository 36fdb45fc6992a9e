"""What a scene is made of: muscles with their attachments, and a motion; the names of its parts."""

import re
import unicodedata
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import KW_ONLY, dataclass, field
from typing import TypeVar

import numpy as np
import trimesh
from pydantic import Field

from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.scene.bone import Bone
from rbfmuscle.scene.content import Compared
from rbfmuscle.scene.joints import Joint
from rbfmuscle.scene.meshes.repair import InputOrder
from rbfmuscle.scene.options import ContractionTable, GuessTable, MotionOptions, Table, Vector
from rbfmuscle.scene.tendons import TendonEnd
from rbfmuscle.validation import SceneError, did_you_mean, shown

MM_PER_UNIT = {"m": 1000.0, "cm": 10.0, "mm": 1.0}


def from_mm(millimetres: float, units: str) -> float:
    """A length given in millimetres, in other units ("mm", "cm" or "m")."""
    return millimetres / MM_PER_UNIT[units]


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


@dataclass(eq=False)
class Attachment(Compared):
    """Vertices (n,) of a muscle's mesh that move with a bone.

    ``tendon`` joins them to it where they end short of it. ``attachment_frame`` is the name,
    among the poses, of what they move with: the bone, or the end of the tendon. What is ``via`` a
    bone passes it and is neither origin nor insertion. With ``guess``
    nobody has confirmed it.
    """

    bone: str
    vertices: Integers = field(repr=False)
    tendon: LineTable | None = None
    attachment_frame: str = ""
    via: bool = False
    guess: GuessTable | None = None

    def __post_init__(self) -> None:
        self.attachment_frame = self.attachment_frame or self.bone

    @property
    def bones(self) -> list[str]:
        """The bone, and those of the tendon's via points."""
        via = [] if self.tendon is None else self.tendon.via
        return [self.bone, *(point.bone for point in via if isinstance(point, ViaTable))]


@dataclass(eq=False)
class Muscle(Compared):
    """A closed surface (outward, rest pose) held by bones, and the model that moves it.

    ``contraction`` holds the keys of a muscle that contracts, None for any other; ``tendons`` are
    the ends that tendons hold. ``aponeuroses`` are the vertices of a pennate muscle's patches,
    of the origin and of the insertion, between which its fibres run. ``given`` is the mesh of the
    file, where it is another one than ``mesh``.
    """

    not_compared = ("source", "tendons")  # tendons follow from the attachments and the joints

    name: str
    mesh: trimesh.Trimesh = field(repr=False)
    model: str = "rbf"
    options: dict[str, object] = field(default_factory=dict)
    attachments: list[Attachment] = field(default_factory=list)
    fibres: list[Floats] | None = field(default=None, repr=False)
    source: str = ""
    notes: list[str] = field(default_factory=list)
    contraction: ContractionTable | None = None
    tendons: list[TendonEnd] = field(default_factory=list)
    given: InputOrder | None = field(default=None, repr=False)
    aponeuroses: list[Integers] = field(default_factory=list, repr=False)


@dataclass(eq=False)
class Motion(Compared):
    """The frames of a motion, each a dict of "joint.coordinate" -> value [radian or scene unit];
    absent ones rest.
    """

    frames: Sequence[dict[str, float]] = ({},)
    _: KW_ONLY
    options: MotionOptions = field(default_factory=MotionOptions)  # what the frames were made from
    times: Sequence[float] | None = None  # of each frame [s], where a motion file gives it
    # Of each frame its number (n,) in the whole motion, and how many frames that has.
    numbers: Integers = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    whole: int = 0
    notes: list[str] = field(
        default_factory=list
    )  # coordinates that leave their range, columns not used

    def __post_init__(self) -> None:
        if not len(self.numbers):
            self.numbers = np.arange(len(self.frames))
            self.whole = len(self.frames)

    @property
    def coordinates(self) -> list[str]:
        """Names of the coordinates that change, the one with the widest range first."""
        names = sorted({name for frame in self.frames for name in frame})
        spans = {name: np.ptp([frame.get(name, 0.0) for frame in self.frames]) for name in names}
        return sorted((name for name in names if spans[name] > 0), key=lambda name: -spans[name])

    def time(self, number: int) -> float | None:
        """Time of the frame of a number [s], None where the motion has none."""
        if self.times is None:
            return None
        return self.times[int(np.flatnonzero(self.numbers == number)[0])]

    def __len__(self) -> int:
        return len(self.frames)


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


def split_model(model: object, *, context: str) -> tuple[str, dict[str, object]]:
    """Return (name, options) of a model given as a name or as a table with ``name``, or raise
    SceneError.
    """
    if isinstance(model, str):
        return model, {}
    if isinstance(model, Mapping):
        options = dict(model)
        name = options.pop("name", "rbf")
        if isinstance(name, str):
            return name, options
    raise SceneError(f"{context}: model must be a name or a table with a name, got {shown(model)}")


# Devices on Windows, in any case and with any ending: no file can have such a name.
DEVICES = {"con", "prn", "aux", "nul"} | {
    f"{kind}{k}" for kind in ("com", "lpt") for k in range(10)
}
LONGEST_NAME = 100  # a file may be named after two of them, and systems allow 255 letters


def plain_name(name: str) -> str:
    """A name as a scene may have it, of letters, digits, ``_`` and ``-``.

    Accents are dropped; letters of other scripts become ``u`` and their number, so that different
    names stay different.
    """
    words = []
    for letter in name.strip():
        plain = unicodedata.normalize("NFKD", letter).encode("ascii", "ignore").decode()
        other = letter.isalnum() and not plain
        words.append(f"u{ord(letter):04x}" if other else plain or " ")
    return re.sub(r"[^A-Za-z0-9_-]+", "_", "".join(words)) or "_"


def new_name(name: str, taken: Iterable[str], *, file: bool = True) -> str:
    """The plain name, numbered where it is taken; of a ``file`` in letters of another case too, and
    where it names a device.
    """
    plain, number = plain_name(name)[: LONGEST_NAME - 5], 2
    # "all" is the whole scene.
    known = {one.lower() if file else one for one in taken} | {"all"} | DEVICES
    found = plain
    while (found.lower() if file else found) in known:
        found = f"{plain}_{number}"
        number += 1
    return found


NamedItem = TypeVar("NamedItem", Bone, Muscle)


def find_named(items: Sequence[NamedItem], name: str, what: str, *, context: str = "") -> NamedItem:
    """Return the item of that name, or raise SceneError naming the nearest."""
    for item in items:
        if item.name == name:
            return item
    hint = did_you_mean(name, [item.name for item in items])
    raise SceneError(f"{context}unknown {what} {name!r}, {hint}")


def check_name(name: object, what: str) -> str:
    """Return the name, or raise SceneError if it is no name for a file."""
    if not isinstance(name, str) or not re.fullmatch("[A-Za-z0-9_-]+", name):
        raise SceneError(
            f"{what} name {shown(repr(name))} may hold "
            "letters, digits, '_' and '-' only (it becomes a file name)"
        )
    if len(name) > LONGEST_NAME:
        raise SceneError(
            f"{what} name {shown(repr(name))} has {len(name)} letters, at most {LONGEST_NAME} are "
            "allowed (it becomes a file name)"
        )
    if name.lower() in DEVICES:
        raise SceneError(
            f"{what} name {name!r} is that of a device on Windows (it becomes a file name); choose "
            "another"
        )
    return name


def check_new_name(
    items: Sequence[Bone] | Sequence[Joint] | Sequence[Muscle], name: str, what: str
) -> None:
    """Raise SceneError if a name is no name for a file, or taken, in letters of another case
    too.
    """
    check_name(name, what)
    if name == "all":
        raise SceneError(f"{what} name 'all' stands for the whole scene in tables, choose another")
    same = [item.name for item in items if item.name.lower() == name.lower()]
    if name in same:
        raise SceneError(f"{what} {name!r} is given twice")
    if same and what != "joint":
        raise SceneError(
            f"{what} {name!r} differs from {same[0]!r} in case alone, and their files would be one "
            "on some systems; choose another name"
        )
