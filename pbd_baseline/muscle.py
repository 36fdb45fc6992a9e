"""PBDMuscle: a muscle as a triangle mesh held together by constraints, the baseline of the RBF
muscle.
"""

import math
from collections.abc import Callable, Mapping
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from pbd_baseline.constraints import ContactConstraint
from pbd_baseline.contraction import TENDON_WEIGHT, MeshFibres
from pbd_baseline.rest import PBDOptions, RestState
from pbd_baseline.settling import MeshSettling, MovingSurface
from pbd_baseline.shapes import METHODS, Method
from rbfmuscle.geometry.arrays import to_world
from rbfmuscle.geometry.frames import diameter
from rbfmuscle.geometry.harmonic import blended_motion
from rbfmuscle.geometry.interpolation import SurfaceInterpolation
from rbfmuscle.geometry.surfaces import vertex_areas, vertex_normals
from rbfmuscle.loops import loop
from rbfmuscle.scene.motion import turned_angle
from rbfmuscle.scene.muscles import attachment_frames
from rbfmuscle.scene.objects import Muscle, from_mm
from rbfmuscle.scene.scene import Scene
from rbfmuscle.simulation.contact import BoneContacts
from rbfmuscle.simulation.frame import ModelSurface, SolveLog
from rbfmuscle.simulation.neighbours import SEARCHED
from rbfmuscle.simulation.touching import Body, surface_points

# Bones are looked for within this distance [mm] of the vertices as predicted, and as swept.
REACH = 6.0
FINISHING_REACH = 2.0
# Spacing of the vertices that meet neighbours, of the size, and how high the surface rises between.
SPACING, RISES = 0.015, 4e-4
# Sweeps after which bones are asked again, and the fibres of a muscle that does not contract.
FRESH = 10
# Sweeps at most where a tolerance ends them.
MOST_SWEEPS = 2000
# Rounds of contact and volume after the last sweep, and the depth [mm] that ends them.
FINISHING_ROUNDS = 4
DEPTH = 0.05
# Motion that makes the time of one XPBD step [radian].
STEP_ANGLE = math.radians(2.0)
IDENTITY = np.eye(4)


class PBDState(NamedTuple):
    """What changes of a mesh muscle; ``shape`` is what its method remembers, None for nothing."""

    points: np.ndarray  # (n, 3)
    shape: np.ndarray | None
    time: float
    penetration: float
    log: SolveLog
    activation: float


class PBDMuscle:
    """A mesh muscle of any of the paper's kinds; implements
    ``rbfmuscle.simulation.frame.MuscleModel``.

    Raises SceneError on a muscle that nothing holds, MeshError if its mesh is not a closed,
    consistently oriented surface.
    """

    def __init__(
        self,
        muscle: Muscle,
        scene: Scene,
        options: PBDOptions | None = None,
        *,
        method: Method = METHODS["pbd"],
    ) -> None:
        self.name = muscle.name
        self.options = options or PBDOptions()
        self.rest = RestState.from_muscle(muscle, scene, self.options)
        slack = self.options.slack_ratio
        contracts = muscle.contraction is not None
        self.fibres = (
            MeshFibres(muscle, self.rest, slack=slack) if contracts or slack > 1.0 else None
        )
        stiffer = (
            np.where(self.fibres.tendon, TENDON_WEIGHT, 1.0) if contracts and self.fibres else 1.0
        )
        self.shape = method.shape(self.rest, self.options, stiffer)
        self.sweeps = self.options.iterations or method.sweeps
        self.most_sweeps, self.swept = self.sweeps, 0
        if method.tolerance > 0.0:
            self.sweeps = method.sweeps
            self.most_sweeps = self.options.iterations or MOST_SWEEPS
        self.size = diameter(self.rest.vertices)
        self.still = method.tolerance * self.size
        self.log = SolveLog({"solver_residual": 0.0})
        self._contacts: BoneContacts
        self._surface: MovingSurface | None = None
        frames = attachment_frames(scene.bones, muscle)
        numbers = np.array([frames.index(bone) for bone in self.rest.bones])
        #: Number of the bone, or end of a tendon, that holds each vertex, -1 where it is free.
        self.attached_bone = np.where(
            self.rest.attached_bone < 0, -1, numbers[self.rest.attached_bone]
        )
        self.contact = ContactConstraint(reach=from_mm(REACH, scene.units))
        self.finishing_reach = from_mm(FINISHING_REACH, scene.units)
        self.depth = from_mm(DEPTH, scene.units)
        # The mesh's own numbers of the vertices, for `material_mesh`.
        self._place = np.argsort(self.rest.order)
        self._faces = self.rest.order[self.rest.topology.faces]
        self.points = self.rest.vertices.copy()
        self.time = 1.0
        self.penetration = 0.0

    def contact_points(self) -> np.ndarray:
        """The vertices in this model's own order."""
        return self.points

    def predict(self, before: Mapping[str, np.ndarray], after: Mapping[str, np.ndarray]) -> None:
        """Go along with the bones; held vertices arrive exactly."""
        bones, rest = self.rest.bones, self.rest
        old, new = np.array([[poses[bone] for bone in bones] for poses in (before, after)])
        motions = new @ np.linalg.inv(old)
        motions[(old == new).all(axis=(1, 2))] = IDENTITY  # exactly
        # From each bone to each other one.
        turns = motions[:, None, :3, :3] @ np.swapaxes(motions[:, :3, :3], 1, 2)
        self.time = max(1.0, float(turned_angle(turns).max()) / STEP_ANGLE)
        if not (motions == IDENTITY).all():
            self.points[:] = blended_motion(self.points, rest.weights, motions)
        _place_loop(rest.vertices, rest.attached_bone, new, self.points)

    def begin(self, contacts: BoneContacts) -> MeshSettling:
        """Begin to sweep the shape and contacts inside the iteration; `take` restores the volume on
        what is not in contact last.
        """
        self._contacts = contacts
        if self._surface is not None:
            self._surface.move(self.points)
        return MeshSettling(
            self.points,
            self.rest.inverse_mass,
            self.size,
            self._sweep,
            most=self.most_sweeps,
            still=self.still,
            surface=self._surface,
        )

    def _sweep(self, number: int) -> None:
        """One sweep of this number, in place."""
        fresh = number % FRESH == 0
        if fresh:
            self.contact.find(self._contacts, self.points)
        if self.fibres is not None and (fresh or not self.fibres.passive):
            self.shape.contract(self.fibres, self.points)
        self.shape.sweep(self.points, self.time / self.sweeps)
        self.contact.project(self.points)
        if self.shape.volume_in_sweeps or self.still > 0.0:
            self.shape.restore_volume(self.points, self.contact)

    def take(self, moving: MeshSettling) -> None:
        """Finish where the sweeps ended: contact and volume in turn, half-spaces found again, until
        both hold where the bones are now known to be, or `FINISHING_ROUNDS` are over.
        """
        self.swept = moving.iterations
        for _ in range(FINISHING_ROUNDS):
            depth = self.contact.find(self._contacts, self.points, reach=self.finishing_reach)
            self.contact.project(self.points)
            self.shape.restore_volume(self.points, self.contact)
            if depth <= self.depth:
                break
        self.penetration = self.contact.depth(self.points)
        unsettled = self.still > 0.0 and not moving.moved < self.still
        capped = int(unsettled) + int(self.penetration > self.depth)
        self.log = self.log.add(caps=capped, solver_residual=moving.moved / self.size)

    def body(self) -> Body:
        """What others meet that touch this muscle."""
        vertices, faces = self.rest.vertices, self.rest.topology.faces
        normals = vertex_normals(vertices, faces)
        points = surface_points(vertices, normals, SPACING * self.size, RISES * self.size)
        self._surface = MovingSurface(vertices, faces, SEARCHED * self.size)
        nearest = cKDTree(vertices[points]).query(vertices)[1]
        area = np.asarray(np.bincount(nearest, vertex_areas(vertices, faces)), dtype=np.float64)
        return Body(points, points, area)

    def activate(self, activation: float) -> None:
        """Take an activation, 0 to 1, that the next `solve` settles under."""
        if self.fibres is not None:
            self.fibres.activate(activation)

    def transform(self, motion: np.ndarray) -> None:
        """Go along with a rigid motion (4, 4), as the muscle is."""
        self.points[:] = to_world(self.points, motion)
        self.shape.transform(motion)

    def snapshot(self) -> PBDState:
        """Everything that :meth:`restore` needs."""
        return PBDState(
            self.points.copy(),
            self.shape.snapshot(),
            self.time,
            self.penetration,
            self.log,
            0.0 if self.fibres is None else self.fibres.activation,
        )

    def restore(self, state: PBDState) -> None:
        """Go back to a snapshot."""
        self.points[:] = state.points
        self.shape.restore(state.shape)
        self.time = state.time
        self.penetration = state.penetration
        self.log = state.log
        self.activate(state.activation)

    def material_mesh(self) -> tuple[np.ndarray, np.ndarray]:
        """Vertices and faces, numbered as in the muscle's mesh but for the order of the faces."""
        return np.take(self.points, self._place, axis=0), self._faces

    def follower(self, points: np.ndarray) -> Callable[[], np.ndarray]:
        """What gives the present places (n, 3) of points (n, 3) of the muscle at rest, by
        interpolation of the displacement of the surface.
        """
        inside = SurfaceInterpolation(self.rest.vertices, points)
        return lambda: inside(self.points)

    def surface(self, contacts: BoneContacts) -> ModelSurface:
        """The mesh as it is now, where it overlapped bones at rest taken out of them."""
        quantities, notes, self.log = self.log.take()
        quantities |= {
            "solver_penetration_max": self.penetration,
            "solver_sweeps": float(self.swept),
        }
        shown = contacts.lifted(self.points)
        return ModelSurface(np.take(shown, self._place, axis=0), self._faces, quantities, notes)


@loop
def _place_loop(rest, attached_bone, poses, points):
    """Put held vertices where their bones' poses (b, 4, 4) take them."""
    for i in range(len(points)):
        b = attached_bone[i]
        if b >= 0:
            for a in range(3):
                points[i, a] = poses[b, a, 3]
                for k in range(3):
                    points[i, a] += poses[b, a, k] * rest[i, k]
