"""From labels to smooth closed surfaces, without the steps of their voxels.

The mask of a label, 1/2 inside and -1/2 outside, is smoothed by I - (I - G)^4, G a Gaussian of 1.3
voxels: flat to fourth order in the pass band, so that curved surfaces are not drawn in as they are
by G alone. Where two labels share a face, the fields are each other's negative there and their zero
sets are the same. The surface is then shifted to the label's volume, by a few hundredths of a
voxel.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from scipy.ndimage import binary_fill_holes, find_objects, gaussian_filter, map_coordinates
from scipy.ndimage import label as connected

from rbfmuscle.geometry.crossing import crossing_faces
from rbfmuscle.geometry.exact_distance import faces_across
from rbfmuscle.geometry.solids import label_shells
from rbfmuscle.geometry.surfaces import mesh_volume, vertex_areas, vertex_normals
from rbfmuscle.geometry.vectors import to_world
from rbfmuscle.importers.labels.volume import LabelVolume
from rbfmuscle.validation import MeshError

if TYPE_CHECKING:
    import trimesh

# Deviation of the Gaussian [voxels], and how often what it lost is smoothed again.
SMOOTHING, PASSES = 1.3, 4
CUT_OFF = 0.4  # area in the outermost slice against the fourth: that of a ball is 0.14
ON_CAP = 1.2  # vertices nearer than this to the scan's end are on a cap [voxels]
MARGIN = 6  # voxels kept around a label, beyond which the filter sees nothing
PIECE = 0.01  # share of the largest piece from which on a piece belongs to a bone of several parts
# Edge of the surface's triangles [voxels], and rounds in which triangles that cross are drawn
# apart.
EDGE, UNTANGLE = 2.2, 20
# Voxels of a label, at least; into how many each is divided along an axis, and at most how many
# there are then; share by which a surface may miss their volume.
LEAST_VOXELS = 27
FINER = (1, 2, 4)
MOST_VOXELS = 20_000_000
VOLUME_ERROR = 0.05


@dataclass
class LabelSurface:
    """A label's surface, closed and outward [mm], the volume of its voxels [mm3], and what was left
    out, filled or cut; ``capped`` (n,) are the vertices on the cap where the scan ends.
    """

    name: str
    mesh: "trimesh.Trimesh"
    volume: float
    notes: list[str]
    capped: np.ndarray


def label_surface(volume: LabelVolume, label: int, *, pieces: bool = False) -> LabelSurface:
    """Smooth surface of a label, or MeshError where it has too few voxels for one.

    With ``pieces`` (bones of several parts) every piece of a hundredth or more is kept, not the
    largest alone.
    """
    import trimesh

    name, notes = volume.name(label), []
    mask = volume.mask(label)
    box = find_objects(mask.astype(np.int8))[0]
    cuts = _cuts(mask, box, notes)
    others = np.pad((volume.labels[(slice(None), *box)] > 0).any(axis=0) & ~mask[box], MARGIN)
    mask = np.pad(mask[box], MARGIN)
    if mask.sum() < LEAST_VOXELS:
        raise MeshError(
            f"{volume.source}: label {name!r} has {int(mask.sum())} voxels, too few for a surface"
        )
    drawn = _draw(mask, others, notes, pieces)
    if drawn is None:
        raise MeshError(
            f"{volume.source}: label {name!r} is too thin for its voxels: no closed surface has "
            f"its volume within {100 * VOLUME_ERROR:.0f} %; resample the volume"
        )
    vertices, faces, count = drawn
    corner = np.array([part.start for part in box]) - MARGIN
    places = vertices + corner
    capped = np.zeros(len(places), dtype=bool)
    for axis, end in cuts:
        capped |= np.abs(places[:, axis] - end) < ON_CAP
    world = to_world(places, volume.affine)
    mesh = trimesh.Trimesh(world, faces, process=False)
    if mesh.volume < 0:
        mesh.invert()
    volume_mm3 = count * float(np.prod(volume.spacing))
    return LabelSurface(name, mesh, volume_mm3, notes, capped)


def _draw(mask, others, notes, pieces):
    """Vertices [voxels] and faces of a mask, and how many voxels they hold; None where no closed
    surface holds them.

    Voxels that touch along an edge or at a corner alone are first taken as one piece. Where that
    gives none, as the label is thin there, it is drawn from finer voxels, then as its largest
    piece.
    """
    for touching in (True, False):
        for parts in FINER:
            said: list[str] = []
            kept = _without_islands(mask, said, PIECE if pieces else 1.0, touching=touching)
            kept = _filled(kept, others, said)
            count = int(kept.sum())
            if count * parts**3 > MOST_VOXELS:
                continue
            fine = kept
            for axis in range(3):
                fine = np.repeat(fine, parts, axis=axis)
            vertices, faces = _surface_of(fine, said)
            vertices = (vertices + 0.5) / parts - 0.5
            off = abs(abs(mesh_volume(vertices, faces)) / count - 1.0)
            whole = pieces or len(np.unique(label_shells(faces)[0])) == 1
            if off < VOLUME_ERROR and whole and (faces_across(faces) >= 0).all():
                notes += said
                return vertices, faces, count
    return None


def _surface_of(mask, notes):
    """Vertices [voxels] and faces of a mask, of its volume where it is not too thin for that."""
    import igl
    from skimage.measure import marching_cubes

    smooth = smooth_mask(mask)
    if not smooth.min() < 0.0 < smooth.max():
        return np.zeros((1, 3)), np.zeros((0, 3), np.int64)
    vertices, faces, _, _ = marching_cubes(-smooth, 0.0, allow_degenerate=False)
    vertices, faces = vertices.astype(np.float64), faces.astype(np.int64)
    # Fewer triangles by quadric edge collapse (Garland and Heckbert 1997), of about the edge that
    # is wanted.
    target = max(200, int(vertex_areas(vertices, faces).sum() / (np.sqrt(3.0) / 4.0 * EDGE**2)))
    if target < len(faces):
        vertices, faces = (np.asarray(part) for part in igl.qslim(vertices, faces, target)[:2])
    faces = faces.astype(np.int64)
    # Edges that collapse on either side of a thin wall fold it, or bring its sides through each
    # other.
    vertices, crossing = _untangled(vertices, faces, smooth)
    if crossing:
        notes.append(f"{crossing} triangles go through others, where the label is thin")
    return _to_volume(vertices, faces, int(mask.sum())), faces


def smooth_mask(mask: np.ndarray) -> np.ndarray:
    """Field of a mask (i, j, k): positive inside, zero about half-way between voxels in and out."""
    rest = np.where(mask, np.float32(0.5), np.float32(-0.5))
    smooth = np.zeros_like(rest)
    for _ in range(PASSES):
        part = gaussian_filter(rest, SMOOTHING, truncate=4.0, mode="nearest")
        smooth += part
        rest -= part
    return smooth


def _without_islands(mask, notes, least, *, touching):
    """The pieces of at least a share of the largest, of 1 the first of equals; what was left out
    goes to ``notes``. Voxels that are ``touching`` at a corner or an edge are of one piece.
    """
    pieces, count = connected(mask, np.ones((3, 3, 3)) if touching else None)
    if count > 1:
        sizes = np.bincount(pieces.ravel())
        sizes[0] = 0
        kept = sizes >= least * sizes.max()
        if least == 1.0:
            kept = np.arange(len(sizes)) == sizes.argmax()
        rest = int(sizes[~kept].sum())
        if rest:
            share = 100 * rest / sizes.sum()
            notes.append(
                f"{int((~kept).sum()) - 1} islands of {rest} voxels left out ({share:.2g} %)"
            )
        mask = kept[pieces]
    return mask


def _filled(mask, others, notes):
    """The mask with its inner holes filled, but those that hold voxels of other labels."""
    filled = binary_fill_holes(mask)
    holes, _ = connected(filled & ~mask)
    kept = np.isin(holes, np.unique(holes[others & (holes > 0)])) & (holes > 0)
    hollow = int(((holes > 0) & ~kept).sum())
    if hollow:
        notes.append(f"holes of {hollow} voxels filled")
    if kept.any():
        notes.append(f"holes of {int(kept.sum())} voxels hold other labels and stay")
    return filled & ~kept


def _cuts(mask, box, notes):
    """Axis and end [voxel] of each side of the volume at which a label is cut off, not rounded."""
    found = []
    for axis, (part, size) in enumerate(zip(box, mask.shape)):
        for at, inner, end in ((0, 3, -0.5), (size - 1, size - 4, size - 0.5)):
            if part.stop - part.start < 4 or not part.start <= at < part.stop:
                continue
            area, behind = (np.count_nonzero(mask.take(k, axis=axis)) for k in (at, inner))
            if area > CUT_OFF * behind:
                found.append((axis, end))
                notes.append(
                    f"cut off where the scan ends ({area} voxels there): closed by a flat cap, "
                    "to which nothing is attached"
                )
    return found


def _untangled(vertices, faces, smooth):
    """Vertices where no triangle goes through another: beside such places evened out, and put back
    on the zero set. Also how many triangles still do, at the best of `UNTANGLE` tries.
    """
    heads, tails = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    degree = np.bincount(heads, minlength=len(vertices))
    least, best = np.inf, vertices
    for _ in range(UNTANGLE):
        crossing = crossing_faces(vertices, faces)
        if crossing.sum() < least:
            least, best = int(crossing.sum()), vertices
        if least == 0:
            break
        near = np.zeros(len(vertices), dtype=bool)
        near[faces[crossing]] = True
        near[faces[near[faces].any(axis=1)]] = True  # and their neighbours
        means = np.stack(
            [np.bincount(heads, vertices[tails, k]) / degree for k in range(3)], axis=1
        )
        vertices = vertices.copy()
        vertices[near] = _on_zero_set(0.5 * (vertices[near] + means[near]), smooth)
    return best, least


def _on_zero_set(points, smooth):
    """Points moved along the gradient of a field on a grid to where it is zero, by a voxel at
    most.
    """

    def value(at):
        return map_coordinates(smooth, at.T, order=1, mode="nearest")

    moved = np.zeros_like(points)
    for _ in range(3):  # Newton's method from within half a voxel: the third step is below rounding
        at = points + moved
        slope = np.stack([value(at + step) - value(at - step) for step in 0.5 * np.eye(3)], axis=1)
        moved -= (value(at) / np.maximum((slope**2).sum(axis=1), 0.01))[:, None] * slope
    return points + moved / np.maximum(np.linalg.norm(moved, axis=1), 1.0)[:, None]


def _to_volume(vertices, faces, wanted):
    """Vertices moved along their normals, all by the same distance, until the mesh holds the wanted
    volume, but for what is left of an error of some per cent to the fourth power.
    """
    for _ in range(2):
        volume = mesh_volume(vertices, faces)
        normals, area = vertex_normals(vertices, faces), vertex_areas(vertices, faces).sum()
        vertices = vertices + np.sign(volume) * (wanted - abs(volume)) / area * normals
    return vertices
