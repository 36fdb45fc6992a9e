"""The data of a frame, and the interface that a muscle model implements."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol, TypeAlias

import numpy as np

from rbfmuscle.geometry.arrays import to_world
from rbfmuscle.simulation.contact import BoneContacts, BonesInReach
from rbfmuscle.simulation.touching import Body, Moving

Mesh: TypeAlias = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True)
class Event:
    """Something a user should know: ``count`` points of a muscle at a bone, and what was done.

    ``action`` is ``"angle_flag"`` (the angle test found a crossing), ``"reported"`` (crossed, not
    corrected), ``"halved"`` (the step), ``"held_back"`` (kept on its side of a plane),
    ``"unresolved"`` (crossed all the same), ``"carried_stretched"``, ``"carried_held_end"`` or
    ``"carried_sheets"`` (no level set could be shown, so the surface is where the material is: it
    is stretched too far, an end is held inside the bone named, or sheets have met),
    ``"surface_crosses"`` (``count`` triangles of the shown surface cross others of it),
    ``"overlap_kept"`` (at rest, before the first frame),
    ``"iteration_cap"`` (``count`` times a solve, a tendon's line or the shortest path of `bowing`
    ended at a greatest number of steps, without a bone), or, with no muscle, ``"bones_overlap"``
    (the motion drives two bones into each other) or ``"joint_opens"`` (those of a joint apart).
    """

    frame: int
    muscle: str
    bone: str
    count: int
    action: str


@dataclass(frozen=True, eq=False)
class ModelSurface:
    """A closed, outward surface and its quantities."""

    vertices: np.ndarray = field(repr=False)  # (n, 3)
    faces: np.ndarray = field(repr=False)  # (m, 3)
    quantities: dict = field(default_factory=dict)  # ``condition``, ``time_fit`` and others by name
    notes: list = field(
        default_factory=list
    )  # (bone, count, action), turned into events of the frame
    # An earlier ModelSurface and the rigid motion (4, 4) since, where the muscle moved rigidly;
    # else None.
    origin: "tuple[ModelSurface, np.ndarray] | None" = field(default=None, repr=False)
    # Values (n,) at the vertices, by name, that the model knows of and a file may show.
    arrays: Mapping[str, np.ndarray] = field(default_factory=dict, repr=False)

    def moved(self, motion: np.ndarray) -> "ModelSurface":
        """The surface after a rigid motion (4, 4), which took no time."""
        vertices = to_world(self.vertices, motion)
        quantities = {
            name: 0.0 if name.startswith("time_") else value
            for name, value in self.quantities.items()
        }
        # What is said of the solves was said with this surface.
        notes = [note for note in self.notes if note[2] != "iteration_cap"]
        return ModelSurface(vertices, self.faces, quantities, notes, (self, motion), self.arrays)


class FibreLines(NamedTuple):
    """Fibres of a muscle, from origin to insertion, with the tendons at their ends.

    Points (N, k, 3) of the lines [scene unit], the stretch (N,) of each fibre, its length without
    tendons over that at rest, and at its points (N, k), 1 in tendons.
    """

    points: np.ndarray
    stretch: np.ndarray
    local_stretch: np.ndarray

    @property
    def lengths(self) -> np.ndarray:
        """Of each fibre with its tendons (N,) [scene unit]."""
        return np.linalg.norm(np.diff(self.points, axis=1), axis=2).sum(axis=1)


@dataclass(eq=False)
class Frame:
    """One written frame."""

    index: int  # in the scene's motion
    coordinates: dict  # [radian]
    poses: dict = field(repr=False)  # (4, 4) by bone
    surfaces: Mapping[str, ModelSurface] = field(
        repr=False
    )  # by muscle; empty where none were asked for
    material_meshes: dict = field(
        repr=False
    )  # (vertices, faces) by muscle: material surfaces of constant topology
    events: list  # since the frame written before
    # Of each muscle ``time_predict``, ``time_solve``, ... and their sum ``time_frame`` [s], since
    # the last frame.
    times: dict = field(repr=False)
    wall: float  # time for all muscles together [s], since the frame before
    activations: dict = field(default_factory=dict)  # of the muscles that contract
    work: dict = field(default_factory=dict)  # MuscleStatus by muscle
    # TendonLine by the end that each holds; the poses have these too
    tendons: dict = field(default_factory=dict)
    # The bones that each muscle can reach, by muscle
    bones: Mapping[str, BonesInReach] = field(default_factory=dict, repr=False)
    # FibreLines by muscle, where the scene asks for them
    fibres: Mapping[str, FibreLines] = field(default_factory=dict, repr=False)


class SolveLog(NamedTuple):
    """How the solves of a model ended since its last drawing, for the quantities and notes of its
    surface; before any solve, the quantities at rest. It is never changed in place.
    """

    worst: Mapping[str, float]  # the greatest of each quantity
    capped: int = 0  # how often a solve ended at a cap
    taken: bool = False  # whether these were taken

    def add(self, *, caps: int, **quantities: float) -> "SolveLog":
        """With another solve: how often it ended at a cap, and its ``solver_residual`` and others,
        of which the greatest are kept.
        """
        worst = {} if self.taken else dict(self.worst)
        for name, value in quantities.items():
            worst[name] = float(np.fmax(value, worst.get(name, 0.0)))
        return SolveLog(worst, self.capped + caps)

    def take(self) -> "tuple[dict[str, float], list[tuple[str, int, str]], SolveLog]":
        """Quantities and notes for a `ModelSurface`, and the log from then on."""
        notes = [("", self.capped, "iteration_cap")] if self.capped else []
        return dict(self.worst), notes, SolveLog(self.worst, taken=True)


class MuscleModel(Protocol):
    """The interface of a muscle to the frame loop."""

    name: str
    attached_bone: np.ndarray  # (n,) bone that a contact point is attached to, -1 where it is free

    def contact_points(self) -> np.ndarray:
        """Present contact points (n, 3); their number and order never change."""

    def predict(self, before: Mapping[str, np.ndarray], after: Mapping[str, np.ndarray]) -> None:
        """Move with the bones from one set of poses to the next."""

    def begin(self, contacts: BoneContacts) -> Moving:
        """Begin to solve for equilibrium under the model's constraints and these contacts; `settle`
        iterates it, with those that it touches.
        """

    def take(self, moving: Any) -> None:  # each model has a type of its own for what `begin` gives
        """Take the state where a solve ended."""

    def body(self) -> Body:
        """What others meet that touch this muscle."""

    def transform(self, motion: np.ndarray) -> None:
        """Move the whole muscle rigidly by (4, 4)."""

    def snapshot(self) -> object:
        """The state, for :meth:`restore`."""

    def restore(self, state: Any) -> None:  # each model has a type of its own for its state
        """Return to a snapshot, which stays valid."""

    def activate(self, activation: float) -> None:
        """Set the activation, 0 to 1, for the next :meth:`solve`; for muscles that contract."""

    def material_mesh(self) -> Mesh:
        """Vertices and faces of a surface of constant topology that moves with the material."""

    def follower(self, points: np.ndarray) -> Callable[[], np.ndarray]:
        """What gives the present places (n, 3) of points (n, 3) of the muscle at rest."""

    def surface(self, contacts: BoneContacts) -> ModelSurface:
        """The closed, outward surface as the muscle is now."""
