"""RBFMuscle: an implicit RBF surface whose centres follow the bones."""

import time
import warnings

import numpy as np
from scipy.spatial import cKDTree

from rbfmuscle.geometry.exact_distance import ExactDistance
from rbfmuscle.geometry.fields import LevelField
from rbfmuscle.geometry.harmonic import blended_motion, harmonic_weights, surface_gradient
from rbfmuscle.geometry.rest_frame import RestFrame
from rbfmuscle.implicit.extraction.band import box_along
from rbfmuscle.implicit.extraction.obstacles import ObstaclePoints
from rbfmuscle.implicit.extraction.surface import extract_surface
from rbfmuscle.implicit.field import RBFField
from rbfmuscle.implicit.kernels.table import get_kernel
from rbfmuscle.implicit.placement.refinement import FITTED, fit_sample
from rbfmuscle.implicit.placement.sampling import GREEDY_LARGEST
from rbfmuscle.implicit.surface_epsilon import choose_surface_epsilon
from rbfmuscle.model.constraints import ShapeConstraint, VolumeConstraint
from rbfmuscle.model.elasticity import ElasticSolver
from rbfmuscle.model.options import RBFOptions
from rbfmuscle.model.rest import bind_samples, build_clusters, kept_sample
from rbfmuscle.sim.loop.frame import ModelSurface
from rbfmuscle.sim.scene.objects import Muscle
from rbfmuscle.sim.scene.scene import Scene
from rbfmuscle.validation import NumericalWarning, SceneError, SolveError

AREA_A_CENTRE = 212.0  # mm², from which the number of centres follows where the scene names none
LEAST_CENTRES = 150
LEAST_ATTACHED = 4
# With more centres than these a fit to normal derivatives alone errs less for the same time.
MOST_WITH_ALL_DERIVATIVES = 200


def _principal_axes(points):
    """Right-handed principal axes as rows."""
    axes = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[2]
    axes[2] *= np.sign(np.linalg.det(axes))
    return axes


class _BoneCut:
    """What the bones cut away: their smallest distance, a lower bound where it is beyond ``reach``."""

    def __init__(self, contacts, reach):
        self.contacts, self.reach = contacts, reach

    def __call__(self, points):
        return self.contacts.nearest(points, self.reach)

    def value_and_gradient_below(self, points, limit):
        return self.contacts.nearest_with_gradient(points, limit)


class _Drawing:
    """An RBF muscle as it was at one moment: its field, fitted when it is first asked for, and its surface."""

    def __init__(self, muscle, contacts):
        self._muscle = muscle
        self._centres, self._normals, self._points = (
            muscle.x.copy(),
            muscle.normals(),
            muscle.contact_points(),
        )
        self._depth, self._obstacles = contacts.depth(self._points), contacts.frozen()
        self._fitted, self._time_fit = None, 0.0

    def field(self):
        """The field that the surface is drawn by, less the level that the frame before came to."""
        return LevelField(self._fit(), self._muscle.level)

    def surface(self):
        """The closed surface at the rest volume, cut by what lay in the way."""
        surface = self._muscle._extract(self._fit(), self._points, self._obstacles, self._time_fit)
        surface.quantities["solver_penetration_max"] = self._depth
        return surface

    def _fit(self):
        if self._fitted is None:
            started = time.perf_counter()
            self._fitted = self._muscle._fit(self._centres, self._normals)
            self._time_fit = time.perf_counter() - started
        return self._fitted


class RBFMuscle:
    """A muscle as the zero level set of an RBF field with moving centres.

    Parameters
    ----------
    muscle : rbfmuscle.sim.scene.scene.Muscle
        Rest mesh, attachments and fibres.
    scene : rbfmuscle.sim.scene.scene.Scene
        Gives units and the names of the bones.
    options : RBFOptions

    Raises
    ------
    SceneError
        If the placement cannot be had or no centre is left free to move.
    """

    def __init__(self, muscle: Muscle, scene: Scene, options: RBFOptions | None = None) -> None:
        self.name = muscle.name
        self.options = options or RBFOptions()
        self.bones = [bone.name for bone in scene.bones]
        self.bone_points = [ObstaclePoints(bone.mesh.vertices) for bone in scene.bones]
        faces = np.asarray(muscle.mesh.faces)
        self.rest_volume = float(muscle.mesh.volume)
        usual = self._default_centres(muscle.mesh.area, scene)
        count = self.options.centres or usual
        frame = RestFrame(np.asarray(muscle.mesh.vertices, dtype=float))
        seed = self.options.seed
        fitted = self.options.placement == FITTED
        placement = "greedy" if fitted else self.options.placement
        if placement == "greedy" and count > GREEDY_LARGEST:
            raise SceneError(
                f"muscle {muscle.name!r}: placement {self.options.placement!r} takes at most {GREEDY_LARGEST} "
                f"centres, got {count}; take placement 'adaptive'"
            )
        centres = kept_sample(frame.local, faces, count, seed=seed, placement=placement)
        samples = kept_sample(frame.local, faces, self.options.samples, seed=seed, placement="even")
        self.derivatives = self.options.derivatives
        if self.derivatives == "auto":
            self.derivatives = "all" if fitted or count <= MOST_WITH_ALL_DERIVATIVES else "normal"
        self._choose_kernel(frame, faces, centres, samples)
        if fitted:
            centres = self._fit_centres(frame, faces, centres)
        self.rest, self.rest_normals = frame.points(centres.points), frame.directions(centres.normals)
        self.samples = frame.points(samples.points)
        self.control_faces, self.sample_faces = centres.control_faces, samples.control_faces
        fibre = self._attach(muscle, frame, faces, centres.points, samples.points)
        # Links through the thickness are one a centre: with more of them each counts less, so that the muscle
        # resists alike however many centres it has.
        self._build_elasticity(centres, samples, fibre, self.options.across_weight * usual / count)
        self.x = self.rest.copy()
        self.level = 0.0
        # Cells along the muscle's own axes are smaller than along the scene's, and turn with the scene.
        self.axes = frame.directions(_principal_axes(samples.points))

    @staticmethod
    def _default_centres(area, scene):
        return max(LEAST_CENTRES, int(round(area / (AREA_A_CENTRE * scene.length(1.0) ** 2), -1)))

    def _choose_kernel(self, frame, faces, centres, samples):
        """The kernel, and its shape parameter where the scene leaves it open: by the error at the samples at rest."""
        self.kernel = get_kernel(self.options.kernel)
        if not self.kernel.hermite:
            warnings.warn(
                f"muscle {self.name!r}: kernel {self.kernel.name!r} is C{self.kernel.smoothness} only; the field is "
                "fitted to values on and off the surface, with three centres a point, in place of normals",
                NumericalWarning,
                stacklevel=4,
            )
        self.epsilon = self.options.epsilon or 1.0
        if self.kernel.has_epsilon and not self.options.epsilon:
            # In the muscle's own frame, so that a scene that is turned chooses the same.
            self.epsilon = choose_surface_epsilon(
                centres.points, centres.normals, kernel=self.kernel, held_out=samples.points,
                distance=ExactDistance(frame.local, faces).signed_distance, derivatives=self.derivatives,
            ).epsilon / frame.size  # fmt: skip

    def _fit_centres(self, frame, faces, centres):
        """Centres beside the surface, whose field lies nearer to all of it."""
        if not self.kernel.hermite or self.derivatives != "all":
            raise SceneError(
                f"muscle {self.name!r}: placement {FITTED!r} needs a C2 kernel and derivatives 'all', got "
                f"{self.kernel.name!r} and {self.derivatives!r}; take placement 'greedy'"
            )
        return fit_sample(
            centres, frame.local, faces, kernel=self.kernel, epsilon=self.epsilon * frame.size, seed=self.options.seed
        )  # fmt: skip

    def _attach(self, muscle, frame, faces, centres, samples):
        """Fix the centres on attachment patches, share the bones' motions out; returns the fibre directions."""
        groups = [np.asarray(attachment.vertices) for attachment in muscle.attachments]
        owner = np.full(len(frame.local), -1)
        for attachment, group in zip(muscle.attachments, groups):
            owner[group] = self.bones.index(attachment.bone)
        tree = cKDTree(frame.local)
        nearest = tree.query(centres)[1]
        fixed = owner[nearest]
        for attachment, group in zip(muscle.attachments, groups):
            if np.isin(nearest, group).sum() < LEAST_ATTACHED:
                # A patch smaller than the spacing of the centres still has to hold the muscle against turning.
                distance = cKDTree(frame.local[group]).query(centres)[0]
                closest = np.argsort(distance, kind="stable")[:LEAST_ATTACHED]
                fixed[closest] = self.bones.index(attachment.bone)
        self.fixed_bone = fixed
        self.free, self.held = np.flatnonzero(fixed < 0), np.flatnonzero(fixed >= 0)
        if len(self.free) == 0:
            raise SceneError(
                f"muscle {self.name!r}: every centre lies on an attachment; nothing is free to move"
            )
        self.contact_bone = np.concatenate([fixed, owner[tree.query(samples)[1]]])
        used = sorted(set(owner[owner >= 0]))
        self.motion_bones = [self.bones[bone] for bone in used]
        on_mesh = harmonic_weights(frame.local, faces, [np.flatnonzero(owner == bone) for bone in used])
        self.motion_weights = on_mesh[nearest]
        self.motion_weights[self.held] = np.array(used) == fixed[self.held, None]
        # Fibres run up the harmonic field from the first attachment to the last.
        along = frame.directions(
            surface_gradient(frame.local, faces, on_mesh @ np.arange(len(used)))[nearest]
        )
        return self._fibre_directions(along, muscle.fibres)

    def _fibre_directions(self, direction, fibres):
        if fibres:
            middle = np.concatenate([0.5 * (line[1:] + line[:-1]) for line in fibres])
            along = np.concatenate([np.diff(line, axis=0) for line in fibres])
            near = min(3, len(middle))
            distance, index = cKDTree(middle).query(self.rest, k=np.arange(1, near + 1))
            unit = along / np.linalg.norm(along, axis=1, keepdims=True)
            floor = 1e-9 * np.ptp(self.rest, axis=0).max()
            direction = (unit[index] / np.maximum(distance, floor)[:, :, None]).sum(axis=1)
        length = np.linalg.norm(direction, axis=1)
        weak = length < 1e-9 * max(length.max(), 1e-300)
        axis = self.rest[self.held].mean(axis=0) - self.rest[self.free].mean(axis=0)
        direction = np.where(weak[:, None], axis, direction)
        return direction / np.linalg.norm(direction, axis=1, keepdims=True)

    def _build_elasticity(self, centres, samples, fibre, across_weight):
        options = self.options
        start, other, weight = build_clusters(
            centres.points, centres.normals, self.control_faces, samples.points, samples.normals,
            across=options.across, across_weight=across_weight,
        )  # fmt: skip
        limits = (options.stretch_low, options.stretch_high)
        self.shape = ShapeConstraint(
            self.rest, start, other, weight, fibre, limits=limits, hold=options.stretch_hold
        )
        columns, shares = bind_samples(samples.points, samples.normals, centres.points, centres.normals)
        count = len(self.rest)
        alone = np.repeat(np.arange(count)[:, None], columns.shape[1], axis=1)
        self.columns = np.concatenate([alone, columns])
        self.shares = np.concatenate([np.eye(1, columns.shape[1]).repeat(count, axis=0), shares])
        self._attach_hanging()
        self.volume = VolumeConstraint(self.sample_faces, 0.0)
        self.volume.volume = self.volume.evaluate(self.samples)[0]
        self.solver = ElasticSolver(
            self.shape, self.volume, np.concatenate([self.rest, self.samples]), self.columns, self.shares,
            self.free, self.held,
            iterations=options.iterations, contacts=options.contacts, memory=options.acceleration,
        )  # fmt: skip

    def _attach_hanging(self):
        """Count contact points that hang for the most part on held centres to the bone that holds these.

        Contact could lift them only by moving the few free centres they hang on a long way.
        """
        held = self.shares * (self.fixed_bone >= 0)[self.columns]
        hanging = np.flatnonzero((held.sum(axis=1) > 0.5) & (self.contact_bone < 0))
        carrier = self.columns[hanging, held[hanging].argmax(axis=1)]
        self.contact_bone[hanging] = self.fixed_bone[carrier]

    # --- the MuscleModel protocol -------------------------------------------------------------------------

    def contact_points(self):
        """Centres, then surface samples, (K + S, 3)."""
        return self.solver.carry(self.x)

    def carried_mesh(self):
        """The samples and their triangulation: a material surface of constant topology."""
        return self.contact_points()[len(self.x) :], self.sample_faces

    def predict(self, before, after):
        """Move every centre with its share of the bones' motions between two poses."""
        motions = np.array([after[bone] @ np.linalg.inv(before[bone]) for bone in self.motion_bones])
        self.x = blended_motion(self.x, self.motion_weights, motions)
        for bone in set(self.fixed_bone[self.held]):
            own = np.flatnonzero(self.fixed_bone == bone)
            pose = after[self.bones[bone]]
            self.x[own] = self.rest[own] @ pose[:3, :3].T + pose[:3, 3]

    def solve(self, contacts):
        """Settle the centres under shape, volume and contact at the contacts' present poses."""
        self.x = self.solver.solve(self.x, contacts)

    def turn(self, which, transform):
        """Move the centres that carry the contact points ``which`` by a rigid 4x4 transform."""
        hit = np.zeros(len(self.x), dtype=bool)
        hit[self.columns[which, 0]] = True
        hit[self.held] = False
        self.x[hit] = self.x[hit] @ transform[:3, :3].T + transform[:3, 3]

    def snapshot(self):
        """State that ``restore`` brings back."""
        return self.x.copy(), self.shape.quaternion.copy(), self.solver.snapshot()

    def restore(self, state):
        """Return to an earlier ``snapshot``."""
        x, quaternion, solver = state
        self.x = x.copy()
        self.shape.quaternion[:] = quaternion
        self.solver.restore(solver)
        self.shape.localise(self.x)

    def normals(self):
        """Unit normals at the centres, turned with the local deformation by its cofactor, (K, 3)."""
        f = self.shape.deformation
        n = self.rest_normals
        helper = np.where(np.abs(n[:, :1]) < 0.6, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
        u = np.cross(n, helper)
        v = np.cross(n, u)
        turned = np.cross(np.einsum("kab,kb->ka", f, u), np.einsum("kab,kb->ka", f, v))
        return turned / np.linalg.norm(turned, axis=1, keepdims=True)

    def field(self):
        """The RBF field through the present centres."""
        return self._fit(self.x, self.normals())

    def _fit(self, centres, normals):
        return RBFField.fit_surface(
            centres, normals, kernel=self.kernel, epsilon=self.epsilon, derivatives=self.derivatives
        )

    def drawing(self, contacts):
        """What refits the field, cuts the bones away and extracts the closed surface at the rest volume."""
        return _Drawing(self, contacts)

    def _extract(self, field, points, contacts, time_fit):
        started = time.perf_counter()
        axes = self.axes @ contacts.poses[self.motion_bones[0]][:3, :3].T
        # Farther than a cell from the bones a lower bound will do: no vertex gets there.
        reach = 1.25 * float(np.diff(box_along(points, axes), axis=0).max()) / self.options.resolution
        cut = _BoneCut(contacts, reach) if contacts.names else None
        obstacles = [(self.bone_points[b], contacts.poses[contacts.names[b]]) for b in contacts.reached]
        try:
            result = extract_surface(
                field, points=points, resolution=self.options.resolution, cut=cut,
                volume=self.rest_volume, level=self.level, axes=axes, obstacles=obstacles,
            )  # fmt: skip
        except ValueError as error:
            raise SolveError(
                f"muscle {self.name!r}: no closed surface with kernel "
                f"{self.options.kernel!r} and {len(self.x)} centres: {error}"
            ) from error
        self.level = result.level
        quantities = {
            "components": result.components,
            "condition": field.condition,
            "level": result.level,
            "time_fit": time_fit,
            "time_extract": time.perf_counter() - started,
        }
        return ModelSurface(result.vertices, result.faces, quantities)
