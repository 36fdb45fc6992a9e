"""How an RBF muscle is shown: its field refitted, the bones cut away, the closed surface brought
onto the level set.
"""

import time
from collections.abc import Callable
from typing import NamedTuple, TypedDict

import numpy as np

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.geometry.fields import ClipDistance
from rbfmuscle.implicit.extraction.material import FittedMesh, project_to_level_set
from rbfmuscle.implicit.extraction.material_mesh import MaterialMesh
from rbfmuscle.implicit.extraction.obstacles import Obstacles, PointGrid
from rbfmuscle.implicit.extraction.surface import ExtractedSurface, extract_surface
from rbfmuscle.implicit.field import RBFField
from rbfmuscle.muscle.display_mesh import DisplayMesh
from rbfmuscle.muscle.options import RBFOptions
from rbfmuscle.muscle.rest import RestState
from rbfmuscle.scene.objects import Muscle
from rbfmuscle.scene.scene import Scene
from rbfmuscle.simulation.contact import BoneContacts
from rbfmuscle.simulation.frame import ModelSurface
from rbfmuscle.validation import SolveError

# Cells along the longest side where marching cubes is asked for and no resolution.
MARCHING_CELLS = 48
# Bones are asked for exact distances within so many mean edges of the mesh.
REACH = 3.0
# A tenth of the edges this much longer than at rest is the cause of what cannot be fitted.
STRETCHED = 1.6

# Where the material is no sound surface, what it does beside a rigid motion is smoothed so often,
# until it is one; how deep in a bone a vertex of a sound one may be, in mean edges, and how much
# volume may be lacking.
CALM = (30, 120, 500, 2000, 10_000)
SUNKEN = 0.01
LOST = 1e-10


class Placement(NamedTuple):
    """Where a muscle's points are now."""

    centres: np.ndarray  # (K, 3)
    normals: np.ndarray  # (K, 3)
    points: np.ndarray  # (K + S, 3), contact points
    carried: np.ndarray  # (n, 3) vertices of the shown mesh where the material takes them


class _Surroundings(TypedDict):
    """Bones and neighbours, as `project_to_level_set` takes them."""

    cut: ClipDistance | None
    obstacles: Obstacles
    excess: Callable[[Floats], Floats] | None


class TimedFit:
    """Fits the field of a muscle when it is asked for, once; ``condition`` is infinite before, and
    ``seconds`` the time spent.
    """

    def __init__(self, rest: RestState, now: Placement) -> None:
        self._rest, self._now = rest, now
        self.condition, self.seconds = np.inf, 0.0

    def __call__(self) -> RBFField:
        """The field."""
        started = time.perf_counter()
        try:
            fitted = self._rest.field(self._now.centres, self._now.normals)
        finally:
            self.seconds = time.perf_counter() - started
        self.condition = fitted.condition
        return fitted


class SurfaceBuilder:
    """Draws the surface of one muscle, from frame to frame.

    ``level`` is that of the field that met the rest volume last, where the next search begins;
    ``shown`` the material's mesh, None where marching cubes show the surface.
    """

    def __init__(self, muscle: Muscle, scene: Scene, rest: RestState, options: RBFOptions) -> None:
        self.name = f"muscle {muscle.name!r}" + (f" ({muscle.source})" if muscle.source else "")
        self.rest, self.options = rest, options
        self._bones = [
            PointGrid(np.asarray(bone.mesh.vertices, dtype=float)) for bone in scene.bones
        ]
        self.level = 0.0
        self.shown = DisplayMesh(muscle, rest, options) if options.surface == "material" else None

    def draw(self, now: Placement, contacts: BoneContacts) -> ModelSurface:
        """The closed surface at the rest volume of the field through the centres, cut by the
        contacts.

        Raises SolveError if marching cubes find no closed surface.
        """
        started = time.perf_counter()
        fit = TimedFit(self.rest, now)
        notes: list[tuple[str, int, str]] = []
        left = 0.0
        if self.shown is None:
            result: ExtractedSurface = self._march(fit, now, contacts)
        else:
            result = self._of_material(fit, now.carried, contacts)
            left = result.left / len(now.carried)
            if left == 1.0:
                bone, cause = self._cause(now, contacts)
                notes.append((bone, len(now.carried), f"carried_{cause}"))
        quantities = {
            "components": result.components,
            "level": self.level,
            "unfitted_fraction": left,
            "condition": fit.condition,
            "time_fit": fit.seconds,
            "time_extract": time.perf_counter() - started - fit.seconds,
            "solver_penetration_max": max(
                (float(depth.max()) for depth in contacts.depths(now.points).values()), default=0.0
            ),
        }
        return ModelSurface(result.vertices, result.faces, quantities, notes)

    def _of_material(
        self, fit: TimedFit, carried: np.ndarray, contacts: BoneContacts
    ) -> FittedMesh:
        """The material's mesh on the level set, or where the material is if there is no fit."""
        mesh, volume = self.shown.mesh, self.rest.mesh_volume
        reach = REACH * mesh.edge(carried)
        where: _Surroundings = {
            "cut": _BoneCut(contacts, reach) if contacts.names else None,
            "obstacles": self._obstacles(contacts),
            "excess": contacts.excess if contacts.beside else None,
        }
        try:
            result = project_to_level_set(
                mesh, carried, fit(), volume=volume, level=self.level, **where
            )
        except (ValueError, np.linalg.LinAlgError):
            return self._carry(mesh, carried, volume, where)
        self.level = result.level
        return self._sounder(result, mesh, carried, volume, where) if result.crossing else result

    def _sounder(
        self,
        fitted: FittedMesh,
        mesh: MaterialMesh,
        carried: Floats,
        volume: float,
        where: _Surroundings,
    ) -> FittedMesh:
        """What was fitted and crosses itself, or the surface without a fit where that has fewer
        faults.
        """
        try:
            other = self._carry(mesh, carried, volume, where)
        except SolveError:
            return fitted
        return min(fitted, other, key=lambda result: _faults(result, where["cut"], volume))

    def _carry(
        self, mesh: MaterialMesh, carried: Floats, volume: float, where: _Surroundings
    ) -> FittedMesh:
        """The mesh where the material is; where no sound surface comes of that, where the material
        is on the whole.
        """
        found: list[tuple[float, FittedMesh]] = []
        reason: ValueError | None = None
        for sweeps in (0, *CALM):
            start = carried if sweeps == 0 else self.shown.smooth_displacement(carried, sweeps)
            try:
                result = project_to_level_set(mesh, start, None, volume=volume, **where)
            except ValueError as error:
                reason = error
                continue
            faults = _faults(result, where["cut"], volume)
            if faults == 0.0:
                return result
            found.append((faults, result))
        if found:
            return min(found, key=lambda pair: pair[0])[1]
        raise SolveError(
            f"{self.name}: no surface outside the bones holds its volume of {volume:.6g} "
            f"({reason}); look for spikes "
            "in its mesh, and check where its attachments lie and what the motion drives into it"
        ) from reason

    def _march(self, fit: TimedFit, now: Placement, contacts: BoneContacts) -> ExtractedSurface:
        axes, resolution = self._axes(contacts), self.options.resolution or MARCHING_CELLS
        # Farther than a cell from the bones a lower bound will do: no vertex gets there.
        reach = 1.25 * float(np.ptp(now.points @ axes.T, axis=0).max()) / resolution
        try:
            result = extract_surface(
                fit(),
                points=now.points,
                resolution=resolution,
                cut=_BoneCut(contacts, reach) if contacts.names else None,
                volume=self.rest.mesh_volume,
                level=self.level,
                axes=axes,
                obstacles=self._obstacles(contacts),
            )
        except (ValueError, np.linalg.LinAlgError) as error:
            raise SolveError(
                f"{self.name}: no closed surface by marching cubes with kernel "
                f"{self.options.kernel!r} and {len(now.centres)} centres: {error}; surface = "
                "'material' shows one"
            ) from error
        self.level = result.level
        return result

    def _axes(self, contacts: BoneContacts) -> np.ndarray:
        """Axes that turn with the scene: what is sorted by them then falls out alike."""
        return self.rest.axes @ contacts.poses[self.rest.bones[0]][:3, :3].T

    def _obstacles(self, contacts: BoneContacts) -> Obstacles:
        """Points of bones, which faces have to leave outside."""
        return [(self._bones[b], contacts.poses[contacts.names[b]]) for b in contacts.reached]

    def _cause(self, now: Placement, contacts: BoneContacts) -> tuple[str, str]:
        """Bone and cause of a surface that cannot be fitted: a held end in a bone, stretch, or
        sheets that met.
        """
        depth, found = self.shown.mesh.edge(now.carried), ""
        attached_bone = self.rest.attached_bone[: len(now.centres)]
        for b in contacts.reached:
            name = contacts.names[b]
            own = self.rest.bones.index(name) if name in self.rest.bones else -1
            held = (attached_bone >= 0) & (attached_bone != own)
            deepest = -contacts.distance_and_direction(now.centres[held], b)[0].min(initial=0.0)
            if deepest > depth:
                depth, found = deepest, name
        if found:
            return found, "held_end"
        return "", "stretched" if self.shown.stretch(now.carried) > STRETCHED else "sheets"


def _faults(result: FittedMesh, cut: ClipDistance | None, volume: float) -> float:
    """Triangles that cross others, mean edges of depth in a bone, thousandths of volume lost; 0
    where it is sound.
    """
    deep = 0.0 if cut is None else -float(cut(result.vertices).min()) / result.spacing
    lost = abs(result.volume / volume - 1.0)
    # Asked the other way round: NaN is no sound surface.
    return (
        result.crossing + (0.0 if deep <= SUNKEN else deep) + (0.0 if lost <= LOST else 1e3 * lost)
    )


class _BoneCut:
    """What the bones cut away: their smallest distance, a lower bound where it is beyond
    ``reach``.
    """

    def __init__(self, contacts: BoneContacts, reach: float) -> None:
        self.contacts, self.reach = contacts, reach

    def __call__(self, points: Floats) -> Floats:
        return self.contacts.nearest(points, self.reach)[0]

    def value_and_gradient_below(self, points: Floats, limit: Floats) -> tuple[Floats, Floats]:
        return self.contacts.nearest(points, limit)
