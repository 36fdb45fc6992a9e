"""The last of a surface: bones out of it, crossings parted, its volume to the last digit.

Where material folds or sheets meet, both sides of a crossing move apart along the direction from
one to the other at rest, turned as the material around them has turned: so what a fold turned
inside out goes back, and sheets that ran into each other go back to their own sides. Triangles that
share a corner have no two sides: their corners go towards the mean of their neighbours. All move by
the least that parts them, which grows from zero in time; the displacement of sides fades away along
the surface.
"""

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from rbfmuscle.geometry.arrays import Booleans, Floats, Integers, unit
from rbfmuscle.geometry.crossing import cross
from rbfmuscle.geometry.frames import dot, minus, row_of
from rbfmuscle.geometry.surfaces import (
    change_to_volume,
    face_normals,
    vertex_normals,
    volume_rate,
)
from rbfmuscle.loops import loop
from rbfmuscle.surface.sheet import Sheet, Shown, ShownBones

# Rounds, at most; where triangles still cross after PARTED of them, in a tangle without sides, they
# are smoothed as they were, and a ring more of them in each of so many rounds.
ROUNDS, PARTED, WIDER = 64, 12, 6
# Both sides go this much farther apart than they must: triangles beside them cross then.
BEYOND = 1.5
SWEEPS = 2  # of smoothing for a displacement that was spread
# Rings around a crossing by which it is seen how the material turned.
TURNED = 4
# Halvings of the way by which two triangles part, at most an edge.
HALVINGS = 10
# The sides also part along the difference of their normals, where that is shorter, if this is the
# least cosine between it and the direction at rest.
ALONG = 0.3


def part_crossings(
    shown: Shown, bones: ShownBones, sheet: Sheet, *, folds: bool = True
) -> tuple[Booleans, int]:
    """Move the sides of crossings apart, and out of the bones, where one of the triangles has a
    suspect corner or, with ``folds``, one at which triangles do not lie side by side.

    Returns which vertices (n,) moved, and how many triangles still cross.
    """
    before = sheet.vertices.copy()
    moved = np.zeros(len(before), dtype=np.bool_)
    among, pairs = sheet.suspect, np.zeros((0, 2), dtype=np.int64)
    for turn in range(ROUNDS + 1):
        pairs = shown.tree.pairs(sheet.vertices, among, folds=folds and turn == 0, again=turn > 0)
        if len(pairs) == 0 or turn == ROUNDS:
            break
        if turn < PARTED:
            rows, displacement = _displacements(shown, sheet, pairs)
            sheet.vertices[rows] += displacement
        else:
            if turn == PARTED:
                sheet.vertices[:] = before
            rows = shown.grown(np.unique(shown.faces[pairs]), 1 + (turn - PARTED) // WIDER)
            sheet.vertices[rows] = 0.5 * (sheet.vertices[rows] + shown.means(rows, sheet.vertices))
        bones.lift(sheet, rows)
        among = np.zeros(len(moved), dtype=np.bool_)
        among[rows] = True
        moved |= among
    return moved, len(np.unique(pairs))


def _displacements(shown: Shown, sheet: Sheet, pairs: Integers) -> tuple[Integers, Floats]:
    """Vertices (r,) and their displacements (r, 3), which part pairs of triangles (k, 2)."""
    parted, smoothed = np.zeros_like(sheet.vertices), np.zeros_like(sheet.vertices)
    corners = np.unique(shown.faces[pairs])
    inwards = np.zeros_like(sheet.vertices)
    inwards[corners] = shown.means(corners, sheet.vertices) - sheet.vertices[corners]
    directions = _directions(shown, sheet, pairs)
    given = sheet.vertices, shown.faces, pairs, directions, inwards, shown.edge
    _part_loop(*given, parted, smoothed)
    parted *= BEYOND
    rows = shown.spread(parted)
    for _ in range(SWEEPS):
        parted[rows] = 0.5 * (parted[rows] + shown.means(rows, parted))
    rows = np.union1d(rows, corners)
    return rows, parted[rows] + BEYOND * smoothed[rows]


def _directions(shown: Shown, sheet: Sheet, pairs: Integers) -> Floats:
    """Unit vectors (k, 2, 3) along which the first triangle of each pair parts from the second: by
    its place at rest, and by the normals of both where these agree with it, else that again.
    """
    faces = shown.faces
    rows = shown.grown(np.unique(faces[pairs]), TURNED)
    place = np.full(len(shown.rest), -1)
    place[rows] = np.arange(len(rows))
    corners = place[faces[pairs, 0]]
    joined = shown.graph(rows) + coo_matrix(
        (np.ones(len(pairs)), corners.T), (len(rows), len(rows))
    )
    count, label = connected_components(joined, directed=False)
    middle = shown.rest[faces[pairs]].mean(axis=2)
    apart = middle[:, 0] - middle[:, 1]
    for piece in range(count):
        here, some = rows[label == piece], label[corners[:, 0]] == piece
        apart[some] = apart[some] @ rotation(shown.rest[here], sheet.carried[here])
    apart = unit(apart)
    normals = unit(face_normals(sheet.vertices, faces[pairs].reshape(-1, 3))).reshape(-1, 2, 3)
    along = unit(normals[:, 0] - normals[:, 1])
    cosine = np.einsum("ka,ka->k", along, apart)
    along = np.where((np.abs(cosine) < ALONG)[:, None], apart, np.sign(cosine)[:, None] * along)
    return np.stack([apart, along], axis=1)


def rotation(before: Floats, after: Floats) -> Floats:
    """The rotation (3, 3) that takes points (n, 3) best to others (n, 3), for rows: x @ rotation
    (Kabsch 1976).
    """
    u, _, v = np.linalg.svd((before - before.mean(axis=0)).T @ (after - after.mean(axis=0)))
    u[:, 2] *= np.sign(np.linalg.det(u @ v))
    return np.asarray(u @ v)


@loop
def _part_loop(vertices, faces, pairs, directions, inwards, most, parted, smoothed):
    """Displacements of the corners by which each of some pairs of triangles no longer crosses.

    Of the directions (k, d, 3) of a pair that counts along which the way is shortest, at most
    ``most``: ``parted`` (n, 3). Pairs that share a corner go by a share of ``inwards`` (n, 3):
    ``smoothed`` (n, 3). At a corner the pair counts that goes farthest.
    """
    corners, ways = np.empty((6, 3)), np.empty((6, 3))
    steps = np.empty((6, 3))
    both = np.arange(6).reshape(2, 3)
    for k in range(len(pairs)):
        shared = False
        for p in range(3):
            for q in range(3):
                same = faces[pairs[k, 0], p] == faces[pairs[k, 1], q]
                shared |= same
                both[1, q] = p if same else (both[1, q] if p > 0 else 3 + q)
        way = np.inf
        for d in range(1 if shared else directions.shape[1]):
            for c in range(6):
                v = faces[pairs[k, c // 3], c % 3]
                sign = 1.0 if c < 3 else -1.0
                for a in range(3):
                    steps[c, a] = inwards[v, a] if shared else sign * directions[k, d, a]
            low, high = 0.0, 1.0 if shared else most
            for turn in range(HALVINGS + 1):
                middle = high if turn == 0 else 0.5 * (low + high)
                for c in range(6):
                    v = faces[pairs[k, c // 3], c % 3]
                    for a in range(3):
                        corners[c, a] = vertices[v, a] + middle * steps[c, a]
                if not cross(corners, both, 0, 1):
                    high = middle
                elif turn == 0:
                    break
                else:
                    low = middle
            if high < way:
                way = high
                ways[:] = high * steps
        out = smoothed if shared else parted
        for c in range(6):
            v = faces[pairs[k, c // 3], c % 3]
            square = 0.0
            known = 0.0
            for a in range(3):
                square += ways[c, a] ** 2
                known += out[v, a] ** 2
            if square > known:
                for a in range(3):
                    out[v, a] = ways[c, a]


# Bones, crossings and volume are met up to so many times, as the way back to the volume can make
# triangles cross.
AGAIN = 3
# Newton steps of the cubic polynomial of the volume.
CUBIC = 4
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
        given = sheet.vertices, shown.faces, sheet.direction, shown.volume, CUBIC
        change = change_to_volume(*given)
        if np.isnan(change):
            sheet.direction[:] = vertex_normals(sheet.vertices, shown.faces)
            bones.lift(sheet)
            change = change_to_volume(*given)
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
        met = np.zeros(len(centres), dtype=np.bool_)
        _meet_loop(centres, self._far, (NEAR * self._spacing) ** 2, met)
        return np.flatnonzero(met[self._centre]) if met.any() else np.zeros(0, dtype=np.int64)


@loop
def _meet_loop(centres, far, most, met):
    """Mark (K,) the centres (K, 3) whose squared distance from one that was ``far`` (K, K) is below
    ``most``.
    """
    for i in range(len(centres)):
        at = row_of(centres, i)
        for j in range(i):
            way = minus(row_of(centres, j), at)
            if dot(way, way) < most and far[i, j]:
                met[i] = True
                met[j] = True
