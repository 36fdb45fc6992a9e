"""The last of a surface: bones out of it, crossings parted, its volume to the last digit."""

import numpy as np
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from rbfmuscle.geometry.arrays import Booleans, Floats, Integers
from rbfmuscle.geometry.surfaces import vertex_normals, volume_rate
from rbfmuscle.surface.bones import ShownBones
from rbfmuscle.surface.crossings import part_crossings
from rbfmuscle.surface.sheet import Sheet, Shown, level_change

# Bones, crossings and volume are met up to so many times, as the way back to the volume can make
# triangles cross.
AGAIN = 3
# Times that the volume is met after what its step drove into a bone was brought out.
MEET = 4
# Steps by which the material is blown up to its volume, and the step, in mean edges, whose last
# digit follows.
STEPS, SETTLED = 20, 1e-3
# Centres that were farther from each other than FAR mean spacings at rest and are nearer than NEAR
# lie on sheets that may meet.
FAR, NEAR = 2.5, 1.6


def finish(shown: Shown, bones: ShownBones, sheet: Sheet) -> tuple[float, int]:
    """Push bone vertices off a sheet, part its crossings and meet its volume.

    Returns the change of the level, NaN where no level has the volume, and how many triangles still
    cross.
    """
    bones.push_off(sheet)
    change = fill(shown, bones, sheet)
    for turn in range(AGAIN):
        moved, crossing = part_crossings(shown, bones, sheet, folds=turn == 0)
        if not moved.any():
            return change, crossing
        # What was not moved has been looked at.
        sheet.suspect[:] = moved
        if sheet.bounded.all():
            sheet.direction[:] = vertex_normals(sheet.vertices, shown.faces)
        bones.push_off(sheet, moved)
        change += fill(shown, bones, sheet)
    return change, len(np.unique(shown.tree.pairs(sheet.vertices)))


def fill(shown: Shown, bones: ShownBones, sheet: Sheet) -> float:
    """The volume to the last digit, and out of the bones again what that drove into one; the change
    of the level, NaN where no level has the volume.

    Where too little is free to move, the volume comes before what holds the rest.
    """
    total = 0.0
    for turn in range(MEET + 1):
        change = level_change(shown, sheet)
        if np.isnan(change):
            sheet.direction[:] = vertex_normals(sheet.vertices, shown.faces)
            bones.lift(sheet)
            change = level_change(shown, sheet)
        if np.isnan(change):
            return change
        total += change
        sheet.shift(change)
        if turn == MEET or len(bones.lift(sheet)) == 0:
            break
    return total


def fill_material(shown: Shown, bones: ShownBones, sheet: Sheet) -> None:
    """Bring the material out of the bones and along its normals to about the volume: the surface
    without a field.
    """
    sheet.bounded[:] = True
    sheet.suspect[:] = True
    for _ in range(STEPS):
        bones.find_near(sheet.vertices)
        bones.lift(sheet)
        sheet.direction[:] = vertex_normals(sheet.vertices, shown.faces)
        volume, rate = volume_rate(sheet.vertices, shown.faces, sheet.direction)
        if not rate > 0.0:
            return
        most = 0.5 * shown.edge
        step = min(max((shown.volume - volume) / rate, -most), most)
        sheet.shift(step)
        if abs(step) < SETTLED * shown.edge:
            return


def clear_rest(shown: Shown, bones: ShownBones, among: Booleans) -> Floats:
    """Vertices (n, 3) at rest, those of ``among`` (n,) brought out of the bones, without crossings.

    The bone takes them along, so they are out of it in all frames.
    """
    sheet = Sheet.at(shown.rest)
    if len(bones.lift(sheet, np.flatnonzero(among))) == 0:
        return shown.rest
    sheet.suspect[:] = True
    part_crossings(shown, bones, sheet)
    return sheet.vertices


class MeetingSheets:
    """Which vertices lie on sheets of a muscle that have come near each other, by its centres.

    Centres (K, 3) and vertices (n, 3) are those at rest.
    """

    def __init__(self, centres: Floats, vertices: Floats) -> None:
        tree = cKDTree(centres)
        self._spacing = float(tree.query(centres, k=2)[0][:, 1].mean())
        self._centre = tree.query(vertices)[1]
        apart = cdist(centres, centres, "sqeuclidean")
        self._far = apart > (FAR * self._spacing) ** 2

    def __call__(self, centres: Floats) -> Integers:
        """The vertices, by the centres (K, 3) where they are now."""
        near = cdist(centres, centres, "sqeuclidean") < (NEAR * self._spacing) ** 2
        met = (near & self._far).any(axis=1)
        return np.flatnonzero(met[self._centre]) if met.any() else np.zeros(0, dtype=np.int64)
