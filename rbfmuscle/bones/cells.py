"""Which cell of a bone's distance field a point lies in, and how far from the bone that says it is
at least.
"""

import numpy as np

from rbfmuscle.jit import compiled

# Lower bits of a header below the lower bound of its cell.
BOUND = 6
# Cells along one edge of a block, on every level.
BLOCK = 4
# Columns of ``grid``: origin of the grid, inverse edge of a block, unit of the lower bounds.
INVERSE, UNIT = 3, 4


@compiled(inline="always")
def _block_entry(x, y, z, scale, blocks):
    """Entry of the block that holds a point relative to the origin, the fine cell in it, and
    whether it is far.
    """
    u = x * scale
    v = y * scale
    w = z * scale
    nx, ny, nz = blocks.shape
    far = u < -1.0 or v < -1.0 or w < -1.0 or u > nx + 1.0 or v > ny + 1.0 or w > nz + 1.0
    # The cells of the border serve beyond the grid.
    u = min(max(u, 0.0), nx - 1e-6)
    v = min(max(v, 0.0), ny - 1e-6)
    w = min(max(w, 0.0), nz - 1e-6)
    i = int(u)
    j = int(v)
    k = int(w)
    cell = (int((u - i) * BLOCK) * BLOCK + int((v - j) * BLOCK)) * BLOCK + int((w - k) * BLOCK)
    return blocks[i, j, k], cell, far


@compiled(inline="always")
def _beyond(x, y, z, scale, blocks):
    """Squared distance of a point relative to the origin from the grid."""
    nx, ny, nz = blocks.shape
    dx = x - min(max(x, 0.0), nx / scale)
    dy = y - min(max(y, 0.0), ny / scale)
    dz = z - min(max(z, 0.0), nz / scale)
    return dx * dx + dy * dy + dz * dz


@compiled(inline="always")
def _placed(point, pose, grid):
    """A point of the world relative to the grid's origin."""
    p = point[0] - pose[0, 3]
    q = point[1] - pose[1, 3]
    r = point[2] - pose[2, 3]
    x = pose[0, 0] * p + pose[1, 0] * q + pose[2, 0] * r - grid[0]
    y = pose[0, 1] * p + pose[1, 1] * q + pose[2, 1] * r - grid[1]
    z = pose[0, 2] * p + pose[1, 2] * q + pose[2, 2] * r - grid[2]
    return x, y, z


@compiled
def _common_bound(points, pose, grid, blocks, cells, lists):
    """Distance from the bone that all of these points have at least, by the bound at the one in
    their middle.
    """
    middle = points[len(points) // 2]
    square = 0.0
    for n in range(len(points)):
        dx = points[n, 0] - middle[0]
        dy = points[n, 1] - middle[1]
        dz = points[n, 2] - middle[2]
        square = max(square, dx * dx + dy * dy + dz * dz)
    x, y, z = _placed(middle, pose, grid)
    entry, cell, far_point = _block_entry(x, y, z, grid[INVERSE], blocks)
    if entry < 0:
        entry = cells[-1 - entry, cell]
    bound = (lists[entry] >> BOUND) * grid[UNIT]
    if far_point:
        bound = np.sqrt(bound * bound + _beyond(x, y, z, grid[INVERSE], blocks))
    return bound - np.sqrt(square * (pose[0, 0] ** 2 + pose[1, 0] ** 2 + pose[2, 0] ** 2))
