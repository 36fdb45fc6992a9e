"""Corners of the cells of a bone's distance field: which there are, and which cells share them."""

from collections.abc import Iterable

import numpy as np

from rbfmuscle.geometry.arrays import Array, Integers
from rbfmuscle.jit import compiled


def lattice(shape: Iterable[int]) -> Integers:
    """All integer points (n, 3) of a box of this shape, in C order."""
    axes: list[Integers] = [np.arange(n) for n in shape]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def mark_corners(blocks: Integers, shape: tuple[int, int, int]) -> tuple[Array, Integers]:
    """Number of each corner of the blocks in a dense table (-1 elsewhere), and the corners (n, 3)
    in order.
    """
    index = np.full(np.array(shape) + 1, -1, dtype=np.int32)
    for step in lattice((2, 2, 2)):
        index[tuple((blocks + step).T)] = 0
    wanted = np.argwhere(index == 0)
    index[tuple(wanted.T)] = np.arange(len(wanted), dtype=np.int32)
    return index, wanted


def corner_ids(low: Integers, index: Array) -> Array:
    """Numbers (n, 8) of the corners of cells with least corner ``low`` (n, 3), from a dense
    table.
    """
    ids = [index[tuple((low + step).T)] for step in lattice((2, 2, 2))]
    return np.ascontiguousarray(np.stack(ids, axis=1))


@compiled
def _slot(block, cell, step, owner, side):
    """Block that owns a corner of a small cell, and the corner's place in it."""
    a = cell // (side * side) + step // 4
    b = cell // side % side + step // 2 % 2
    c = cell % side + step % 2
    home = owner[block[0] + a // side, block[1] + b // side, block[2] + c // side]
    return home, (a % side * side + b % side) * side + c % side


@compiled
def mark_loop(blocks, active, owner, side, number):
    """Put a zero in ``number`` (blocks, side^3) for each corner of an active small cell."""
    for i in range(len(blocks)):
        for cell in range(active.shape[1]):
            if active[i, cell]:
                for k in range(8):
                    home, place = _slot(blocks[i], cell, k, owner, side)
                    number[home, place] = 0


@compiled
def small_ids_loop(blocks, which, cell, owner, side, number, ids):
    """Numbers ``ids`` (n, 8) of the corners of small cells, given by their block and place in
    it.
    """
    for i in range(len(which)):
        for k in range(8):
            home, place = _slot(blocks[which[i]], cell[i], k, owner, side)
            ids[i, k] = number[home, place]
