"""A moving run as one animated binary glTF file: bones are nodes that turn, muscles are meshes with morph targets.

glTF is in metres with y up, and knows no other animation of vertices than morph targets: one a frame, whose weights
go from 0 to 1 and back one after the other. Displacements are written whole or sparse, whichever is smaller; normals,
which need no more than two digits, as bytes (KHR_mesh_quantization, which Blender and the common viewers read).
"""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.geometry.surfaces import vertex_normals
from rbfmuscle.study.animation.moving import MovingBone, MovingMuscle, MovingRun, linear_rgb
from rbfmuscle.validation import UsageError

_FLOAT, _BYTE, _SHORT, _INT = 5126, 5120, 5123, 5125
_VERTICES, _INDICES = 34962, 34963  # what a view is bound as
_TURN_Z_UP = [-np.sqrt(0.5), 0.0, 0.0, np.sqrt(0.5)]  # quaternion (x, y, z, w) that brings z up to y up
# Displacements below this [m] are none: single precision does not hold them at a metre from the origin.
STILL = 3e-8


def write_animated_glb(path: Path, run: MovingRun) -> None:
    """Write a run as one animated ``.glb``.

    Parameters
    ----------
    path : pathlib.Path
    run : MovingRun
        In metres.

    Raises
    ------
    UsageError
        If a muscle's surface has other vertices in other frames.
    """
    path.write_bytes(animated_glb(run))


def animated_glb(run: MovingRun, name: str = "animated-glb") -> bytes:
    """The whole of such a file; ``name`` is what messages call the format, the rest as for `write_animated_glb`."""
    changing = [muscle.name for muscle in run.muscles if not muscle.keeps_vertices]
    if changing:
        raise UsageError(
            f"{name} needs surfaces that keep their vertices, those of {changing[0]!r} do not; "
            "run with surface = 'material', or export to usd, vtkhdf or glb"
        )
    file = _File()
    file.times = file.add(run.times[:, None] - run.times[0], _FLOAT, "SCALAR", bounds=True)
    children = [_add_bone(file, bone) for bone in run.bones] + [_add_muscle(file, m) for m in run.muscles]
    root: dict[str, Any] = {"name": run.name, "children": children}
    if run.up == "z":
        root["rotation"] = [float(x) for x in _TURN_Z_UP]
    scene = {"name": run.name, "nodes": [file.node(root)]}
    return file.content(scene)


def _add_bone(file: _File, bone: MovingBone) -> int:
    mesh = file.mesh(bone.name, bone.colour, bone.vertices, bone.faces)
    turns, shifts = _quaternions(bone.poses[:, :3, :3]), bone.poses[:, :3, 3]
    node = file.node(
        {"name": bone.name, "mesh": mesh, "rotation": turns[0].tolist(), "translation": shifts[0].tolist()}
    )
    if bone.moves:
        file.animate(node, "rotation", file.add(turns, _FLOAT, "VEC4"))
        file.animate(node, "translation", file.add(shifts, _FLOAT, "VEC3"))
    return node


def _add_muscle(file: _File, muscle: MovingMuscle) -> int:
    base, faces = muscle.vertices[0], muscle.faces[0]
    first = vertex_normals(base, faces)
    targets = []
    for vertices in muscle.vertices[1:]:
        turned = _turns(first, vertex_normals(vertices, faces))
        targets.append({"POSITION": file.add_moves(vertices - base), "NORMAL": file.add_bytes(turned)})
    mesh = file.mesh(muscle.name, muscle.colour, base, faces, targets=targets)
    node = file.node({"name": muscle.name, "mesh": mesh})
    if targets:
        weights = np.eye(len(muscle.vertices))[:, 1:]
        file.animate(node, "weights", file.add(weights.reshape(-1, 1), _FLOAT, "SCALAR"))
    return node


def _turns(first, normals):
    """What to add to unit normals for the direction of others, each number within -1 to 1.

    Only the direction counts, so the second normal is made as short as the bytes need.
    """
    room = (1.0 + np.sign(normals) * first) / np.maximum(np.abs(normals), 1e-12)
    return np.minimum(room.min(axis=1), 1.0)[:, None] * normals - first


def _quaternions(rotations):
    """Quaternions (T, 4), scalar last, none more than half a turn from the one before."""
    from scipy.spatial.transform import Rotation

    found = Rotation.from_matrix(rotations).as_quat()
    for k in range(1, len(found)):
        if found[k] @ found[k - 1] < 0.0:
            found[k] = -found[k]
    return found


class _File:
    """A glTF file on its way: the binary part and the lists that describe it."""

    def __init__(self) -> None:
        self.parts: list[bytes] = []
        self.size, self.times = 0, 0
        self.lists: dict[str, list[Any]] = {
            key: [] for key in ("bufferViews", "accessors", "meshes", "materials", "nodes")
        }
        self.samplers: list[Any] = []
        self.channels: list[Any] = []

    def _append(self, key: str, entry: dict[str, Any]) -> int:
        self.lists[key].append(entry)
        return len(self.lists[key]) - 1

    def view(self, data: bytes, **more: int) -> int:
        """Number of a new view of these bytes, which begins at a multiple of four."""
        entry = {"buffer": 0, "byteOffset": self.size, "byteLength": len(data), **more}
        data += bytes(-len(data) % 4)
        self.parts.append(data)
        self.size += len(data)
        return self._append("bufferViews", entry)

    def add(
        self, values: Floats, kind: int, shape: str, *, target: int | None = None, bounds: bool = False
    ) -> int:
        """Number of a new accessor of these rows."""
        dtype = {_FLOAT: "<f4", _SHORT: "<u2", _INT: "<u4"}[kind]
        rows = np.ascontiguousarray(values, dtype=dtype)
        view = self.view(rows.tobytes(), **({} if target is None else {"target": target}))
        entry = {"bufferView": view, "componentType": kind, "count": len(rows), "type": shape}
        return self._append("accessors", entry | (_bounds(rows) if bounds else {}))

    def add_moves(self, moves: Floats) -> int:
        """Displacements (n, 3) of a morph target, sparse where that is smaller."""
        rows = np.flatnonzero(np.abs(moves).max(axis=1) > STILL)
        narrow = len(moves) <= 0xFFFF
        if len(rows) * (14 if narrow else 16) >= 12 * len(moves):
            return self.add(moves, _FLOAT, "VEC3", target=_VERTICES, bounds=True)
        kept = np.zeros(moves.shape, dtype="<f4")
        kept[rows] = moves[rows]
        entry = {"componentType": _FLOAT, "count": len(moves), "type": "VEC3"} | _bounds(kept)
        if len(rows):
            numbers = self.view(rows.astype("<u2" if narrow else "<u4").tobytes())
            entry["sparse"] = {
                "count": len(rows),
                "indices": {"bufferView": numbers, "componentType": _SHORT if narrow else _INT},
                "values": {"bufferView": self.view(kept[rows].tobytes())},
            }
        return self._append("accessors", entry)

    def add_bytes(self, values: Floats) -> int:
        """Vectors (n, 3) of -1 to 1 as bytes, each padded to four."""
        rows = np.zeros((len(values), 4), dtype=np.int8)
        rows[:, :3] = np.round(127.0 * values)
        view = self.view(rows.tobytes(), byteStride=4, target=_VERTICES)
        what = {"bufferView": view, "componentType": _BYTE, "normalized": True}
        return self._append("accessors", {**what, "count": len(rows), "type": "VEC3"})

    def mesh(self, name: str, colour: Floats, vertices: Floats, faces: Any, *, targets: Any = ()) -> int:
        """Number of a new mesh with a material of its own."""
        normals = vertex_normals(vertices, faces)
        attributes = {
            "POSITION": self.add(vertices, _FLOAT, "VEC3", target=_VERTICES, bounds=True),
            "NORMAL": self.add_bytes(normals),
        }
        width = _SHORT if len(vertices) <= 0xFFFF else _INT
        primitive = {
            "attributes": attributes,
            "indices": self.add(faces.reshape(-1, 1), width, "SCALAR", target=_INDICES),
            "material": self._append("materials", _material(name, colour)),
        }
        entry: dict[str, Any] = {"name": name, "primitives": [primitive]}
        if targets:
            primitive["targets"] = list(targets)
            entry["weights"] = [0.0] * len(targets)
            entry["extras"] = {"targetNames": [f"frame {k}" for k in range(1, len(targets) + 1)]}
        return self._append("meshes", entry)

    def node(self, entry: dict[str, Any]) -> int:
        """Number of a new node."""
        return self._append("nodes", entry)

    def animate(self, node: int, path: str, values: int) -> None:
        """Let an accessor move a node's ``path`` over the times."""
        self.samplers.append({"input": self.times, "output": values, "interpolation": "LINEAR"})
        self.channels.append({"sampler": len(self.samplers) - 1, "target": {"node": node, "path": path}})

    def content(self, scene: dict[str, Any]) -> bytes:
        """The whole file."""
        tree: dict[str, Any] = {
            "asset": {"version": "2.0", "generator": "rbfmuscle"},
            "scene": 0,
            "scenes": [scene],
            "buffers": [{"byteLength": self.size}],
            **self.lists,
        }
        if self.channels:
            tree["animations"] = [{"name": "motion", "samplers": self.samplers, "channels": self.channels}]
        if any(entry["componentType"] == _BYTE for entry in self.lists["accessors"]):
            tree["extensionsUsed"] = tree["extensionsRequired"] = ["KHR_mesh_quantization"]
        text = json.dumps(tree, separators=(",", ":")).encode()
        text += b" " * (-len(text) % 4)
        head = struct.pack("<4sIII4s", b"glTF", 2, 28 + len(text) + self.size, len(text), b"JSON")
        return b"".join([head, text, struct.pack("<I4s", self.size, b"BIN\0"), *self.parts])


def _bounds(rows):
    return {"min": rows.min(axis=0).tolist(), "max": rows.max(axis=0).tolist()}


def _material(name, colour):
    base = [*(float(x) for x in linear_rgb(colour)), 1.0]
    look = {"baseColorFactor": base, "metallicFactor": 0.0, "roughnessFactor": 0.6}
    return {"name": name, "pbrMetallicRoughness": look}
