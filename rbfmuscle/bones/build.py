"""Builds the sparse cells of a bone's distance field from exact distances at their corners.

Four levels: coarse cells over the whole grid; blocks, four times finer, where a coarse cell may
meet the outer band about the surface or errs; half blocks in the outer band; fine cells, four to a
block's edge, in the inner band.
"""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from rbfmuscle.bones.cells import BLOCK
from rbfmuscle.bones.lattice import corner_ids, lattice, mark_corners, mark_loop, small_ids_loop
from rbfmuscle.bones.lists import LONGEST, SLACK, folded_list, list_loop
from rbfmuscle.bones.query import COUNT, FieldData
from rbfmuscle.geometry.arrays import Array, Booleans, Floats, Integers
from rbfmuscle.geometry.exact_distance import (
    STACK,
    ExactDistance,
    nearest_triangle,
    record_square,
    signed_side,
)
from rbfmuscle.geometry.threads import in_chunks
from rbfmuscle.geometry.triangles import FIRST
from rbfmuscle.jit import compiled

# Fine cells of a block.
CUT = BLOCK**3
# Half blocks reach this many fine cells further than the band of the fine cells.
OUTER = 3.0
# Shift of the grid from the middle of the bone, in coarse cells.
OFF_MIDDLE = np.array([0.0137, 0.0291, 0.0173])
# A coarse cell is cut where its corners' triangles err at its centre by more than this share of the
# distance.
COARSE_ERROR = 0.02
# Lower bounds of the distance are held in multiples of this share of a fine cell.
UNIT_SHARE = 1 / 16
# Directions in which triangles are sought for points beyond the grid.
FAR_DIRECTIONS = 200


class _Nodes(NamedTuple):
    """Points where the exact distance was asked for: nearest record, signed distance, doubt about
    the sign.
    """

    record: np.ndarray
    distance: np.ndarray
    doubt: np.ndarray


class _Builder:
    """What all levels share, and the lists so far."""

    def __init__(
        self,
        exact: ExactDistance,
        origin: Floats,
        unit: float,
        inside: Callable[[Floats], Booleans] | None,
        doubtful: Booleans | None,
    ) -> None:
        self.exact = exact
        self.origin = origin
        self.unit = unit
        self.inside = inside
        self.doubtful = (
            np.zeros(len(exact.faces), dtype=np.bool_)
            if doubtful is None
            else doubtful[exact.order]
        )
        place = np.full(len(exact.order) + 1, -1, dtype=np.int32)
        place[exact.order] = np.arange(len(exact.order))
        #: Corner of its face that is the first of each record, and the two that follow.
        self.turn = (exact.records[:, FIRST].astype(np.int64)[:, None] + np.arange(3)) % 3
        self.across = place[np.maximum(exact.across[exact.order[:, None], self.turn], -1)]
        self.lists: list[Array] = []
        self.corners: list[Array] = []
        self.length = self.rows = 0
        self.sound = True

    def nodes(self, index: Array, edge: float, near: Array | None = None) -> _Nodes:
        """Exact distances at lattice points ``index`` (n, 3) times ``edge``; ``near`` names a near
        record.
        """
        points = np.ascontiguousarray(self.origin + edge * index)
        record, distance = np.empty(len(points), dtype=np.int32), np.empty(len(points))
        near = np.full(len(points), -1, dtype=np.int32) if near is None else near
        exact = self.exact
        normals = (*exact.pseudonormals, exact.faces, exact.order)

        def work(a, b):
            _node_loop(points[a:b], near[a:b], exact.tree, normals, record[a:b], distance[a:b])

        in_chunks(len(points), work, least=256)
        doubt = np.zeros(len(points), dtype=np.bool_)
        if self.inside is not None:
            signed = np.where(self.inside(points), -np.abs(distance), np.abs(distance))
            doubt = signed * distance < 0.0
            distance = signed
        return _Nodes(record, distance, doubt)

    def write(
        self,
        low: Integers,
        edge: float,
        ids: Array,
        corners: _Nodes,
        centres: Array | None,
        *,
        probe: bool = True,
    ) -> Array:
        """Lists of cells with least corner ``low`` (n, 3) in edges, probed inside; returns their
        offsets (n,).
        """
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
            cells = low[a:b], ids[a:b], centre[a:b]
            used, mixed, sound = list_loop(cells, nodes, float(edge), self.unit, mesh, probe, out)
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


def build_cells(
    exact: ExactDistance,
    spacing: float,
    band: float,
    *,
    inside: Callable[[Floats], Booleans] | None = None,
    region: Floats | None = None,
    doubtful: Booleans | None = None,
) -> tuple[FieldData, bool]:
    """What queries read: sparse cells about the mesh of an exact tree; and whether signs agree with
    the distances.

    ``spacing`` is the edge of a fine cell; fine cells cover all points nearer than ``band``, coarse
    ones serve outside of the box ``region`` (2, 3). ``inside`` gives the sign where the mesh itself
    has no reliable one, ``doubtful`` (m,) marks faces whose pseudonormals are not to be believed.
    Records are in single precision and relative to the grid's origin, where that loses nothing.
    """
    block, coarse = BLOCK * spacing, BLOCK * BLOCK * spacing
    low, high = exact.vertices.min(axis=0), exact.vertices.max(axis=0)
    margin = band + block
    shape = grid_shape(low, high, spacing, band)
    # Off the middle, so that corners do not lie on the planes of symmetry of symmetric meshes: two
    # triangles equally near would be told apart by rounding.
    origin = 0.5 * (low + high) - (0.5 + OFF_MIDDLE / shape) * coarse * shape
    box = (
        np.array([low - margin, high + margin])
        if region is None
        else np.asarray(region, dtype=np.float64)
    )
    builder = _Builder(exact, origin, UNIT_SHARE * spacing, inside, doubtful)

    bands = (band, band + OUTER * spacing)
    table, chosen = _coarse_level(builder, shape, coarse, bands[1], (box - origin) / coarse)
    cells = _block_level(builder, table, chosen, block, bands, (box - origin) / block)
    far = _far_records(exact, float(np.linalg.norm(high - low)))
    lists, corners = np.concatenate(builder.lists), np.concatenate(builder.corners)
    records = np.empty((len(exact.records), 16), dtype=np.float32)
    records[:, :3] = exact.records[:, :3] - origin
    records[:, 3:] = exact.records[:, 3:16]
    rows = exact.order[:, None], builder.turn
    data = FieldData(
        grid=np.array([*origin, 1.0 / block, builder.unit]),
        blocks=table,
        cells=cells,
        lists=lists,
        corners=corners,
        far=far,
        records=records,
        edge_normals=exact.pseudonormals[0][rows].astype(np.float32),
        vertex_normals=exact.pseudonormals[1].astype(np.float32),
        vertices=exact.faces[rows].astype(np.int32),
        across=builder.across,
    )
    return data, builder.sound


def grid_shape(low: Floats, high: Floats, spacing: float, band: float) -> Integers:
    """Coarse cells of the grid along each axis."""
    margin = band + BLOCK * spacing
    return np.maximum(
        np.ceil((high - low + 2 * margin) / (BLOCK * BLOCK * spacing)).astype(np.int64), 1
    )


def _coarse_level(builder, shape, edge, band, box):
    """Block table filled with the lists of coarse cells, and the (n, 3) blocks that are to replace
    them.
    """
    low = lattice(shape)
    corners, centres = builder.nodes(lattice(shape + 1), edge), builder.nodes(low + 0.5, edge)
    ids = corner_ids(low, np.arange(len(corners.record), dtype=np.int32).reshape(shape + 1))
    offsets = builder.write(low, edge, ids, corners, centres.record)
    table = offsets.reshape(shape)
    for axis in range(3):
        table = table.repeat(BLOCK, axis)
    guess = np.empty(len(low))
    _guess_loop(
        builder.origin + edge * (low + 0.5), ids, corners.record, builder.exact.records, guess
    )
    distance = np.abs(centres.distance)
    near = distance - 0.5 * np.sqrt(3) * edge < band
    wanted = near | (guess > (1 + COARSE_ERROR) * distance)
    wanted &= np.all((low + 1 > box[0]) & (low < box[1]), axis=1)
    chosen = (BLOCK * low[wanted][:, None, :] + lattice((BLOCK,) * 3)).reshape(-1, 3)
    return np.ascontiguousarray(table), chosen


def _block_level(builder, table, chosen, edge, bands, box):
    """Put the blocks' lists, and what refers to smaller cells, in the table; return the smaller
    cells (k, 64).
    """
    if len(chosen) == 0:
        return np.zeros((0, CUT), dtype=np.int32)
    index, wanted = mark_corners(chosen, table.shape)
    corners = builder.nodes(wanted, edge)
    ids = corner_ids(chosen, index)
    # Only blocks that may be cut are looked at in their centre.
    least = np.abs(corners.distance[ids]).argmin(axis=1)
    nearest = ids[np.arange(len(ids)), least]
    reach = bands[1] + 0.5 * np.sqrt(3) * edge
    cut = np.abs(corners.distance[nearest]) < reach
    cut &= np.all((chosen + 1 > box[0]) & (chosen < box[1]), axis=1)
    centres = builder.nodes(chosen[cut] + 0.5, edge, near=corners.record[nearest[cut]])
    record = np.full(len(chosen), -1, dtype=np.int32)
    record[cut] = centres.record
    offsets = builder.write(chosen, edge, ids, corners, record)
    table[tuple(chosen.T)] = offsets
    kept = np.abs(centres.distance) < reach
    cut[cut] = kept
    table[tuple(chosen[cut].T)] = -1 - np.arange(int(cut.sum()), dtype=np.int32)
    samples = (ids[cut], corners.distance, centres.distance[kept])
    return _cut_blocks(builder, table.shape, chosen[cut], offsets[cut], samples, edge, bands)


def _cut_blocks(builder, shape, blocks, offsets, samples, edge, bands):
    """Offsets (k, 64) of the smaller cells of blocks, those of the block itself where it
    suffices.
    """
    lists = np.concatenate(builder.lists)
    marks = []
    for side, band in zip((BLOCK, 2), bands):
        active = np.zeros((len(blocks), side**3), dtype=np.bool_)
        _active_loop(*samples, edge, band, side, active)
        if builder.inside is None:
            cut = builder.origin, edge, band, side
            _near_loop(blocks, offsets, lists, builder.exact.records, cut, active)
        marks.append(active)
    parent = (lattice((BLOCK,) * 3) // (BLOCK // 2)) @ np.array([4, 2, 1])
    fine, half = marks
    for k in range(8):
        half[:, k] &= ~fine[:, parent == k].all(axis=1)
    cells = np.repeat(offsets[:, None], CUT, axis=1)
    own = _small_cells(builder, shape, blocks, half, edge, 2)[:, parent]
    cells = np.where(half[:, parent], own, cells)
    return np.where(fine, _small_cells(builder, shape, blocks, fine, edge, BLOCK), cells)


def _small_cells(builder, shape, blocks, active, edge, side):
    """Offsets (k, side^3) of the lists of active cells, ``side`` to an edge of a block."""
    cells = np.zeros(active.shape, dtype=np.int32)
    if not active.any():
        return cells
    owner, owners = mark_corners(blocks, shape)
    number = np.full((len(owners), side**3), -1, dtype=np.int32)
    mark_loop(blocks, active, owner, side, number)
    slots = np.argwhere(number == 0)
    number[number == 0] = np.arange(len(slots), dtype=np.int32)
    steps = lattice((side,) * 3)
    corners = builder.nodes(side * owners[slots[:, 0]] + steps[slots[:, 1]], edge / side)
    which, cell = np.nonzero(active)
    ids = np.empty((len(which), 8), dtype=np.int32)

    def work(a, b):
        small_ids_loop(blocks, which[a:b], cell[a:b], owner, side, number, ids[a:b])

    in_chunks(len(which), work)
    # In the fine cells a query's own walk over the surface finds what the corners missed.
    low, probe = side * blocks[which] + steps[cell], side < BLOCK
    cells[active] = builder.write(low, edge / side, ids, corners, None, probe=probe)
    return cells


def _far_records(exact, diagonal):
    """Records nearest to points spread over large spheres: what a point beyond the grid is tested
    against.
    """
    turn = np.arange(FAR_DIRECTIONS) * np.pi * (3 - np.sqrt(5))
    z = 1 - (2 * np.arange(FAR_DIRECTIONS) + 1) / FAR_DIRECTIONS
    flat = np.sqrt(1 - z * z)
    directions = np.column_stack([flat * np.cos(turn), flat * np.sin(turn), z])
    centre = 0.5 * (exact.vertices.min(axis=0) + exact.vertices.max(axis=0))
    faces = exact.nearest(centre + 1.5 * diagonal * directions)[2]
    place = np.empty(len(exact.order), dtype=np.int32)
    place[exact.order] = np.arange(len(exact.order))
    return np.unique(place[faces])


@compiled
def _node_loop(points, near, tree, normals, record, distance):
    records = tree.records
    closest = np.empty(3)
    normal = np.empty(3)
    stack = np.empty(STACK, np.int64), np.empty(STACK)
    best = 0
    for i in range(len(points)):
        x = points[i, 0]
        y = points[i, 1]
        z = points[i, 2]
        # Where nothing nearer is named, the last answer bounds this one.
        best = near[i] if near[i] >= 0 else best
        square = record_square(records, best, x, y, z)
        best, square = nearest_triangle(tree, (x, y, z), best, square, SLACK, stack)
        record[i] = best
        side = signed_side(records[best], normals[3][best], points[i], normals, closest, normal)
        distance[i] = np.sqrt(square) if side >= 0.0 else -np.sqrt(square)


@compiled
def _guess_loop(points, ids, record, records, guess):
    """Distance of each point to the nearest of the triangles of eight corners."""
    for i in range(len(points)):
        least = np.inf
        for k in range(8):
            n = record[ids[i, k]]
            least = min(least, record_square(records, n, points[i, 0], points[i, 1], points[i, 2]))
        guess[i] = np.sqrt(least)


@compiled
def _active_loop(ids, distance, centre, edge, band, side, active):
    """Mark small cells that may hold a point nearer than ``band``, by bounds from a block's nine
    samples.
    """
    small = edge / side
    half = 0.5 * edge
    for i in range(len(ids)):
        for cell in range(side**3):
            x = (cell // (side * side) + 0.5) * small
            y = (cell // side % side + 0.5) * small
            z = (cell % side + 0.5) * small
            bound = abs(centre[i]) - np.sqrt((x - half) ** 2 + (y - half) ** 2 + (z - half) ** 2)
            for k in range(8):
                dx = x - edge * (k // 4)
                dy = y - edge * (k // 2 % 2)
                dz = z - edge * (k % 2)
                bound = max(bound, abs(distance[ids[i, k]]) - np.sqrt(dx * dx + dy * dy + dz * dz))
            active[i, cell] = bound - 0.5 * np.sqrt(3.0) * small < band


@compiled
def _near_loop(blocks, offsets, lists, records, cut, active):
    """Unmark small cells that a block's triangles show to be out of the band, unless the surface is
    folded.

    ``cut`` holds origin, edge of a block, width of the band and small cells along an edge.
    """
    origin, edge, band, side = cut
    small = edge / side
    limit = (band + 0.5 * np.sqrt(3.0) * small) ** 2
    for i in range(len(blocks)):
        first = offsets[i] + 1
        count = lists[offsets[i]] & COUNT
        if folded_list(records, lists[first : first + count], count):
            continue
        for cell in range(side**3):
            if not active[i, cell]:
                continue
            x = origin[0] + edge * blocks[i, 0] + (cell // (side * side) + 0.5) * small
            y = origin[1] + edge * blocks[i, 1] + (cell // side % side + 0.5) * small
            z = origin[2] + edge * blocks[i, 2] + (cell % side + 0.5) * small
            near = False
            for m in range(first, first + count):
                near = near or record_square(records, lists[m], x, y, z) < limit
            active[i, cell] = near
