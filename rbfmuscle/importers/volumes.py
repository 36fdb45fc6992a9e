"""Label volumes: read as integers in millimetres (NIfTI, NRRD), their surfaces, and the scenes that
are guessed from these.
"""

import codecs
import csv
import json
import re
import tomllib
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import trimesh
from scipy.ndimage import binary_fill_holes, find_objects, gaussian_filter, map_coordinates
from scipy.ndimage import label as connected

from rbfmuscle.anatomy.bones import HEADER
from rbfmuscle.anatomy.names import name_facts
from rbfmuscle.geometry.arrays import Array, Booleans, Floats, to_world
from rbfmuscle.geometry.crossing import crossing_faces
from rbfmuscle.geometry.exact_distance import faces_across
from rbfmuscle.geometry.solids import label_shells
from rbfmuscle.geometry.surfaces import mesh_volume, simplified, vertex_areas, vertex_normals
from rbfmuscle.importers.guess.guess import SceneGuess, guess_scene, scene_in_memory
from rbfmuscle.scene.objects import new_name, plain_name
from rbfmuscle.scene.scene import Scene
from rbfmuscle.validation import BROKEN_FILE, MeshError, UsageError

# A label's number is its value in its layer, and this much more for each layer before.
LAYER = 1 << 16
MOST_NAMED = 10  # overlaps named one by one


@dataclass
class LabelVolume:
    """Labels (layers, i, j, k) on a regular grid, 0 for what belongs to nothing.

    One layer (i, j, k) is enough where no labels overlap. ``affine`` (4, 4) takes voxel indices to
    positions [mm, RAS]; ``names`` are those of the labels that have one; ``notes`` say what was
    assumed, rounded or empty; ``directed`` is whether the header states directions.
    """

    labels: Array
    affine: Floats
    names: dict[int, str]
    source: str
    notes: list[str] = field(default_factory=list)
    directed: bool = True

    def __post_init__(self) -> None:
        if self.labels.ndim == 3:
            self.labels = self.labels[None]

    @property
    def spacing(self) -> Floats:
        """Edges of a voxel [mm], (3,)."""
        return np.linalg.norm(self.affine[:3, :3], axis=0)

    def values(self) -> Array:
        """Labels that occur, without 0."""
        found = [np.flatnonzero(np.bincount(layer.ravel())) for layer in self.labels]
        return np.concatenate([each[each > 0] + k * LAYER for k, each in enumerate(found)])

    def mask(self, label: int) -> Booleans:
        """Voxels (i, j, k) of a label."""
        layer, value = divmod(label, LAYER)
        return self.labels[layer] == value

    def name(self, label: int) -> str:
        """Name of a label; its number where it has none."""
        layer, value = divmod(int(label), LAYER)
        where = f"_layer_{layer + 1}" if layer else ""
        return self.names.get(int(label)) or f"label_{value}{where}"

    def overlaps(self) -> list[str]:
        """One line for each two labels that have voxels in common."""
        found = []
        for b in range(1, len(self.labels)):
            for a in range(b):
                both = (self.labels[a] > 0) & (self.labels[b] > 0)
                one, other = (self.labels[k][both].astype(np.int64) for k in (a, b))
                pairs, counts = np.unique(one * LAYER + other, return_counts=True)
                for pair, count in zip(pairs.tolist(), counts.tolist()):
                    labels = pair // LAYER + a * LAYER, pair % LAYER + b * LAYER
                    found.append((count, *labels))
        lines = []
        for count, first, second in sorted(found, reverse=True)[:MOST_NAMED]:
            size, small = min((int(self.mask(k).sum()), k) for k in (first, second))
            lines.append(
                f"{self.name(first)} and {self.name(second)} overlap in {count} voxels "
                f"({100 * count / size:.3g} % of {self.name(small)}), both kept"
            )
        more = len(found) - len(lines)
        return lines + ([f"{more} more pairs of labels overlap, each kept whole"] if more else [])


VOLUME_SUFFIXES = (".nii", ".nii.gz", ".nrrd", ".nhdr")
# Stated limits: bytes of one volume once unpacked, labels, and the edge of a voxel [mm].
MOST_BYTES = 2_000_000_000
MOST_LABELS = 512
VOXEL_RANGE = (0.02, 20.0)
_TO_MM = {"mm": 1.0, "millimeter": 1.0, "unknown": 1.0, "cm": 10.0, "m": 1000.0, "meter": 1000.0}
_TO_MM |= {"um": 0.001, "micron": 0.001}
# Labels may be stored with this much less or more than whole numbers.
ROUNDED = 1e-3
NO_DIRECTIONS = (
    "the header states no directions: the voxels' axes are taken to run to the right, forward and "
    "up (RAS), so left and right may be exchanged"
)
NO_UNIT = "the header states no unit of length: mm taken"
NUMBER = r"\s*([-+]?\d+(\.\d*)?)?\s*"  # a cell of a table of names that is none, or empty
# Places of voxels by a NIfTI's two transforms that differ by more than this [mm] are said.
SAME_PLACE = 0.1


def is_volume(path: Path) -> bool:
    """Whether a path is that of a label volume, by its suffix."""
    return path.name.lower().endswith(VOLUME_SUFFIXES)


def read_labels(path: Path, *, names: Path | None = None) -> LabelVolume:
    """Read a volume of labels, or a folder with one mask a file, named after what it masks.

    ``names`` is a table of names, as `read_names` takes it. MeshError if the volume cannot be read,
    has not three axes, no label, too many, or no usable voxel size.
    """
    volume = _read_folder(path) if path.is_dir() else _read_file(path)
    if names is not None:
        volume.names.update(read_names(names))
    values, image = volume.values(), "is it the image instead of its segmentation?"
    volume.notes += volume.overlaps()
    if len(values) == 0:
        raise MeshError(f"{path}: no voxel has a label; {image}")
    if not (values % LAYER % 256).any():
        raise MeshError(
            f"{path}: all labels are multiples of 256, so its bytes are swapped; export it again"
        )
    if len(values) > MOST_LABELS:
        raise MeshError(f"{path}: {len(values)} labels, at most {MOST_LABELS}; {image}")
    if len(values) == 1:
        only = volume.name(values[0])
        raise MeshError(f"{path}: only one label, {only!r}; a scene needs bones and muscles")
    return volume


def _read_folder(path):
    """One mask a file: the label's name is the file's."""
    found = sorted(file for file in path.iterdir() if is_volume(file))
    files = [file for file in found if not file.name.startswith(".")]
    if not 0 < len(files) <= MOST_LABELS:
        raise MeshError(
            f"{path}: {len(files)} masks ({' '.join(VOLUME_SUFFIXES)}), 1 to {MOST_LABELS}"
        )
    first = _read_file(files[0])
    layers: list[Array] = []
    names = {}
    notes = first.notes
    if len(files) < len(found):
        hidden = ", ".join(file.name for file in found if file not in files)
        notes.append(f"hidden files are not read: {hidden}")
    empty = []
    for number, file in enumerate(files, start=1):
        mask = _read_file(file)
        if mask.labels.shape != first.labels.shape or not np.allclose(
            mask.affine, first.affine, atol=1e-3
        ):
            raise MeshError(f"{file}: its grid differs from that of {files[0].name}; resample it")
        name = re.sub(r"(\.seg)?(\.nii(\.gz)?|\.n(rr|hd)[dr])$", "", file.name, flags=re.IGNORECASE)
        if len(mask.values()) > 1:
            notes.append(
                f"{file.name} has {len(mask.values())} labels and is taken for one mask of them all"
            )
        voxels = np.flatnonzero(mask.labels.max(axis=0))
        notes += [note for note in mask.notes if note not in notes]
        if len(voxels) == 0:
            empty.append(name)
            continue
        # The first layer in which nothing has these voxels, a new one where all do.
        free = (k for k, one in enumerate(layers) if not one.ravel()[voxels].any())
        layer = next(free, len(layers))
        if layer == len(layers):
            layers.append(np.zeros(first.labels.shape[1:], dtype=np.uint16))
        if len(layers) * layers[0].nbytes > MOST_BYTES:
            raise MeshError(
                f"{path}: its masks overlap in {len(layers)} layers; crop or split them"
            )
        layers[layer].ravel()[voxels] = number
        names[number + layer * LAYER] = name
    if empty:
        notes.append(f"{len(empty)} of {len(files)} masks are empty: {', '.join(empty)}")
    labels = np.stack(layers) if layers else np.zeros_like(first.labels)
    return LabelVolume(labels, first.affine, names, str(path), notes, first.directed)


def _read_file(path):
    from nibabel.filebasedimages import ImageFileError
    from nibabel.spatialimages import HeaderDataError
    from nibabel.wrapstruct import WrapStructError
    from nrrd.errors import NRRDError

    if not path.exists():
        raise UsageError(f"{path} does not exist; give a label volume or a folder")
    kind = "NRRD" if path.name.lower().endswith((".nrrd", ".nhdr")) else "NIfTI"
    own_errors = ImageFileError, HeaderDataError, WrapStructError, NRRDError
    try:
        volume, unit = _read_nrrd(path) if kind == "NRRD" else _read_nifti(path)
    except MeshError:
        raise
    except (*BROKEN_FILE, *own_errors) as error:
        why = " ".join(str(error).split())[:120] or type(error).__name__
        raise MeshError(f"{path}: no readable {kind} volume ({why}); export it again") from None
    if unit not in _TO_MM:
        raise MeshError(f"{path}: unknown unit of length {unit!r} in its header")
    volume.affine[:3] *= _TO_MM[unit]
    volume.labels = _check_labels(volume.labels, path, volume.notes)
    _check_affine(volume.affine, path)
    if not volume.directed:
        volume.notes.append(NO_DIRECTIONS)
    occur = set(volume.values().tolist())
    empty = [name for label, name in volume.names.items() if label not in occur]
    if empty:
        volume.notes.append(f"{len(empty)} named labels have no voxel: {', '.join(empty)}")
    return volume


def _read_nifti(path):
    """Unchecked volume, with names that segmentation programs leave in its header as XML, and the
    unit of its affine.
    """
    import nibabel

    image = nibabel.load(path)
    _check_size(image.shape, image.get_data_dtype().itemsize, path)
    names = {}
    for extension in getattr(image.header, "extensions", []):
        content = extension.get_content()
        text = content.decode("utf-8", "ignore") if isinstance(content, bytes) else str(content)
        for number, name in re.findall(
            r'<Label[^>]*?Key="(\d+)"[^>]*?>(?:<!\[CDATA\[)?([^<\]]+)', text
        ):
            names[int(number)] = name.strip()
    data = np.asanyarray(image.dataobj)
    affine = np.array(image.affine, dtype=np.float64)
    unit = image.header.get_xyzt_units()[0]
    volume = LabelVolume(data.reshape(data.shape[:3]), affine, names, str(path))
    volume.notes += [NO_UNIT] if unit == "unknown" else []
    if not (int(image.header["qform_code"]) or int(image.header["sform_code"])):
        volume.directed = False
        volume.affine = np.diag([*map(float, image.header.get_zooms()[:3]), 1.0])
    # Both transforms may be set, and put the voxels at different places.
    first, known = image.get_sform(coded=True)
    second, other = image.get_qform(coded=True)
    if known and other:
        ends = np.meshgrid(*([0, size - 1] for size in image.shape[:3]))
        corners = np.column_stack([np.stack(ends, -1).reshape(-1, 3), np.ones(8)])
        apart = float(np.linalg.norm((first - second)[:3] @ corners.T, axis=0).max())
        if apart > SAME_PLACE:
            said = f"its sform counts, from which its qform is up to {apart:.3g} mm off"
            volume.notes.append(said)
    return volume, unit


def _read_nrrd(path):
    """Unchecked volume, with the names that Slicer writes for segments, and the unit of its
    affine.
    """
    import nrrd

    said = nrrd.read_header(str(path))
    sizes = tuple(int(size) for size in said["sizes"])
    layered = _layer_axis(said, len(sizes))
    _check_size(sizes if layered is None else np.delete(sizes, layered), 8, path)
    data, said = nrrd.read(str(path))
    if layered is not None:
        data = np.moveaxis(data, layered, 0)
    across = np.diag(np.asarray(said.get("spacings", np.ones(3)), dtype=np.float64)[-3:])
    directions = np.asarray(said.get("space directions", across), dtype=np.float64)
    directions = directions[np.isfinite(directions).all(axis=1)]
    if directions.shape != (3, 3):
        raise MeshError(
            f"{path}: its directions are not those of three axes; export one label map in 3-D"
        )
    affine = np.eye(4)
    affine[:3, :3], affine[:3, 3] = directions.T, said.get("space origin", np.zeros(3))
    space = str(said.get("space", "ras")).lower()
    ends = "".join(word[:1] for word in space.split("-")) if "-" in space else space
    if len(ends) < 3 or any(end not in pair for end, pair in zip(ends, ("lr", "pa", "si"))):
        raise MeshError(f"{path}: its space is {space!r}; export it as left-posterior-superior")
    affine[:3] *= [[-1.0] if end in "lpi" else [1.0] for end in ends[:3]]
    unit = str((said.get("space units") or [""])[0]).strip('"').lower()
    # Spaces of the body are in mm by convention.
    directed = "space" in said
    volume = LabelVolume(
        data,
        affine,
        names=_segment_names(said, layered is not None),
        source=str(path),
        notes=[] if unit or directed else [NO_UNIT],
        directed=directed,
    )
    return volume, unit or "mm"


def _layer_axis(header, count):
    """The axis of a NRRD file along which its layers lie; None where it has no layers."""
    kinds = [str(kind) for kind in header.get("kinds", [])]
    if count != 4 or not any(re.fullmatch(r"Segment\d+_Name", str(key)) for key in header):
        return kinds.index("list") if count == 4 and "list" in kinds else None
    other = [k for k, kind in enumerate(kinds) if kind not in ("domain", "space")]
    return other[0] if other else 0


def _segment_names(header, layered):
    """Names of Slicer's segments by label; of one layer a segment where no layer is said."""
    names = {}
    for key, value in header.items():
        segment = re.fullmatch(r"Segment(\d+)_Name", str(key))
        if segment:
            number = int(segment[1])
            said = header.get(f"Segment{number}_Layer")
            layer = int(said if said is not None else number) if layered else 0
            usual = 1 if layered and said is None else number + 1
            label = int(header.get(f"Segment{number}_LabelValue", usual))
            names[label + layer * LAYER] = str(value)
    return names


def _check_size(shape, itemsize, path):
    """MeshError where a volume has not three axes or is too large; nothing is unpacked for it."""
    if len(shape) < 3 or min(shape[:3]) < 2 or any(size > 1 for size in shape[3:]):
        raise MeshError(
            f"{path}: a volume of shape {tuple(shape)}; give one label map with three axes"
        )
    size = int(np.prod([int(size) for size in shape], dtype=object)) * itemsize
    if size > MOST_BYTES:
        raise MeshError(
            f"{path}: {size:,} bytes unpacked, at most {MOST_BYTES:,}; crop it or split it"
        )


def _check_labels(data, path, notes):
    """Whole numbers from 0 on, of uint16; rounded where they are nearly whole."""
    if not np.issubdtype(data.dtype, np.number) or np.iscomplexobj(data):
        raise MeshError(f"{path}: voxels of type {data.dtype}; labels are whole numbers")
    if not np.isfinite(data).all():
        count = int((~np.isfinite(data)).sum())
        raise MeshError(
            f"{path}: {count:,} of {data.size:,} voxels are not finite; set to 0 what belongs to "
            "nothing"
        )
    whole = np.rint(data)
    off = np.abs(data - whole)
    if off.max(initial=0.0) > ROUNDED:
        wrong = data.ravel()[off.ravel().argmax()]
        raise MeshError(
            f"{path}: {int((off > ROUNDED).sum())} voxels between whole numbers, as {wrong:g}; "
            "is it the image instead of its segmentation?"
        )
    if off.any():
        notes.append(f"labels that are no whole numbers rounded, by {off.max():.2g} at most")
    low, high = float(whole.min()), float(whole.max())
    if low < 0 or high >= LAYER:
        raise MeshError(
            f"{path}: labels from {low:g} to {high:g}, allowed are 0 to {LAYER - 1}; is "
            "it an image? take it out of the folder, or give its segmentation"
        )
    return np.ascontiguousarray(whole, dtype=np.uint16)


def _check_affine(affine, path):
    edges = np.linalg.norm(affine[:3, :3], axis=0)
    low, high = VOXEL_RANGE
    if not np.isfinite(affine).all() or (edges < low).any() or (edges > high).any():
        shown = " x ".join(f"{edge:g}" for edge in edges)
        raise MeshError(
            f"{path}: voxels of {shown} mm, allowed are {low:g} to {high:g}; is its unit metres?"
        )
    if abs(np.linalg.det(affine[:3, :3])) < 0.1 * edges.prod():
        raise MeshError(f"{path}: its axes do not span space; write its directions again")


def read_names(path: Path) -> dict[int, str]:
    """Names of labels from JSON, from lines with a number and a name, or from a known table by its
    name.
    """
    tables = tomllib.loads((Path(__file__).parent / "volumes.toml").read_text(encoding="utf-8"))
    if not path.exists() and path.name in tables:
        return dict(enumerate(tables[path.name].split(), start=1))
    try:
        data = path.read_bytes()
        # UTF-16 with its mark at the beginning, as spreadsheets write it, else UTF-8.
        marked = data[:2] in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
        text = data.decode("utf-16" if marked else "utf-8-sig", errors="replace")
    except OSError as error:
        known = ", ".join(tables)
        raise UsageError(f"cannot read {path}: {error.strerror}; known tables: {known}") from None
    if path.suffix.lower() == ".json":
        try:
            names = _json_names(json.loads(text))
        except (ValueError, RecursionError):
            raise UsageError(f"{path} is no JSON") from None
    else:
        names = _row_names(text, path)
    if not names:
        raise UsageError(f"{path} names no label; write lines of number and name, or JSON")
    return names


def _row_names(text, path):
    """Names of lines with a number and a name in either order: CSV with any separator, columns
    with spaces between (3D Slicer, FreeSurfer, ITK-SNAP).
    """
    names = {}
    for line in text.splitlines():
        separator = next((mark for mark in ";\t," if mark in re.sub(r'"[^"]*"', "", line)), " ")
        cells = next(csv.reader([line.strip()], delimiter=separator, skipinitialspace=True), [])
        numbers = [cell for cell in cells if re.fullmatch(r"\s*\d+(\.0*)?\s*", cell)]
        words = [cell.strip() for cell in cells if not re.fullmatch(NUMBER, cell)]
        if not numbers or not words or line.startswith("#"):
            continue
        number, name = int(float(numbers[0])), " ".join(words if separator == " " else words[:1])
        if names.setdefault(number, name) != name:
            raise UsageError(
                f"{path}: label {number} has two names, {names[number]!r} and {name!r}; keep one"
            )
    return names


def _json_names(table):
    """Names of a JSON table: number to name, name to number, or a list of rows as MuscleMap writes
    it.
    """
    if isinstance(table, dict) and isinstance(table.get("labels"), (dict, list)):
        table = table["labels"]
    if isinstance(table, list):
        rows = [row for row in table if isinstance(row, dict) and isinstance(row.get("value"), int)]
        parts = {
            row["value"]: (row.get("anatomy") or row.get("structure"), row.get("side"))
            for row in rows
        }
        return {
            number: " ".join(str(word) for word in words if word) for number, words in parts.items()
        }
    pairs = table.items() if isinstance(table, dict) else ()
    names = {int(key): str(value) for key, value in pairs if str(key).isdigit()}
    return names | {
        value: str(key) for key, value in pairs if isinstance(value, int) and not key.isdigit()
    }


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
    mesh: trimesh.Trimesh
    volume: float
    notes: list[str]
    capped: np.ndarray


def label_surface(volume: LabelVolume, label: int, *, pieces: bool = False) -> LabelSurface:
    """Smooth surface of a label, or MeshError where it has too few voxels for one.

    With ``pieces`` (bones of several parts) every piece of a hundredth or more is kept, not the
    largest alone.
    """
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
    places = vertices + (np.array([part.start for part in box]) - MARGIN)
    capped = np.zeros(len(places), dtype=bool)
    for axis, end in cuts:
        capped |= np.abs(places[:, axis] - end) < ON_CAP
    mesh = trimesh.Trimesh(to_world(places, volume.affine), faces, process=False)
    if mesh.volume < 0:
        mesh.invert()
    return LabelSurface(name, mesh, count * float(np.prod(volume.spacing)), notes, capped)


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
    from skimage.measure import marching_cubes

    # A field that is positive inside, zero about half-way between voxels in and out.
    rest = np.where(mask, np.float32(0.5), np.float32(-0.5))
    smooth = np.zeros_like(rest)
    for _ in range(PASSES):
        part = gaussian_filter(rest, SMOOTHING, truncate=4.0, mode="nearest")
        smooth += part
        rest -= part
    if not smooth.min() < 0.0 < smooth.max():
        return np.zeros((1, 3)), np.zeros((0, 3), np.int64)
    vertices, faces, _, _ = marching_cubes(-smooth, 0.0, allow_degenerate=False)
    vertices, faces = vertices.astype(np.float64), faces.astype(np.int64)
    # Fewer triangles, of about the edge that is wanted.
    target = max(200, int(vertex_areas(vertices, faces).sum() / (np.sqrt(3.0) / 4.0 * EDGE**2)))
    vertices, faces = simplified(vertices, faces, target)
    # Edges that collapse on either side of a thin wall fold it, or bring its sides through each
    # other.
    vertices, crossing = _untangled(vertices, faces, smooth)
    if crossing:
        notes.append(f"{crossing} triangles go through others, where the label is thin")
    # Moved along the normals, all by the same distance, to the volume of the voxels, but for what
    # is left of an error of some per cent to the fourth power.
    for _ in range(2):
        volume = mesh_volume(vertices, faces)
        normals, area = vertex_normals(vertices, faces), vertex_areas(vertices, faces).sum()
        off = int(mask.sum()) - abs(volume)
        vertices = vertices + np.sign(volume) * off / area * normals
    return vertices, faces


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


def scene_from_labels(path: Path, *, labels: Path | None) -> Scene:
    """The scene of `Scene.from_labels`."""
    volume = read_labels(path, names=labels)
    with TemporaryDirectory() as base:
        stage = Path(base, "surfaces")
        stage.mkdir()
        scene = scene_in_memory(guess_volume(volume, stage, Path(base)), Path(base))
    scene.name = plain_name(path.name.split(".")[0]) or "scene"
    return scene


def guess_volume(
    volume: LabelVolume,
    stage: Path,
    base: Path,
    *,
    progress: Callable[[int, int], None] | None = None,
) -> SceneGuess:
    """The guess of a label volume, whose surfaces are written into a folder ``stage``; the scene's
    paths are relative to ``base``. ``progress`` is called with the labels that are done, and of how
    many.
    """
    folder, capped, notes, unusable = write_surfaces(volume, stage, progress)
    guess = guess_scene(
        folder,
        "mm",
        base,
        header=HEADER if volume.directed else None,
        capped=capped,
        source=volume.source,
        unusable=unusable,
    )
    guess.notes[:0] = notes
    return guess


def write_surfaces(
    volume: LabelVolume, stage: Path, progress: Callable[[int, int], None] | None = None
) -> tuple[Path, dict[str, Booleans], list[str], dict[str, str]]:
    """Surfaces of all labels as PLY in ``meshes`` of a folder; ``progress`` as of
    `guess_volume`. Returned are that folder, vertices (n,) on caps by file, notes, and why labels
    have no surface, by their names.
    """
    meshes = stage / "meshes"
    meshes.mkdir()
    values = volume.values()
    capped: dict[str, Booleans] = {}
    unusable: dict[str, str] = {}
    frame = "right, forward, up (RAS), mm"
    notes = [f"surfaces of {Path(volume.source).name}, in its frame: {frame}", *volume.notes]
    for done, label in enumerate(values, start=1):
        tissue = name_facts(volume.name(label)).tissue
        if tissue == "other":
            notes.append(f"{volume.name(label)}: neither bone nor muscle, left out")
            continue
        try:
            surface = label_surface(volume, int(label), pieces=tissue == "bone")
        except MeshError as error:
            unusable[volume.name(label)] = str(error).removeprefix(f"{volume.source}: ")
            continue
        plain = plain_name(surface.name)
        file = new_name(surface.name, capped)
        if plain.lower() in map(str.lower, capped):  # they are two parts
            notes.append(f"several labels are named {plain}: one of them is {file} here")
        surface.mesh.export(meshes / f"{file}.ply")
        capped[file] = surface.capped
        notes += [f"{surface.name}: {note}" for note in surface.notes]
        if progress is not None:
            progress(done, len(values))
    return meshes, capped, notes, unusable
