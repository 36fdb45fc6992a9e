"""The facts in ``run.json``: what was run, with what, on what, how long it took and how it went."""

from __future__ import annotations

import hashlib
import importlib.metadata
import os
import platform
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import rbfmuscle
from rbfmuscle.metrics.quantities import ALL
from rbfmuscle.scene.motion import shown_value
from rbfmuscle.scene.scene import Scene
from rbfmuscle.simulation.frame import Frame

FORMAT = 2
_PACKAGES = ("numpy", "scipy", "numba", "scikit-image", "trimesh", "pyvista", "vtk", "libigl")


def build_info(
    scene: Scene, started: datetime, neighbours: Neighbours, summary: dict[str, Any], **facts: Any
) -> dict[str, Any]:
    """Assemble ``run.json``; ``summary`` is from `Summary.table`.

    Other facts are kept as they are: ``status`` ("running", "complete", "interrupted" or "failed"), ``message`` (why it
    did not complete), ``options`` of the caller, ``times`` of the parts of the run [s], ``limits``, ``verdict``,
    ``beyond`` (muscle, quantity, worst value, limit, frame) and ``frames`` (`frame_facts`).
    """
    return {
        "format": FORMAT,
        "started": started.isoformat(timespec="seconds"),
        "written": datetime.now(UTC).isoformat(timespec="seconds"),
        "scene": scene.resolved(),
        "versions": versions(),
        "machine": machine(),
        "inputs": input_hashes(scene),
        **({"neighbours": neighbours.table()} if neighbours.pairs else {}),
        "muscles": {name: found for name, found in summary.items() if name != ALL},
        "frame_time": summary.get(ALL, {}).get("time_frame"),
        **facts,
    }


def frame_facts(scene: Scene, frame: Frame) -> dict:
    """What ``run.json`` says of a written frame; coordinates in degrees, those of shifts in scene units."""
    times = scene.motion.times
    return {
        "frame": frame.index,
        **({} if times is None else {"time": times[frame.index]}),
        "coordinates": {name: shown_value(scene, name, value) for name, value in frame.coordinates.items()},
        "wall": frame.wall,
    }


class Neighbours:
    """Pairs of muscles that slide: worst overlap and its frame, worst gap and its frame."""

    def __init__(self) -> None:
        self.pairs: dict[tuple[str, str], tuple[float, int, float, int]] = {}

    def add(self, frame: Frame) -> None:
        """Take in what a frame holds of them."""
        for pair, (overlap, gap) in frame.neighbours.items():
            deepest, at, widest, there = self.pairs.get(pair, (-1.0, 0, -1.0, 0))
            deepest, at = max((deepest, at), (overlap, frame.index), key=lambda found: found[0])
            widest, there = max((widest, there), (gap, frame.index), key=lambda found: found[0])
            self.pairs[pair] = deepest, at, widest, there

    def table(self) -> list[dict[str, Any]]:
        """Pairs of neighbours, the deepest overlap first [scene unit]."""
        names = ("overlap_max", "overlap_frame", "gap_rms", "gap_frame")
        found = [{"muscles": list(pair), **dict(zip(names, worst))} for pair, worst in self.pairs.items()]
        return sorted(found, key=lambda row: -row["overlap_max"])


def versions() -> dict[str, str]:
    """Versions of Python, this library and what it computes with."""
    found = {"python": platform.python_version(), "rbfmuscle": rbfmuscle.__version__}
    for name in _PACKAGES:
        # Some distributions of VTK bring no metadata.
        with suppress(importlib.metadata.PackageNotFoundError):
            found[name] = importlib.metadata.version(name)
    return found


def machine() -> dict[str, Any]:
    """What the times belong to."""
    import numba

    return {
        "system": platform.platform(),
        "processor": platform.processor() or platform.machine(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "threads": numba.get_num_threads(),
    }


def input_hashes(scene: Scene) -> dict[str, Any]:
    """SHA-256 of the scene file and of the meshes and motion that it names; files that are gone are left out."""
    motion = scene.motion.options.file
    if motion is not None:
        motion = (Path(scene.path).parent if scene.path else Path()) / motion
    sources = [scene.path, motion, *(b.source for b in scene.bones), *(m.source for m in scene.muscles)]
    paths = [Path(source) for source in dict.fromkeys(str(source) for source in sources if source)]
    return {str(path): hashlib.sha256(path.read_bytes()).hexdigest() for path in paths if path.is_file()}
