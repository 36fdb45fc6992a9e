"""The fibres of a muscle: traced at rest, carried over a motion by the material and the bones."""

import warnings
from collections.abc import Mapping, Sequence

import numpy as np
import scipy.sparse as sparse
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import cg
from scipy.spatial import cKDTree

from rbfmuscle.geometry.arrays import Booleans, Floats, Integers, box_size, unit
from rbfmuscle.geometry.lines import nearest_pieces
from rbfmuscle.geometry.mesh_distance import MeshDistance
from rbfmuscle.geometry.surfaces import even_points, mesh_volume
from rbfmuscle.geometry.threads import each
from rbfmuscle.metrics.centreline import moving_joints, resampled, split_ends
from rbfmuscle.metrics.rows import bones_about
from rbfmuscle.scene.bone import BoneDistance
from rbfmuscle.scene.objects import Muscle
from rbfmuscle.scene.scene import Scene
from rbfmuscle.scene.tendons import NODES, TendonLine
from rbfmuscle.simulation.frame import FibreLines, MuscleModel
from rbfmuscle.validation import SceneWarning

CELLS = 30_000  # of a muscle, about
GRIP = 30.0  # conductance of an end where u is given, over that of a cube of the muscle's volume
ACROSS = 0.02  # conductivity across polylines, over that along them
NEAREST = 4  # pieces of polylines that speak for one place
TOLERANCE = 1e-8  # relative residual of the potential
MOST_ITERATIONS = 5_000  # of conjugate gradients; some hundreds serve
POINTS = 25  # of a fibre, at even distances along it
STEP = 0.5  # of a line that is traced, in cells
LONGEST = 6.0  # of a line, in diagonals of the muscle's box
SPARE = 1.5  # lines traced for each one wanted, as some do not reach both ends
ROUNDS = 4  # in which points are moved into the muscle and out of bones
DEPTH = 0.05  # of points inside the surface, in cells
PATCH_POINTS = 3000  # of an end
SURFACE_APART = 0.4  # of points that find the cells which the surface passes through, in cells
_CORNERS = np.indices((2, 2, 2)).reshape(3, -1).T  # of a cell, (8, 3)


class FluxField:
    """The flux in a closed muscle mesh between points of its origin and of its insertion.

    Parameters
    ----------
    mesh : MeshDistance
        The muscle at rest.
    ends : pair of (n, 3) ndarray
        Points spread evenly over the area of the origin's patches, and of the insertion's.
    polylines : sequence of (k, 3) ndarray, optional
        That the flux follows.

    Attributes
    ----------
    side : float
        Of a cell [scene unit].
    middles : (m, 3) ndarray
        Of the cells in the muscle.

    Raises
    ------
    numpy.linalg.LinAlgError
        If origin and insertion lie in separate pieces, or the potential does not converge.
    """

    def __init__(
        self,
        mesh: MeshDistance,
        ends: tuple[Floats, Floats],
        polylines: Sequence[Floats] | None = None,
    ) -> None:
        low = mesh.vertices.min(axis=0)
        extent = np.ptp(mesh.vertices, axis=0)
        # Side of a cell [scene unit] with which the muscle has about `CELLS`.
        volume = abs(mesh_volume(mesh.vertices, mesh.faces))
        self.side = float(max((volume / CELLS) ** (1 / 3), extent.max() / 1000.0))
        self.low = low - 1.5 * self.side
        self.shape = np.ceil(extent / self.side).astype(int) + 3
        self.cells = self._cells(mesh, ends)
        self.middles = self.low + (self.cells + 0.5) * self.side
        corner = self.cells[:, None, :] + _CORNERS
        flat = np.ravel_multi_index(tuple(np.moveaxis(corner, -1, 0)), tuple(self.shape + 1))
        self._known, nodes = np.unique(flat, return_inverse=True)
        self.nodes = nodes.reshape(flat.shape)
        conductivity = _conductivity(self.middles, polylines)
        # Matrix of the potential's energy, trilinear in each cell.
        element = self.side * np.einsum("cij,ijkl->ckl", conductivity, _element_matrices())
        rows = np.repeat(self.nodes, 8, axis=1).ravel()
        columns = np.tile(self.nodes, (1, 8)).ravel()
        size = len(self._known)
        matrix = sparse.csr_matrix((element.ravel(), (rows, columns)), shape=(size, size))
        source = self._source(ends)
        if polylines:
            grip = GRIP * self.side * len(self.cells) ** (1 / 3)
            matrix += sparse.diags(grip * np.abs(source))
            source = grip * source
        potential = _solve(matrix, source)
        self._spread(conductivity, potential)

    def __call__(self, points: Floats) -> Floats:
        """Flux (n, 3) at points (n, 3); beyond the cells, that of the nearest node."""
        place = np.clip((points - self.low) / self.side, 0.0, self.shape - 1e-9)
        cell = place.astype(int)
        share = place - cell
        out = np.zeros((len(points), 3))
        for corner in _CORNERS:
            weight = np.prod(np.where(corner, share, 1.0 - share), axis=1)
            out += weight[:, None] * self._flux[tuple((cell + corner).T)]
        return out

    def _cells(self, mesh: MeshDistance, ends: tuple[Floats, Floats]) -> Integers:
        """Cells (m, 3) of which the middle lies inside, those of the ends, and, where these are not
        joined, those that the surface passes through.
        """
        from trimesh.remesh import subdivide_to_size

        every = np.indices(self.shape).reshape(3, -1).T
        inside = mesh.inside(self.low + (every + 0.5) * self.side).reshape(self.shape)
        at_ends = [self._cell_of(end) for end in ends]
        for cell in at_ends:
            inside[tuple(cell.T)] = True
        piece, joined = self._piece(inside, at_ends)
        if not joined:
            points, _ = subdivide_to_size(
                mesh.vertices, mesh.faces, SURFACE_APART * self.side, max_iter=30
            )
            inside[tuple(self._cell_of(points).T)] = True
            piece, joined = self._piece(inside, at_ends)
            if not joined:
                raise np.linalg.LinAlgError("origin and insertion lie in separate pieces")
        return np.argwhere(piece)

    def _cell_of(self, points: Floats) -> Integers:
        return np.asarray(((points - self.low) / self.side).astype(int))

    def _piece(self, inside: Booleans, ends: Sequence[Integers]) -> tuple[Booleans, bool]:
        """The cells joined to the one that most of the origin's cells (n, 3) are joined to, and
        whether most of the insertion's are among them.
        """
        from scipy.ndimage import label

        labels = label(inside)[0]
        piece = labels == np.bincount(labels[tuple(ends[0].T)]).argmax()
        return piece, bool(piece[tuple(ends[1].T)].mean() > 1 / 2)

    def _source(self, ends: tuple[Floats, Floats]) -> Floats:
        """Flux (n,) into each node: one in all through the origin, as much out of the insertion."""
        out = np.zeros(len(self._known))
        tree = cKDTree(self.middles)
        for sign, end in zip((1.0, -1.0), ends):
            cell = tree.query(end)[1]
            share = np.clip((end - self.middles[cell]) / self.side + 0.5, 0.0, 1.0)
            for k, corner in enumerate(_CORNERS):
                weight = np.prod(np.where(corner, share, 1.0 - share), axis=1)
                np.add.at(out, self.nodes[cell, k], sign * weight / len(end))
        return out

    def _spread(self, conductivity: Floats, potential: Floats) -> None:
        """Mean flux of the cells around each node, and beyond the muscle that of the nearest."""
        from scipy.ndimage import distance_transform_edt

        slope = (_CORNERS - 0.5) * 2.0 / (4.0 * self.side)  # at the middle of a cell
        gradient = np.einsum("ck,ka->ca", potential[self.nodes], slope)
        flux = -np.einsum("cab,cb->ca", conductivity, gradient)
        total = np.zeros((len(self._known), 3))
        count = np.bincount(self.nodes.ravel(), minlength=len(self._known))
        np.add.at(total, self.nodes.ravel(), np.repeat(flux, 8, axis=0))
        grid = np.zeros((*(self.shape + 1), 3))
        known = np.zeros(self.shape + 1, dtype=bool)
        where = np.unravel_index(self._known, tuple(self.shape + 1))
        grid[where] = total / count[:, None]
        known[where] = True
        nearest = distance_transform_edt(~known, return_distances=False, return_indices=True)
        self._flux = grid[tuple(nearest)]


def _conductivity(points: Floats, polylines: Sequence[Floats] | None) -> Floats:
    """D (n, 3, 3) at points (n, 3)."""
    if not polylines:
        return np.tile(np.eye(3), (len(points), 1, 1))
    tangent, share = nearest_pieces(points, polylines, NEAREST)
    share /= share.sum(axis=1, keepdims=True)
    # Dyads have no sense of direction, as fibres have none.
    dyads = np.einsum("nk,nka,nkb->nab", share, tangent, tangent)
    direction = np.linalg.eigh(dyads)[1][:, :, 2]
    along = np.einsum("na,nb->nab", direction, direction)
    return ACROSS * np.eye(3) + (1.0 - ACROSS) * along


def _element_matrices() -> Floats:
    """∫ ∂_i N_k ∂_j N_l over a unit cell, (3, 3, 8, 8), by two Gauss points along each axis."""
    gauss = 0.5 + (_CORNERS - 0.5) / np.sqrt(3.0)
    # Of each point and corner: the factors of the shape function, one an axis, and its slopes.
    factor = np.where(_CORNERS, gauss[:, None], 1.0 - gauss[:, None])
    others = [np.delete(factor, axis, axis=2).prod(axis=2) for axis in range(3)]
    slopes = np.stack(others, axis=1) * (2 * _CORNERS.T - 1)
    return np.sum([np.einsum("ik,jl->ijkl", at, at) / 8.0 for at in slopes], axis=0)


def _solve(matrix: sparse.csr_matrix, source: Floats) -> Floats:
    """Potential (n,) by conjugate gradients; where fluxes are given up to a constant."""
    if connected_components(matrix, directed=False)[0] > 1:
        raise np.linalg.LinAlgError("the muscle's cells lie in separate pieces")
    scale = 1.0 / matrix.diagonal()
    found, status = cg(
        matrix, source, rtol=TOLERANCE, maxiter=MOST_ITERATIONS, M=sparse.diags(scale)
    )
    if status != 0:
        raise np.linalg.LinAlgError("the potential of the fibres does not converge")
    return np.asarray(found)


def trace_fibres(
    mesh: MeshDistance,
    ends: tuple[Floats, Floats],
    count: int,
    *,
    polylines: Sequence[Floats] | None = None,
    bones: Sequence[BoneDistance] = (),
) -> tuple[Floats, Integers]:
    """Lines from origin to insertion along the flux between them, evenly by volume.

    Parameters
    ----------
    mesh : MeshDistance
        The muscle at rest, in which all lines lie.
    ends : pair of (k, 3) ndarray
        Points evenly over the patches of the origin and of the insertion, on which lines end.
    count : int
        Of the lines; fewer come out where some do not reach both ends.
    polylines : sequence of (k, 3) ndarray, optional
        That the lines follow.
    bones : sequence of BoneDistance
        At rest, of which all inner points of the lines stay out.

    Returns
    -------
    lines : (n, `POINTS`, 3) ndarray
        From origin to insertion.
    ends : (n, 2) ndarray of int
        Of both ends of each line the number of the point of the patches that it ends on.

    Raises
    ------
    numpy.linalg.LinAlgError
        If the flux cannot be had, see `FluxField`, or no line reaches both ends.
    """
    flux = FluxField(mesh, ends, polylines)
    seeds = even_seeds(mesh, int(np.ceil(SPARE * count)))
    back, origin = _trace(seeds, -1, mesh, flux, ends[0])
    ahead, insertion = _trace(seeds, 1, mesh, flux, ends[1])
    whole = np.flatnonzero((origin >= 0) & (insertion >= 0))[:count]
    lines = [np.concatenate([back[k][::-1], ahead[k][1:]]) for k in whole]
    if not lines:
        raise np.linalg.LinAlgError("no line reaches from the origin to the insertion")
    even = np.array([resampled(line, POINTS - 1) for line in lines])
    _keep_inside(even, mesh, bones, DEPTH * flux.side)
    return even, np.stack([origin[whole], insertion[whole]], axis=1)


def even_seeds(mesh: MeshDistance, count: int) -> Floats:
    """So many points (count, 3) spread evenly over the volume of a closed mesh.

    Of an additive recurrence of the root of x⁴ = x + 1 in the mesh's box, those inside: it fills
    volume, and any section through it, more evenly than random points do (Roberts 2018).
    """
    root = 1.2207440846057596
    step = root ** -np.arange(1.0, 4.0)
    low = mesh.vertices.min(axis=0)
    extent = np.ptp(mesh.vertices, axis=0)
    found = np.empty((0, 3))
    first = 0
    while len(found) < count:
        number = np.arange(first, first + 4 * count)
        points = low + extent * ((0.5 + number[:, None] * step) % 1.0)
        found = np.concatenate([found, points[mesh.inside(points)]])
        first += 4 * count
    return found[:count]


def _trace(
    seeds: Floats, sense: int, mesh: MeshDistance, flux: FluxField, end: Floats
) -> tuple[list[Floats], Integers]:
    """Lines from the seeds (n, 3) along the flux, or against it where ``sense`` is -1, and the
    number (n,) of the patch's point (k, 3) at which each arrives, -1 where it does not.
    """
    patch = cKDTree(end)
    step = STEP * flux.side
    lines = [[seed] for seed in seeds]
    arrived = np.full(len(seeds), -1)
    here = seeds.copy()
    open_lines = np.arange(len(seeds))
    for _ in range(int(LONGEST * box_size(mesh.vertices) / step)):
        half = here + 0.5 * sense * step * unit(flux(here))
        here = here + sense * step * unit(flux(half))
        beyond = ~mesh.inside(here)
        if beyond.any():  # back to the surface
            here[beyond] = mesh.nearest(here[beyond])[1]
        distance, nearest = patch.query(here)
        # At the surface and nearer to the patch than a cell: it has come through it.
        done = beyond & (distance < flux.side)
        for k, line in enumerate(open_lines):
            lines[line].append(patch.data[nearest[k]] if done[k] else here[k])
        arrived[open_lines[done]] = nearest[done]
        open_lines = open_lines[~done]
        here = here[~done]
        if not len(open_lines):
            break
    return [np.array(line) for line in lines], arrived


def _keep_inside(
    lines: Floats, mesh: MeshDistance, bones: Sequence[BoneDistance], depth: float
) -> None:
    """Smooth lines (n, k, 3), and move their inner points inside the muscle and out of bones."""
    inner = lines[:, 1:-1]
    for _ in range(ROUNDS):
        smooth = 0.25 * (lines[:, :-2] + 2.0 * inner + lines[:, 2:])
        points = np.ascontiguousarray(smooth.reshape(-1, 3))
        for bone in bones:
            points = _moved_off(points, bone, 1.0, 0.0)
        points = _moved_off(points, mesh, -1.0, depth)
        inner[:] = points.reshape(inner.shape)


def _moved_off(points: Floats, mesh: MeshDistance, side: float, depth: float) -> Floats:
    """Points (n, 3), those not farther out (side 1) or in (-1) than a depth moved there."""
    distance, closest, outward = mesh.nearest(points)
    distance = np.where(mesh.inside(points), -np.abs(distance), np.abs(distance))
    wrong = side * distance < depth
    points[wrong] = closest[wrong] + side * depth * unit(outward[wrong])
    return points


class FibreBundle:
    """Fibres of a muscle at rest, and what carries them.

    Inner points go with the material, as the ``model`` says; the ends go with the bones, or with
    the ends of tendons, that hold the patches they lie on. Where the muscle has aponeuroses the
    ends of fibres lie on these and go with the material, and a straight line joins each to the
    nearest point that a bone holds.
    """

    def __init__(self, muscle: Muscle, scene: Scene, model: MuscleModel, count: int) -> None:
        mesh = MeshDistance(muscle.mesh.vertices, muscle.mesh.faces)
        groups = split_ends(muscle, scene.joints, moving_joints(scene))
        patches = [_end_points(mesh, [a.vertices for a in group]) for group in groups]
        sheets = [_end_points(mesh, [patch])[0] for patch in muscle.aponeuroses]
        probes = [bone.exact for bone in scene.bones]
        near = bones_about(mesh.vertices, probes, {probe.name: np.eye(4) for probe in probes})
        first, last = sheets or [points for points, _ in patches]
        ends = (first, last)
        self.rest, _ = trace_fibres(mesh, ends, count, polylines=muscle.fibres, bones=near)
        self.attachment_frames = [a.attachment_frame for group in groups for a in group]
        self.pennate = bool(sheets)
        held = [
            cKDTree(points).query(self.rest[:, place])[1]
            for (points, _), place in zip(patches, (0, -1))
        ]
        # Where each end (N, 2, 3) is held at rest, and the place of what holds it in
        # attachment_frames.
        self._anchors = np.stack([patch[0][at] for patch, at in zip(patches, held)], axis=1)
        number = [patch[1][at] for patch, at in zip(patches, held)]
        self._held = np.stack([number[0], len(groups[0]) + number[1]], axis=1)
        self._segments = _segments(self.rest)
        self._follow = model.follower(np.ascontiguousarray(self.rest.reshape(-1, 3)))
        self._tendon = [[a.tendon is not None for a in group] for group in groups]

    def at(self, poses: Mapping[str, Floats], tendons: Mapping[str, TendonLine]) -> FibreLines:
        """The fibres where the model is now, at poses (4, 4) of bones and ends of tendons, and the
        tendons by the end that each holds.
        """
        belly = self._follow().reshape(self.rest.shape)
        # Held points (N, 2, 3) of both ends where their bones, or ends of tendons, carry them.
        pose = np.array([poses[name] for name in self.attachment_frames])[self._held]
        held = np.einsum("neij,nej->nei", pose[:, :, :3, :3], self._anchors) + pose[:, :, :3, 3]
        if not self.pennate:
            belly[:, [0, -1]] = held
        now = _segments(belly)
        ratio = now / self._segments
        local = np.empty((len(belly), POINTS))
        local[:, 1:-1] = 0.5 * (ratio[:, 1:] + ratio[:, :-1])
        local[:, [0, -1]] = ratio[:, [0, -1]]
        before, after = (
            self._beyond(end, belly[:, place], held[:, end], tendons)
            for end, place in ((0, 0), (1, -1))
        )
        points = np.concatenate([before[:, ::-1], belly, after], axis=1)
        still = [np.ones(part.shape[:2]) for part in (before, after)]
        stretch = now.sum(axis=1) / self._segments.sum(axis=1)
        return FibreLines(points, stretch, np.concatenate([still[0], local, still[1]], axis=1))

    def _beyond(
        self, end: int, tips: Floats, held: Floats, tendons: Mapping[str, TendonLine]
    ) -> Floats:
        """Points (N, k, 3) of each fibre's aponeurosis and tendon beyond its tips (N, 3) at an end,
        away from the belly: none where no fibre has these there, the last one repeated for fibres
        that have no tendon. The aponeurosis ends at the held points (N, 3).
        """
        sheet = held[:, None] if self.pennate else np.empty((len(tips), 0, 3))
        if not any(self._tendon[end]):
            return sheet
        out = np.repeat((held if self.pennate else tips)[:, None], NODES - 1, axis=1)
        for place, name in enumerate(self.attachment_frames):
            if name in tendons:
                out[self._held[:, end] == place] = tendons[name].points[1:]
        return np.concatenate([sheet, out], axis=1)


def build_bundles(scene: Scene, models: Sequence[MuscleModel]) -> dict[str, FibreBundle]:
    """Fibres of each model's muscle, as many as the scene asks for; a muscle in which none can be
    traced is left out with a warning.
    """
    count = scene.output.fibres
    if count == 0:
        return {}

    def build(model: MuscleModel) -> FibreBundle | None:
        muscle = scene.muscle(model.name)
        if len([a for a in muscle.attachments if not a.via]) < 2:
            return None
        try:
            return FibreBundle(muscle, scene, model, count)
        except np.linalg.LinAlgError as error:
            warnings.warn(
                f"muscle {muscle.name!r} has no fibres: {error}", SceneWarning, stacklevel=2
            )
            return None

    found = zip(models, each(build, models))
    return {model.name: bundle for model, bundle in found if bundle is not None}


def _segments(lines: Floats) -> Floats:
    """Length (N, k - 1) of each segment of lines (N, k, 3)."""
    return np.asarray(np.linalg.norm(np.diff(lines, axis=1), axis=2))


def _end_points(mesh: MeshDistance, patches: Sequence[Integers]) -> tuple[Floats, Integers]:
    """Points (n, 3) evenly over the area of some patches of vertices, and the number (n,) of each
    one's.
    """
    owner = np.full(len(mesh.vertices), -1)
    for number, patch in enumerate(patches):
        owner[patch] = number
    corners = owner[mesh.faces]
    whole = (corners[:, 0] >= 0) & (corners == corners[:, :1]).all(axis=1)
    points, face = even_points(mesh.vertices, mesh.faces[whole], PATCH_POINTS)
    number = corners[whole][face, 0]
    # Patches without a whole triangle count by their vertices.
    for k, patch in enumerate(patches):
        if not (number == k).any():
            points = np.concatenate([points, mesh.vertices[patch]])
            number = np.concatenate([number, np.full(len(patch), k)])
    return points, number
