"""Mending meshes where it is safe: what is changed never moves a vertex by more than rounding."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.validation import MeshError

MERGE_TOLERANCE = 1e-7  # of the diagonal: float32 files repeat vertices to about this
HOLE_LIMIT = 0.1  # of the diagonal: a longer rim (of more than four edges) is not closed by guesswork
COLLAPSE_TOLERANCE = 1e-9  # of the diagonal: ends of an edge that are one point
LEAST_COMPACTNESS = 1e-6  # volume over area^1.5; a ball has 0.094, a sheet 200 x 200 x 0.05 mm 2.4e-5
TWISTED_NOTED = 0.005  # of the area
MOST_TWISTED = 0.3  # of the area: of more it cannot be said what is inside
WINDING_SAMPLES = 1500  # triangles asked; before and behind them by a small share of their size:
WINDING_STEP = 1e-3
CRUMB_LIMIT = 0.01  # of the largest part's area: smaller loose parts are dropped


@dataclass
class Repaired:
    """Arrays of a mended mesh; ``vertex_map`` takes old vertex numbers to new ones (-1: dropped)."""

    vertices: np.ndarray
    faces: np.ndarray
    vertex_map: np.ndarray
    notes: list = field(default_factory=list)
    closed: bool = True


def repair(vertices: Floats, faces: Integers, *, place: str, may_be_open: bool = False) -> Repaired:
    """Return the mesh closed, manifold, outward; say what was done.

    Parameters
    ----------
    vertices : (n, 3) ndarray
    faces : (m, 3) ndarray of int
    place : str
        Begins each message: the file or the object.
    may_be_open : bool
        Keep holes and several parts (bones) instead of refusing them.

    Raises
    ------
    MeshError
        If holes, non-manifold edges or several parts remain that cannot be mended safely.
    """
    vertices = np.asarray(vertices, dtype=np.float64)
    state = Repaired(vertices, np.asarray(faces, dtype=np.int64), np.arange(len(vertices)))
    _drop_degenerate(state)
    if not _is_closed(state.faces):
        _merge_equal(state)
        _drop_fins(state)
    if len(state.faces) == 0:
        raise MeshError(f"{place}: nothing is left of the mesh without degenerate triangles")
    _drop_crumbs(state, keep_parts=may_be_open)
    _drop_unused(state)
    if not _is_closed(state.faces):
        _check_manifold(state.faces, place)
        _fill_holes(state)
    _collapse_points(state)
    _orient(state, place)
    state.closed = _is_closed(state.faces)
    if not state.closed:
        count = int((_edge_uses(state.faces)[1] == 1).sum())
        if not may_be_open:
            raise MeshError(
                f"{place}: the surface is open ({count} boundary edges{_widest_hole(state)}); close its holes"
            )
        state.notes.append(f"the surface is open ({count} boundary edges)")
    elif not may_be_open:
        _check_one_part(state, place)
        wrong = check_volume(state.vertices, state.faces, place=place)
        if wrong > TWISTED_NOTED:
            state.notes.append(f"the surface passes through itself over {100 * wrong:.2g} % of its area")
    return state


def _edge_uses(faces):
    """Undirected edges (sorted pairs), how many faces use each, and the edge of each face's side."""
    keys, width = _edge_keys(faces)
    unique, inverse, count = np.unique(keys, return_inverse=True, return_counts=True)
    return np.column_stack([unique // width, unique % width]), count, inverse.reshape(-1, 3)


def _edge_keys(faces):
    """One number for each side of each face, the same for both directions of an edge."""
    width = int(faces.max()) + 1
    ends = faces[:, [1, 2, 0]]
    return (np.minimum(faces, ends) * width + np.maximum(faces, ends)).ravel(), width


def _is_closed(faces):
    return len(faces) > 0 and bool((_edge_uses(faces)[1] == 2).all())


def _drop_degenerate(state):
    f = state.faces
    degenerate = (f[:, 0] == f[:, 1]) | (f[:, 1] == f[:, 2]) | (f[:, 2] == f[:, 0])
    width = int(f.max()) + 1
    low, middle, high = np.sort(f, axis=1).T
    _, first = np.unique((low * width + middle) * width + high, return_index=True)
    keep = np.zeros(len(f), dtype=bool)
    keep[first] = True
    keep &= ~degenerate
    if not keep.all():
        state.notes.append(f"{int((~keep).sum())} degenerate or repeated triangles dropped")
        state.faces = f[keep]


def _merge_equal(state):
    diagonal = np.linalg.norm(np.ptp(state.vertices, axis=0))
    if diagonal == 0:
        return
    keys = np.round((state.vertices - state.vertices.min(axis=0)) / (MERGE_TOLERANCE * diagonal)).astype(
        np.int64
    )
    _, first, inverse = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    merged = first[inverse.ravel()]
    count = int((merged != np.arange(len(merged))).sum())
    if count:
        state.notes.append(f"{count} repeated vertices merged")
        state.faces = merged[state.faces]
        state.vertex_map = merged[state.vertex_map]
        _drop_degenerate(state)


def _collapse_points(state):
    """Contract edges without length of a closed surface, where it stays closed: their triangles have no normal."""
    if not _is_closed(state.faces):
        return
    tolerance = COLLAPSE_TOLERANCE * np.linalg.norm(np.ptp(state.vertices, axis=0))
    sides = state.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    short = sides[np.linalg.norm(np.diff(state.vertices[sides], axis=1)[:, 0], axis=1) <= tolerance]
    if not len(short):
        return
    count = len(state.vertices)
    graph = coo_matrix((np.ones(len(short)), short.T), shape=(count, count))
    _, label = connected_components(graph, directed=False)
    _, first = np.unique(label, return_index=True)
    merged = first[label]
    faces = merged[state.faces]
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
    _, back, uses = np.unique(np.sort(faces, axis=1), axis=0, return_inverse=True, return_counts=True)
    faces = faces[uses[back.ravel()] == 1]  # triangles that came to lie back to back enclose nothing
    if len(faces) < 4 or not _is_closed(faces):
        return
    state.notes.append(f"{len(state.faces) - len(faces)} triangles without extent dropped")
    state.faces, state.vertex_map = faces, np.where(state.vertex_map < 0, -1, merged[state.vertex_map])
    _drop_unused(state)


def check_volume(vertices: np.ndarray, faces: np.ndarray, *, place: str) -> float:
    """Raise MeshError unless a closed surface (n, 3), (m, 3) encloses a volume, once, over most of its area.

    A flat or twisted surface may be closed and consistently oriented, and still have no inside. Returned is the
    share of its area that does not bound the inside.
    """
    a, b, c = (vertices - vertices.mean(axis=0))[faces].transpose(1, 0, 2)
    volume = float(np.einsum("ij,ij->i", a, np.cross(b, c)).sum() / 6.0)
    area = float(_areas(vertices, faces).sum())
    if not volume > LEAST_COMPACTNESS * area**1.5:
        raise MeshError(
            f"{place}: the surface encloses no volume ({volume:.3g}, of an area of {area:.3g}): it is flat or "
            "twisted through itself; export the mesh again"
        )
    wrong = twisted_share(vertices, faces)
    if wrong > MOST_TWISTED:
        raise MeshError(
            f"{place}: the surface passes through itself, {100 * wrong:.0f} % of it does not bound its inside, so its "
            f"volume ({volume:.4g}) means nothing; repair it, for instance by remeshing"
        )
    return wrong


def twisted_share(vertices: np.ndarray, faces: np.ndarray) -> float:
    """Share of the area of a closed surface that has not its inside (winding number 1) behind it, outside before it.

    Measured just before and behind some thousand triangles, large ones first.
    """
    import igl

    a, b, c = vertices[faces].transpose(1, 0, 2)
    normals = np.cross(b - a, c - a)
    length = np.linalg.norm(normals, axis=1)
    chosen = np.argsort(-length, kind="stable")[:WINDING_SAMPLES]
    chosen = chosen[length[chosen] > 0]
    middle, unit = (a + b + c)[chosen] / 3.0, normals[chosen] / length[chosen, None]
    step = WINDING_STEP * np.sqrt(length[chosen])[:, None]
    asked = np.ascontiguousarray(np.concatenate([middle + step * unit, middle - step * unit]))
    winding = igl.fast_winding_number(
        np.ascontiguousarray(vertices, dtype=np.float64), np.ascontiguousarray(faces, dtype=np.int64), asked
    )
    before, behind = winding[: len(chosen)], winding[len(chosen) :]
    wrong = (np.abs(before) > 0.4) | (np.abs(behind - 1.0) > 0.4)
    return float(length[chosen][wrong].sum() / length[chosen].sum())


def _drop_fins(state):
    """Triangles that hang on an edge of more than two faces and end in the open."""
    dropped = 0
    while len(state.faces):
        _, count, sides = _edge_uses(state.faces)
        uses = count[sides]
        fin = (uses > 2).any(axis=1) & (uses == 1).any(axis=1)
        if not fin.any():
            break
        dropped += int(fin.sum())
        state.faces = state.faces[~fin]
    if dropped:
        state.notes.append(f"{dropped} dangling triangles dropped")


def _parts(faces, count):
    """Number of the connected part that each face belongs to, and how many parts."""
    rows, columns = faces[:, [0, 1]].ravel(), faces[:, [1, 2]].ravel()
    graph = coo_matrix((np.ones(len(rows)), (rows, columns)), shape=(count, count))
    _, labels = connected_components(graph, directed=False)
    _, part = np.unique(labels[faces[:, 0]], return_inverse=True)
    return part, int(part.max()) + 1


def _areas(vertices, faces):
    a, b, c = vertices[faces].transpose(1, 0, 2)
    return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)


def _drop_crumbs(state, *, keep_parts):
    part, count = _parts(state.faces, len(state.vertices))
    if count == 1:
        return
    area = np.bincount(part, weights=_areas(state.vertices, state.faces), minlength=count)
    keep = area >= CRUMB_LIMIT * area.max()
    if not keep.all():
        state.faces = state.faces[keep[part]]
        state.notes.append(f"{int((~keep).sum())} loose parts of less than 1 % of the surface dropped")
    if keep_parts and keep.sum() > 1:
        state.notes.append(f"the surface has {int(keep.sum())} parts")


def _drop_unused(state):
    used = np.zeros(len(state.vertices), dtype=bool)
    used[state.faces] = True
    if used.all():
        return
    number = np.cumsum(used) - 1
    new = np.where(used, number, -1)
    state.vertices = state.vertices[used]
    state.faces = new[state.faces]
    state.vertex_map = new[state.vertex_map]


def _check_manifold(faces, place):
    edges, count, _ = _edge_uses(faces)
    bad = np.flatnonzero(count > 2)
    if len(bad):
        a, b = edges[bad[0]].tolist()
        raise MeshError(
            f"{place}: {len(bad)} edges belong to more than two triangles (first: vertices {a} and {b}); "
            "make the surface manifold, for instance by remeshing"
        )


def _fill_holes(state):
    """Close each hole whose rim is short, or of one or two missing triangles, by a fan about its centre."""
    diagonal = np.linalg.norm(np.ptp(state.vertices, axis=0))
    filled = 0
    for rim in _rims(state.faces):
        points = state.vertices[rim]
        around = np.linalg.norm(points - np.roll(points, 1, axis=0), axis=1).sum()
        if len(rim) > 4 and around > HOLE_LIMIT * diagonal:
            continue
        if len(rim) == 3:
            fan = np.array([[rim[2], rim[1], rim[0]]])
        else:
            centre = len(state.vertices)
            state.vertices = np.vstack([state.vertices, points.mean(axis=0)])
            fan = np.column_stack([np.roll(rim, -1), rim, np.full(len(rim), centre)])
        state.faces = np.vstack([state.faces, fan])
        filled += 1
    if filled:
        state.notes.append(f"{filled} small holes closed")


def _widest_hole(state):
    """Words for the place of the hole with the longest rim, "" where no rim is a simple loop."""
    rims = [state.vertices[rim] for rim in _rims(state.faces)]
    if not rims:
        return ""
    widest = max(rims, key=lambda rim: np.linalg.norm(rim - np.roll(rim, 1, axis=0), axis=1).sum())
    x, y, z = widest.mean(axis=0)
    return f", the widest hole about ({x:.4g}, {y:.4g}, {z:.4g})"


def _rims(faces):
    """Closed loops of boundary edges in the direction of their faces; knotted ones are left out."""
    sides = faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    _, count, used = _edge_uses(faces)
    rim_sides = sides[count[used.ravel()] == 1]
    starts, repeats = np.unique(rim_sides[:, 0], return_counts=True)
    following = dict(rim_sides.tolist())
    knots = set(starts[repeats > 1].tolist())
    loops = []
    while following:
        start, current = following.popitem()
        loop = [start]
        while current != start and current in following:
            loop.append(current)
            current = following.pop(current)
        if current == start and len(loop) >= 3 and not knots.intersection(loop):
            loops.append(np.array(loop))
    return loops


def _orient(state, place):
    """Make neighbouring faces agree, then turn what was mended, or the whole, outward.

    A consistent inner shell (a cavity of a bone) rightly faces the other way and stays.
    """
    turned = _consistent_turns(state.faces, place)
    part, count = _parts(state.faces, len(state.vertices))
    faces = np.where(turned[:, None], state.faces[:, ::-1], state.faces)
    a, b, c = (state.vertices - state.vertices.mean(axis=0))[faces].transpose(1, 0, 2)
    volume = np.bincount(part, weights=np.einsum("ij,ij->i", a, np.cross(b, c)), minlength=count)
    mended = np.bincount(part, weights=turned, minlength=count) > 0
    turned ^= mended[part] & (volume[part] < 0)
    volume[mended] = np.abs(volume[mended])
    if volume.sum() < 0:
        turned ^= ~mended[part]
    if turned.all():
        state.notes.append("all triangles faced inward: turned outward")
    elif turned.any():
        state.notes.append(f"{int(turned.sum())} triangles faced the wrong way: turned")
    state.faces = np.ascontiguousarray(np.where(turned[:, None], state.faces[:, ::-1], state.faces))


def _consistent_turns(faces, place):
    """Which faces to turn so that each shared edge is used once in either direction."""
    if _sides_agree(faces):
        return np.zeros(len(faces), dtype=bool)
    import igl

    oriented, _ = igl.bfs_orient(np.ascontiguousarray(faces))
    if not _sides_agree(oriented):
        raise MeshError(f"{place}: the surface has one side only (no consistent orientation); remesh it")
    turned = (oriented != faces).any(axis=1)
    part, count = _parts(faces, int(faces.max()) + 1)
    most = np.bincount(part, weights=turned, minlength=count) * 2 > np.bincount(part, minlength=count)
    return turned ^ most[part]


def _sides_agree(faces):
    """Whether no two faces use an edge in the same direction."""
    sides = faces * (int(faces.max()) + 1) + faces[:, [1, 2, 0]]
    return len(np.unique(sides)) == sides.size


def _check_one_part(state, place):
    part, count = _parts(state.faces, len(state.vertices))
    if count > 1:
        sizes = sorted(np.bincount(part).tolist(), reverse=True)
        raise MeshError(
            f"{place}: the surface has {count} separate parts (triangles: {', '.join(map(str, sizes[:5]))}); "
            "a muscle is one closed surface, split or join them"
        )
