"""Point clouds: ``.xyz``, ``.npy`` and ``.ply`` files, with normals or without."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.validation import MeshError, is_file, shown_path


def read_points(path: str | Path) -> tuple[Floats, Floats | None]:
    """Points of a file, and their normals where it has them.

    Parameters
    ----------
    path : path
        ``.xyz``: three or six numbers a line (what follows ``#`` is left out); ``.npy``: an array (n, 3) or
        (n, 6); ``.ply``: vertices, whose faces are left out.

    Returns
    -------
    points : (n, 3) ndarray
    normals : (n, 3) ndarray or None

    Raises
    ------
    MeshError
        If the file is missing or unreadable, or its numbers are not finite.
    """
    path = Path(path)
    if not is_file(path):
        raise MeshError(f"{shown_path(path)}: no such file of points")
    suffix = path.suffix.lower()
    if suffix not in POINT_SUFFIXES:
        raise MeshError(f"{shown_path(path)}: points are read from {', '.join(POINT_SUFFIXES)}")
    try:
        table = _READERS[suffix](path)
    except (ValueError, OSError, EOFError, KeyError, IndexError, TypeError) as error:
        raise MeshError(f"{path}: not readable as points ({' '.join(str(error).split())[:120]})") from None
    if table.ndim != 2 or table.shape[1] not in (3, 6):
        raise MeshError(
            f"{path}: points need 3 numbers, or 6 with normals, got an array of shape {table.shape}"
        )
    if not np.isfinite(table).all():
        row = int(np.argwhere(~np.isfinite(table))[0][0])
        raise MeshError(f"{path}: point {row} is not finite; export the points again")
    normals = table[:, 3:] if table.shape[1] == 6 else None
    if normals is not None:
        length = np.linalg.norm(normals, axis=1)
        if not length.all():
            return table[:, :3].copy(), None
        normals = normals / length[:, None]
    return table[:, :3].copy(), normals


def _read_text(path: Path) -> Floats:
    text = path.read_text(encoding="utf-8", errors="replace").replace(",", " ")
    rows, width = [], 0
    for number, line in enumerate(text.splitlines(), start=1):
        words = line.split("#", 1)[0].split()
        width = width or len(words)
        if words and len(words) != width:
            raise ValueError(f"line {number} has {len(words)} numbers, those before it {width}")
        try:
            rows += [[float(word) for word in words]] if words else []
        except ValueError as error:
            raise ValueError(f"line {number}: {error}") from None
    return np.array(rows, dtype=np.float64)


def _read_array(path: Path) -> Floats:
    return np.asarray(np.load(path, allow_pickle=False), dtype=np.float64)


def _read_ply(path: Path) -> Floats:
    import trimesh

    loaded = trimesh.load(path, file_type="ply", process=False)
    points = np.asarray(loaded.vertices, dtype=np.float64)
    raw = loaded.metadata.get("_ply_raw", {}).get("vertex", {}).get("data", {})
    names = getattr(getattr(raw, "dtype", None), "names", None) or (
        raw.keys() if isinstance(raw, dict) else ()
    )
    if {"nx", "ny", "nz"} <= set(names):
        normals = np.stack(
            [np.asarray(raw[name], dtype=np.float64).ravel() for name in ("nx", "ny", "nz")], axis=1
        )
        return np.hstack([points, normals])
    return points


_READERS = {".xyz": _read_text, ".npy": _read_array, ".ply": _read_ply}
POINT_SUFFIXES = tuple(_READERS)
