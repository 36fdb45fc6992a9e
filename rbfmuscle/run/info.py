"""The facts of a run, as ``run.json`` holds them: checked when they are made and when they are
read.
"""

from functools import partial
from typing import TYPE_CHECKING, Annotated, Literal, TypeAlias

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, NonNegativeInt

from rbfmuscle.metrics.summary import Doubt, Exceedance, QuantityFacts, Unmeasured
from rbfmuscle.scene.names import check_name
from rbfmuscle.scene.tendons import tendon_name

# Version of ``run.json``: raised where readers of the one before would misread it.
FORMAT = 2


# Names become those of files.
BoneName = Annotated[str, AfterValidator(partial(check_name, what="bone"))]
MuscleName = Annotated[str, AfterValidator(partial(check_name, what="muscle"))]


if TYPE_CHECKING:
    Facts: TypeAlias = QuantityFacts
else:  # on Python 3.11 pydantic takes no TypedDict of the standard library
    Facts = dict[str, str | int | float | None]


class Part(BaseModel):
    """Facts whose further keys are kept as they are."""

    model_config = ConfigDict(extra="allow", frozen=True)


class BoneInfo(Part):
    """A bone of the scene."""

    name: BoneName


class EndInfo(Part):
    """An attachment of a muscle; ``tendon`` holds the keys of its tendon, where it has one."""

    bone: str
    tendon: object = None


class ModelInfo(Part):
    """The model of a muscle; further keys are its settings."""

    name: str


class MuscleInfo(Part):
    """A muscle of the scene."""

    name: MuscleName
    model: ModelInfo
    attach: list[EndInfo] = []


class JointInfo(Part):
    """A joint of the scene, between two bones."""

    name: str
    parent: str
    child: str


class OutputInfo(Part):
    """What was written."""

    surfaces: bool
    tendons: bool = True  # false of earlier versions alone


class MotionInfo(Part):
    """The motion: ``times`` (n,) of its frames [s], where it has any; of how many frames it is
    the ``whole``, those that ``--frames`` left out included.
    """

    times: list[float] | None = None
    whole: int | None = None  # None of earlier versions


class SceneInfo(Part):
    """The scene as it was run; ``coordinate_units`` of what is not in degrees."""

    name: str = ""
    file: str | None = None
    units: Literal["m", "cm", "mm"]
    bones: list[BoneInfo]
    missing_bones: list[str] = []
    joints: list[JointInfo] = []
    muscles: list[MuscleInfo]
    output: OutputInfo
    motion: MotionInfo = MotionInfo()
    superior: list[float] | None = None
    anterior: list[float] | None = None
    coordinate_units: dict[str, str] = {}


class FrameInfo(Part):
    """A written frame: coordinates [degree, of translations scene unit], wall time [s], and the
    time of the motion [s] where it has one.
    """

    frame: NonNegativeInt = Field(strict=True)
    coordinates: dict[str, float]
    wall: float | None
    time: float | None = None


class RunInfo(Part):
    """The facts of a run.

    ``status`` is "running", "complete", "interrupted" or "failed", ``message`` why it did not
    complete. ``times`` are those of the parts of the run [s], ``muscles`` and ``frame_time`` what
    `Summary.table` gives. ``limits`` are in the scene's unit, ``fail_on`` those that it may fail
    on (None: the default); ``beyond`` are values beyond a limit, ``not_measured`` limits without a
    value, ``outcome`` which muscles are within all limits, ``doubts`` what no limit
    holds, ``verdict`` all of these in sentences. ``neighbours`` are the pairs of muscles that
    touched or met, with the worst of each. ``planned`` are the coordinates of all frames while the
    run goes on.
    """

    format: int = 0
    status: str = "complete"
    message: str | None = None
    scene: SceneInfo
    options: dict[str, object] = {}  # settings have values of any type
    versions: dict[str, str] = {}
    machine: dict[str, str | int | None] = {}
    kernels: dict[str, str] = {}
    times: dict[str, float] = {}
    muscles: dict[str, dict[str, Facts]] = {}
    frame_time: Facts | None = None
    limits: dict[str, float] = {}
    fail_on: dict[str, float | None] = {}
    verdict: str = ""
    outcome: str = ""
    beyond: list[Exceedance] = []
    not_measured: list[Unmeasured] = []
    doubts: list[Doubt] = []
    neighbours: list[dict[str, object]] = []
    frames: list[FrameInfo]
    planned: list[dict[str, float]] = []

    def to_dict(self) -> dict[str, object]:
        """What ``run.json`` holds."""
        return self.model_dump(exclude_unset=True)

    def replaced(self, **facts: object) -> "RunInfo":
        """The facts with others in place of some."""
        return self.model_copy(update=facts)

    @property
    def tendon_muscles(self) -> dict[str, str]:
        """Muscle of each mesh of tendons, by the name of the mesh."""
        if not self.scene.output.tendons:
            return {}
        held = [
            muscle.name
            for muscle in self.scene.muscles
            if any("tendon" in end.model_fields_set for end in muscle.attach)
        ]
        return {tendon_name(name): name for name in held}
