"""What a scene holds."""

import copy
from dataclasses import KW_ONLY, dataclass, field, replace
from pathlib import Path
from typing import Self

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.scene.bone import Bone
from rbfmuscle.scene.guesses import Guess
from rbfmuscle.scene.joints.joint import Coupling, Joint
from rbfmuscle.scene.objects import MM_PER_UNIT, Motion, Muscle, body_axes, find_named
from rbfmuscle.scene.options import ContactOptions, DetectOptions, OutputOptions, SlidingOptions
from rbfmuscle.validation import SceneError


@dataclass(eq=False, repr=False)
class SceneContents:
    """Bones, joints, muscles, a motion and the settings of a simulation.

    Attributes
    ----------
    name : str
    units : {"mm", "cm", "m"}
        Unit of every length in the scene.
    couplings : list of Coupling
        Coordinates that follow others.
    meshless_bones : list of str
        Bones without a mesh, which carry joints only.
    path : pathlib.Path or None
        The file it was loaded from.
    missing_bones : list of str
        Bones of which no mesh could be used; they count in the verdict of a run.
    doubts : list of str
        What makes the scene another one than its source, in sentences; warnings of a check, and in
        the verdict of a run.
    guesses : list of Guess
        Lines of the file that are marked GUESS; the doubtful ones count in the verdict of a run.
    notes : list of str
        What was assumed about the data or left out, for a check to repeat.
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
    meshless_bones: list[str] = field(default_factory=list)
    muscles: list[Muscle] = field(default_factory=list)
    motion: Motion = field(default_factory=Motion)
    contact: ContactOptions = field(default_factory=ContactOptions)
    sliding: SlidingOptions | None = None
    detect: DetectOptions | None = None
    output: OutputOptions = field(default_factory=OutputOptions)
    path: Path | None = None
    missing_bones: list[str] = field(default_factory=list)
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

    def attachment_frames(self, muscle: Muscle) -> list[str]:
        """Names of the bones, then of the ends that tendons of a muscle hold."""
        return [*(bone.name for bone in self.bones), *(end.name for end in muscle.tendons)]

    def copy(self) -> Self:
        """Return a copy whose lists and tables are its own; meshes are shared."""
        other = copy.copy(self)
        lists = (
            "bones",
            "joints",
            "couplings",
            "meshless_bones",
            "missing_bones",
            "doubts",
            "guesses",
            "notes",
        )
        for name in lists:
            setattr(other, name, list(getattr(self, name)))
        other.muscles = [replace(muscle, options=dict(muscle.options)) for muscle in self.muscles]
        return other

    def __repr__(self) -> str:
        muscles = ", ".join(f"{muscle.name} ({muscle.model})" for muscle in self.muscles)
        counts = f"{len(self.bones)} bones, {muscles or 'no muscles'}, {len(self.motion)} frames"
        return f"<Scene {self.name!r}, {self.units}: {counts}>"
