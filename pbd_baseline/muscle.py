"""PBDMuscle: a muscle as a triangle mesh held together by constraints, the baseline of the RBF muscle."""

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from pbd_baseline.contact import ContactConstraint
from pbd_baseline.contraction import TENDON_WEIGHT, MeshFibres
from pbd_baseline.motion import carry
from pbd_baseline.options import PBDOptions
from pbd_baseline.rest import RestState
from pbd_baseline.self_collision.contact import SoundContact
from pbd_baseline.self_collision.ridges import Ridges
from pbd_baseline.self_collision.untangling import Untangling
from pbd_baseline.shapes import METHODS, sweeps
from rbfmuscle.scene.objects import Muscle
from rbfmuscle.scene.scene import Scene
from rbfmuscle.simulation.contact import BoneContacts
from rbfmuscle.simulation.frame import FinishedDrawing, ModelSurface

# Bones are looked for within this distance [mm] of the vertices as predicted, and as swept.
REACH = 6.0
FINISHING_REACH = 2.0
# Rounds of contact and volume after the last sweep, and the depth [mm] that ends them.
FINISHING_ROUNDS = 4
DEPTH = 0.05
# Solves that bring what is held out of bones at rest, at most.
SETTLING_ROUNDS = 8
# Of a muscle kept sound: what faces away from a bone keeps this share of an edge from it.
SKIN = 0.2
# Share of its velocity that a vertex of `pbd-paper` keeps.
DAMPING = 0.99
# Motion that makes the time of one XPBD step [radian].
STEP_ANGLE = math.radians(2.0)


class PBDMuscle:
    """A mesh muscle of any of the paper's kinds; implements ``rbfmuscle.simulation.frame.MuscleModel``.

    Parameters
    ----------
    muscle : Muscle
        Mesh, attachments and fibres, from a scene.
    scene : Scene
    options : PBDOptions
        ``method`` chooses the kind.

    Raises
    ------
    SceneError
        On a muscle that nothing holds.
    MeshError
        If the mesh is not a closed, consistently oriented surface.
    """

    def __init__(self, muscle: Muscle, scene: Scene, options: PBDOptions | None = None) -> None:
        self.name = muscle.name
        self.options = options or PBDOptions()
        self.rest = RestState.from_muscle(muscle, scene, self.options)
        self.fibres: Any = MeshFibres(muscle, self.rest) if muscle.contraction is not None else None
        stiffer = 1.0 if self.fibres is None else np.where(self.fibres.tendon, TENDON_WEIGHT, 1.0)
        method = METHODS[self.options.method]
        kind: Any = method.shape
        self.shape, self.as_printed = kind(self.rest, self.options, stiffer), method.as_printed
        self.sweeps = sweeps(self.options)
        numbers = _bone_numbers(self.rest, scene)
        self.contact = _contact(self.rest, scene, self.options, numbers)
        self.sound = self.contact if isinstance(self.contact, SoundContact) else None
        self.untangling = Untangling(self.rest) if self.options.sound else None
        self.finishing_reach, self.depth = scene.length(FINISHING_REACH), scene.length(DEPTH)
        self.contact_bone = numbers[self.contact.columns].max(axis=1)
        self.points = self.rest.vertices.copy()
        self.before = self.points.copy()
        self.time = 1.0
        self.penetration = 0.0

    def contact_points(self) -> np.ndarray:
        """The vertices in this model's own order, then the middles of edges and faces where these are asked for."""
        return self.points if self.options.contact == "vertices" else self.contact.place(self.points)

    def predict(self, before: Mapping[str, np.ndarray], after: Mapping[str, np.ndarray]) -> None:
        """Go along with the bones; held vertices arrive exactly."""
        motions = np.array([_relative(before[bone], after[bone]) for bone in self.rest.bones])
        self.time = max(1.0, _largest_angle(motions) / STEP_ANGLE)
        if self.as_printed:
            velocity = self.points - self.before
            self.before = self.points.copy()
            self.points += DAMPING * velocity
        else:
            carry(self.points, self.rest.weights, motions)
        for b, bone in enumerate(self.rest.bones):
            held = self.rest.attached_bone == b
            self.points[held] = self.rest.vertices[held] @ after[bone][:3, :3].T + after[bone][:3, 3]

    def solve(self, contacts: BoneContacts) -> None:
        """Sweep the shape, contacts inside the iteration and last, the volume on what is not in contact."""
        if self.sound is not None:
            self.sound.free_held(contacts, self.points)
        self.contact.find(contacts, self.points)
        for _ in range(self.sweeps):
            if self.fibres is not None:
                self.shape.contract(self.fibres, self.points)
            self.shape.sweep(self.points, self.time / self.sweeps)
            self.contact.project(self.points)
            if self.shape.volume_in_sweeps:
                self.shape.restore_volume(self.points, self.contact)
        self._finish(contacts)
        if self.untangling is not None:
            self.untangling.untangle(self.points, lambda: self._settle(contacts))

    def activate(self, activation: float) -> None:
        """Take an activation, 0 to 1, that the next `solve` settles under."""
        self.fibres.law.activate(activation)

    def settle(self, contacts: BoneContacts) -> None:
        """Bring held vertices and faces out of the bones at rest, where the muscle is kept sound."""
        if self.sound is None:
            return
        for _ in range(SETTLING_ROUNDS):
            if self.sound.overlap(contacts, self.points) <= self.depth:
                return
            self.solve(contacts)

    def turn(self, which: np.ndarray, transform: np.ndarray) -> None:
        """Move the vertices marked in a bool mask (n,) by a (4, 4) transform; held ones stay."""
        which = self._vertices_of(which) & (self.rest.attached_bone < 0)
        self.points[which] = self.points[which] @ transform[:3, :3].T + transform[:3, 3]

    def _vertices_of(self, which):
        marked = np.zeros(len(self.points), dtype=bool)
        marked[self.contact.columns[which]] = True
        return marked

    def transform(self, motion: np.ndarray) -> None:
        """Go along with a rigid motion (4, 4), as the muscle is."""
        for points in (self.points, self.before):
            points[:] = points @ motion[:3, :3].T + motion[:3, 3]
        self.shape.transform(motion)

    def snapshot(self) -> Any:
        """Everything that :meth:`restore` needs."""
        return self.points.copy(), self.before.copy(), self.shape.snapshot(), self.time, self.penetration

    def restore(self, state: Any) -> None:
        """Go back to a snapshot."""
        points, before, shape, self.time, self.penetration = state
        self.points[:], self.before = points, before.copy()
        self.shape.restore(shape)

    def material_mesh(self) -> tuple[np.ndarray, np.ndarray]:
        """Vertices and faces, numbered as in the muscle's mesh but for the order of the faces."""
        vertices = np.empty_like(self.points)
        vertices[self.rest.order] = self.points
        return vertices, self.rest.order[self.rest.topology.faces]

    def drawing(self, contacts: BoneContacts) -> FinishedDrawing:
        """What gives the mesh as it is now."""
        return FinishedDrawing(
            ModelSurface(*self.material_mesh(), {"solver_penetration_max": self.penetration})
        )

    def volume(self) -> float:
        """Enclosed volume now [unit^3]."""
        return self.rest.volume.volume(self.points)

    def _finish(self, contacts):
        """Contact and volume in turn until both hold where the bones are now known to be.

        The half-spaces are found again where the last round still left something to do.
        """
        self.penetration = self.contact.find(contacts, self.points, reach=self.finishing_reach)
        for k in range(FINISHING_ROUNDS):
            settled = self.penetration <= self.depth
            self.contact.project(self.points)
            self.shape.restore_volume(self.points, self.contact)
            if settled or k == FINISHING_ROUNDS - 1:
                self.penetration = self.contact.depth(self.points)
                return
            self.penetration = self.contact.find(contacts, self.points, reach=self.finishing_reach)

    def _settle(self, contacts):
        """A round of contact and volume, two of contact where the first had far to go."""
        for _ in range(2):
            far = self.contact.find(contacts, self.points, reach=self.finishing_reach) > self.depth
            self.contact.project(self.points)
            if not far:
                break
        self.shape.restore_volume(self.points, self.contact)
        self.penetration = self.contact.depth(self.points)


def _bone_numbers(rest, scene):
    """Number in the scene of the bone that holds each vertex, -1 where it is free."""
    names = [bone.name for bone in scene.bones]
    numbers = np.array([names.index(bone) for bone in rest.bones])
    return np.where(rest.attached_bone < 0, -1, numbers[rest.attached_bone])


def _contact(rest, scene, options, numbers):
    """The contact that the options ask for."""
    columns, shares = _contact_carriers(rest, faces_too=options.contact == "faces")
    usual = {"reach": scene.length(REACH), "nearest_only": METHODS[options.method].as_printed}
    if not options.sound:
        return ContactConstraint(columns, shares, **usual)
    faces, edge = rest.topology.faces, rest.edge()
    ridges = Ridges(faces, [bone.mesh for bone in scene.bones], cell=edge, deepest=edge)
    held = np.flatnonzero(numbers >= 0)
    return SoundContact(
        columns,
        shares,
        faces=faces,
        held=held,
        attached_bone=numbers[held],
        skin=SKIN * edge,
        ridges=ridges,
        **usual,
    )


def _contact_carriers(rest, *, faces_too):
    """Vertices and shares of the contact points: columns and shares (p, 3)."""
    count = len(rest.vertices)
    columns, shares = (
        [np.repeat(np.arange(count)[:, None], 3, axis=1)],
        [np.tile([1.0, 0.0, 0.0], (count, 1))],
    )
    if faces_too:
        edges, faces = rest.topology.edges, rest.topology.faces
        columns += [edges[:, [0, 1, 1]], faces]
        shares += [np.tile([0.5, 0.5, 0.0], (len(edges), 1)), np.full((len(faces), 3), 1.0 / 3.0)]
    return np.ascontiguousarray(np.concatenate(columns)), np.concatenate(shares)


def _relative(before, after):
    if np.array_equal(before, after):
        return np.eye(4)
    return after @ np.linalg.inv(before)


def _largest_angle(motions):
    """Largest angle between any two of the motions [radian]."""
    largest = 0.0
    for i, one in enumerate(motions):
        for other in motions[:i]:
            turn = one[:3, :3] @ other[:3, :3].T
            largest = max(largest, math.acos(min(1.0, max(-1.0, 0.5 * (np.trace(turn) - 1.0)))))
    return largest
