"""The unit ball as a shown surface, with the field through its centres, and bones about it."""

import numpy as np
import pytest
import trimesh

from rbfmuscle.bones.sdf import BoneSDF
from rbfmuscle.geometry.crossing import crossing_faces
from rbfmuscle.geometry.point_grid import PointGrid
from rbfmuscle.geometry.surfaces import mesh_volume
from rbfmuscle.implicit.field import SMALL, FieldFit, overlapping_parts
from rbfmuscle.implicit.kernels import get_kernel
from rbfmuscle.simulation.contact import BoneContacts, BonesInReach
from rbfmuscle.surface.finish import fill_material, finish
from rbfmuscle.surface.projection import MovingField, reach_level
from rbfmuscle.surface.sheet import Sheet, Shown, ShownBones

BALL = trimesh.creation.icosphere(3)
X = np.array(BALL.vertices)
FACES = np.array(BALL.faces, dtype=np.int64)
VOLUME = mesh_volume(X, FACES)
EDGE = float(BALL.edges_unique_length.mean())
CENTRES = np.array(trimesh.creation.icosphere(2).vertices)
PARTS = overlapping_parts(CENTRES, *SMALL)


def bone(radius, *centre):
    return trimesh.creation.icosphere(3, radius).apply_translation(centre)


class Drawn:
    """The ball, at rest with the offsets of its vertices, drawn where its vertices are."""

    def __init__(self, bones=(), points=None, volume=VOLUME):
        self.fields = [BoneSDF.from_mesh(one) for one in bones]
        names = [f"bone {k}" for k in range(len(bones))]
        places = [
            np.asarray(one.vertices, dtype=float) if points is None else points for one in bones
        ]
        self.grids = {name: PointGrid.of(place) for name, place in zip(names, places)}
        self.contacts = BoneContacts(BonesInReach(names, self.fields), np.full(len(CENTRES), -1))
        self.contacts.move(dict.fromkeys(names, np.eye(4)))
        self.field = MovingField(FieldFit(get_kernel("cubic"), 1.0), PARTS, CENTRES, CENTRES)
        weights = self.field.weights(X)
        value, gradient = self.field(X, weights)
        slope = np.linalg.norm(gradient, axis=1)
        self.shown = Shown.of(X, FACES, volume, weights=weights, offset=value, slope=slope)
        self.forget()

    def forget(self):
        self.level = 0.0
        self.bones = ShownBones(self.shown, self.contacts.bones, self.contacts.placed, self.grids)

    def __call__(self, carried, *, fitted=True, displacement=None):
        """Vertices, triangles that cross, whether there is a level, and what was bounded."""
        sheet = Sheet.at(np.ascontiguousarray(carried))
        level = np.nan
        if fitted:
            level = reach_level(self.shown, self.field, self.bones, sheet, self.level)
        if np.isnan(level):
            fill_material(self.shown, self.bones, sheet)
        if displacement is not None:
            sheet.displace(displacement)
        change, crossing = finish(self.shown, self.bones, sheet)
        self.level = level + change
        assert mesh_volume(sheet.vertices, FACES) == pytest.approx(self.shown.volume, rel=1e-12)
        assert crossing == crossing_faces(sheet.vertices, FACES).sum()
        return sheet.vertices, crossing, bool(np.isfinite(level)), sheet.bounded

    def distance(self, points):
        return np.min([field.distance(points) for field in self.fields], axis=0)

    def height(self, points):
        """F(x) - r - l at the vertices."""
        return self.field(points, self.shown.weights)[0] - self.shown.offset - self.level
