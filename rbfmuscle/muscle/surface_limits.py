"""What bounds the surface of an RBF muscle: bones, neighbours, and triangles of its own that it
crosses.

Arrays of one surface, and compiled functions that move its vertices out of what they may not be in.
"""

from typing import NamedTuple

import numpy as np

from rbfmuscle.bones.obstacles import Bones
from rbfmuscle.geometry.crossing import TreeArrays, crossing_loop, no_boxes
from rbfmuscle.implicit.blend import Blend
from rbfmuscle.implicit.extraction.obstacles import PointGrids, grid_of, push_off_loop
from rbfmuscle.jit import compiled
from rbfmuscle.muscle.bone_distances import ask_bones
from rbfmuscle.muscle.model import Embedding

# Lengths below are in mean edges of the mesh at rest.
# No point of a triangle is farther from a corner than its longest side over root 3, and a bone's
# vertex behind it, which pushes it, no deeper than a third of that side; in longest sides.
NEAR_FACE = 0.8
OUT = 1e-5  # what is no deeper in a bone counts as out of it
PUSHED = 0.01  # a bone's vertex may lie within the surface by so much
LIFTS = 2  # rounds of moving what lies in a bone onto it, at most
# What crosses is taken back to the material beside the bones by a share of the way in each of some
# rounds; in as many more its distance from the material is smoothed, then it is, as is what crosses
# in the material from the first. Rounds, at most, and in how many the region grows by a ring.
BACK = 0.3
TRIED = 12
ROUNDS = 64
GROWTH = 6
# What may get into that region, in rings of vertices around it, is looked at in the material too.
WIDER = 4


class SurfaceModel(NamedTuple):
    """What never changes of a shown mesh: n vertices, m outward triangles."""

    faces: np.ndarray  # (m, 3)
    start: np.ndarray  # (n + 1,) neighbours of vertex v are other[start[v] : start[v + 1]]
    other: np.ndarray
    tree: TreeArrays
    embedding: Embedding  # of the vertices in the solid
    blend: Blend  # local fits of each vertex
    offset: np.ndarray  # (n,) level offset, the field's value at rest
    slope: np.ndarray  # (n,) |grad F| at rest; 0 where there is no field
    volume: float  # at rest [scene unit cubed]
    edge: float  # mean length of an edge at rest [scene unit]


class SurfaceState(NamedTuple):
    """What goes from frame to frame; r bones, in whose coordinates the last questions are."""

    level: np.ndarray  # (1,)
    height: np.ndarray  # (n,) above the carried material, along its normal
    places: np.ndarray  # (r, n, 3) of the last questions
    bounds: np.ndarray  # (r, n) lower bounds of the distances there
    outward: np.ndarray  # (r, n, 3) directions in which these grow, 0 where none was found


class Obstacles(NamedTuple):
    """The bones in reach, their poses (r, 4, 4), and grids of their vertices."""

    bones: Bones
    poses: np.ndarray
    grids: PointGrids


class Work(NamedTuple):
    """A surface on its way; all arrays by vertex."""

    carried: np.ndarray
    normals: np.ndarray  # unit, of the carried mesh
    vertices: np.ndarray
    direction: np.ndarray  # motion for a unit of level; 0 where held
    near: np.ndarray  # may come to a bone
    least: np.ndarray  # lower bound of the distance from all bones, where carried
    clearance: np.ndarray  # above a bone
    on_field: np.ndarray  # and not on a bone
    odd: np.ndarray  # what may cross others without a fold at a corner
    left: np.ndarray  # kept from a level set that is too far away
    edge: float  # of the model


@compiled
def lift(obstacles, state, work, rows):
    """Move vertices that lie in a bone onto it, where they stay; whether any did."""
    moved = False
    count, limit = len(rows), np.empty(len(rows))
    distance, outward = np.empty(len(rows)), np.empty((len(rows), 3))
    rows = rows.copy()
    for _ in range(LIFTS):
        for i in range(count):
            limit[i] = work.clearance[rows[i]]
        some = rows[:count], limit[:count]
        ask_bones(obstacles, state, work.vertices, some[0], some[1], 0.0, distance, outward)
        left = 0
        for i in range(count):
            v = rows[i]
            gap = distance[i] - work.clearance[v]
            if gap < -OUT * work.edge:
                for a in range(3):
                    work.vertices[v, a] -= gap * outward[i, a]
                    work.direction[v, a] = 0.0
                rows[left] = v
                left += 1
        count = left
        moved |= left > 0
        if left == 0:
            break
    return moved


@compiled
def mark_near(work, rows):
    """Mark those of some vertices that have gone so far from where the material carries them that
    they may lie in a bone.
    """
    for v in rows:
        square, least = 0.0, max(work.least[v], 0.0)
        for a in range(3):
            square += (work.vertices[v, a] - work.carried[v, a]) ** 2
        work.near[v] |= square >= least * least


@compiled
def push_off(model, state, obstacles, work, among):
    """Move the corners of triangles, of those with a marked corner, that a bone's vertices came
    through, and out of the bones again what that drove into another.
    """
    if len(obstacles.poses) == 0:
        return
    moved = np.zeros(len(work.vertices), np.bool_)
    for turn in range(2):
        faces = _near_faces(model, work, among if turn == 0 else _grown(model, moved, 1))
        if len(faces) == 0:
            return
        for b in range(len(obstacles.poses)):
            grid, pose = grid_of(obstacles.grids, b), obstacles.poses[b]
            push_off_loop(work.vertices, faces, grid, pose, PUSHED * work.edge, moved)
        rows = np.flatnonzero(moved)
        for v in rows:
            work.odd[v] = True
            work.direction[v] = 0.0
        if len(rows) == 0 or not lift(obstacles, state, work, rows):
            return


@compiled
def _near_faces(model, work, among):
    """The triangles with a marked corner that a bone's vertex may have come through."""
    x = work.vertices
    faces = np.empty_like(model.faces)
    count = 0
    least = np.empty(len(x))
    for v in range(len(x)):
        away = 0.0
        for a in range(3):
            away += (x[v, a] - work.carried[v, a]) ** 2
        least[v] = work.least[v] - np.sqrt(away)
    for f in range(len(model.faces)):
        p = model.faces[f, 0]
        q = model.faces[f, 1]
        r = model.faces[f, 2]
        if not (among[p] or among[q] or among[r]):
            continue
        one = 0.0
        two = 0.0
        three = 0.0
        for a in range(3):
            one += (x[q, a] - x[p, a]) ** 2
            two += (x[r, a] - x[q, a]) ** 2
            three += (x[p, a] - x[r, a]) ** 2
        near, side = min(least[p], least[q], least[r]), max(one, two, three)
        if near <= 0.0 or near * near < NEAR_FACE * NEAR_FACE * side:
            faces[count, 0] = p
            faces[count, 1] = q
            faces[count, 2] = r
            count += 1
    return faces[:count]


@compiled
def untangle(model, state, obstacles, work, embedded, sound, asked, folds):
    """Bring triangles that cross one of those ``asked`` for (m,), or any at ``folds``, back to a
    ``sound`` surface (n, 3), or, without one, (0, 3), to the material beside the bones; where these
    cross too, and those of an ``embedded`` surface, are smoothed. Returns a mask (n,) of the
    vertices that were moved for it.
    """
    n = len(work.vertices)
    found, among = np.zeros(len(model.faces), np.bool_), asked.copy()
    moved = np.zeros(n, np.bool_)
    target, knotted = sound, np.zeros(n, np.bool_)
    boxes = no_boxes(model.tree)
    for turn in range(ROUNDS):
        # What was not moved does not begin to cross.
        if crossing_loop(work.vertices, model.tree, among, folds and turn == 0, boxes, found) == 0:
            break
        marked = _grown(model, _corners(model, found), 1 + turn // GROWTH)
        if turn == 0 and len(sound) == 0:
            target, knotted = _freed(model, state, obstacles, work, _grown(model, marked, WIDER))
        touching(model.faces, marked, among)
        work.odd[:] |= marked
        moved[:] |= marked
        if len(sound) > 0:
            work.left[:] |= marked
        rows = np.flatnonzero(marked & ~knotted)
        if len(sound) > 0 or (turn < TRIED and not embedded):
            _take_back(work, rows, target)
        else:
            _smooth_heights(model, work, rows)
        # An embedded surface is the material: where that crosses itself, all is smoothed at once.
        at_once = embedded and (knotted.any() or turn == TRIED)
        if at_once or (turn == 2 * TRIED and len(sound) == 0):
            knotted[:] = True
        smooth_loop(work.vertices, np.flatnonzero(marked & knotted), model.start, model.other)
        mark_near(work, np.flatnonzero(marked))
        lift(obstacles, state, work, np.flatnonzero(marked & work.near))
    return moved


@compiled
def _freed(model, state, obstacles, work, region):
    """The material (n, 3), marked vertices of it brought out of the bones, and which of these (n,)
    are corners of triangles that cross others before that.
    """
    found, among = np.zeros(len(model.faces), np.bool_), np.zeros(len(model.faces), np.bool_)
    touching(model.faces, region, among)
    crossing_loop(work.carried, model.tree, among, False, no_boxes(model.tree), found)
    vertices, direction = work.vertices.copy(), work.direction.copy()
    work.vertices[:] = work.carried
    lift(obstacles, state, work, np.flatnonzero(region & work.near))
    freed = work.vertices.copy()
    work.vertices[:], work.direction[:] = vertices, direction
    return freed, _corners(model, found)


@compiled
def _take_back(work, rows, target):
    """Move some vertices by a share of the way to the target (n, 3)."""
    for v in rows:
        for a in range(3):
            work.vertices[v, a] += BACK * (target[v, a] - work.vertices[v, a])


@compiled
def _smooth_heights(model, work, rows):
    """Smooth how far some vertices are from where the material carries them."""
    away = work.vertices - work.carried
    smooth_loop(away, rows, model.start, model.other)
    work.vertices[rows] = work.carried[rows] + away[rows]


@compiled
def _corners(model, found):
    """The corners of marked triangles."""
    marked = np.zeros(len(model.offset), np.bool_)
    for f in range(len(found)):
        if found[f]:
            for k in range(3):
                marked[model.faces[f, k]] = True
    return marked


@compiled
def touching(faces, marked, out):
    """Mark the triangles with a marked corner."""
    for f in range(len(faces)):
        out[f] = marked[faces[f, 0]] or marked[faces[f, 1]] or marked[faces[f, 2]]


@compiled
def _grown(model, marked, rings):
    """The marked vertices and their neighbours, as many times."""
    out = marked
    for _ in range(rings):
        marked = out
        out = marked.copy()
        for v in range(len(marked)):
            if marked[v]:
                for k in range(model.start[v], model.start[v + 1]):
                    out[model.other[k]] = True
    return out


@compiled
def smooth_loop(vertices, rows, start, other):
    """Half the way to the mean of the neighbours, one vertex after the other."""
    for v in rows:
        count = start[v + 1] - start[v]
        for a in range(3):
            total = 0.0
            for n in range(start[v], start[v + 1]):
                total += vertices[other[n], a]
            vertices[v, a] = 0.5 * (vertices[v, a] + total / count)
