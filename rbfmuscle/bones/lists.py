"""Lists of a field's cells: which triangles each names, its side and its lower bound."""

import numpy as np

from rbfmuscle.bones.cells import BOUND
from rbfmuscle.bones.query import CROSSED, INSIDE, MIXED, OUTSIDE, SIDE
from rbfmuscle.geometry.exact_distance import STACK, nearest_triangle, record_feature, record_square
from rbfmuscle.geometry.triangles import CORNER, EDGE, FACE
from rbfmuscle.jit import compiled

# Points of a cell, beside its corners, from which a walk over the surface looks for triangles to
# list.
PROBES = 0.25 * np.array(
    [[0, 0, 0], [1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]], dtype=np.float64
)
# At most this many triangles a cell; a header, and the row of the corners' distances.
MOST, LONGEST = 15, 17
# Steps of one walk, at most.
WALK = 8
# Cells whose triangles' normals differ by more than 40 degrees ask the tree at their probes, unless
# further away than this many of their edges.
FOLD, FOLD_REACH = 0.75, 2.0
# Triangles whose squared distances differ by less than this share are equally near.
SLACK = 1e-9
# Lists before this one that are looked through for the same content.
LOOK_BACK = 6


@compiled
def list_loop(cells, nodes, edge, unit, mesh, probe, out):
    """Write the list of each cell; return the lengths used and whether all signs agree with the
    distances.
    """
    low, ids, centre = cells
    record, distance, doubt = nodes
    lists, offsets, rows, first_row = out
    used = 0
    mixed = 0
    sound = True
    stack = np.empty(STACK, np.int64), np.empty(STACK)
    for i in range(len(ids)):
        listed = lists[used + 1 : used + 1 + MOST]
        count = 0
        doubted = False
        for k in range(9):
            n = centre[i] if k == 8 else record[ids[i, k]]
            if n >= 0:
                count = _add(listed, count, np.int64(n))
            if k < 8:
                doubted = doubted or doubt[ids[i, k]]
        folded = abs(distance[ids[i, 0]]) < FOLD_REACH * edge and folded_list(
            mesh[0].records, listed, count
        )
        if probe or folded:
            count = _probe(listed, count, folded, low[i], edge, mesh, stack)
        for k in range(count):
            doubted = doubted or mesh[3][listed[k]]
        state, bound = _cell_state(ids[i], distance, edge)
        if state == CROSSED:
            sound = sound and _signs_agree(ids[i], distance, edge)
            if doubted and len(rows):
                state = MIXED
                lists[used + 1 + count] = first_row + mixed
                _fill_row(low[i], ids[i], distance, edge, rows[mixed])
                mixed += 1
        lists[used] = count | state << SIDE | int(bound / unit) << BOUND
        size = 1 + count + (1 if state == MIXED else 0)
        offsets[i] = _same_before(lists, offsets, i, used, size)
        if offsets[i] == used:
            used += size
    return used, mixed, sound


@compiled
def _add(listed, count, n):
    """Append n to the first ``count`` triangles of a list if it is new and has room; return their
    number.
    """
    for m in range(count):
        if listed[m] == n:
            return count
    if count == MOST:
        return count
    listed[count] = n
    return count + 1


@compiled
def folded_list(records, listed, count):
    """Whether the triangles of a list face different ways."""
    first = listed[0]
    for m in range(1, count):
        n, dot = listed[m], 0.0
        for k in range(3):
            dot += records[first, 9 + k] * records[n, 9 + k]
        if dot < FOLD:
            return True
    return False


@compiled
def _probe(listed, count, folded, low, edge, mesh, stack):
    """Add the triangles nearest to points inside the cell.

    Where a corner's nearest point lies on an edge or a vertex, several triangles are equally near
    and the corner names only one of them; inside the cell another may be nearer by far. A walk
    downhill over the surface, from the nearest triangle listed, finds it; where the surface is
    folded the tree is asked.
    """
    tree, across, origin, _ = mesh
    records = tree.records
    for k in range(len(PROBES)):
        x = origin[0] + edge * (low[0] + 0.5 + PROBES[k, 0])
        y = origin[1] + edge * (low[1] + 0.5 + PROBES[k, 1])
        z = origin[2] + edge * (low[2] + 0.5 + PROBES[k, 2])
        best, square = np.int64(listed[0]), np.inf
        for m in range(count):
            s = record_square(records, listed[m], x, y, z)
            if s < square * (1 - SLACK):
                best, square = np.int64(listed[m]), s
        if folded:
            end, _ = nearest_triangle(tree, (x, y, z), best, square, SLACK, stack)
        else:
            end = _walk(best, square, x, y, z, records, across)
        if end != best:
            count = _add(listed, count, end)
    return count


@compiled
def _walk(best, square, x, y, z, records, across):
    """Triangle at which a walk over neighbours, always to a nearer one, ends."""
    for _ in range(WALK):
        feature = record_feature(records, best, x, y, z)
        if feature == FACE:
            return best
        step = best
        # Edges BC and so on follow their first corner: those at corner k are k and k - 1.
        first = feature - EDGE if feature < CORNER else feature - CORNER
        for turn in range(1 if feature < CORNER else 2):
            n = across[best, (first + 2 * turn) % 3]
            if n >= 0:
                s = record_square(records, n, x, y, z)
                if s < square * (1 - SLACK):
                    step, square = n, s
        if step == best:
            return best
        best = step
    return best


@compiled
def _same_before(lists, offsets, i, used, size):
    """Offset of a recent list equal to the one at ``used``, or ``used``."""
    for m in range(max(0, i - LOOK_BACK), i):
        other, same = offsets[m], True
        for k in range(size):
            same = same and lists[other + k] == lists[used + k]
        if same:
            return other
    return used


@compiled
def _cell_state(ids, distance, edge):
    """Side of a cell, and a lower bound of the distance in it (zero unless outside)."""
    furthest = 0.0
    for k in range(8):
        if abs(distance[ids[k]]) > abs(furthest):
            furthest = distance[ids[k]]
    diagonal = np.sqrt(3.0) * edge
    if abs(furthest) <= diagonal * (1 + 1e-9):
        return CROSSED, 0.0
    if furthest < 0.0:
        return INSIDE, 0.0
    return OUTSIDE, furthest - diagonal


@compiled
def _signs_agree(ids, distance, edge):
    """Whether the surface is near enough wherever the sign changes along an edge of the cell."""
    for k in range(8):
        for bit in (1, 2, 4):
            if k & bit == 0:
                a, b = distance[ids[k]], distance[ids[k | bit]]
                if a * b < 0.0 and abs(a - b) > edge * (1 + 1e-6):
                    return False
    return True


@compiled
def _fill_row(low, ids, distance, edge, row):
    for k in range(8):
        row[k] = distance[ids[k]]
    for k in range(3):
        row[8 + k] = low[k] * edge
    row[11] = 1.0 / edge
