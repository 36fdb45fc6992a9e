"""Reading label volumes: NIfTI, NRRD, or a folder of masks; voxels, directions, units and names honoured.

Positions come out in millimetres in the frame of NIfTI (RAS: x to the right, y forward, z up), whatever the
order and the signs of the voxels' axes; NRRD files in LPS are turned.
"""

import csv
import json
import re
import tomllib
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from rbfmuscle.validation import MeshError, MissingPartError, UsageError

VOLUME_SUFFIXES = (".nii", ".nii.gz", ".nrrd", ".seg.nrrd")
# Stated limits: bytes of one volume once unpacked, labels, and the edge of a voxel [mm].
MOST_BYTES = 2_000_000_000
MOST_LABELS = 512
VOXEL_RANGE = (0.02, 20.0)
_TO_MM = {
    "mm": 1.0,
    "meter": 1000.0,
    "m": 1000.0,
    "micron": 0.001,
    "um": 0.001,
    "cm": 10.0,
    "unknown": 1.0,
    "": 1.0,
}


@dataclass
class LabelVolume:
    """Labels on a regular grid.

    Attributes
    ----------
    labels : (i, j, k) ndarray of int
        0 is what belongs to nothing.
    affine : (4, 4) ndarray
        Voxel index to position [mm, RAS].
    names : dict of int to str
        Of the labels that have one.
    source : str
    """

    labels: np.ndarray
    affine: np.ndarray
    names: dict
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
    """Read a volume of labels, or a folder with one mask a file.

    Parameters
    ----------
    path : Path
        ``.nii``, ``.nii.gz`` or ``.nrrd``, or a folder of such files, named after what they mask.
    names : Path, optional
        Table of names: JSON (number to name), or lines of number and name as CSV, TSV or ITK-SNAP's descriptions.

    Raises
    ------
    MeshError
        If the volume cannot be read, has not three axes, no label, too many, or no usable voxel size.
    MissingPartError
        If the package that reads the format is not installed.
    """
    volume = _read_folder(path) if path.is_dir() else _read_file(path)
    if names is not None:
        volume.names.update(read_names(names))
    count = len(volume.values())
    if count and not (volume.values() % 256).any():
        raise MeshError(f"{path}: all labels are multiples of 256, so its bytes are swapped; export it again")
    if count == 0:
        raise MeshError(f"{path}: no voxel has a label; is it the image instead of its segmentation?")
    if count > MOST_LABELS:
        raise MeshError(
            f"{path}: {count} labels, at most {MOST_LABELS}; is it the image instead of its segmentation?"
        )
    if count == 1:
        raise MeshError(
            f"{path}: only one label, {volume.name(volume.values()[0])!r}; a scene needs bones and muscles"
        )
    return volume


def _read_file(path):
    if not path.exists():
        raise UsageError(f"{path} does not exist; give a label volume or a folder")
    reader = _read_nrrd if path.name.lower().endswith(".nrrd") else _read_nifti
    data, affine, names = reader(path)
    return LabelVolume(_check_labels(data, path), _check_affine(affine, path), names, str(path))


def _read_folder(path):
    """One mask a file: the label's name is the file's."""
    files = sorted(p for p in path.iterdir() if is_volume(p))
    if len(files) > MOST_LABELS:
        raise MeshError(f"{path}: {len(files)} masks, at most {MOST_LABELS}")
    together = None
    for number, file in enumerate(files, start=1):
        mask = _read_file(file)
        if together is None:
            together = LabelVolume(np.zeros(mask.labels.shape, np.int32), mask.affine, {}, str(path))
        same = mask.labels.shape == together.labels.shape and np.allclose(
            mask.affine, together.affine, atol=1e-3
        )
        if not same:
            raise MeshError(
                f"{file}: its grid differs from that of {files[0].name}; resample the masks to one grid"
            )
        together.labels[mask.labels > 0] = number
        together.names[number] = re.sub(r"(\.seg)?(\.nii(\.gz)?|\.nrrd)$", "", file.name, flags=re.IGNORECASE)
    if together is None:
        raise UsageError(f"{path} holds no mask ({' '.join(VOLUME_SUFFIXES)})")
    return together


def _read_nifti(path):
    try:
        import nibabel
        from nibabel.filebasedimages import ImageFileError
    except ImportError:
        raise MissingPartError(
            "reading .nii needs nibabel: pip install -e '.[labels]' in rbfmuscle's folder"
        ) from None
    try:
        image = nibabel.load(path)
        shape, itemsize = image.shape, image.get_data_dtype().itemsize
        unit = image.header.get_xyzt_units()[0]
        data = np.asanyarray(image.dataobj) if _check_size(shape, itemsize, path) else None
    except MeshError:
        raise
    except (ImageFileError, OSError, EOFError, ValueError, KeyError, zlib.error, OverflowError) as error:
        raise MeshError(f"{path}: no readable NIfTI volume ({_first_line(error)}); export it again") from None
    factor = _TO_MM.get(unit)
    if factor is None:
        raise MeshError(f"{path}: unknown unit of length {unit!r} in its header")
    affine = np.array(image.affine, dtype=np.float64)
    affine[:3] *= factor
    return data, affine, _names_in_extensions(image)


def _names_in_extensions(image):
    """Names that segmentation programs leave in the header: JSON or the XML of a label table."""
    names = {}
    for extension in getattr(image.header, "extensions", []):
        content = extension.get_content()
        text = content.decode("utf-8", "ignore") if isinstance(content, bytes) else str(content)
        for number, name in re.findall(r'<Label[^>]*?Key="(\d+)"[^>]*?>(?:<!\[CDATA\[)?([^<\]]+)', text):
            names[int(number)] = name.strip()
    return names


def _read_nrrd(path):
    try:
        import nrrd
    except ImportError:
        raise MissingPartError(
            "reading .nrrd needs pynrrd: pip install -e '.[labels]' in rbfmuscle's folder"
        ) from None
    try:
        header = nrrd.read_header(str(path))
        shape = tuple(int(size) for size in header["sizes"])
        data, header = nrrd.read(str(path)) if _check_size(shape, 8, path) else (None, header)
    except MeshError:
        raise
    except (nrrd.NRRDError, OSError, EOFError, ValueError, KeyError, zlib.error, OverflowError) as error:
        raise MeshError(f"{path}: no readable NRRD volume ({_first_line(error)}); export it again") from None
    affine = np.eye(4)
    directions = np.asarray(header.get("space directions", np.eye(3)), dtype=np.float64)
    if directions.shape != (3, 3):
        raise MeshError(f"{path}: its directions are not those of three axes; export one label map in 3-D")
    affine[:3, :3] = directions.T
    affine[:3, 3] = np.asarray(header.get("space origin", np.zeros(3)), dtype=np.float64)
    unit = (header.get("space units") or ["mm"])[0]
    affine[:3] *= _TO_MM.get(str(unit).strip('"').lower(), 1.0)
    if str(header.get("space", "left-posterior-superior")).lower() in ("left-posterior-superior", "lps"):
        affine[:2] *= -1.0
    return data, affine, _slicer_names(header)


def _slicer_names(header):
    names = {}
    for key, value in header.items():
        segment = re.fullmatch(r"Segment(\d+)_Name", str(key))
        if segment:
            names[int(header.get(f"Segment{segment[1]}_LabelValue", int(segment[1]) + 1))] = str(value)
    return names


def _first_line(error):
    return (str(error).strip().splitlines() or [type(error).__name__])[0][:120]


def _check_size(shape, itemsize, path):
    """True, or MeshError where a volume has not three axes or is too large; nothing is unpacked for it."""
    if (
        len([size for size in shape if size > 1]) != 3
        or len(shape) < 3
        or any(size > 1 for size in shape[3:])
    ):
        raise MeshError(f"{path}: a volume of shape {tuple(shape)}; give one label map with three axes")
    size = int(np.prod([int(size) for size in shape], dtype=object)) * itemsize
    if size > MOST_BYTES:
        raise MeshError(f"{path}: {size:,} bytes unpacked, at most {MOST_BYTES:,}; crop it or split it")
    return True


def _check_labels(data, path):
    """Whole numbers from 0 on, (i, j, k) of int32."""
    data = np.asarray(data).reshape(np.asarray(data).shape[:3])
    if not np.issubdtype(data.dtype, np.number) or np.iscomplexobj(data):
        raise MeshError(f"{path}: voxels of type {data.dtype}; labels are whole numbers")
    if np.issubdtype(data.dtype, np.floating):
        if not np.isfinite(data).all():
            raise MeshError(
                f"{path}: {int((~np.isfinite(data)).sum()):,} voxels are not finite; labels are whole numbers"
            )
        if not (data == np.rint(data)).all():
            raise MeshError(
                f"{path}: voxels between whole numbers; is it the image instead of its segmentation?"
            )
    low, high = float(data.min()), float(data.max())
    if low < 0 or high > 65535:
        raise MeshError(
            f"{path}: labels from {low:g} to {high:g}, allowed are 0 to 65535; is its byte order right?"
        )
    return np.ascontiguousarray(data, dtype=np.int32)


def _check_affine(affine, path):
    edges = np.linalg.norm(affine[:3, :3], axis=0)
    low, high = VOXEL_RANGE
    if not np.isfinite(affine).all() or (edges < low).any() or (edges > high).any():
        shown = " x ".join(f"{edge:g}" for edge in edges)
        raise MeshError(f"{path}: voxels of {shown} mm, allowed are {low:g} to {high:g}; is its unit metres?")
    if abs(np.linalg.det(affine[:3, :3])) < 0.1 * edges.prod():
        raise MeshError(f"{path}: its axes do not span space; write its directions again")
    return affine


def read_names(path: Path) -> dict[int, str]:
    """Names of labels from a file, or from a known table by its name.

    Raises
    ------
    UsageError
        If the file cannot be read or names nothing.
    """
    known = known_tables()
    if not path.exists() and path.name in known:
        return known[path.name]
    try:
        text = path.read_text(encoding="utf-8", errors="replace")
    except OSError as error:
        raise UsageError(f"cannot read {path}: {error.strerror}; known tables: {', '.join(known)}") from None
    names: dict[int, str] = {}
    if path.suffix.lower() == ".json":
        names = _json_names(text, path)
    else:
        for line in text.splitlines():
            if line.lstrip().startswith("#"):
                continue
            words = next(csv.reader([line.replace("\t", ",")], skipinitialspace=True), [])
            snap = re.match(r'\s*(\d+)\s+.*"([^"]+)"\s*$', line)
            if snap:
                names[int(snap[1])] = snap[2]
            elif len(words) >= 2 and words[0].strip().isdigit():
                names[int(words[0])] = words[1].strip()
    if not names:
        raise UsageError(f"{path} names no label; write lines of number and name, or JSON")
    return names


def known_tables() -> dict[str, dict[int, str]]:
    """Names of labels by number, of segmentation programs, from ``tables.toml``."""
    with (Path(__file__).parent / "tables.toml").open("rb") as file:
        tables = tomllib.load(file)
    return {name: dict(enumerate(words.split(), start=1)) for name, words in tables.items()}


def _json_names(text, path):
    try:
        table = json.loads(text)
    except (ValueError, RecursionError):
        raise UsageError(f"{path} is no JSON") from None
    if isinstance(table, dict) and isinstance(table.get("labels"), (dict, list)):
        table = table["labels"]
    if isinstance(table, list):  # as MuscleMap writes it
        rows = [row for row in table if isinstance(row, dict) and isinstance(row.get("value"), int)]
        return {
            r["value"]: f"{r.get('anatomy') or r.get('structure')} {r.get('side', '')}".strip() for r in rows
        }
    if not isinstance(table, dict):
        raise UsageError(f"{path}: give an object of number and name")
    names = {}
    for key, value in table.items():
        if str(key).isdigit():
            names[int(key)] = str(value)
        elif isinstance(value, int):
            names[value] = str(key)
    return names
