"""Mending meshes where it is safe: what is changed never moves a vertex by more than rounding."""

from dataclasses import dataclass, field
from functools import cached_property
from typing import NamedTuple

import igl
import numpy as np
import trimesh
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from rbfmuscle.cache import content_key, load_arrays, store_arrays
from rbfmuscle.geometry.arrays import Floats, Integers, box_size
from rbfmuscle.geometry.mesh_distance import winding_numbers
from rbfmuscle.geometry.solids import outer_surface
from rbfmuscle.geometry.surfaces import repeated_faces
from rbfmuscle.validation import MeshError

MERGE_TOLERANCE = 1e-7  # of the diagonal: float32 files repeat vertices to about this
# Of the diagonal: triangles whose corners lie farther apart, up to the last, are joined where that
# closes at least so much of their border, and loses no more than so many of them.
WIDER_TOLERANCES = (1e-6, 1e-5, 1e-4)
BORDER_CLOSED, TRIANGLES_LOST = 0.5, 0.01
MOST_MISSING = 0.1  # of the surface: where more is missing, the inside of a bone is a guess
# Of the diagonal: a longer rim (of more than four edges) is not closed by guesswork.
HOLE_LIMIT = 0.1
TWISTED_NOTED = 0.005  # of the area
MOST_TWISTED = 0.3  # of the area: of more it cannot be said what is inside
WINDING_SAMPLES = 1500  # triangles asked, before and behind them by a small share of their size:
WINDING_STEP = 1e-3  # of the root of twice the area
WRONG_WINDING = 0.4  # from 0 before a triangle and from 1 behind it
MOST_WRONG = 0.01  # of the triangles of a bone, dropped where no surface can be made of them
LEAST_KEPT = 1000  # triangles: smaller meshes are mended as fast as the cache is read
CRUMB_LIMIT = 0.01  # of the largest part's area: smaller loose parts are dropped


class InputOrder(NamedTuple):
    """Triangles (m, 3) of a file by its own vertices, in its order; ``source`` (n,) is the vertex
    of the model's mesh that each of these is, whose triangles are ``source[faces]``.

    A model needs each point of a surface once, and files repeat vertices along the seams of their
    textures. This leads back from the mesh of the model, wherever its vertices have gone, to that
    of the file.
    """

    faces: Integers
    source: Integers


@dataclass(eq=False)
class ReadMesh:
    """A mesh as read and mended."""

    vertices: Floats = field(repr=False)  # (n, 3) in scene units
    faces: Integers = field(repr=False)  # (m, 3), outward
    # The vertex (n_file,) that each vertex of the file became, -1 where it was dropped.
    vertex_map: Integers = field(repr=False)
    notes: list[str] = field(default_factory=list)  # what was mended
    doubt: str = ""  # why it is not known what is inside a bone
    closed: bool = True
    source: str = ""  # the file
    # The mesh of the file, where it is another one.
    given: InputOrder | None = field(default=None, repr=False)

    @cached_property
    def mesh(self) -> trimesh.Trimesh:
        """The surface."""
        return trimesh.Trimesh(self.vertices, self.faces, process=False)


def input_order(read: ReadMesh, given: Integers) -> InputOrder | None:
    """The mesh of a file, with triangles ``given`` (m, 3), that became what was read; None where
    that has the vertices of the file, or triangles that the file has not.
    """
    faces, vertex_map = read.faces, read.vertex_map
    if np.array_equal(vertex_map, np.arange(len(read.vertices))):
        return None
    there = vertex_map[given]
    kept = np.flatnonzero((there >= 0).all(axis=1) & ~repeated_faces(there))
    there = there[kept]
    _, label = np.unique(
        np.sort(np.concatenate([faces, there]), axis=1), axis=0, return_inverse=True
    )
    place = np.full(len(faces) + len(there), -1)
    place[label.ravel()[len(faces) :]] = np.arange(len(there))
    chosen = place[label.ravel()[: len(faces)]]
    if (chosen < 0).any():
        return None
    order = (faces[:, :, None] == there[chosen][:, None, :]).argmax(axis=2)
    own = np.take_along_axis(given[kept][chosen], order, axis=1)
    used = np.unique(own)
    return InputOrder(np.searchsorted(used, own), vertex_map[used])


def repair(
    vertices: Floats, faces: Integers, *, context: str, may_be_open: bool = False
) -> ReadMesh:
    """Return the mesh closed, manifold and outward, with notes of what was done; ``context`` begins
    each message.

    Holes and several parts are kept where it ``may_be_open`` (bones), and refused by a MeshError
    elsewhere. What was mended of a large mesh is kept in the cache.
    """
    if len(faces) < LEAST_KEPT:
        return _mend(vertices, faces, context=context, may_be_open=may_be_open)
    key = content_key(vertices, faces, ("mended, doubted", may_be_open))
    kept = load_arrays(key)
    if kept is not None:
        notes = [note for note in str(kept["notes"]).split("\n") if note]
        return ReadMesh(
            kept["vertices"],
            kept["faces"],
            kept["vertex_map"],
            notes,
            str(kept["doubt"]),
            closed=bool(kept["closed"]),
        )
    state = _mend(vertices, faces, context=context, may_be_open=may_be_open)
    found = {
        "vertices": state.vertices,
        "faces": state.faces,
        "vertex_map": state.vertex_map,
        "closed": state.closed,
        "doubt": state.doubt,
        "notes": "\n".join(state.notes),
    }
    store_arrays(key, found)
    return state


def _mend(vertices, faces, *, context, may_be_open):
    """What `repair` returns."""
    bad = repeated_faces(faces)
    state = ReadMesh(vertices, faces[~bad], np.arange(len(vertices)))
    unused = len(vertices) - len(np.unique(faces))
    if unused:
        state.notes.append(f"{unused} vertices of no triangle left out")
    if bad.any():
        state.notes.append(f"{int(bad.sum())} degenerate or repeated triangles dropped")
    if len(state.faces):
        _merge_equal(state)
        _drop_fins(state)
    if len(state.faces) == 0:
        raise MeshError(f"{context}: nothing is left of the mesh without degenerate triangles")
    _drop_crumbs(state)
    outer, faces, notes = outer_surface(vertices, state.faces)
    parts = int(_parts(faces).max()) + 1
    if may_be_open or (parts == 1 and outer is vertices):
        state.vertices, state.faces = outer, faces
        state.notes += notes + ([f"the surface has {parts} parts"] if parts > 1 else [])
    state.vertices, state.faces, new, _ = igl.remove_unreferenced(state.vertices, state.faces)
    state.vertex_map = new[state.vertex_map]
    if not _is_closed(state.faces):
        if may_be_open:
            _drop_crowded(state)
        _fill_holes(state, context)
    _orient(state, context)
    _check_closed(state, context, may_be_open)
    return state


def _check_closed(state, context, may_be_open):
    """Refuse or note holes, several parts and a surface without an inside."""
    edges, uses, _ = _edges(state.faces)
    border = edges[uses == 1]
    state.closed = len(border) == 0
    if not state.closed:
        x, y, z = state.vertices[border[0, 0]]
        words = (
            f"the surface is open ({len(border)} boundary edges, one at ({x:.4g}, {y:.4g}, "
            f"{z:.4g}))"
        )
        if not may_be_open:
            raise MeshError(f"{context}: {words}; close its holes")
        state.notes.append(words)
        missing = _missing_share(state)
        if missing > MOST_MISSING:
            state.doubt = (
                f"{100 * missing:.0f} % of its surface is missing: what is inside is a guess"
            )
    elif may_be_open:
        wrong = _twisted_share(state.mesh)
        if wrong > MOST_TWISTED:
            state.doubt = (
                f"it is flat or passes through itself, {100 * wrong:.0f} % of its surface does "
                "not bound an inside: muscles may pass through it"
            )
    else:
        sizes = np.sort(np.bincount(_parts(state.faces)))[::-1]
        if len(sizes) > 1:
            raise MeshError(
                f"{context}: the surface has {len(sizes)} separate parts (triangles: "
                f"{', '.join(map(str, sizes[:5]))}); a muscle is one closed surface, split or "
                "join them"
            )
        # Closed, it may still have no inside: flat or twisted, judged over all of its area.
        wrong = _twisted_share(state.mesh)
        if wrong > MOST_TWISTED:
            volume = float(_cones(state.vertices, state.faces).sum())
            raise MeshError(
                f"{context}: the surface is flat or passes through itself, {100 * wrong:.0f} % of "
                f"it does not bound its inside, so its volume ({volume:.4g}) means nothing; repair "
                "it, for instance by remeshing"
            )
        if wrong > TWISTED_NOTED:
            state.notes.append(
                f"the surface passes through itself over {100 * wrong:.2g} % of its area"
            )


def _missing_share(state):
    """Share of the surface that is missing, taking each rim to be closed by a fan."""
    missing = 0.0
    for rim in boundary_rims(state.faces):
        points = state.vertices[rim]
        spokes = points - points.mean(axis=0)
        missing += 0.5 * np.linalg.norm(np.cross(spokes, np.roll(spokes, -1, axis=0)), axis=1).sum()
    there = 0.5 * igl.doublearea(state.vertices, state.faces).sum()
    return missing / max(missing + there, 1e-300)


def _twisted_share(mesh):
    """Share of the area with another winding number than 1 just behind it and 0 just before it,
    large faces asked.
    """
    chosen = np.argsort(-mesh.area_faces, kind="stable")[:WINDING_SAMPLES]
    chosen = chosen[mesh.area_faces[chosen] > 0]
    area, middle = mesh.area_faces[chosen], mesh.triangles_center[chosen]
    step = WINDING_STEP * mesh.face_normals[chosen] * np.sqrt(2.0 * area)[:, None]
    winding = winding_numbers(np.asarray(mesh.vertices), np.asarray(mesh.faces))
    before, behind = winding(np.concatenate([middle + step, middle - step])).reshape(2, -1)
    wrong = (np.abs(before) > WRONG_WINDING) | (np.abs(behind - 1.0) > WRONG_WINDING)
    return float(area[wrong].sum() / area.sum()) if len(area) else 1.0


def _cones(vertices: Floats, faces: Integers) -> Floats:
    """Signed volume (m,) between each triangle and the mean vertex."""
    a, b, c = (vertices - vertices.mean(axis=0))[faces].transpose(1, 0, 2)
    return np.einsum("ij,ij->i", a, np.cross(b, c)) / 6.0


def _edges(faces: Integers) -> tuple[Integers, Integers, Integers]:
    """Edges (sorted pairs), how many faces use each, and the edge (m, 3) of each face's side."""
    ends, width = np.roll(faces, -1, axis=1), int(faces.max(initial=0)) + 1
    keys = (np.minimum(faces, ends) * width + np.maximum(faces, ends)).ravel()
    unique, inverse, count = np.unique(keys, return_inverse=True, return_counts=True)
    return np.column_stack([unique // width, unique % width]), count, inverse.reshape(-1, 3)


def _is_closed(faces):
    return len(faces) > 0 and bool((_edges(faces)[1] == 2).all())


def _parts(faces: Integers) -> Integers:
    """Number of the connected part that each face belongs to."""
    return np.unique(
        igl.vertex_components(np.ascontiguousarray(faces))[faces[:, 0]], return_inverse=True
    )[1]


def _merge_equal(state):
    """Merge vertices that are one point; a closed surface only by contracting edges, so that it
    stays closed, and an open one by a wider tolerance where that closes it.
    """
    faces, used = state.faces, np.unique(state.faces)
    vertices = state.vertices[used]
    size = max(MERGE_TOLERANCE * box_size(vertices), 1e-300)
    keys = np.round((vertices - vertices.min(axis=0)) / size).astype(np.int64)
    _, first, inverse = np.unique(keys, axis=0, return_index=True, return_inverse=True)
    merged = np.arange(len(state.vertices))
    merged[used] = used[first[inverse.ravel()]]
    new = _merged_faces(faces, merged)
    # A closed surface stays one of the same Euler characteristic.
    euler = len(used) - len(faces) / 2
    if _is_closed(faces) and not (_is_closed(new) and len(np.unique(new)) - len(new) / 2 == euler):
        return
    border, apart = _border(new), 0.0
    for tolerance in WIDER_TOLERANCES if border else ():
        wider = np.arange(len(merged))
        # The first vertex of each group of those that are so near to another.
        near = tolerance * box_size(vertices)
        pairs = cKDTree(vertices).query_pairs(near, output_type="ndarray")
        links = coo_matrix((np.ones(len(pairs)), tuple(pairs.T)), shape=(len(vertices),) * 2)
        label = connected_components(links, directed=False)[1]
        wider[used] = used[np.unique(label, return_index=True)[1][label]]
        joined = _merged_faces(faces, wider)
        few = len(joined) >= (1.0 - TRIANGLES_LOST) * len(new)
        left = _border(joined)
        if few and left < border and left <= BORDER_CLOSED * border:
            merged, new, border, apart = wider, joined, left, tolerance
    if apart:
        state.notes.append(f"corners up to {apart:g} of its size apart joined")
    count = int((merged != np.arange(len(merged))).sum())
    if not count:
        return
    lost = (
        f", {len(faces) - len(new)} triangles without extent dropped"
        if len(new) < len(faces)
        else ""
    )
    state.notes.append(f"{count} repeated vertices merged{lost}")
    state.faces, state.vertex_map = new, merged[state.vertex_map]


def _merged_faces(faces, merged):
    new = merged[faces]
    return new[~repeated_faces(new)]


def _border(faces):
    """Number of edges of one face alone."""
    return int((_edges(faces)[1] == 1).sum())


def _drop_fins(state):
    """Drop triangles that hang on an edge of more than two faces and end in the open."""
    before = len(state.faces)
    while len(state.faces):
        _, count, sides = _edges(state.faces)
        fin = (count[sides] > 2).any(axis=1) & (count[sides] == 1).any(axis=1)
        if not fin.any():
            break
        state.faces = state.faces[~fin]
    if len(state.faces) < before:
        state.notes.append(f"{before - len(state.faces)} dangling triangles dropped")


def _drop_crumbs(state):
    part = _parts(state.faces)
    area = np.bincount(part, weights=igl.doublearea(state.vertices, state.faces))
    large = area >= CRUMB_LIMIT * area.max()
    if not large.all():
        state.faces = state.faces[large[part]]
        state.notes.append(
            f"{int((~large).sum())} loose parts of less than 1 % of the surface dropped"
        )


def _fill_holes(state, context):
    """Close each hole whose rim is short, or of one or two missing triangles, by a fan about its
    centre.
    """
    edges, count, _ = _edges(state.faces)
    bad = edges[count > 2]
    if len(bad):
        raise MeshError(
            f"{context}: {len(bad)} edges belong to more than two triangles (first: vertices "
            f"{bad[0, 0]} and "
            f"{bad[0, 1]}); make the surface manifold, for instance by remeshing"
        )
    limit, filled = HOLE_LIMIT * box_size(state.vertices), 0
    for rim in boundary_rims(state.faces):
        points = state.vertices[rim]
        if (
            len(rim) > 4
            and np.linalg.norm(points - np.roll(points, 1, axis=0), axis=1).sum() > limit
        ):
            continue
        if len(rim) == 3:
            fan = rim[None, ::-1]
        else:
            fan = np.column_stack([np.roll(rim, -1), rim, np.full(len(rim), len(state.vertices))])
            state.vertices = np.vstack([state.vertices, points.mean(axis=0)])
        state.faces = np.vstack([state.faces, fan])
        filled += 1
    if filled:
        state.notes.append(f"{filled} small holes closed")


def _drop_crowded(state):
    """Drop triangles of a bone at edges of more than two where they are few; its inside is then
    found by winding.
    """
    _, count, used = _edges(state.faces)
    wrong = (count[used] > 2).any(axis=1)
    if wrong.any() and wrong.mean() < MOST_WRONG:
        state.faces = state.faces[~wrong]
        state.notes.append(
            f"{int(wrong.sum())} triangles at edges of more than two triangles dropped"
        )


def boundary_rims(faces: Integers) -> list[Integers]:
    """Closed loops of boundary edges in the direction of their faces; knotted ones are left out."""
    _, count, used = _edges(faces)
    sides = np.stack([faces, np.roll(faces, -1, axis=1)], axis=2)[count[used] == 1]
    starts, repeats = np.unique(sides[:, 0], return_counts=True)
    following, knots = dict(sides.tolist()), set(starts[repeats > 1].tolist())
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


def _agree(faces):
    """Whether no two faces run along an edge in the same direction."""
    sides = np.sort(faces * (int(faces.max()) + 1) + np.roll(faces, -1, axis=1), axis=None)
    return not (sides[1:] == sides[:-1]).any()


def _orient(state, context):
    """Make neighbouring faces agree, then turn what was mended, or the whole, outward; consistent
    cavities stay.
    """
    faces = np.ascontiguousarray(state.faces)
    oriented, part = faces, np.zeros(len(faces), dtype=int)
    # Most meshes agree, and bfs_orient, which would leave these as they are, takes long.
    if not _agree(faces):
        oriented, part = igl.bfs_orient(faces)
        if not _agree(oriented):
            raise MeshError(
                f"{context}: the surface has one side only (no consistent orientation); remesh it"
            )
    turned = (oriented != faces).any(axis=1)
    turned ^= (np.bincount(part, weights=turned) * 2 > np.bincount(part))[part]
    mended = np.bincount(part, weights=turned) > 0
    volume = np.bincount(part, weights=_cones(state.vertices, faces) * np.where(turned, -1.0, 1.0))
    inward = np.where(mended, np.abs(volume), volume).sum() < 0
    turned ^= np.where(mended, volume < 0, inward)[part]
    if turned.all():
        state.notes.append("all triangles faced inward: turned outward")
    elif turned.any():
        state.notes.append(f"{int(turned.sum())} triangles faced the wrong way: turned")
    state.faces = np.ascontiguousarray(np.where(turned[:, None], faces[:, ::-1], faces))
