"""Reading label volumes: NIfTI, NRRD, or a folder of masks; voxels, directions, units and names
honoured.

Positions come out in millimetres in the frame of NIfTI (RAS: x to the right, y forward, z up),
whatever the order and the signs of the voxels' axes; NRRD files in LPS are turned.
"""

import codecs
import csv
import json
import re
import tomllib
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from rbfmuscle.geometry.arrays import Array, Floats
from rbfmuscle.importers.labels.volume import LAYER, LabelVolume
from rbfmuscle.validation import BROKEN_FILE, MeshError, UsageError

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


@dataclass
class _Header:
    """What a file says besides its voxels."""

    affine: Floats  # (4, 4), in its unit
    unit: str
    names: dict[int, str]
    notes: list[str] = field(default_factory=list)
    directed: bool = True


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
    together = LabelVolume(first.labels, first.affine, {}, str(path), first.notes, first.directed)
    if len(files) < len(found):
        hidden = ", ".join(file.name for file in found if file not in files)
        together.notes.append(f"hidden files are not read: {hidden}")
    empty = []
    for number, file in enumerate(files, start=1):
        mask = _read_file(file)
        if mask.labels.shape != first.labels.shape or not np.allclose(
            mask.affine, first.affine, atol=1e-3
        ):
            raise MeshError(f"{file}: its grid differs from that of {files[0].name}; resample it")
        name = re.sub(r"(\.seg)?(\.nii(\.gz)?|\.n(rr|hd)[dr])$", "", file.name, flags=re.IGNORECASE)
        if len(mask.values()) > 1:
            together.notes.append(
                f"{file.name} has {len(mask.values())} labels and is taken for one mask of them all"
            )
        voxels = np.flatnonzero(mask.labels.max(axis=0))
        together.notes += [note for note in mask.notes if note not in together.notes]
        if len(voxels) == 0:
            empty.append(name)
            continue
        layer = _free_layer(layers, voxels, first.labels.shape[1:], path)
        layers[layer].ravel()[voxels] = number
        together.names[number + layer * LAYER] = name
    if empty:
        together.notes.append(f"{len(empty)} of {len(files)} masks are empty: {', '.join(empty)}")
    together.labels = np.stack(layers) if layers else np.zeros_like(first.labels)
    return together


def _free_layer(layers, voxels, shape, path):
    """Number of the first layer in which nothing has these voxels, a new one where all do."""
    for number, layer in enumerate(layers):
        if not layer.ravel()[voxels].any():
            return number
    layers.append(np.zeros(shape, dtype=np.uint16))
    if len(layers) * layers[0].nbytes > MOST_BYTES:
        raise MeshError(f"{path}: its masks overlap in {len(layers)} layers; crop or split them")
    return len(layers) - 1


def _read_file(path):
    if not path.exists():
        raise UsageError(f"{path} does not exist; give a label volume or a folder")
    kind, read = (
        ("NRRD", _read_nrrd)
        if path.name.lower().endswith((".nrrd", ".nhdr"))
        else ("NIfTI", _read_nifti)
    )
    try:
        data, header = read(path)
    except MeshError:
        raise
    except (*BROKEN_FILE, *_own_errors(kind)) as error:
        why = " ".join(str(error).split())[:120] or type(error).__name__
        raise MeshError(f"{path}: no readable {kind} volume ({why}); export it again") from None
    if header.unit not in _TO_MM:
        raise MeshError(f"{path}: unknown unit of length {header.unit!r} in its header")
    header.affine[:3] *= _TO_MM[header.unit]
    labels = _check_labels(data, path, header.notes)
    affine = _check_affine(header.affine, path)
    if not header.directed:
        header.notes.append(NO_DIRECTIONS)
    volume = LabelVolume(labels, affine, header.names, str(path), header.notes, header.directed)
    occur = set(volume.values().tolist())
    empty = [name for label, name in header.names.items() if label not in occur]
    if empty:
        volume.notes.append(f"{len(empty)} named labels have no voxel: {', '.join(empty)}")
    return volume


def _own_errors(kind):
    """What the library for a kind of file raises besides usual errors."""
    if kind == "NRRD":
        from nrrd.errors import NRRDError

        return (NRRDError,)
    from nibabel.filebasedimages import ImageFileError
    from nibabel.spatialimages import HeaderDataError
    from nibabel.wrapstruct import WrapStructError

    return ImageFileError, HeaderDataError, WrapStructError


def _read_nifti(path):
    """Voxels (i, j, k) and header, with names that segmentation programs leave in it as XML."""
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
    header = _Header(
        np.array(image.affine, dtype=np.float64), image.header.get_xyzt_units()[0], names
    )
    header.notes += [NO_UNIT] if header.unit == "unknown" else []
    if not (int(image.header["qform_code"]) or int(image.header["sform_code"])):
        header.directed = False
        header.affine = np.diag([*map(float, image.header.get_zooms()[:3]), 1.0])
    header.notes += _two_places(image)
    return data.reshape(data.shape[:3]), header


def _two_places(image):
    """A note where both transforms of a NIfTI are set and put its voxels at different places."""
    first, second = image.get_sform(coded=True), image.get_qform(coded=True)
    if not (first[1] and second[1]):
        return []
    corners = np.stack(np.meshgrid(*([0, size - 1] for size in image.shape[:3])), -1).reshape(-1, 3)
    way = (first[0] - second[0])[:3] @ np.column_stack([corners, np.ones(8)]).T
    apart = float(np.linalg.norm(way, axis=0).max())
    return (
        [f"its sform counts, from which its qform is up to {apart:.3g} mm off"]
        if apart > SAME_PLACE
        else []
    )


def _read_nrrd(path):
    """Voxels (i, j, k), or (layers, i, j, k), and header, with the names that Slicer writes for
    segments.
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
    header = _Header(affine, unit or "mm", _segment_names(said, layered is not None))
    header.directed = "space" in said
    # Spaces of the body are in mm by convention.
    header.notes += [] if unit or header.directed else [NO_UNIT]
    return data, header


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
    return affine


def read_names(path: Path) -> dict[int, str]:
    """Names of labels from JSON, from lines with a number and a name, or from a known table by its
    name.
    """
    tables = tomllib.loads((Path(__file__).parent / "tables.toml").read_text(encoding="utf-8"))
    if not path.exists() and path.name in tables:
        return dict(enumerate(tables[path.name].split(), start=1))
    try:
        text = _decoded(path.read_bytes())
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


def _decoded(data):
    """Text of UTF-8, or of UTF-16 where it begins with its mark, as spreadsheets write it."""
    marked = data[:2] in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
    return data.decode("utf-16" if marked else "utf-8-sig", errors="replace")


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
