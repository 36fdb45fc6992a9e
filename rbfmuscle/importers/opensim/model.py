"""An OpenSim model as read: bodies, joints, couplings, meshes and muscles, in metres and
radians.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np

from rbfmuscle.scene.joints import (
    Coordinate,
    Coupling,
    Joint,
    all_coordinates,
    coordinate_values,
    full_name,
)

GROUND = "ground"


@dataclass
class ModelJoint(Joint):
    """A joint between two bodies: ``X_child = X_parent P J(q) C^-1``, with P and C the joint's
    frames (4, 4) in them.

    Its own centre is the origin.
    """

    parent_frame: np.ndarray = field(default_factory=lambda: np.eye(4))
    child_frame: np.ndarray = field(default_factory=lambda: np.eye(4))

    def across(self, values: Mapping[str, float]) -> np.ndarray:
        """The child's frame (4, 4) in the parent's, at values of coordinates by full names."""
        own = {name: values[f"{self.name}.{name}"] for name in self.coordinates}
        return self.parent_frame @ self.displacement(own) @ np.linalg.inv(self.child_frame)


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

    ``title`` is its type and its name in the file.
    """

    name: str
    points: list[tuple[str, np.ndarray]]
    wraps: list[WrapShape] = field(default_factory=list)
    volume: float = 0.0
    title: str = ""


@dataclass
class ModelConstraint:
    """A constraint between two bodies that is not taken, and its type and name in the file."""

    title: str
    bodies: tuple[str, str]


class Walk(NamedTuple):
    """How the bodies hang together.

    ``steps`` are joints from the roots outwards, with whether each is walked from its child to its
    parent; ``roots`` the bodies that no joint joins to those before them; ``left`` the joints
    between two bodies that are joined already: each closes a loop.
    """

    steps: list[tuple[ModelJoint, bool]]
    roots: list[str]
    left: list[ModelJoint]


@dataclass
class OsimModel:
    """All that is taken from an ``.osim`` file; ``bodies`` begin with ``"ground"``.

    ``welds`` are its weld constraints, as joints. ``notes`` say what is in the file and is not
    taken, or taken otherwise than a user may expect; ``doubts`` what makes the scene another one
    than the model.
    """

    name: str
    version: int
    path: Path
    bodies: list[str] = field(default_factory=list)
    joints: list[ModelJoint] = field(default_factory=list)
    welds: list[ModelJoint] = field(default_factory=list)
    couplings: list[Coupling] = field(default_factory=list)
    constraints: list[ModelConstraint] = field(default_factory=list)
    meshes: list[ModelMesh] = field(default_factory=list)
    muscles: list[ModelMuscle] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    doubts: list[str] = field(default_factory=list)

    def coordinates(self) -> dict[str, Coordinate]:
        """Every coordinate by its full name, joint.coordinate."""
        return all_coordinates(list(self.joints))

    def walk(self, *, welds: bool = True) -> Walk:
        """How the bodies hang together, by joints and, unless told otherwise, by weld constraints.

        A weld constraint comes after the joints, a joint that leaves its body free after both.
        """
        joints = [*self.joints, *(self.welds if welds else [])]
        waiting = sorted(joints, key=lambda joint: joint.kind == "free")
        steps: list[tuple[ModelJoint, bool]] = []
        roots: list[str] = []
        reached: set[str] = set()
        for body in [GROUND, *_by_depth(self.bodies, joints)]:
            if body in reached:
                continue
            reached.add(body)
            roots.append(body)
            while ready := next(
                (j for j in waiting if (j.parent in reached) != (j.child in reached)), None
            ):
                waiting.remove(ready)
                steps.append((ready, ready.child in reached))
                reached |= {ready.parent, ready.child}
        return Walk(steps, roots, waiting)

    def resolved(self, values: Mapping[str, float] | None = None) -> dict[str, float]:
        """Every coordinate's value by its full name; bare names may be given where one joint has
        them.
        """
        known = self.coordinates()
        asked = {full_name(n, list(known), context="pose"): v for n, v in (values or {}).items()}
        return coordinate_values(asked, known, self.couplings)

    def transforms(
        self, values: Mapping[str, float] | None = None, *, welds: bool = True
    ) -> dict[str, np.ndarray]:
        """The (4, 4) transform from every body to the ground [metre], at values of coordinates."""
        resolved = self.resolved(values)
        found = {body: np.eye(4) for body in self.bodies}
        for joint, backward in self.walk(welds=welds).steps:
            across = joint.across(resolved)
            if backward:
                found[joint.parent] = found[joint.child] @ np.linalg.inv(across)
            else:
                found[joint.child] = found[joint.parent] @ across
        return found


def _by_depth(bodies: list[str], joints: list[ModelJoint]) -> list[str]:
    """Bodies that are no joint's child, then the others: the order in which roots are chosen."""
    children = {joint.child for joint in joints}
    return sorted(bodies, key=lambda body: body in children)


def joints_between(walk: Walk, first: str, second: str) -> list[ModelJoint]:
    """The joints on the way from a body to another; none where they have different roots."""
    above = {
        (joint.parent if backward else joint.child): (
            joint,
            joint.child if backward else joint.parent,
        )
        for joint, backward in walk.steps
    }
    chains = []
    for name in (first, second):
        chain = []
        while name in above:
            joint, name = above[name]
            chain.append(joint)
        chains.append((chain, name))
    (one, root), (two, other) = chains
    if root != other:
        return []
    return [j for j in one if j not in two] + [j for j in reversed(two) if j not in one]
