"""What a run that was killed needs to go on: a tree of plain values and arrays in one file, exact and whole."""

from __future__ import annotations

import json
import os
import zipfile
from pathlib import Path
from typing import Any

import numpy as np

NAME = "checkpoint.npz"


def write_checkpoint(path: Path, state: dict[str, Any]) -> None:
    """Write a tree of dicts (keys are text), lists, tuples, arrays, numbers, text and None, in one move.

    Whoever reads finds the old one or the new one, also after the power has failed.

    Parameters
    ----------
    path : pathlib.Path
    state : dict
    """
    arrays: list[np.ndarray] = []
    text = json.dumps(_packed(state, arrays))
    named = {f"a{k}": array for k, array in enumerate(arrays)}
    part = path.with_name(f".{path.name}.part")
    try:
        with open(part, "wb") as file:
            np.savez(file, allow_pickle=False, tree=np.frombuffer(text.encode(), dtype=np.uint8), **named)
            file.flush()
            os.fsync(file.fileno())
        os.replace(part, path)
    except OSError:
        part.unlink(missing_ok=True)
        raise


def read_checkpoint(path: Path) -> dict[str, Any] | None:
    """The tree of a file, None where there is none or it is damaged (the file carries sums of its parts)."""
    try:
        with np.load(path, allow_pickle=False) as file:
            tree = json.loads(file["tree"].tobytes().decode())
            return _unpacked(tree, file)
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        return None


def _packed(value, arrays):
    """JSON of a tree in which each dict, list, tuple and array is a dict with one key that tells which."""
    if isinstance(value, dict):
        return {"d": {key: _packed(item, arrays) for key, item in value.items()}}
    if isinstance(value, (list, tuple)):
        return {"t" if isinstance(value, tuple) else "l": [_packed(item, arrays) for item in value]}
    if isinstance(value, np.ndarray):
        arrays.append(value)
        return {"a": len(arrays) - 1}
    return value.item() if isinstance(value, np.generic) else value


def _unpacked(tree, arrays):
    if not isinstance(tree, dict):
        return tree
    (kind, value), *_ = tree.items()
    if kind == "d":
        return {key: _unpacked(item, arrays) for key, item in value.items()}
    if kind == "a":
        return arrays[f"a{value}"]
    found = [_unpacked(item, arrays) for item in value]
    return tuple(found) if kind == "t" else found
