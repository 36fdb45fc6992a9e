"""Moving runs as data that a script in a page turns, scrubs and switches on and off; no network.

Positions are whole numbers of a step, kept as second differences along the frames and first
differences along the vertices; all arrays follow each other in one deflated stream, their bytes
sorted by place, as base64.
"""

import base64
import json
import zlib
from collections.abc import Mapping
from importlib import resources
from itertools import groupby

import numpy as np

from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.output.animation.parts import FRAMES_A_SECOND, AnimatedMesh, Animation
from rbfmuscle.output.appearance import VIEWS

# Whole numbers of which the longest side of all that moves has so many: 0.03 mm of 900.
_STEPS = 30_000


def scene_file(name: str) -> str:
    """The script or style that shows what `pack_runs` packs: ``scene.js``, ``scene.css``."""
    return (resources.files("rbfmuscle.output.animation") / name).read_text(encoding="utf-8")


def pack_runs(runs: Mapping[str, Animation]) -> str:
    """JSON of runs of the same frames and bones, side by side, by what stands above each, for
    ``scene.js``.
    """
    first = next(iter(runs.values()))
    packer = _Packer(runs)
    parts = [
        packer.part(muscle, k) for k, run in enumerate(runs.values()) for muscle in run.muscles
    ]
    parts += [packer.part(bone, -1) for bone in first.bones]
    facts = {
        "panels": list(runs),
        "captions": first.captions,
        "parts": parts,
        "step": packer.step,
        "views": VIEWS,
        "body": first.body.tolist(),
        "direction": first.direction.tolist(),
        "origin": packer.origin.tolist(),
        "rate": FRAMES_A_SECOND / 2.0,
        "bytes": packer.text(),
    }
    # No name may end the script that holds it.
    return json.dumps(facts, separators=(",", ":")).replace("<", "\\u003c")


class _Packer:
    """Arrays on their way into one stream."""

    def __init__(self, runs: Mapping[str, Animation]) -> None:
        drawn = [part for run in runs.values() for part in (*run.bones, *run.muscles)]
        low = np.min([points.min(axis=0) for part in drawn for points in part.vertices], axis=0)
        high = np.max([points.max(axis=0) for part in drawn for points in part.vertices], axis=0)
        self.origin, self.step = low, float((high - low).max()) / _STEPS or 1.0
        self.parts: list[bytes] = []

    def part(self, part: AnimatedMesh, panel: int) -> dict[str, object]:
        """Take in a muscle or bone, in pieces: frames that follow each other and have the same
        triangles.
        """
        pieces: list[dict[str, int]] = []
        for _, group in groupby(range(len(part.faces)), key=lambda k: id(part.faces[k])):
            frames = list(group)
            pieces.append(self._piece([part.vertices[k] for k in frames], part.faces[frames[0]]))
        entry: dict[str, object] = {"name": part.name, "panel": panel, "pieces": pieces}
        entry |= {"colour": part.colour, "group": part.group}
        if part.poses is not None:
            poses = part.poses[: None if part.moves else 1, :3].round(6)
            entry["poses"] = poses.reshape(len(poses), 12).tolist()
        return entry

    def _piece(self, frames: list[Floats], faces: Integers) -> dict[str, int]:
        """Take in the points of some frames and their triangles; how many there are of each."""
        whole = np.rint((np.asarray(frames) - self.origin) / self.step).astype(np.int32)
        for axis, times in ((0, 2), (1, 1)):
            for _ in range(times):
                whole = np.diff(whole, axis=axis, prepend=0)
        self._add(whole.astype("<i2"))
        self._add(np.diff(np.asarray(faces, dtype="<i4").ravel(), prepend=0).astype("<i4"))
        return {"frames": len(frames), "points": len(frames[0]), "faces": len(faces)}

    def _add(self, values: Integers) -> None:
        places = np.frombuffer(values.tobytes(), dtype=np.uint8).reshape(-1, values.itemsize)
        self.parts.append(places.T.tobytes())

    def text(self) -> str:
        """All of it, deflated, as base64."""
        return base64.b64encode(zlib.compress(b"".join(self.parts), 4)).decode("ascii")
