"""How an RBF muscle is shown: its field fitted anew, the bones cut away, the shown mesh on the
level set.
"""

import time
from collections.abc import Callable

import numpy as np
from scipy.spatial import cKDTree

from rbfmuscle.geometry.arrays import Booleans, Floats
from rbfmuscle.geometry.crossing import FaceTree
from rbfmuscle.implicit.blend import Blend, material_blend, refit_loop
from rbfmuscle.implicit.evaluation import Terms
from rbfmuscle.implicit.extraction.obstacles import PointGrid, stack_grids
from rbfmuscle.implicit.extraction.surface import extract_surface
from rbfmuscle.muscle.display_mesh import display_mesh, neighbour_lists
from rbfmuscle.muscle.level_set import FITTED, NO_VOLUME, UNSURE
from rbfmuscle.muscle.model import Embedding
from rbfmuscle.muscle.options import RBFOptions
from rbfmuscle.muscle.rest import RestState
from rbfmuscle.muscle.state import SolidState
from rbfmuscle.muscle.surface import clear_rest, finish_surface, start_surface
from rbfmuscle.muscle.surface_limits import Obstacles, SurfaceModel, SurfaceState
from rbfmuscle.scene.objects import Muscle
from rbfmuscle.scene.scene import Scene
from rbfmuscle.simulation.contact import BoneContacts
from rbfmuscle.simulation.frame import ModelSurface
from rbfmuscle.validation import SolveError

# Cells along the longest side where marching cubes is asked for and no resolution.
MARCHING_CELLS = 48
# A tenth of the edges this much longer than at rest is the cause of what cannot be fitted.
STRETCHED = 1.6
NO_EXCESS = np.zeros(0)


class MuscleFit:
    """The field of a muscle, fitted anew where its centres are now.

    ``terms`` and ``form`` are what compiled loops read, ``sound`` says whether there is a fit,
    ``flat`` whether it is flat at rest, and ``condition`` is the worst of a matrix, infinite
    without a fit. A Hermite fit without a bound of its condition is made in one compiled call.
    """

    def __init__(self, rest: RestState) -> None:
        self.rest, kernel = rest, rest.fit.kernel
        self.form = None if kernel.plain_cube else kernel.form
        self._epsilon = rest.fit.epsilon if kernel.has_epsilon else 0.0
        self._quick = kernel.hermite and not np.isfinite(rest.fit.condition)
        self.terms = _no_terms(len(kernel.form.table))
        self.sound = False
        self.flat = False
        self.condition = np.inf
        self.move(rest.centres, rest.normals, first=True)

    def move(self, centres: Floats, normals: Floats, *, first: bool = False) -> None:
        """Fit through centres (K, 3) with unit normals (K, 3)."""
        if self._quick and not first and len(self.terms.middle):
            self.condition = refit_loop(
                centres, normals, self.rest.parts, self.terms, self.form, self._epsilon
            )
            self.sound = self.condition < np.inf
            return
        try:
            field = self.rest.field(centres, normals)
        except (ValueError, np.linalg.LinAlgError):
            self.sound, self.condition = False, np.inf
            return
        self.terms = field.terms
        self.sound = True
        self.condition = field.condition


def _no_terms(count: int) -> Terms:
    """Those of a field without a fit."""
    none = np.zeros((0, 3))
    return Terms(
        none,
        np.zeros(0),
        np.zeros((0, 3, 0)),
        np.zeros((0, 0)),
        np.zeros((0, 3, 0)),
        True,
        np.zeros(0),
        np.zeros((0, 0)),
        np.zeros((0, 3), np.int64),
        none,
        np.zeros(0),
    )


class SurfaceBuilder:
    """Draws the surface of one muscle, from frame to frame.

    ``mesh`` is the shown one at rest; ``embed`` gives the places of points (n, 3) in the solid.
    """

    def __init__(
        self,
        muscle: Muscle,
        scene: Scene,
        rest: RestState,
        options: RBFOptions,
        embed: Callable[[Floats], Embedding],
    ) -> None:
        self.name = f"muscle {muscle.name!r}" + (f" ({muscle.source})" if muscle.source else "")
        self.rest = rest
        self.options = options
        self._embed = embed
        self.mesh = vertices, _ = display_mesh(muscle, options.resolution)
        self._grids = {
            bone.name: PointGrid.of(np.asarray(bone.mesh.vertices, dtype=float))
            for bone in scene.bones
        }
        self.embedded = options.surface == "embedded"
        self.marching = options.surface == "marching"
        self.state = SurfaceState(
            np.zeros(1),
            np.zeros(len(vertices)),
            np.zeros((0, 0, 3)),
            np.zeros((0, 0)),
            np.zeros((0, 0, 3)),
        )
        self._met: tuple[BoneContacts, Obstacles] | None = None
        self._take(vertices)

    def _take(self, vertices: Floats) -> None:
        """Take the places of the shown vertices at rest, and find their offsets there."""
        faces = self.mesh[1]
        self.mesh = vertices, faces
        self.fit = fit = None if self.embedded or self.marching else MuscleFit(self.rest)
        offset, slope = np.zeros(len(vertices)), np.zeros(len(vertices))
        blend = Blend(np.zeros(1, np.int64), np.zeros(0, np.int64), np.zeros(0))
        if fit is not None and fit.sound:
            blend = material_blend(vertices, fit.terms)
            offset, gradient = blend.field(vertices, fit.terms, fit.form)
            slope = np.linalg.norm(gradient, axis=1)
            # A field that is flat between its centres is none of the surface.
            fit.flat = bool(np.median(slope) < UNSURE)
        self.model = SurfaceModel(
            faces,
            *neighbour_lists(faces, len(vertices)),
            FaceTree(vertices, faces).arrays,
            self._embed(vertices),
            blend,
            offset,
            slope,
            self.rest.mesh_volume,
            float(_lengths(vertices, faces).mean()),
        )

    def _clear_rest(self, obstacles: Obstacles) -> None:
        """Bring what is held inside a bone at rest out of it, once."""
        vertices = self.mesh[0]
        still = np.tile(np.eye(4), (len(obstacles.poses), 1, 1))
        nearest = cKDTree(self.rest.contact_points()).query(vertices)[1]
        held = self.rest.attached_bone[nearest] >= 0
        there = obstacles._replace(poses=still)
        self._take(clear_rest(self.model, self.state, there, vertices, held))

    def restore(self, state: SurfaceState) -> None:
        """Go back to an earlier ``state``; what is known of the bones stays known."""
        self.state = self.state._replace(level=state.level, height=state.height)

    def draw(self, solid: SolidState, normals: Floats, contacts: BoneContacts) -> ModelSurface:
        """The closed surface at the rest volume, cut by the contacts, with unit normals (K, 3) at
        the centres.

        Raises SolveError where there is none.
        """
        started = time.perf_counter()
        centres = solid.points[: len(normals)]
        # Loops change these in place: the state before, which may be a snapshot, stays as it is.
        level, height, *known = self.state
        self.state = SurfaceState(level.copy(), height.copy(), *known)
        if self.marching:
            surface = self._march(solid.points, centres, normals, contacts)
        else:
            surface = self._of_material(solid.lifted_nodes, centres, normals, contacts)
        spent = time.perf_counter() - started - surface.quantities["time_fit"]
        surface.quantities["time_extract"] = spent
        surface.quantities["lifted_penetration_max"] = contacts.depth(solid.points)
        return surface

    def _of_material(
        self, nodes: Floats, centres: Floats, normals: Floats, contacts: BoneContacts
    ) -> ModelSurface:
        """The shown mesh on the level set, or where the material is."""
        started, fit = time.perf_counter(), self.fit
        if fit is not None:
            fit.move(centres, normals)
        time_fit = time.perf_counter() - started
        obstacles = self._obstacles(contacts)
        fitted = fit is not None and fit.sound and not fit.flat
        given = (fit.terms, fit.form) if fit is not None else (_no_terms(0), None)
        work, outcome = start_surface(self.model, self.state, obstacles, nodes, given, fitted)
        excess = contacts.excess(work.vertices) if contacts.beside else NO_EXCESS
        _, outcome = finish_surface(self.model, self.state, obstacles, work, outcome, excess)
        if outcome == NO_VOLUME or not np.isfinite(work.vertices).all():
            raise SolveError(
                f"{self.name}: no surface outside the bones holds its volume of "
                f"{self.model.volume:.6g}; look for spikes in its mesh, and check where its "
                "attachments lie and what the motion drives into it"
            )
        quantities = {"time_fit": time_fit}
        notes = []
        if fit is not None:
            count = len(work.left)
            left = float(work.left.sum()) / count if outcome == FITTED else 1.0
            quantities["condition"] = fit.condition
            quantities["unfitted_fraction"] = left
            if left == 1.0:
                bone, cause = self._cause(centres, work.carried, contacts)
                notes.append((bone, count, f"carried_{cause}"))
        arrays = {} if fit is None else {"level_offset": self.model.offset}
        return ModelSurface(work.vertices, self.model.faces, quantities, notes, arrays=arrays)

    def _obstacles(self, contacts: BoneContacts) -> Obstacles:
        """The bones in reach, whose poses change with the contacts."""
        if self._met is None or self._met[0] is not contacts:
            bones = contacts.bones
            known = self._met is not None and self._met[0].bones.names == bones.names
            grids = [self._grids[name] for name in bones.names]
            met = Obstacles(bones.arrays, contacts.placed, stack_grids(grids))
            self._met = contacts, met
            if not known:
                shape = len(grids), len(self.mesh[0])
                self.state = self.state._replace(
                    places=np.zeros((*shape, 3)),
                    bounds=np.full(shape, -np.inf),
                    outward=np.zeros((*shape, 3)),
                )
                self._clear_rest(met)
        return self._met[1]

    def _march(
        self, points: Floats, centres: Floats, normals: Floats, contacts: BoneContacts
    ) -> ModelSurface:
        started = time.perf_counter()
        # Axes that turn with the scene: what is sorted by them then falls out alike.
        axes = self.rest.axes @ contacts.poses[self.rest.bones[0]][:3, :3].T
        resolution = self.options.resolution or MARCHING_CELLS
        # Farther than a cell from the bones a lower bound will do: no vertex gets there.
        reach = 1.25 * float(np.ptp(points @ axes.T, axis=0).max()) / resolution
        names = contacts.bones.names
        try:
            field = self.rest.field(centres, normals)
            time_fit = time.perf_counter() - started
            result = extract_surface(
                field,
                points=points,
                resolution=resolution,
                clip_distance=_BoneCut(contacts, reach) if names else None,
                volume=self.rest.mesh_volume,
                level=float(self.state.level[0]),
                axes=axes,
                obstacles=[(self._grids[name], contacts.poses[name]) for name in names],
            )
        except (ValueError, np.linalg.LinAlgError) as error:
            raise SolveError(
                f"{self.name}: no closed surface by marching cubes with kernel "
                f"{self.options.kernel!r} and {len(centres)} centres: {error}; surface = "
                "'material' shows one"
            ) from error
        self.state.level[0] = result.level
        quantities = {"time_fit": time_fit, "condition": field.condition}
        return ModelSurface(result.vertices, result.faces, quantities, [])

    def _cause(self, centres: Floats, carried: Floats, contacts: BoneContacts) -> tuple[str, str]:
        """Bone and cause of a surface that cannot be fitted: a held end in a bone, stretch, or
        sheets that met.
        """
        lengths, found = _lengths(carried, self.mesh[1]), ""
        depth = float(lengths.mean())
        attached_bone = self.rest.attached_bone[: len(centres)]
        for b, name in enumerate(contacts.bones.names):
            own = self.rest.bones.index(name) if name in self.rest.bones else -1
            held: Booleans = (attached_bone >= 0) & (attached_bone != own)
            deepest = -contacts.distance_and_direction(centres[held], b)[0].min(initial=0.0)
            if deepest > depth:
                depth, found = deepest, name
        if found:
            return found, "held_end"
        stretch = np.percentile(lengths / _lengths(*self.mesh), 90.0)
        return "", "stretched" if stretch > STRETCHED else "sheets"


def _lengths(vertices: Floats, faces: np.ndarray) -> Floats:
    """Lengths (m, 3) of the triangles' sides."""
    sides = vertices[faces] - vertices[np.roll(faces, 1, axis=1)]
    return np.maximum(np.linalg.norm(sides, axis=2), np.finfo(float).tiny)


class _BoneCut:
    """What the bones cut away: their smallest distance, a lower bound where it is beyond
    ``reach``.
    """

    def __init__(self, contacts: BoneContacts, reach: float) -> None:
        self.contacts, self.reach = contacts, reach

    def __call__(self, points: Floats) -> Floats:
        return self.contacts.bones.distance(points, self.contacts.poses, self.reach)

    def value_and_gradient_below(self, points: Floats, limit: Floats) -> tuple[Floats, Floats]:
        return self.contacts.bones.nearest(points, self.contacts.poses, limit)
