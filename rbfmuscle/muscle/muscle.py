"""RBFMuscle: an implicit RBF surface whose centres move with an elastic solid."""

from collections.abc import Mapping

import numpy as np

from rbfmuscle.geometry.rest_frame import RestFrame
from rbfmuscle.implicit.field import RBFField
from rbfmuscle.implicit.placement.lattice import Lattice
from rbfmuscle.muscle.activation import FibrePull
from rbfmuscle.muscle.drawing import Placement, SurfaceBuilder
from rbfmuscle.muscle.fibres import fibre_directions, rise
from rbfmuscle.muscle.options import RBFOptions
from rbfmuscle.muscle.rest import LEAST_ATTACHED, RestState
from rbfmuscle.muscle.solid import EmbeddedSolid, SolidState
from rbfmuscle.scene.objects import Muscle
from rbfmuscle.scene.scene import Scene
from rbfmuscle.simulation.contact import BoneContacts
from rbfmuscle.simulation.frame import Mesh, ModelSurface

# Neighbours meet a muscle at contact points so far apart, of the side of a lattice cell, which has
# three nodes on it.
DETAIL = 0.3


class RBFMuscle:
    """A muscle as the zero level set of an RBF field with moving centres.

    Implements ``rbfmuscle.simulation.frame.MuscleModel``.

    Parameters
    ----------
    muscle : Muscle
        Mesh, attachments and fibres, from a scene.
    scene : Scene
    options : RBFOptions

    Attributes
    ----------
    points : (K, 3) ndarray
        The centres now.
    rest : RestState
    solid : EmbeddedSolid
        The elastic solid that carries the free centres.
    law : FibrePull or None
        Of a muscle that contracts.

    Raises
    ------
    SceneError
        If the placement cannot be had or no centre is left free to move.

    Examples
    --------
    >>> from rbfmuscle import phantom_scene
    >>> scene = phantom_scene(end=0.0)
    >>> muscle = RBFMuscle(scene.muscles[0], scene)
    >>> muscle.contact_points().shape[1]
    3
    """

    def __init__(self, muscle: Muscle, scene: Scene, options: RBFOptions | None = None) -> None:
        self.name = muscle.name
        self.options = options or RBFOptions()
        self.rest = RestState.from_muscle(muscle, scene, self.options)
        self.solid, self.law = _build_solid(muscle, scene, self.rest, self.options)
        self.drawer = SurfaceBuilder(muscle, scene, self.rest, self.options)
        names = scene.holders(muscle)
        numbers = np.array([names.index(bone) for bone in self.rest.bones])
        self.detail = DETAIL * self.solid.side
        self.contact_bone = np.where(self.solid.owner < 0, -1, numbers[self.solid.owner])
        self.points = self.rest.centres.copy()
        # Contact points, and the centres and nodes that they belong to.
        self._placed: tuple[np.ndarray, np.ndarray, np.ndarray] | None = None

    def contact_points(self) -> np.ndarray:
        """Centres, then surface samples, (K + S, 3)."""
        if (
            self._placed is None
            or self._placed[0] is not self.points
            or self._placed[1] is not self.solid.shown
        ):
            points = self.solid.carry()
            points[: len(self.points)] = self.points
            self._placed = self.points, self.solid.shown, points
        return self._placed[2].copy()

    def material_mesh(self) -> Mesh:
        """The samples and their triangulation: a material surface of constant topology."""
        return self.contact_points()[len(self.points) :], self.rest.sample_faces

    def predict(self, before: Mapping[str, np.ndarray], after: Mapping[str, np.ndarray]) -> None:
        """Go along with the bones; held centres arrive exactly."""
        rest = self.rest
        motions = np.array([after[bone] @ np.linalg.inv(before[bone]) for bone in rest.bones])
        points = self.points.copy()
        for b, bone in enumerate(rest.bones):
            held = rest.held[rest.attached_bone[rest.held] == b]
            points[held] = rest.centres[held] @ after[bone][:3, :3].T + after[bone][:3, 3]
        self.solid.move(motions, [after[bone] for bone in rest.bones])
        self.points = self.solid.centres(points)

    def solve(self, contacts: BoneContacts) -> None:
        """Solve for the equilibrium under elasticity, volume and contact at the bones' present
        poses.
        """
        self.solid.settle(contacts)
        self.points = self.solid.centres(self.points)

    def make_room(self, contacts: BoneContacts) -> None:
        """Move what is shown out of the planes of neighbours."""
        self.solid.make_room(contacts)
        self.points = self.solid.centres(self.points)

    def activate(self, activation: float) -> None:
        """Take an activation, 0 to 1, that the next `solve` settles under."""
        if self.law is not None:
            self.law.activate(activation)

    def turn(self, which: np.ndarray, transform: np.ndarray) -> None:
        """Move the centres that carry contact points marked in a bool mask by a (4, 4) transform;
        held ones stay.
        """
        self.solid.turn(which, transform)
        self.points = self.solid.centres(self.points)

    def transform(self, motion: np.ndarray) -> None:
        """Go along with a rigid motion (4, 4), as the muscle is."""
        self.points = self.points @ motion[:3, :3].T + motion[:3, 3]
        self.solid.transform(motion)

    def snapshot(self) -> tuple[np.ndarray, SolidState]:
        """Everything that :meth:`restore` needs."""
        return self.points.copy(), self.solid.snapshot()

    def restore(self, state: tuple[np.ndarray, SolidState]) -> None:
        """Go back to a snapshot."""
        points, solid = state
        self.points = points.copy()
        self.solid.restore(solid)

    def normals(self) -> np.ndarray:
        """Unit normals at the centres, turned with the local deformation by its cofactor, (K,
        3).
        """
        return self.solid.turned_normals(self.rest.normals)

    def field(self) -> RBFField:
        """The RBF field through the present centres."""
        return self.rest.field(self.points, self.normals())

    def carried_mesh(self) -> Mesh:
        """The shown mesh where the solid carries it; the samples where marching cubes show the
        surface.
        """
        shown = self.drawer.shown
        if shown is None:
            return self.material_mesh()
        return self.solid.follow(shown.rest), shown.mesh.faces

    def surface(self, contacts: BoneContacts) -> ModelSurface:
        """The closed surface at the rest volume, cut by what lies in the way."""
        carried, _ = self.carried_mesh()
        now = Placement(self.points, self.normals(), self.contact_points(), carried)
        return self.drawer.draw(now, contacts)


def _build_solid(
    muscle: Muscle, scene: Scene, rest: RestState, options: RBFOptions
) -> tuple[EmbeddedSolid, FibrePull | None]:
    """The solid that carries the centres, and the law of its fibres where the muscle contracts."""
    frame, faces = (
        RestFrame(np.asarray(muscle.mesh.vertices, dtype=float)),
        np.asarray(muscle.mesh.faces),
    )
    points = rest.contact_points()
    centres = len(rest.centres)
    owner = rest.attached_bone
    held = centres + np.flatnonzero(owner[centres:] >= 0)
    for bone in range(len(rest.bones)):
        if (owner[held] == bone).sum() < LEAST_ATTACHED:
            held = np.concatenate([held, np.flatnonzero(owner[:centres] == bone)])
    solid = EmbeddedSolid(
        Lattice(frame.local, faces, options.nodes),
        frame,
        points,
        owner.copy(),
        held,
        free=rest.free,
        count=centres,
        area=float(muscle.mesh.area) / len(rest.samples),
        iterations=options.iterations,
        bones={
            bone.name: (np.asarray(bone.mesh.vertices), np.asarray(bone.mesh.faces))
            for bone in scene.bones
        },
    )
    axis = points[held].mean(axis=0) - points.mean(axis=0)
    along = fibre_directions(solid.quad_points, rise(solid), muscle.fibres, fallback=axis)
    count = len(along)
    solid.take_fibres(
        solid.fibres._replace(
            direction=np.ascontiguousarray(along),
            passive=np.full(count, 1.5 * (options.fibre_ratio - 1.0)),
            lower=np.full(count, 1.0 / options.slack),
        )
    )
    solid.attach_immobile()
    law = FibrePull(solid, muscle) if muscle.contraction is not None else None
    return solid, law
