"""Parents of bones, the joints between them and their ranges; and a joint as guessed."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from rbfmuscle.importers.guess.parts import Part
from rbfmuscle.scene.joints.tables import JointTable

# Class of bone: its possible parents, the likeliest first, and the kind of joint between.
PARENTS = {
    "ilium": (("pelvis", "fixed"), ("sacrum", "fixed")),
    "ischium": (("ilium", "fixed"), ("pelvis", "fixed")),
    "pubis": (("ilium", "fixed"), ("pelvis", "fixed")),
    "pelvis": (("pelvis", "fixed"), ("sacrum", "fixed")),
    "sacrum": (("pelvis", "fixed"), ("ilium", "fixed")),
    "femur": (("pelvis", "ball"), ("ilium", "ball"), ("ischium", "ball")),
    "patella": (("femur", "hinge"),),
    "tibia": (("femur", "hinge"),),
    "fibula": (("tibia", "fixed"), ("femur", "hinge")),
    "talus": (("tibia", "hinge"), ("fibula", "hinge")),
    "calcaneus": (("talus", "fixed"), ("tibia", "hinge")),
    "foot": (("calcaneus", "fixed"), ("talus", "fixed"), ("foot", "fixed"), ("tibia", "hinge")),
    "vertebra": (("vertebra", "fixed"), ("sacrum", "fixed"), ("pelvis", "fixed")),
    "scapula": (("clavicle", "fixed"), ("rib", "fixed"), ("sternum", "fixed")),
    "clavicle": (("sternum", "fixed"), ("rib", "fixed")),
    "humerus": (("scapula", "ball"),),
    "ulna": (("humerus", "hinge"),),
    "radius": (("ulna", "fixed"), ("humerus", "hinge")),
    "hand": (("radius", "ball"), ("ulna", "ball"), ("hand", "fixed")),
}
ROOTS = ("pelvis", "ilium", "sacrum", "scapula", "rib", "vertebra", "femur", "humerus", "tibia")
# Class of the child: name of its joint with one of its parents above.
JOINTS = {
    "femur": "hip",
    "tibia": "knee",
    "talus": "ankle",
    "patella": "patella",
    "humerus": "shoulder",
    "ulna": "elbow",
}
# Joint: coordinates and ranges [degree] (American Academy of Orthopaedic Surgeons 1965, Joint Motion). Positive as the
# International Society of Biomechanics has it (Wu et al. 2002): flexion, adduction, internal rotation, dorsiflexion.
COORDINATES = {
    "hip": {"flexion": (-30.0, 120.0), "adduction": (-45.0, 30.0), "rotation": (-45.0, 45.0)},
    "knee": {"flexion": (-10.0, 135.0)},
    "ankle": {"dorsiflexion": (-50.0, 20.0)},
}


@dataclass
class JointGuess:
    """A joint as guessed.

    Attributes
    ----------
    parent, child : Part
    kind : str
        ``"ball"``, ``"hinge"``, ``"custom"`` (the patella) or ``"fixed"``.
    centre : (3,) ndarray [scene unit]
    axes : dict of str to (3,) ndarray
        Axis of each coordinate.
    confidence : float
        0 to 1: one minus half the misfit over the greatest allowed, where something was fitted.
    reason, name : str
        Why; of the joint in the scene.
    ranges, rest : dict of str to (float, float), float
        Of coordinates; the value of the first one in the pose of the meshes [degree].
    tables : dict
        ``rotations`` and ``translations`` of a custom joint, as the scene file has them.
    follows : tuple of str
        Full name of the coordinate that the first one follows.
    ligament : (2, 3) ndarray or None
        Ends of a patella's ligament at rest, on it and on the tibia [scene unit].
    """

    parent: Part
    child: Part
    kind: str
    centre: np.ndarray
    axes: dict[str, np.ndarray]
    confidence: float
    reason: str
    name: str = ""
    ranges: dict[str, tuple] = field(default_factory=dict)
    rest: float = 0.0
    tables: dict[str, list] = field(default_factory=dict)
    follows: tuple[str, ...] = ()
    ligament: np.ndarray | None = None

    @property
    def axis(self) -> np.ndarray:
        """Axis (3,) of the first coordinate."""
        return next(iter(self.axes.values()))

    @property
    def coordinate(self) -> str:
        """Full name of the first coordinate."""
        return f"{self.name}.{next(iter(self.axes))}"

    def row(self) -> dict[str, Any]:
        """The joint's table in the scene file [degree, scene unit]."""
        row: dict[str, Any] = {"name": self.name, "parent": self.parent.name, "child": self.child.name}
        row["type"] = self.kind
        if self.kind != "fixed":
            row["centre"] = rounded(self.centre, 6)
        if self.axes and not self.tables:
            row["axes"] = {name: rounded(axis, 6) for name, axis in self.axes.items()}
        row |= self.tables
        facts: dict[str, dict] = {name: {"range": rounded(ends, 1)} for name, ends in self.ranges.items()}
        if self.rest:
            facts.setdefault(next(iter(self.axes)), {})["rest"] = self.rest
        if self.tables:
            facts.setdefault(next(iter(self.axes)), {})["motion"] = "rotation"
        return row | ({"coordinates": facts} if facts else {})

    def pose(self, angle: float) -> np.ndarray:
        """Motion (4, 4) of the child when the first coordinate is turned by an angle [degree] from rest."""
        (name,) = self.axes
        values = [{name: float(np.radians(value))} for value in (self.rest + angle, self.rest)]
        return JointTable(**self.row()).joint().motion(*values)


def rounded(values: ArrayLike, digits: int) -> list[float]:
    """Numbers rounded for the scene file."""
    return np.round(np.asarray(values, dtype=float), digits).tolist()
