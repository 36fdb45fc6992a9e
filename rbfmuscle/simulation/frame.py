"""What a frame of a motion holds, and what a muscle must offer to be brought through one."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from rbfmuscle.geometry.fields import Field
from rbfmuscle.simulation.contact import BoneContacts


@dataclass(frozen=True)
class Event:
    """Something a user should know of: ``count`` points of a muscle at a bone, and what was done.

    ``action`` is ``"angle_flag"`` (the angle test spoke), ``"reported"`` (crossed, nothing done),
    ``"rotated"``, ``"halved"`` (the step was), ``"held_back"`` (kept on its side of a plane), ``"grazed"``
    (crossed by the bone's field, by its triangles less than 0.1 mm deep), ``"unresolved"`` (and nothing helped),
    ``"carried_stretched"``, ``"carried_held_end"`` or ``"carried_sheets"`` (no level set could be shown, so the surface
    is where the material is: it is stretched too far, an end is held inside the bone named, or sheets have met),
    ``"neighbours_let_in"`` (sliding neighbours on all sides left no surface, so it was fitted without them),
    ``"overlap_kept"`` or ``"overlap_resolved"`` (at rest, before the first frame), or, with no muscle,
    ``"bones_overlap"`` (the motion drives two bones into each other).
    """

    frame: int
    muscle: str
    bone: str
    count: int
    action: str


@dataclass(frozen=True)
class ModelSurface:
    """A closed, outward surface and what the model knows about it.

    Attributes
    ----------
    vertices : (n, 3) ndarray
    faces : (m, 3) ndarray of int
    quantities : dict of str to float
        For example ``solver_penetration_max``, ``condition``, ``time_fit``, ``time_extract``.
    notes : list of (bone, count, action)
        What becomes events of the frame.
    origin : tuple of (ModelSurface, (4, 4) ndarray) or None
        The surface that this one is, moved, and the motion; of one that was not drawn anew.
    """

    vertices: np.ndarray
    faces: np.ndarray
    quantities: dict = field(default_factory=dict)
    notes: list = field(default_factory=list)
    origin: Any = None


@dataclass
class Frame:
    """One written frame.

    Attributes
    ----------
    index : int
        Place in the scene's motion.
    coordinates : dict of str to float
        [radian].
    poses : dict of str to (4, 4) ndarray
    surfaces : dict of str to ModelSurface
        Empty where no surfaces were asked for.
    carried : dict of str to (vertices, faces)
        Material surfaces of constant topology.
    events : list of Event
        Since the frame written before.
    times : dict of str to dict
        For each muscle ``time_predict``, ``time_solve``, ... and their sum ``time_frame`` [s], since the
        frame before.
    wall : float
        Time for all muscles together [s], since the frame before.
    activations : dict of str to float
        Of the muscles that contract.
    work : dict of str to Work
        Whether each muscle was solved for the frame, carried along as it was, or left where it was, and why.
    neighbours : dict of (str, str) to (float, float)
        Of muscles that slide, by pair: their overlap, and the gap opened where they touched at rest (RMS).
    """

    index: int
    coordinates: dict
    poses: dict
    surfaces: dict
    carried: dict
    events: list
    times: dict
    wall: float
    activations: dict = field(default_factory=dict)
    work: dict = field(default_factory=dict)
    neighbours: dict = field(default_factory=dict)


class Drawing(Protocol):
    """A model as it was at one moment, ready to be drawn while the model goes on."""

    def field(self) -> Field | None:
        """The field whose zero set will be shown, None for a model that has none."""

    def surface(self) -> ModelSurface:
        """The surface, closed and outward; asked for once."""


@dataclass(frozen=True)
class FinishedDrawing:
    """The drawing of a model that has its surface at hand, and no field."""

    finished: ModelSurface

    def field(self) -> None:
        """None: there is no field."""

    def surface(self) -> ModelSurface:
        """The surface."""
        return self.finished


class MuscleModel(Protocol):
    """What the loop asks of a muscle.

    Attributes
    ----------
    name : str
        The muscle's name.
    contact_bone : (n,) ndarray of int
        Index of the bone that a contact point is attached to, -1 where it is free.
    """

    name: str
    contact_bone: np.ndarray

    def contact_points(self) -> np.ndarray:
        """Points (n, 3) that contacts act on, now; number and order never change."""

    def predict(self, before: Mapping[str, np.ndarray], after: Mapping[str, np.ndarray]) -> None:
        """Go along with the bones from one set of poses to the next."""

    def solve(self, contacts: BoneContacts) -> None:
        """Settle under the model's own constraints and these contacts."""

    def settle(self, contacts: BoneContacts) -> None:
        """At rest, where a scene resolves overlap: bring out of the bones what no contact point stands for."""

    def turn(self, which: np.ndarray, transform: np.ndarray) -> None:
        """Move the contact points marked in a bool mask (n,) by a (4, 4) transform."""

    def transform(self, motion: np.ndarray) -> None:
        """Go along with a rigid motion (4, 4), as the muscle is."""

    def snapshot(self) -> Any:
        """Everything that :meth:`restore` needs to go back to this moment."""

    def restore(self, state: Any) -> None:
        """Go back to a snapshot; it can be used again."""

    def activate(self, activation: float) -> None:
        """Take an activation, 0 to 1, that the next :meth:`solve` settles under; for muscles that contract."""

    def material_mesh(self) -> tuple[np.ndarray, np.ndarray]:
        """Vertices and faces of a surface that moves with the material, of constant topology."""

    def drawing(self, contacts: BoneContacts) -> Drawing:
        """The model as it is now, for its surface."""
