"""Builds the sparse cells of a bone's distance field from exact distances at their corners.

Three levels, each four times finer than the one before: coarse cells over the whole grid, blocks where a
coarse cell may meet the band about the surface or errs, fine cells where a block may meet the band.
"""

from dataclasses import dataclass

import numba
import numpy as np

from rbfmuscle.sim.exact_distance import STACK, nearest_triangle, record_feature, record_square, signed_side
from rbfmuscle.sim.sdf_query import BLOCK, BOUND, COUNT, CROSSED, INSIDE, MIXED, OUTSIDE, SIDE
from rbfmuscle.sim.threads import in_chunks
from rbfmuscle.sim.triangles import CORNER, EDGE, FACE, FIRST

# Fine cells of a block.
CUT = BLOCK**3
# A coarse cell is cut where its corners' triangles err at its centre by more than this share of the distance.
COARSE_ERROR = 0.02
# Lower bounds of the distance are held in multiples of this share of a fine cell.
UNIT_SHARE = 1 / 16
# Directions in which triangles are sought for points beyond the grid.
FAR_DIRECTIONS = 200
# Points of a cell, beside its corners, from which a walk over the surface looks for triangles to list.
PROBES = 0.25 * np.array([[0, 0, 0], [1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]], dtype=np.float64)
# At most this many triangles a cell; a header, and the row of the corners' distances.
MOST, LONGEST = 15, 17
# Steps of one walk, at most.
WALK = 8
# Cells whose triangles' normals differ by more than 60 degrees ask the tree at their probes, unless further
# away than this many of their edges.
FOLD, FOLD_REACH = 0.5, 2.0
# Lists before this one that are looked through for the same content.
LOOK_BACK = 6


@dataclass
class Cells:
    """The sparse grid, arrays named as in FieldData; ``sound`` tells whether the signs agree with the
    distances."""

    origin: np.ndarray
    block: float
    unit: float
    blocks: np.ndarray
    cells: np.ndarray
    lists: np.ndarray
    corners: np.ndarray
    far: np.ndarray
    sound: bool
    nodes: int


@dataclass
class _Nodes:
    """Points where the exact distance was asked for: nearest record, signed distance, doubt about the
    sign."""

    record: np.ndarray
    distance: np.ndarray
    doubt: np.ndarray


class _Builder:
    """What all levels share, and the lists so far."""

    def __init__(self, exact, origin, unit, inside, doubtful):
        self.exact, self.origin, self.unit, self.inside = exact, origin, unit, inside
        self.doubtful = (
            np.zeros(len(exact.faces), dtype=np.bool_) if doubtful is None else doubtful[exact.order]
        )
        place = np.full(len(exact.order) + 1, -1, dtype=np.int32)
        place[exact.order] = np.arange(len(exact.order))
        turn = (exact.records[:, FIRST].astype(np.int64)[:, None] + np.arange(3)) % 3
        self.across = place[np.maximum(exact.across[exact.order[:, None], turn], -1)]
        self.lists, self.corners = [], []
        self.length = self.rows = self.count = 0
        self.sound = True

    def nodes(self, index, edge, near=None):
        """Exact distances at lattice points ``index`` (n, 3) times ``edge``; ``near`` names a near record."""
        points = self.origin + edge * index
        record, distance = np.empty(len(points), dtype=np.int32), np.empty(len(points))
        near = np.full(len(points), -1, dtype=np.int32) if near is None else near
        exact = self.exact
        normals = (exact.edge_normals, exact.vertex_normals, exact.faces, exact.order)

        def work(a, b):
            _node_loop(points[a:b], near[a:b], exact.tree, normals, record[a:b], distance[a:b])

        in_chunks(len(points), work, least=256)
        self.count += len(points)
        doubt = np.zeros(len(points), dtype=np.bool_)
        if self.inside is not None:
            signed = np.where(self.inside(points), -np.abs(distance), np.abs(distance))
            doubt = signed * distance < 0.0
            distance = signed
        return _Nodes(record, distance, doubt)

    def write(self, low, edge, ids, corners, centres):
        """Lists of cells with least corner ``low`` (n, 3) in edges; returns their offsets (n,)."""
        count = len(ids)
        offsets = np.empty(count, dtype=np.int32)
        rows = np.empty((count if self.inside is not None else 0, 12), dtype=np.float32)
        centre = np.full(count, -1, dtype=np.int32) if centres is None else centres
        nodes = (corners.record, corners.distance, corners.doubt)
        mesh = (self.exact.tree, self.across, self.origin, self.doubtful)
        written = {}

        def work(a, b):
            lists = np.empty((b - a) * LONGEST, dtype=np.int32)
            out = (lists, offsets[a:b], rows, self.rows)
            used, mixed, sound = _list_loop(
                low[a:b], ids[a:b], nodes, centre[a:b], float(edge), self.unit, mesh, out
            )
            written[a, b] = (lists[:used].copy(), mixed, sound)

        # Rows of mixed cells are numbered in order.
        in_chunks(count, work, least=1024 if self.inside is None else count + 1)
        for (a, b), (lists, mixed, sound) in sorted(written.items(), key=lambda item: item[0]):
            offsets[a:b] += self.length
            self.lists.append(lists)
            self.corners.append(rows[:mixed].copy())
            self.length += len(lists)
            self.rows += mixed
            self.sound = self.sound and sound
        return offsets


def build_cells(exact, spacing, band, *, inside=None, region=None, doubtful=None):
    """Sparse cells about the mesh of an exact tree.

    Parameters
    ----------
    exact : ExactDistance
    spacing : float
        Edge of a fine cell [unit of the mesh].
    band : float
        Fine cells cover all points nearer than this.
    inside : callable, optional
        ``inside(points) -> (n,) bool``, where the mesh itself gives no reliable sign.
    region : (2, 3) ndarray, optional
        Box outside of which coarse cells serve.
    doubtful : (m,) ndarray of bool, optional
        Faces whose pseudonormals are not to be believed.

    Returns
    -------
    Cells
    """
    block, coarse = BLOCK * spacing, BLOCK * BLOCK * spacing
    low, high = exact.vertices.min(axis=0), exact.vertices.max(axis=0)
    margin = band + block
    shape = grid_shape(low, high, spacing, band)
    origin = 0.5 * (low + high) - 0.5 * coarse * shape
    box = np.array([low - margin, high + margin]) if region is None else np.asarray(region, dtype=np.float64)
    builder = _Builder(exact, origin, UNIT_SHARE * spacing, inside, doubtful)

    table, chosen = _coarse_level(builder, shape, coarse, band, (box - origin) / coarse)
    cells = _block_level(builder, table, chosen, block, band, (box - origin) / block)
    far = _far_records(exact, float(np.linalg.norm(high - low)))
    lists, corners = np.concatenate(builder.lists), np.concatenate(builder.corners)
    return Cells(origin, block, builder.unit, table, cells, lists, corners, far, builder.sound, builder.count)


def grid_shape(low, high, spacing, band):
    """Coarse cells of the grid along each axis."""
    margin = band + BLOCK * spacing
    return np.maximum(np.ceil((high - low + 2 * margin) / (BLOCK * BLOCK * spacing)).astype(np.int64), 1)


def _lattice(shape):
    return np.stack(np.meshgrid(*[np.arange(n) for n in shape], indexing="ij"), axis=-1).reshape(-1, 3)


def _coarse_level(builder, shape, edge, band, box):
    """Block table filled with the lists of coarse cells, and the (n, 3) blocks that are to replace them."""
    low = _lattice(shape)
    corners, centres = builder.nodes(_lattice(shape + 1), edge), builder.nodes(low + 0.5, edge)
    ids = _corner_ids(low, np.arange(len(corners.record), dtype=np.int32).reshape(shape + 1))
    offsets = builder.write(low, edge, ids, corners, centres.record)
    table = offsets.reshape(shape)
    for axis in range(3):
        table = table.repeat(BLOCK, axis)
    guess = np.empty(len(low))
    _guess_loop(builder.origin + edge * (low + 0.5), ids, corners.record, builder.exact.records, guess)
    distance = np.abs(centres.distance)
    near = distance - 0.5 * np.sqrt(3) * edge < band
    wanted = near | (guess > (1 + COARSE_ERROR) * distance)
    wanted &= np.all((low + 1 > box[0]) & (low < box[1]), axis=1)
    chosen = (BLOCK * low[wanted][:, None, :] + _lattice((BLOCK,) * 3)).reshape(-1, 3)
    return np.ascontiguousarray(table), chosen


def _block_level(builder, table, chosen, edge, band, box):
    """Put the blocks' lists, and what refers to fine cells, in the table; return the fine cells (k, 64)."""
    if len(chosen) == 0:
        return np.zeros((0, CUT), dtype=np.int32)
    index = np.full(np.array(table.shape) + 1, -1, dtype=np.int32)
    for step in _lattice((2, 2, 2)):
        index[tuple((chosen + step).T)] = 0
    wanted = np.argwhere(index == 0)
    index[tuple(wanted.T)] = np.arange(len(wanted), dtype=np.int32)
    corners = builder.nodes(wanted, edge)
    ids = _corner_ids(chosen, index)
    # Only blocks that may be cut are looked at in their centre.
    least = np.abs(corners.distance[ids]).argmin(axis=1)
    nearest = ids[np.arange(len(ids)), least]
    cut = np.abs(corners.distance[nearest]) - 0.5 * np.sqrt(3) * edge < band
    cut &= np.all((chosen + 1 > box[0]) & (chosen < box[1]), axis=1)
    centres = builder.nodes(chosen[cut] + 0.5, edge, near=corners.record[nearest[cut]])
    record = np.full(len(chosen), -1, dtype=np.int32)
    record[cut] = centres.record
    offsets = builder.write(chosen, edge, ids, corners, record)
    table[tuple(chosen.T)] = offsets
    kept = np.abs(centres.distance) - 0.5 * np.sqrt(3) * edge < band
    cut[cut] = kept
    blocks = chosen[cut]
    active = np.zeros((len(blocks), CUT), dtype=np.bool_)
    _active_loop(ids[cut], corners.distance, centres.distance[kept], edge, band, active)
    if builder.inside is None:
        lists = builder.lists[-1] if len(builder.lists) == 1 else np.concatenate(builder.lists)
        _near_loop(blocks, offsets[cut], lists, builder.exact.records, builder.origin, edge, band, active)
    cells = np.repeat(offsets[cut][:, None], CUT, axis=1)
    table[tuple(blocks.T)] = -1 - np.arange(len(blocks), dtype=np.int32)
    _fine_level(builder, table.shape, blocks, active, edge / BLOCK, cells)
    return cells


def _fine_level(builder, shape, blocks, active, edge, cells):
    """Replace the offsets of active fine cells in ``cells`` by those of their own lists."""
    owner = np.full(np.array(shape) + 1, -1, dtype=np.int32)
    for step in _lattice((2, 2, 2)):
        owner[tuple((blocks + step).T)] = 0
    owners = np.argwhere(owner == 0)
    owner[tuple(owners.T)] = np.arange(len(owners), dtype=np.int32)
    number = np.full((len(owners), CUT), -1, dtype=np.int32)
    _mark_loop(blocks, active, owner, number)
    slots = np.argwhere(number == 0)
    number[number == 0] = np.arange(len(slots), dtype=np.int32)
    steps = _lattice((BLOCK,) * 3)
    corners = builder.nodes(BLOCK * owners[slots[:, 0]] + steps[slots[:, 1]], edge)
    which, cell = np.nonzero(active)
    ids = np.empty((len(which), 8), dtype=np.int32)
    _fine_ids_loop(blocks, which, cell, owner, number, ids)
    low = BLOCK * blocks[which] + steps[cell]
    cells[active] = builder.write(low, edge, ids, corners, None)


def _far_records(exact, diagonal):
    """Records nearest to points spread over large spheres: what a point beyond the grid is tested against."""
    turn = np.arange(FAR_DIRECTIONS) * np.pi * (3 - np.sqrt(5))
    z = 1 - (2 * np.arange(FAR_DIRECTIONS) + 1) / FAR_DIRECTIONS
    flat = np.sqrt(1 - z * z)
    directions = np.column_stack([flat * np.cos(turn), flat * np.sin(turn), z])
    centre = 0.5 * (exact.vertices.min(axis=0) + exact.vertices.max(axis=0))
    faces = exact.nearest(centre + 1.5 * diagonal * directions)[2]
    place = np.empty(len(exact.order), dtype=np.int32)
    place[exact.order] = np.arange(len(exact.order))
    return np.unique(place[faces])


def _corner_ids(low, index):
    ids = [index[tuple((low + step).T)] for step in _lattice((2, 2, 2))]
    return np.ascontiguousarray(np.stack(ids, axis=1))


@numba.njit(cache=True, nogil=True)
def _node_loop(points, near, tree, normals, record, distance):
    boxes, starts, records = tree
    nodes, squares, closest, normal = np.empty(STACK, np.int64), np.empty(STACK), np.empty(3), np.empty(3)
    best = 0
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        # Where nothing nearer is named, the last answer bounds this one.
        best = near[i] if near[i] >= 0 else best
        square = record_square(records, best, x, y, z)
        best, square = nearest_triangle(boxes, starts, records, x, y, z, best, square, nodes, squares)
        record[i] = best
        side = signed_side(records[best], normals[3][best], points[i], normals, closest, normal)
        distance[i] = np.sqrt(square) if side >= 0.0 else -np.sqrt(square)


@numba.njit(cache=True, nogil=True)
def _guess_loop(points, ids, record, records, guess):
    """Distance of each point to the nearest of the triangles of eight corners."""
    for i in range(len(points)):
        least = np.inf
        for k in range(8):
            n = record[ids[i, k]]
            least = min(least, record_square(records, n, points[i, 0], points[i, 1], points[i, 2]))
        guess[i] = np.sqrt(least)


@numba.njit(cache=True, nogil=True)
def _active_loop(ids, distance, centre, edge, band, active):
    """Mark fine cells that may hold a point nearer than ``band``, by the bounds from the block's nine
    samples."""
    fine = edge / BLOCK
    for i in range(len(ids)):
        for cell in range(CUT):
            x = (cell // (BLOCK * BLOCK) + 0.5) * fine
            y = (cell // BLOCK % BLOCK + 0.5) * fine
            z = (cell % BLOCK + 0.5) * fine
            half = 0.5 * edge
            bound = abs(centre[i]) - np.sqrt((x - half) ** 2 + (y - half) ** 2 + (z - half) ** 2)
            for k in range(8):
                dx, dy, dz = x - edge * (k // 4), y - edge * (k // 2 % 2), z - edge * (k % 2)
                bound = max(bound, abs(distance[ids[i, k]]) - np.sqrt(dx * dx + dy * dy + dz * dz))
            active[i, cell] = bound - 0.5 * np.sqrt(3.0) * fine < band


@numba.njit(cache=True, nogil=True)
def _near_loop(blocks, offsets, lists, records, origin, edge, band, active):
    """Unmark fine cells that the triangles of a block show to be out of the band, unless the surface is
    folded."""
    fine = edge / BLOCK
    limit = (band + 0.5 * np.sqrt(3.0) * fine) ** 2
    for i in range(len(blocks)):
        first = offsets[i] + 1
        count = lists[offsets[i]] & COUNT
        if _folded(records, lists[first : first + count], count):
            continue
        for cell in range(CUT):
            if not active[i, cell]:
                continue
            x = origin[0] + edge * blocks[i, 0] + (cell // (BLOCK * BLOCK) + 0.5) * fine
            y = origin[1] + edge * blocks[i, 1] + (cell // BLOCK % BLOCK + 0.5) * fine
            z = origin[2] + edge * blocks[i, 2] + (cell % BLOCK + 0.5) * fine
            near = False
            for m in range(first, first + count):
                near = near or record_square(records, lists[m], x, y, z) < limit
            active[i, cell] = near


@numba.njit(cache=True, nogil=True)
def _slot(block, cell, step, owner):
    """Block that owns a corner of a fine cell, and the corner's place in it."""
    a = cell // (BLOCK * BLOCK) + step // 4
    b = cell // BLOCK % BLOCK + step // 2 % 2
    c = cell % BLOCK + step % 2
    home = owner[block[0] + a // BLOCK, block[1] + b // BLOCK, block[2] + c // BLOCK]
    return home, (a % BLOCK * BLOCK + b % BLOCK) * BLOCK + c % BLOCK


@numba.njit(cache=True, nogil=True)
def _mark_loop(blocks, active, owner, number):
    for i in range(len(blocks)):
        for cell in range(CUT):
            if active[i, cell]:
                for k in range(8):
                    home, place = _slot(blocks[i], cell, k, owner)
                    number[home, place] = 0


@numba.njit(cache=True, nogil=True)
def _fine_ids_loop(blocks, which, cell, owner, number, ids):
    for i in range(len(which)):
        for k in range(8):
            home, place = _slot(blocks[which[i]], cell[i], k, owner)
            ids[i, k] = number[home, place]


@numba.njit(cache=True, nogil=True)
def _list_loop(low, ids, nodes, centre, edge, unit, mesh, out):
    """Write the list of each cell; return the lengths used and whether all signs agree with the distances."""
    record, distance, doubt = nodes
    lists, offsets, rows, first_row = out
    used, mixed, sound = 0, 0, True
    nodes_left, squares = np.empty(STACK, np.int64), np.empty(STACK)
    for i in range(len(ids)):
        listed = lists[used + 1 : used + 1 + MOST]
        count = 0
        doubted = False
        for k in range(9):
            n = centre[i] if k == 8 else record[ids[i, k]]
            if n >= 0:
                count = _add(listed, count, n)
            if k < 8:
                doubted = doubted or doubt[ids[i, k]]
        folded = abs(distance[ids[i, 0]]) < FOLD_REACH * edge and _folded(mesh[0][2], listed, count)
        count = _probe(listed, count, folded, low[i], edge, mesh, nodes_left, squares)
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


@numba.njit(cache=True, nogil=True)
def _add(listed, count, n):
    """Append n to the first ``count`` triangles of a list if it is new and has room; return their number."""
    for m in range(count):
        if listed[m] == n:
            return count
    if count == MOST:
        return count
    listed[count] = n
    return count + 1


@numba.njit(cache=True, nogil=True)
def _folded(records, listed, count):
    """Whether the triangles of a list face different ways."""
    first = listed[0]
    for m in range(1, count):
        n, dot = listed[m], 0.0
        for k in range(3):
            dot += records[first, 9 + k] * records[n, 9 + k]
        if dot < FOLD:
            return True
    return False


@numba.njit(cache=True, nogil=True)
def _probe(listed, count, folded, low, edge, mesh, nodes_left, squares):
    """Add the triangles nearest to points inside the cell.

    Where a corner's nearest point lies on an edge or a vertex, several triangles are equally near and the
    corner names only one of them; inside the cell another may be nearer by far. A walk downhill over the
    surface, from the nearest triangle listed, finds it; where the surface is folded the tree is asked.
    """
    (boxes, starts, records), across, origin, _ = mesh
    for k in range(len(PROBES)):
        x = origin[0] + edge * (low[0] + 0.5 + PROBES[k, 0])
        y = origin[1] + edge * (low[1] + 0.5 + PROBES[k, 1])
        z = origin[2] + edge * (low[2] + 0.5 + PROBES[k, 2])
        best, square = listed[0], np.inf
        for m in range(count):
            s = record_square(records, listed[m], x, y, z)
            if s < square:
                best, square = listed[m], s
        if folded:
            end, _ = nearest_triangle(boxes, starts, records, x, y, z, best, square, nodes_left, squares)
        else:
            end = _walk(best, square, x, y, z, records, across)
        if end != best:
            count = _add(listed, count, end)
    return count


@numba.njit(cache=True, nogil=True)
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
                if s < square * (1 - 1e-9):
                    step, square = n, s
        if step == best:
            return best
        best = step
    return best


@numba.njit(cache=True, nogil=True)
def _same_before(lists, offsets, i, used, size):
    """Offset of a recent list equal to the one at ``used``, or ``used``."""
    for m in range(max(0, i - LOOK_BACK), i):
        other, same = offsets[m], True
        for k in range(size):
            same = same and lists[other + k] == lists[used + k]
        if same:
            return other
    return used


@numba.njit(cache=True, nogil=True)
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


@numba.njit(cache=True, nogil=True)
def _signs_agree(ids, distance, edge):
    """Whether the surface is near enough wherever the sign changes along an edge of the cell."""
    for k in range(8):
        for bit in (1, 2, 4):
            if k & bit == 0:
                a, b = distance[ids[k]], distance[ids[k | bit]]
                if a * b < 0.0 and abs(a - b) > edge * (1 + 1e-6):
                    return False
    return True


@numba.njit(cache=True, nogil=True)
def _fill_row(low, ids, distance, edge, row):
    for k in range(8):
        row[k] = distance[ids[k]]
    for k in range(3):
        row[8 + k] = low[k] * edge
    row[11] = 1.0 / edge
