"""How fast this machine is now: a few small measurements, in which the cost of everything else is counted."""

from __future__ import annotations

import json
import os
import time
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

# Least of so many rounds: what else the machine does can only make a round longer.
ROUNDS = 7


def shortest(act: Any) -> Any:
    """Least time of a few calls [s]; the first, which may load compiled code, does not count."""
    act()
    times = []
    for _ in range(ROUNDS):
        start = time.perf_counter()
        act()
        times.append(time.perf_counter() - start)
    return min(times)


def measure_rates() -> Any:
    """Seconds for one unit of each kind of work, on one thread, measured now.

    Returns
    -------
    dict of str to float
        ``call``: a call of NumPy on a small array. ``visit``: one entry of a sparse matrix times a vector, which
        stands for the loops over meshes. ``query``: an exact distance near a mesh.
    """
    return {"call": _call(), "visit": _visit(), "query": _query()}


@cache
def scales() -> dict[str, Any]:
    """What the counts of work are multiplied by, as runs were last found to take: ``plan_check.py --remake`` writes it.

    Returns
    -------
    dict
        ``models``: of each model ``build`` and ``motion``; of any ``checks`` of the bones and ``lines`` that lengths
        are taken along, before the motion, and ``metrics`` and ``write`` of a frame; ``command``, ``commit``,
        ``machine`` and ``date`` say where they come from.
    """
    return json.loads(Path(__file__).with_name("scales.json").read_text(encoding="utf-8"))


def resident_memory() -> Any:
    """Memory that this process holds [bytes]; 0 where the system does not tell."""
    try:
        pages = int(Path("/proc/self/statm").read_text().split()[1])
    except (OSError, IndexError):
        return 0
    return pages * os.sysconf("SC_PAGE_SIZE")


def _call(count=500):
    one = np.ones((100, 3))

    def act():
        for _ in range(count):
            np.multiply(one, 2.0)

    return shortest(act) / count


def _visit(count=20_000, row=7):
    import scipy.sparse as sparse

    rng = np.random.default_rng(0)
    columns = (np.arange(count)[:, None] + rng.integers(-200, 200, (count, row))) % count
    matrix = sparse.csr_matrix(
        (np.ones(count * row), columns.ravel(), np.arange(0, count * row + 1, row)), shape=(count, count)
    )
    vector = rng.random(count)
    return shortest(lambda: matrix @ vector) / (count * row)


def _query(count=1000):
    from rbfmuscle.geometry.exact_distance import ExactDistance

    tree = ExactDistance(*_bumpy_sphere(48))
    points = np.random.default_rng(0).normal(size=(count, 3))
    points *= 1.1 / np.linalg.norm(points, axis=1, keepdims=True)
    return shortest(lambda: tree.signed_distance(points)) / count


def _bumpy_sphere(rings):
    """Closed, outward mesh with 2 rings (rings - 1) triangles and as many sides as rings."""
    polar, around = np.meshgrid(
        np.pi * np.arange(1, rings) / rings, 2 * np.pi * np.arange(rings) / rings, indexing="ij"
    )
    radius = 1 + 0.05 * np.sin(5 * polar) * np.cos(4 * around)
    ring = np.stack([np.sin(polar) * np.cos(around), np.sin(polar) * np.sin(around), np.cos(polar)], axis=-1)
    vertices = np.vstack([(radius[..., None] * ring).reshape(-1, 3), [[0, 0, 1], [0, 0, -1]]])
    number = np.arange((rings - 1) * rings).reshape(rings - 1, rings)
    a, b = number[:-1], number[1:]
    c, d = np.roll(b, -1, axis=1), np.roll(a, -1, axis=1)
    first, last = number[0], number[-1]
    north, south = np.full(rings, len(vertices) - 2), np.full(rings, len(vertices) - 1)
    faces = [
        np.stack([a, b, c], axis=-1).reshape(-1, 3),
        np.stack([a, c, d], axis=-1).reshape(-1, 3),
        np.stack([north, first, np.roll(first, -1)], axis=-1),
        np.stack([south, np.roll(last, -1), last], axis=-1),
    ]
    return vertices, np.concatenate(faces)
