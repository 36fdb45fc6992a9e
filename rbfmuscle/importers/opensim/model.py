"""An OpenSim model as read: bodies, joints, couplings, meshes and muscles, in metres and
radians.
"""

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from rbfmuscle.scene.joints.joint import Coordinate, Coupling, Joint, ordered, resolve
from rbfmuscle.validation import SceneError

GROUND = "ground"


@dataclass
class ModelJoint(Joint):
    """A joint between two bodies: ``X_child = X_parent P J(q) C^-1``, with P and C the joint's
    frames (4, 4) in them.

    Its own centre is the origin.
    """

    parent_frame: np.ndarray = field(default_factory=lambda: np.eye(4))
    child_frame: np.ndarray = field(default_factory=lambda: np.eye(4))


@dataclass
class ModelMesh:
    """A mesh that a body shows: scaled by three factors, then moved by ``transform`` (4, 4) into
    the body.
    """

    file: str
    body: str
    scale: tuple[float, ...]
    transform: np.ndarray


@dataclass
class WrapShape:
    """A cylinder (z), ellipsoid or sphere that a path goes around, in a frame (4, 4) of a body
    [metre].
    """

    body: str
    frame: np.ndarray
    radii: np.ndarray  # of the ellipsoid; of a cylinder two radii and half the length
    kind: str
    quadrant: str


@dataclass
class ModelMuscle:
    """A muscle of the model: points by body in their frames [metre], shapes it wraps around, volume
    [m3].
    """

    name: str
    points: list[tuple[str, np.ndarray]]
    wraps: list[WrapShape] = field(default_factory=list)
    volume: float = 0.0


@dataclass
class OsimModel:
    """All that is taken from an ``.osim`` file; ``bodies`` begin with ``"ground"``.

    ``notes`` say what is in the file and is not taken, or taken otherwise than a user may expect.
    """

    name: str
    version: int
    path: Path
    bodies: list[str] = field(default_factory=list)
    joints: list[ModelJoint] = field(default_factory=list)
    couplings: list[Coupling] = field(default_factory=list)
    meshes: list[ModelMesh] = field(default_factory=list)
    muscles: list[ModelMuscle] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)

    def coordinates(self) -> dict[str, Coordinate]:
        """Every coordinate by its bare name, which is unique in a model."""
        return {name: facts for joint in self.joints for name, facts in joint.coordinates.items()}

    def tree(self) -> Iterator[tuple[ModelJoint, bool]]:
        """Joints from the ground outwards; the flag says that the joint is walked from its child to
        its parent.

        A joint between two bodies that are both reached already closes a loop and is left out.
        """
        reached, waiting = {GROUND}, list(self.joints)
        while ready := next(
            (j for j in waiting if (j.parent in reached) != (j.child in reached)), None
        ):
            waiting.remove(ready)
            backward = ready.child in reached
            reached |= {ready.parent, ready.child}
            yield ready, backward

    def transforms(self, values: dict[str, float] | None = None) -> dict[str, np.ndarray]:
        """The (4, 4) transform from every body to the ground [metre], at values of coordinates by
        bare names.
        """
        resolved = resolve(values or {}, self.coordinates(), self.couplings)
        found = {body: np.eye(4) for body in self.bodies}
        for joint, backward in self.tree():
            moved = joint.displacement(resolved)
            across = joint.parent_frame if moved is None else joint.parent_frame @ moved
            across = across @ np.linalg.inv(joint.child_frame)
            if backward:
                found[joint.parent] = found[joint.child] @ np.linalg.inv(across)
            else:
                found[joint.child] = found[joint.parent] @ across
        return found


def finish(model: OsimModel) -> OsimModel:
    """The model, what is not connected noted; SceneError if names are shared, or if one names what
    is not there.
    """
    coordinates = [name for joint in model.joints for name in joint.coordinates]
    joints = [joint.name for joint in model.joints]
    for what, names in (("bodies", model.bodies), ("joints", joints), ("coordinates", coordinates)):
        for name, count in Counter(names).items():
            if count > 1:
                raise SceneError(f"two {what} are named {name!r}; rename one")
    for joint in model.joints:
        for body in (joint.parent, joint.child):
            if body not in model.bodies:
                raise SceneError(
                    f"joint {joint.name!r}: there is no body {body!r}; correct its frames"
                )
    for coupling in model.couplings:
        for name in (coupling.coordinate, *coupling.of):
            if name not in coordinates:
                raise SceneError(
                    f"a coupling names coordinate {name!r}, which no joint has; correct it"
                )
    model.couplings = ordered(model.couplings)
    used = [joint.name for joint, _ in model.tree()]
    for joint in model.joints:
        if joint.name not in used:
            ends = f"({joint.parent} to {joint.child})"
            model.notes.append(
                f"joint {joint.name!r} {ends} closes a loop or is not connected: not taken"
            )
    held = {GROUND} | {b for j in model.joints if j.name in used for b in (j.parent, j.child)}
    for body in model.bodies:
        if body not in held:
            model.notes.append(
                f"body {body!r} has no joint to the ground: it stays where its file puts it"
            )
    return model
