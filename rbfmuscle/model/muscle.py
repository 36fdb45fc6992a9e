"""RBFMuscle: an implicit RBF surface whose centres follow the bones."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from rbfmuscle.geometry.harmonic import blended_motion
from rbfmuscle.implicit.field import RBFField
from rbfmuscle.model.contraction import contracting
from rbfmuscle.model.drawing import Moment, RBFDrawing, SurfaceDrawer
from rbfmuscle.model.elasticity import SETTLED, SETTLED_STILL, ElasticSolver
from rbfmuscle.model.inside.build import build_interior
from rbfmuscle.model.options import RBFOptions
from rbfmuscle.model.rest import Rest
from rbfmuscle.sim.loop.contact import BoneContacts
from rbfmuscle.sim.scene.objects import Muscle
from rbfmuscle.sim.scene.scene import Scene


class RBFMuscle:
    """A muscle as the zero level set of an RBF field with moving centres.

    Implements ``rbfmuscle.sim.loop.frame.MuscleModel``.

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
    rest : Rest
    solver : ElasticSolver or Interior
        An `Interior` where ``inside`` asks for one.
    law : FibreLaw, FibrePull or None
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
        self.rest = Rest.from_muscle(muscle, scene, self.options)
        self.law: Any = None
        self.interior = None
        if self.options.inside:
            self.interior, self.law = build_interior(muscle, self.rest, self.options)
        elif muscle.contraction is not None:
            self.rest, self.law = contracting(muscle, self.rest, self.options)
        self.solver: Any = self.interior or ElasticSolver(self.rest, self.options, self.law)
        self.drawer = SurfaceDrawer(muscle, scene, self.rest, self.options)
        names = [bone.name for bone in scene.bones]
        numbers = np.array([names.index(bone) for bone in self.rest.bones])
        holder = self.interior.owner if self.interior else self.rest.holder
        self.contact_bone = np.where(holder < 0, -1, numbers[holder])
        self.points = self.rest.centres.copy()

    def contact_points(self) -> np.ndarray:
        """Centres, then surface samples, (K + S, 3); with an inside denser points of the surface after them."""
        return self.solver.carry(self.points)

    def carried_mesh(self) -> tuple[np.ndarray, np.ndarray]:
        """The samples and their triangulation: a material surface of constant topology."""
        first = len(self.points)
        return self.contact_points()[first : first + len(self.rest.samples)], self.rest.sample_faces

    def predict(self, before: Mapping[str, np.ndarray], after: Mapping[str, np.ndarray]) -> None:
        """Go along with the bones; held centres arrive exactly."""
        rest = self.rest
        motions = np.array([after[bone] @ np.linalg.inv(before[bone]) for bone in rest.bones])
        if self.law is not None and self.interior is None:
            still = all(np.array_equal(before[bone], after[bone]) for bone in rest.bones)
            self.solver.settled = SETTLED_STILL if still else SETTLED
        self.points = blended_motion(self.points, rest.weights, motions)
        for b, bone in enumerate(rest.bones):
            held = rest.held[rest.holder[rest.held] == b]
            self.points[held] = rest.centres[held] @ after[bone][:3, :3].T + after[bone][:3, 3]
        if self.interior:
            self.interior.move(motions, [after[bone] for bone in rest.bones])
            self.points = self.interior.centres(self.points)

    def solve(self, contacts: BoneContacts) -> None:
        """Settle the centres under shape, volume and contact at the contacts' present poses."""
        self.points = self.solver.solve(self.points, contacts)

    def activate(self, activation: float) -> None:
        """Take an activation, 0 to 1, that the next `solve` settles under."""
        self.law.activate(activation)

    def settle(self, contacts: BoneContacts) -> None:
        """Nothing: the surface is cut along the bones."""

    def turn(self, which: np.ndarray, transform: np.ndarray) -> None:
        """Move the centres that carry contact points marked in a bool mask by a (4, 4) transform; held ones stay."""
        if self.interior:
            self.interior.turn(which, transform)
            self.points = self.interior.centres(self.points)
            return
        hit = np.zeros(len(self.points), dtype=bool)
        hit[self.rest.columns[which, 0]] = True
        hit[self.rest.held] = False
        self.points[hit] = self.points[hit] @ transform[:3, :3].T + transform[:3, 3]

    def transform(self, motion: np.ndarray) -> None:
        """Go along with a rigid motion (4, 4), as the muscle is."""
        self.points = self.points @ motion[:3, :3].T + motion[:3, 3]
        self.solver.transform(motion, self.points)

    def snapshot(self) -> Any:
        """Everything that :meth:`restore` needs."""
        return self.points.copy(), self.solver.snapshot()

    def restore(self, state: Any) -> None:
        """Go back to a snapshot."""
        points, solver = state
        self.points = points.copy()
        self.solver.restore(solver)

    def normals(self) -> np.ndarray:
        """Unit normals at the centres, turned with the local deformation by its cofactor, (K, 3)."""
        f = self.solver.deformation()
        n = self.rest.normals
        helper = np.where(np.abs(n[:, :1]) < 0.6, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
        u = np.cross(n, helper)
        v = np.cross(n, u)
        turned = np.cross(np.einsum("kab,kb->ka", f, u), np.einsum("kab,kb->ka", f, v))
        return turned / np.linalg.norm(turned, axis=1, keepdims=True)

    def field(self) -> RBFField:
        """The RBF field through the present centres."""
        return self.rest.fit.fit(self.points, self.normals())

    def drawing(self, contacts: BoneContacts) -> RBFDrawing:
        """The muscle as it is now, for its surface."""
        shown = self.drawer.shown
        carried = None
        if shown is not None:
            carried = (
                self.interior.follow(shown.rest) if self.interior else shown.carried(self.points, self.solver)
            )
        now = Moment(self.points.copy(), self.normals(), self.contact_points(), carried)
        return RBFDrawing(self.drawer, now, contacts)
