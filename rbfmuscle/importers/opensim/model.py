"""An OpenSim model as read: bodies, joints, couplings and meshes, in metres and radians."""

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from rbfmuscle.importers.opensim.muscle_paths import ModelMuscle
from rbfmuscle.scene.joints.joint import KINDS, Coordinate, Coupling, Joint, TransformAxis
from rbfmuscle.scene.joints.skeleton import ordered
from rbfmuscle.validation import SceneError

GROUND = "ground"
# What OpenSim calls a joint -> kind in our table, where the coordinates are in the same order.
JOINT_KINDS = {
    "WeldJoint": "fixed",
    "PinJoint": "hinge",
    "SliderJoint": "slider",
    "UniversalJoint": "universal",
    "BallJoint": "ball",
    "GimbalJoint": "ball",
    "PlanarJoint": "planar",
    "FreeJoint": "free",
    "CustomJoint": "custom",
}


@dataclass
class ModelJoint:
    """A joint between two bodies: ``X_child = X_parent P J(q) C^-1``.

    Attributes
    ----------
    parent, child : str
    parent_frame, child_frame : (4, 4) ndarray
        P and C: the joint's frames in their bodies.
    moves : Joint
        The motion J itself, its frame the identity.
    """

    name: str
    kind: str
    parent: str
    child: str
    parent_frame: np.ndarray
    child_frame: np.ndarray
    moves: Joint


@dataclass
class ModelMesh:
    """A mesh that a body shows: scaled by three factors, then moved by ``transform`` (4, 4) into the body."""

    file: str
    body: str
    scale: tuple[float, float, float]
    transform: np.ndarray
    visible: bool = True


@dataclass
class OsimModel:
    """All that is taken from an ``.osim`` file.

    Attributes
    ----------
    bodies : list of str
        ``"ground"`` first.
    notes : list of str
        What is in the file and is not taken, or taken otherwise than a user may expect.
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
        return {name: facts for joint in self.joints for name, facts in joint.moves.coordinates.items()}

    def resolve(self, values: dict[str, float] | None = None) -> dict[str, float]:
        """Return the value of every coordinate when some are set: locks, clamps and couplings honoured.

        Parameters
        ----------
        values : dict of str to float, optional
            Bare names [radian, metre]; absent ones keep their default.
        """
        values = values or {}
        found = {n: c.honoured(values[n]) if n in values else c.rest for n, c in self.coordinates().items()}
        for coupling in self.couplings:
            found[coupling.coordinate] = coupling.function(*(found[name] for name in coupling.of))
        return found

    def tree(self) -> Iterator[tuple[ModelJoint, bool]]:
        """Joints from the ground outwards; the flag says that the joint is walked from its child to its parent.

        A joint between two bodies that are both reached already closes a loop and is left out.
        """
        reached, waiting = {GROUND}, list(self.joints)
        while waiting:
            ready = next((j for j in waiting if (j.parent in reached) != (j.child in reached)), None)
            if ready is None:
                return
            waiting.remove(ready)
            backward = ready.child in reached
            reached |= {ready.parent, ready.child}
            yield ready, backward

    def transforms(self, values: dict[str, float] | None = None) -> dict[str, np.ndarray]:
        """Return the (4, 4) transform from every body to the ground [metre].

        Parameters
        ----------
        values : dict of str to float, optional
            As for `resolve`.
        """
        resolved = self.resolve(values)
        found = {GROUND: np.eye(4)}
        for joint, backward in self.tree():
            moved = joint.moves.displacement({n: resolved[n] for n in joint.moves.coordinates})
            across = joint.parent_frame @ (np.eye(4) if moved is None else moved)
            across = across @ np.linalg.inv(joint.child_frame)
            if backward:
                found[joint.parent] = found[joint.child] @ np.linalg.inv(across)
            else:
                found[joint.child] = found[joint.parent] @ across
        return {body: found.get(body, np.eye(4)) for body in self.bodies}


def finish(model: OsimModel) -> OsimModel:
    """Check what was read, note what hangs loose, and return the model.

    Raises
    ------
    SceneError
        If two bodies or two coordinates share a name, or a joint names a body that is not there.
    """
    for what, names in (
        ("bodies", model.bodies),
        ("joints", [joint.name for joint in model.joints]),
        ("coordinates", [name for joint in model.joints for name in joint.moves.coordinates]),
    ):
        for name in names:
            if names.count(name) > 1:
                raise SceneError(f"two {what} are named {name!r}; rename one")
    for joint in model.joints:
        for body in (joint.parent, joint.child):
            if body not in model.bodies:
                raise SceneError(
                    f"joint {joint.name!r}: there is no body {body!r}; correct the joint's frames"
                )
    used = [joint for joint, _ in model.tree()]
    for joint in model.joints:
        if joint not in used:
            model.notes.append(
                f"joint {joint.name!r} ({joint.parent} to {joint.child}) closes a loop or hangs on nothing: not taken"
            )
    held = {GROUND, *(joint.parent for joint in used), *(joint.child for joint in used)}
    for body in model.bodies:
        if body not in held:
            model.notes.append(f"body {body!r} has no joint to the ground: it stands where its file puts it")
    known = model.coordinates()
    for coupling in list(model.couplings):
        lost = [name for name in (coupling.coordinate, *coupling.of) if name not in known]
        if lost:
            raise SceneError(
                f"a coupling names coordinate {lost[0]!r}, which no joint has; correct the constraint"
            )
    model.couplings = ordered(model.couplings)
    return model


def joint_motion(
    name: str, kind: str, coordinates: dict[str, Coordinate], axes: dict[str, TransformAxis]
) -> Joint:
    """Return the motion J of a joint, in its own frame.

    Parameters
    ----------
    kind : str
        A key of `KINDS`.
    coordinates : dict of str to Coordinate
        In the order of the file.
    axes : dict of str to TransformAxis
        ``rotation1`` ... ``translation3`` of a custom joint; else empty.
    """
    facts = KINDS[kind]
    if kind == "custom":
        rotations = tuple(axes[f"rotation{k}"] for k in (1, 2, 3) if f"rotation{k}" in axes)
        translations = tuple(axes[f"translation{k}"] for k in (1, 2, 3) if f"translation{k}" in axes)
    else:
        names = list(coordinates)
        count = len(facts.rotations)
        rotations = tuple(TransformAxis(a, (n,)) for a, n in zip(facts.rotations, names))
        translations = tuple(TransformAxis(a, (n,)) for a, n in zip(facts.translations, names[count:]))
    return Joint(name, "", "", np.eye(4), coordinates, rotations, translations, kind)


def motion_kinds(kind: str, names: list[str], axes: dict[str, TransformAxis], slopes: dict) -> list[str]:
    """Return what each coordinate of a joint is, by OpenSim's rule.

    In a custom joint a coordinate is an angle or a length where it drives an axis of that sort by a linear function
    of slope 1 or -1, the last such axis deciding; else it is coupled.

    Parameters
    ----------
    slopes : dict of str to float
        Slope of each axis whose function is a plain linear one.
    """
    facts = KINDS[kind]
    if kind != "custom":
        return (["rotation"] * len(facts.rotations) + ["translation"] * len(facts.translations))[: len(names)]
    found = dict.fromkeys(names, "coupled")
    for slot in ("rotation", "translation"):
        for k in (1, 2, 3):
            axis = axes.get(f"{slot}{k}")
            if (
                axis is not None
                and math.fabs(slopes.get(f"{slot}{k}", 0.0)) == 1.0
                and len(axis.coordinates) == 1
            ):
                found[axis.coordinates[0]] = slot
    return [found[name] for name in names]
