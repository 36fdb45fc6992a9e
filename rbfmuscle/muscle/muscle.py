"""RBFMuscle: an implicit RBF surface whose centres move with an elastic solid."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from rbfmuscle.bones.rounded import round_bone
from rbfmuscle.bones.sdf import BoneSDF
from rbfmuscle.geometry.frames import RestFrame
from rbfmuscle.geometry.lines import fibre_directions
from rbfmuscle.geometry.surfaces import vertex_normals
from rbfmuscle.muscle.activation import (
    along_fibres,
    contracting_fibres,
    descending_limb,
    held_at_insertion,
)
from rbfmuscle.muscle.rest import LEAST_ATTACHED, RBFOptions, measure_rest
from rbfmuscle.scene.joints import Joint
from rbfmuscle.scene.muscles import attachment_frames, ordered_muscle
from rbfmuscle.scene.objects import Muscle
from rbfmuscle.scene.scene import Scene
from rbfmuscle.simulation.contact import EVERYWHERE, BoneContacts
from rbfmuscle.simulation.frame import Mesh, ModelSurface, SolveLog
from rbfmuscle.simulation.neighbours import SEARCHED
from rbfmuscle.simulation.touching import Body, surface_points
from rbfmuscle.solid.contact import Obstacles
from rbfmuscle.solid.kernels import turned_normals
from rbfmuscle.solid.lattice import Lattice
from rbfmuscle.solid.material import Material
from rbfmuscle.solid.model import (
    SolidModel,
    attached_owner,
    build_solid,
    embed,
    greatest_forces,
    lattice_slopes,
)
from rbfmuscle.solid.solve import NEAR, Settling
from rbfmuscle.solid.state import SolidState, predict, rest_state, transform
from rbfmuscle.surface.drawing import Carry, RestState, SurfaceBuilder

# Spacing of the points that meet neighbours, of the size, and how high the surface rises between.
APART, RISES = 0.02, 4e-4
# Of the samples' spacing: that for which the surface is rounded that others meet. With 1, thin rims
# lie up to 1.2 mm in a neighbour.
MET_SPACING = 0.5
# A muscle whose activation changes while the bones stand still ends nearer to its equilibrium: what
# is left of each step adds up.
ERROR_ACTIVE = 2e-6


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
    rest : RestState
    epsilon : float or None
        Shape parameter of the kernel, as given or as found; None where the kernel has none.
    model : SolidModel
        Of the elastic solid that carries the centres.
    state : SolidState

    Raises
    ------
    SceneError
        If no centre is left free to move, or the kernel gives no surface at rest.

    Examples
    --------
    >>> from rbfmuscle import phantom_scene
    >>> scene = phantom_scene(end=0.0)
    >>> muscle = RBFMuscle(scene.muscles[0], scene)
    >>> muscle.contact_points().shape[1]
    3
    """

    def __init__(self, muscle: Muscle, scene: Scene, options: RBFOptions | None = None) -> None:
        given, (muscle, order) = muscle, ordered_muscle(muscle)
        self.name = muscle.name
        self._rest_mesh = muscle.mesh
        self.options = options or RBFOptions()
        self.rest = measure_rest(muscle, scene, self.options)
        fit = self.rest.fit
        self.epsilon = fit.epsilon if fit.kernel.has_epsilon else None
        self.frame = RestFrame(np.asarray(muscle.mesh.vertices, dtype=float))
        self._lattice = Lattice(self.frame.local, np.asarray(muscle.mesh.faces), self.options.nodes)
        self.model = _build_solid(
            muscle, scene.joints, self._lattice, self.frame, self.rest, self.options
        )
        self.state = rest_state(self.model)
        self._asked = 0.0
        self._most = greatest_forces(self.model, 0.0)
        self._normals_at = lattice_slopes(self._lattice, self.frame, self.rest.centres)
        self.drawer = SurfaceBuilder(
            muscle,
            scene,
            self.rest,
            self._carry,
            shape=self.options.surface,
            resolution=self.options.resolution,
        )
        # Where the shown mesh is the input mesh, its vertices as numbered there, and its faces.
        self._input: Mesh | None = None
        if not self.options.resolution:
            faces = np.ascontiguousarray(given.mesh.faces, dtype=np.int64)
            self._input = np.argsort(order), faces
        names = attachment_frames(scene.bones, muscle)
        numbers = np.array([names.index(bone) for bone in self.rest.bones])
        owner = attached_owner(self.model)
        self.attached_bone = np.where(owner < 0, -1, numbers[owner])
        self._met: tuple[BoneContacts, Obstacles] | None = None
        self._material: Material | None = None
        self.log = SolveLog({"solver_residual": 0.0, "solid_volume_error": 0.0})

    def contact_points(self) -> np.ndarray:
        """Centres, then surface samples, (K + S, 3); never changed in place."""
        return self.state.points

    def material_mesh(self) -> tuple[np.ndarray, np.ndarray]:
        """The samples and their triangulation: a material surface of constant topology."""
        points = self.model.embedding.of(self.state.nodes)
        return points[len(self.rest.centres) :], self.rest.sample_faces

    def predict(self, before: Mapping[str, np.ndarray], after: Mapping[str, np.ndarray]) -> None:
        """Go along with the bones."""
        bones = self.rest.bones
        old, new = np.array([[poses[bone] for bone in bones] for poses in (before, after)])
        self.state = predict(self.model, self.state, old, new)
        self.activate(self._asked)

    def begin(self, contacts: BoneContacts) -> Settling:
        """Begin to solve for the equilibrium under elasticity, volume and contact at the bones'
        present poses.
        """
        if self._met is None or self._met[0] is not contacts:
            self._met = contacts, self._obstacles(contacts)
        obstacles = self._met[1]
        obstacles.fences = contacts.fences
        return Settling(
            self.model,
            self._most,
            self.state,
            obstacles,
            error=ERROR_ACTIVE if self.state.activation or not self.state.step.any() else None,
            material=self._material,
        )

    def take(self, solid: Settling) -> None:
        """Take the state where a solve ended."""
        self.state = solid.finish()
        report = solid.report()
        self.log = self.log.add(
            caps=len(report.caps),
            solver_residual=report.error,
            solid_volume_error=report.volume_error,
        )

    def _obstacles(self, contacts: BoneContacts) -> Obstacles:
        """What the contact points meet, with the bones rounded for their spacing."""
        spacing, reach = float(np.sqrt(self.model.area)), NEAR * self.model.size
        bones = contacts.bones
        rounded = [
            round_bone(field, self.frame, spacing, region, reach=reach)
            for field, region in zip(bones.fields, bones.regions)
        ]
        exact = [field.arrays for field in bones.fields]
        return Obstacles(exact, rounded, contacts.placed, contacts.free, contacts.allowed)

    def body(self) -> Body:
        """What others meet that touch this muscle, whose solves answer them from then on."""
        model, lattice, frame = self.model, self._lattice, self.frame
        normals = vertex_normals(self.rest.samples, self.rest.sample_faces)
        normals = np.concatenate([self.rest.normals, normals])
        points = surface_points(model.points, normals, APART * model.size, RISES * model.size)
        nearest = cKDTree(model.points[points]).query(model.points)[1]
        spacing = MET_SPACING * float(np.sqrt(model.area))
        rest = BoneSDF.from_mesh(self._rest_mesh, name=f"muscle {self.name!r}")
        reach = SEARCHED * model.size
        turn = lattice.axes @ frame.axes / frame.size / lattice.spacing[:, None]
        origin = frame.origin + np.linalg.solve(turn, lattice.low / lattice.spacing)
        every = np.indices(tuple(lattice.count)).reshape(3, -1).T
        cell = lattice.tree.query(every + 0.5)[1].astype(np.int64)
        self._material = Material(
            origin,
            turn,
            np.linalg.inv(turn),
            cell.reshape(tuple(lattice.count)),
            np.ascontiguousarray(lattice.cells),
            lattice.nodes,
            round_bone(rest, frame, spacing, rest.bounds + EVERYWHERE, reach=reach),
        )
        places = (model.points[points] - origin) @ turn.T
        share = np.bincount(nearest, minlength=len(points)) / len(nearest)
        return Body(points, places, float(self._rest_mesh.area) * share)

    def activate(self, activation: float) -> None:
        """Take an activation, 0 to 1, that the next solve settles under: less of it where fibres
        are long.
        """
        self._asked = activation
        if activation:
            activation *= descending_limb(self.model, self.state.nodes)
        self._take_activation(activation)

    def _take_activation(self, activation: float) -> None:
        if activation != self.state.activation:
            self._most = greatest_forces(self.model, activation)
            self.state = self.state._replace(activation=activation, metric=None)

    def transform(self, motion: np.ndarray) -> None:
        """Go along with a rigid motion (4, 4), as the muscle is."""
        self.state = transform(self.state, motion)

    def snapshot(self) -> tuple[SolidState, float, float, SolveLog]:
        """Everything that :meth:`restore` needs."""
        return self.state, self._asked, self.drawer.level, self.log

    def restore(self, state: tuple[SolidState, float, float, SolveLog]) -> None:
        """Go back to a snapshot."""
        solid, self._asked, self.drawer.level, self.log = state
        self._take_activation(solid.activation)
        self.state = solid

    def follower(self, points: np.ndarray) -> Callable[[], np.ndarray]:
        """What gives the present places (n, 3) of points (n, 3) of the muscle at rest."""
        placed = self._carry(points)
        return lambda: placed(self.state.nodes)

    def _carry(self, points: np.ndarray) -> Carry:
        """What gives the places (n, 3) of points (n, 3) of the muscle at rest from the nodes."""
        return embed(self._lattice, self.frame, points).of

    def surface(self, contacts: BoneContacts) -> ModelSurface:
        """The closed surface at the rest volume, cut by what lies in the way."""
        nodes = self.state.lifted_nodes
        normals = np.empty_like(self.rest.normals)
        columns = self.model.embedding.columns
        turned_normals(nodes, columns, self._normals_at, self.rest.normals, normals)
        drawn = self.drawer.draw(self.state.points, nodes, normals, contacts)
        quantities, notes, self.log = self.log.take()
        # Before what the solve left in a bone was lifted out of it.
        settled = self.model.embedding.of(self.state.nodes)
        drawn.quantities["solver_penetration_max"] = contacts.depth(settled)
        drawn.quantities.update(quantities)
        drawn.notes.extend(notes)
        if self._input is not None and self.options.surface != "marching":
            place, faces = self._input
            arrays = {name: values[place] for name, values in drawn.arrays.items()}
            drawn = replace(drawn, vertices=drawn.vertices[place], faces=faces, arrays=arrays)
        return drawn


def _build_solid(
    muscle: Muscle,
    joints: Sequence[Joint],
    lattice: Lattice,
    frame: RestFrame,
    rest: RestState,
    options: RBFOptions,
) -> SolidModel:
    """The solid that carries the centres, with its fibres."""
    points = rest.contact_points()
    centres = len(rest.centres)
    owner = rest.attached_bone
    held = centres + np.flatnonzero(owner[centres:] >= 0)
    for bone in range(len(rest.bones)):
        if (owner[held] == bone).sum() < LEAST_ATTACHED:
            held = np.concatenate([held, np.flatnonzero(owner[:centres] == bone)])
    model = build_solid(
        lattice,
        frame,
        points,
        owner,
        held,
        surface=float(muscle.mesh.area),
        area=float(muscle.mesh.area) / len(rest.samples),
        iterations=options.iterations,
    )
    axis = points[held].mean(axis=0) - points.mean(axis=0)
    insertion = held_at_insertion(model, muscle, joints)
    along = fibre_directions(
        model.cells.points, along_fibres(model, insertion), muscle.fibres, fallback=axis
    )
    count = len(along)
    fibres = model.fibres._replace(
        direction=np.ascontiguousarray(along),
        passive=np.full(count, 1.5 * (options.fibre_ratio - 1.0)),
        lower=np.full(count, 1.0 / options.slack_ratio),
    )
    model = model._replace(fibres=fibres)
    if muscle.contraction is None:
        return model
    return model._replace(fibres=contracting_fibres(model, muscle, insertion))
