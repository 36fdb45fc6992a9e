"""The facts of a run, as ``run.json`` holds them: checked when they are made and when they are
read.
"""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Annotated, Literal, TypeAlias

import numpy as np
from pydantic import AfterValidator, BaseModel, ConfigDict, Field, NonNegativeInt

from rbfmuscle.geometry.surfaces import mesh_hash
from rbfmuscle.metrics.summary import Doubt, Exceedance, QuantityFacts, Unmeasured
from rbfmuscle.scene.bone import Bone
from rbfmuscle.scene.joints import all_coordinates, coupling_row, joint_row
from rbfmuscle.scene.objects import Muscle, check_name
from rbfmuscle.scene.scene import Scene
from rbfmuscle.scene.tendons import tendon_name

if TYPE_CHECKING:
    Facts: TypeAlias = QuantityFacts
else:  # on Python 3.11 pydantic takes no TypedDict of the standard library
    Facts = dict[str, str | int | float | None]


def record_scene(scene: Scene) -> dict[str, object]:
    """A scene as plain data: names, counts, options, sources and hashes."""
    known = all_coordinates(scene.joints)
    units = {name: coordinate.unit_sign(scene.units) for name, coordinate in known.items()}
    motion = scene.motion.options.model_dump(mode="json", by_alias=True, exclude_none=True)
    times = {} if scene.motion.times is None else {"times": scene.motion.times}
    return {
        "name": scene.name,
        "units": scene.units,
        "file": str(scene.path) if scene.path else None,
        "superior": scene.superior,
        "anterior": scene.anterior,
        "bones": [{"name": bone.name, **record_mesh(bone)} for bone in scene.bones],
        "meshless_bones": list(scene.meshless_bones),
        "missing_bones": list(scene.missing_bones),
        "doubts": list(scene.doubts),
        "guesses": [guess._asdict() for guess in scene.guesses],
        "notes": list(scene.notes),
        "joints": [joint_row(joint) for joint in scene.joints],
        "couplings": [coupling_row(coupling, scene.joints) for coupling in scene.couplings],
        "coordinate_units": {name: unit for name, unit in units.items() if unit != "°"},
        "motion": {**motion, "frames": len(scene.motion), "whole": scene.motion.whole, **times},
        "muscles": [record_muscle(muscle) for muscle in scene.muscles],
        "contact": scene.contact.model_dump(),
        "neighbours": scene.neighbours.model_dump() if scene.neighbours else False,
        "detect": scene.detect.model_dump(),
        "output": scene.output.model_dump(),
    }


def record_muscle(muscle: Muscle) -> dict[str, object]:
    """A muscle by its name, options, attachments in numbers, and mesh."""
    keys = muscle.contraction
    return {
        "name": muscle.name,
        "model": {"name": muscle.model, **muscle.options},
        "attach": [
            {"bone": held.bone, "vertices": len(held.vertices)}
            | ({} if held.tendon is None else {"tendon": held.tendon.model_dump()})
            | ({"via": True} if held.via else {})
            for held in muscle.attachments
        ],
        "fibres": len(muscle.fibres) if muscle.fibres else 0,
        "aponeuroses": [len(patch) for patch in muscle.aponeuroses],
        **({} if keys is None else keys.model_dump(exclude_none=True)),
        **record_mesh(muscle),
    }


def record_mesh(item: Bone | Muscle) -> dict[str, object]:
    """Source, size and hash of a mesh."""
    vertices = np.asarray(item.mesh.vertices)
    faces = np.asarray(item.mesh.faces)
    return {
        "mesh": item.source,
        "vertices": len(vertices),
        "triangles": len(faces),
        "volume": float(item.mesh.volume),
        "sha256": mesh_hash(vertices, faces),
        "mended": list(item.notes),
    }


# Version of ``run.json``: raised where readers of the one before would misread it.
FORMAT = 2


# Names become those of files.
BoneName = Annotated[str, AfterValidator(partial(check_name, what="bone"))]
MuscleName = Annotated[str, AfterValidator(partial(check_name, what="muscle"))]


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
    """The motion: the number of its ``frames``, their ``times`` (n,) [s], where it has any; of how
    many frames it is the ``whole``, those that ``--frames`` left out included.
    """

    frames: int = 0
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
    complete. ``epsilons`` are the shape parameters of the ``kernels`` that have one [1 / scene
    unit], both by muscle. ``times`` are those of the parts of the run [s], ``muscles`` and
    ``frame_time`` what `Summary.table` gives. ``limits`` are in the scene's unit, ``fail_on`` those
    that it may fail on (None: the default); ``beyond`` are values beyond a limit, ``not_measured``
    limits without a value, ``outcome`` which muscles are within all limits, ``doubts`` what no
    limit holds, ``verdict`` all of these in sentences. ``neighbours`` are the pairs of muscles that
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
    epsilons: dict[str, float] = {}
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
