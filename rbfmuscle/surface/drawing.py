"""How an RBF muscle is shown: its field fitted anew, the bones cut away, the shown mesh on the
level set.
"""

import time
from collections.abc import Callable
from typing import NamedTuple, TypeAlias

import numpy as np
from scipy.spatial import cKDTree

from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.geometry.point_grid import PointGrid
from rbfmuscle.implicit.extraction import extract_surface
from rbfmuscle.implicit.field import FieldFit
from rbfmuscle.scene.objects import Muscle
from rbfmuscle.scene.scene import Scene
from rbfmuscle.simulation.contact import BoneContacts
from rbfmuscle.simulation.frame import ModelSurface
from rbfmuscle.surface.display import display_mesh
from rbfmuscle.surface.finish import MeetingSheets, clear_rest, fill_material, finish
from rbfmuscle.surface.projection import UNSURE, MovingField, reach_level
from rbfmuscle.surface.sheet import Sheet, Shown, ShownBones
from rbfmuscle.validation import SolveError

Carry: TypeAlias = Callable[[Floats], Floats]  # from the nodes of the solid to places (n, 3)

# Cells along the longest side where marching cubes is asked for and no resolution.
MARCHING_CELLS = 48
# A tenth of the edges this much longer than at rest is the cause of what cannot be fitted.
STRETCHED = 1.6


class RestState(NamedTuple):
    """An RBF muscle at rest: K centres, whose field is its surface, and S samples of the
    surface.
    """

    centres: Floats  # (K, 3)
    normals: Floats  # (K, 3)
    samples: Floats  # (S, 3)
    sample_faces: Integers  # (m, 3) closed outward triangulation of the samples
    fit: FieldFit  # how the field through the centres is fitted
    parts: Integers  # (P, n) centres of its local fits
    # bones, and ends of tendons, that hold the muscle, by their names; the axes turn with the first
    bones: list[str]
    # (K + S,) position in ``bones`` of what holds a contact point, -1 where free
    attached_bone: Integers
    volume: float  # of the muscle's mesh [scene unit cubed]
    axes: Floats  # (3, 3) principal axes as rows

    def contact_points(self) -> Floats:
        """Centres, then samples, (K + S, 3)."""
        return np.concatenate([self.centres, self.samples])


class SurfaceBuilder:
    """Draws the surface of one muscle, from frame to frame.

    ``shape`` is ``"material"``, ``"embedded"`` (no field) or ``"marching"`` (marching cubes), with
    ``resolution`` edges or cells along the longest side, 0 for the input mesh; ``embed`` gives for
    points (n, 3) at rest their places as the nodes of the solid are. ``level``, at which the last
    surface lies, is all that a frame takes from the one before, to start from.
    """

    def __init__(
        self,
        muscle: Muscle,
        scene: Scene,
        rest: RestState,
        embed: Callable[[Floats], Carry],
        *,
        shape: str,
        resolution: int = 0,
    ) -> None:
        self.name = f"muscle {muscle.name!r}" + (f" ({muscle.source})" if muscle.source else "")
        self.rest = rest
        self.level = 0.0
        self._embed = embed
        self._marching = shape == "marching"
        self._resolution = resolution or MARCHING_CELLS
        self._grids = {
            bone.name: PointGrid.of(np.asarray(bone.mesh.vertices, dtype=float))
            for bone in scene.bones
        }
        self.field = MovingField(rest.fit, rest.parts, rest.centres, rest.normals)
        self._has_field = shape == "material"
        self._bones: tuple[BoneContacts, ShownBones] | None = None
        self._take(*display_mesh(muscle, resolution))

    def _take(self, vertices: Floats, faces: Integers) -> None:
        """Take the places of the shown vertices at rest, and find their offsets there."""
        weights, offset, slope = None, np.zeros(len(vertices)), np.zeros(len(vertices))
        if self._has_field and np.isfinite(self.field.condition):
            self.field.move(self.rest.centres, self.rest.normals)
            weights = self.field.weights(vertices)
            offset, gradient = self.field(vertices, weights)
            slope = np.linalg.norm(gradient, axis=1)
            # A field that is flat between its centres is none of the surface.
            weights = weights if np.median(slope) >= UNSURE else None
        self.shown = Shown.of(
            vertices, faces, self.rest.volume, weights=weights, offset=offset, slope=slope
        )
        self._meeting = MeetingSheets(self.rest.centres, vertices)
        self.carry = self._embed(vertices)

    def draw(
        self, points: Floats, nodes: Floats, normals: Floats, contacts: BoneContacts
    ) -> ModelSurface:
        """The closed surface at the rest volume, cut by the contacts.

        Parameters
        ----------
        points : (K + S, 3) ndarray
            Centres, then samples, where the solid has them.
        nodes : (N, 3) ndarray
            Of the solid, from which the surface is carried.
        normals : (K, 3) ndarray
            Unit, at the centres.
        contacts : BoneContacts

        Raises
        ------
        SolveError
            If there is none.
        """
        started = time.perf_counter()
        if self._marching:
            surface = self._march(points, normals, contacts)
        else:
            surface = self._of_material(nodes, points[: len(normals)], normals, contacts)
        spent = time.perf_counter() - started - surface.quantities["time_fit"]
        surface.quantities["time_extract"] = spent
        surface.quantities["lifted_penetration_max"] = contacts.depth(points)
        return surface

    def _of_material(
        self, nodes: Floats, centres: Floats, normals: Floats, contacts: BoneContacts
    ) -> ModelSurface:
        """The shown mesh on the level set, or where the material is."""
        started, bones = time.perf_counter(), self._meet(contacts)
        if self._has_field:
            self.field.move(centres, normals)
        time_fit = time.perf_counter() - started
        shown, sheet = self.shown, Sheet.at(self.carry(nodes))
        level = np.nan
        if shown.weights is not None and np.isfinite(self.field.condition):
            level = reach_level(shown, self.field, bones, sheet, self.level)
        fitted = np.isfinite(level)
        if not fitted:
            sheet = Sheet.at(sheet.carried)
            fill_material(shown, bones, sheet)
        sheet.suspect[self._meeting(centres)] = True
        sheet.displace(contacts.out_of_neighbours(sheet.vertices))
        change, crossing = finish(shown, bones, sheet)
        if not np.isfinite(change) or not np.isfinite(sheet.vertices).all():
            raise SolveError(
                f"{self.name}: no surface outside the bones holds its volume of "
                f"{shown.volume:.6g}; look for spikes in its mesh, and check where its "
                "attachments lie and what the motion drives into it"
            )
        quantities = {"time_fit": time_fit}
        notes = []
        if crossing:
            notes.append(("", crossing, "surface_crosses"))
        arrays = {}
        if self._has_field:
            self.level = level + change if fitted else self.level
            quantities["condition"] = self.field.condition
            quantities["unfitted_fraction"] = float(sheet.bounded.mean()) if fitted else 1.0
            arrays["level_offset"] = shown.offset
            if not fitted:
                bone, cause = self._cause(centres, sheet.carried, contacts)
                notes.append((bone, len(sheet.bounded), f"carried_{cause}"))
        return ModelSurface(sheet.vertices, shown.faces, quantities, notes, arrays=arrays)

    def _meet(self, contacts: BoneContacts) -> ShownBones:
        """The bones in reach; when they are first met, what they hold or cover at rest is taken out
        of them.
        """
        if self._bones is None or self._bones[0] is not contacts:
            at_rest = np.tile(np.eye(4), (len(contacts.placed), 1, 1))
            resting = ShownBones(self.shown, contacts.bones, at_rest, self._grids)
            nearest = cKDTree(self.rest.contact_points()).query(self.shown.rest)[1]
            kept = (self.rest.attached_bone >= 0) | (contacts.allowed > 0.0).any(axis=0)
            cleared = clear_rest(self.shown, resting, kept[nearest])
            if not np.array_equal(cleared, self.shown.rest):
                self._take(cleared, self.shown.faces)
            met = ShownBones(self.shown, contacts.bones, contacts.placed, self._grids)
            self._bones = contacts, met
        return self._bones[1]

    def _march(self, points: Floats, normals: Floats, contacts: BoneContacts) -> ModelSurface:
        started = time.perf_counter()
        # Axes that turn with the scene: what is sorted by them then falls out alike.
        axes = self.rest.axes @ contacts.poses[self.rest.bones[0]][:3, :3].T
        names = contacts.bones.names

        def cut(where: Floats, limit: Floats | float) -> tuple[Floats, Floats]:
            return contacts.bones.nearest(where, contacts.poses, limit)

        try:
            field = self.field.through(points[: len(normals)], normals)
            time_fit = time.perf_counter() - started
            result = extract_surface(
                field,
                points=points,
                resolution=self._resolution,
                cut=cut if names else None,
                volume=self.rest.volume,
                level=self.level,
                axes=axes,
                obstacles=[(self._grids[name], contacts.poses[name]) for name in names],
            )
        except (ValueError, np.linalg.LinAlgError) as error:
            raise SolveError(
                f"{self.name}: no closed surface by marching cubes with kernel "
                f"{self.rest.fit.kernel.name!r} and {len(normals)} centres: {error}; surface = "
                "'material' shows one"
            ) from error
        self.level = result.level
        quantities = {"time_fit": time_fit, "condition": field.condition}
        return ModelSurface(result.vertices, result.faces, quantities, [])

    def _cause(self, centres: Floats, carried: Floats, contacts: BoneContacts) -> tuple[str, str]:
        """Bone and cause of a surface that cannot be fitted: a held end in a bone, stretch, or
        sheets that met.
        """
        lengths, found = _lengths(carried, self.shown.faces), ""
        depth = float(lengths.mean())
        attached_bone = self.rest.attached_bone[: len(centres)]
        for b, name in enumerate(contacts.bones.names):
            own = self.rest.bones.index(name) if name in self.rest.bones else -1
            held = (attached_bone >= 0) & (attached_bone != own)
            deepest = -contacts.distance_and_direction(centres[held], b)[0].min(initial=0.0)
            if deepest > depth:
                depth, found = deepest, name
        if found:
            return found, "held_end"
        stretch = np.percentile(lengths / _lengths(self.shown.rest, self.shown.faces), 90.0)
        return "", "stretched" if stretch > STRETCHED else "sheets"


def _lengths(vertices: Floats, faces: np.ndarray) -> Floats:
    """Lengths (m, 3) of the triangles' sides."""
    sides = vertices[faces] - vertices[np.roll(faces, 1, axis=1)]
    return np.maximum(np.linalg.norm(sides, axis=2), np.finfo(float).tiny)
