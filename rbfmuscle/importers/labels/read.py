"""Reading label volumes: NIfTI, NRRD, or a folder of masks; voxels, directions, units and names
honoured.

Positions come out in millimetres in the frame of NIfTI (RAS: x to the right, y forward, z up),
whatever the order and the signs of the voxels' axes; NRRD files in LPS are turned.
"""

import json
import re
import tomllib
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rbfmuscle.validation import MeshError, UsageError

VOLUME_SUFFIXES = (".nii", ".nii.gz", ".nrrd")
# Stated limits: bytes of one volume once unpacked, labels, and the edge of a voxel [mm].
MOST_BYTES = 2_000_000_000
MOST_LABELS = 512
VOXEL_RANGE = (0.02, 20.0)
_TO_MM = {"mm": 1.0, "millimeter": 1.0, "unknown": 1.0, "cm": 10.0, "m": 1000.0, "meter": 1000.0}
_TO_MM |= {"um": 0.001, "micron": 0.001}


@dataclass
class LabelVolume:
    """Labels (i, j, k) on a regular grid, 0 for what belongs to nothing.

    ``affine`` (4, 4) takes voxel indices to positions [mm, RAS]; ``names`` are those of the labels
    that have one.
    """

    labels: np.ndarray
    affine: np.ndarray
    names: dict[int, str]
    source: str

    @property
    def spacing(self) -> np.ndarray:
        """Edges of a voxel [mm], (3,)."""
        return np.linalg.norm(self.affine[:3, :3], axis=0)

    def values(self) -> np.ndarray:
        """Labels that occur, without 0."""
        found = np.flatnonzero(np.bincount(self.labels.ravel()))
        return found[found > 0]

    def name(self, label: int) -> str:
        """Name of a label; its number where it has none."""
        return self.names.get(int(label)) or f"label_{int(label)}"


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
    if len(values) == 0:
        raise MeshError(f"{path}: no voxel has a label; {image}")
    if not (values % 256).any():
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
    files = sorted(file for file in path.iterdir() if is_volume(file))
    if not 0 < len(files) <= MOST_LABELS:
        raise MeshError(
            f"{path}: {len(files)} masks ({' '.join(VOLUME_SUFFIXES)}), 1 to {MOST_LABELS}"
        )
    first = _read_file(files[0])
    together = LabelVolume(np.zeros_like(first.labels), first.affine, {}, str(path))
    for number, file in enumerate(files, start=1):
        mask = _read_file(file)
        if mask.labels.shape != first.labels.shape or not np.allclose(
            mask.affine, first.affine, atol=1e-3
        ):
            raise MeshError(f"{file}: its grid differs from that of {files[0].name}; resample it")
        together.labels[mask.labels > 0] = number
        together.names[number] = re.sub(
            r"(\.seg)?(\.nii(\.gz)?|\.nrrd)$", "", file.name, flags=re.IGNORECASE
        )
    return together


def _read_file(path):
    if not path.exists():
        raise UsageError(f"{path} does not exist; give a label volume or a folder")
    kind, read = (
        ("NRRD", _read_nrrd) if path.name.lower().endswith(".nrrd") else ("NIfTI", _read_nifti)
    )
    try:
        data, affine, unit, names = read(path)
    except MeshError:
        raise
    except Exception as error:  # noqa: BLE001 - any error of a library becomes one line
        why = " ".join(str(error).split())[:120] or type(error).__name__
        raise MeshError(f"{path}: no readable {kind} volume ({why}); export it again") from None
    if unit not in _TO_MM:
        raise MeshError(f"{path}: unknown unit of length {unit!r} in its header")
    affine[:3] *= _TO_MM[unit]
    return LabelVolume(_check_labels(data, path), _check_affine(affine, path), names, str(path))


def _read_nifti(path):
    """Voxels, affine (4, 4), its unit, and names that segmentation programs leave in the header as
    XML.
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
    unit = image.header.get_xyzt_units()[0]
    return np.asanyarray(image.dataobj), np.array(image.affine, dtype=np.float64), unit, names


def _read_nrrd(path):
    """Voxels, affine (4, 4), its unit, and the names that Slicer writes for segments."""
    import nrrd

    _check_size(tuple(int(size) for size in nrrd.read_header(str(path))["sizes"]), 8, path)
    data, header = nrrd.read(str(path))
    across = np.diag(np.asarray(header.get("spacings", np.ones(3)), dtype=np.float64))
    directions = np.asarray(header.get("space directions", across), dtype=np.float64)
    if directions.shape != (3, 3):
        raise MeshError(
            f"{path}: its directions are not those of three axes; export one label map in 3-D"
        )
    affine = np.eye(4)
    affine[:3, :3], affine[:3, 3] = directions.T, header.get("space origin", np.zeros(3))
    space = str(header.get("space", "lps")).lower()
    ends = "".join(word[:1] for word in space.split("-")) if "-" in space else space
    if len(ends) < 3 or any(end not in pair for end, pair in zip(ends, ("lr", "pa", "si"))):
        raise MeshError(f"{path}: its space is {space!r}; export it as left-posterior-superior")
    affine[:3] *= [[-1.0] if end in "lpi" else [1.0] for end in ends[:3]]
    names = {}
    for key, value in header.items():
        segment = re.fullmatch(r"Segment(\d+)_Name", str(key))
        if segment:
            names[int(header.get(f"Segment{segment[1]}_LabelValue", int(segment[1]) + 1))] = str(
                value
            )
    unit = str((header.get("space units") or ["mm"])[0]).strip('"').lower()
    return data, affine, unit or "mm", names


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


def _check_labels(data, path):
    """Whole numbers from 0 on, (i, j, k) of int32."""
    data = data.reshape(data.shape[:3])
    if not np.issubdtype(data.dtype, np.number) or np.iscomplexobj(data):
        raise MeshError(f"{path}: voxels of type {data.dtype}; labels are whole numbers")
    if not np.isfinite(data).all():
        raise MeshError(f"{path}: some voxels are not finite; labels are whole numbers")
    if not (data == np.rint(data)).all():
        raise MeshError(
            f"{path}: voxels between whole numbers; is it the image instead of its segmentation?"
        )
    low, high = float(data.min()), float(data.max())
    if low < 0 or high > 65535:
        raise MeshError(f"{path}: labels from {low:g} to {high:g}, allowed are 0 to 65535")
    return np.ascontiguousarray(data, dtype=np.int32)


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
    """Names of labels from JSON, from lines as CSV, TSV or ITK-SNAP write them, or from a known
    table by its name.
    """
    tables = tomllib.loads((Path(__file__).parent / "tables.toml").read_text(encoding="utf-8"))
    if not path.exists() and path.name in tables:
        return dict(enumerate(tables[path.name].split(), start=1))
    try:
        text = path.read_text(encoding="utf-8", errors="replace")
        names = (
            _json_names(json.loads(text)) if path.suffix.lower() == ".json" else _row_names(text)
        )
    except OSError as error:
        known = ", ".join(tables)
        raise UsageError(f"cannot read {path}: {error.strerror}; known tables: {known}") from None
    except (ValueError, RecursionError):
        raise UsageError(f"{path} is no JSON") from None
    if not names:
        raise UsageError(f"{path} names no label; write lines of number and name, or JSON")
    return names


def _row_names(text):
    """Names of lines of number and name: CSV, TSV, or ITK-SNAP's descriptions with the name in
    quotes at the end.
    """
    names = {}
    for line in text.splitlines():
        snap = re.match(r'\s*(\d+)\s+.*"([^"]+)"\s*$', line)
        row = snap or re.match(r'\s*(\d+)\s*[,\t]\s*"?([^",\t]+)', line)
        if row:
            names[int(row[1])] = row[2].strip()
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
