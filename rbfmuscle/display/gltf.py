"""A moving run as one animated binary glTF file: bones are nodes that turn, muscles are meshes with
morph targets.

glTF is in metres with y up, and knows no other animation of vertices than morph targets: one a
frame, whose weights go from 0 to 1 and back one after the other.
"""

import json
import struct
from collections.abc import Mapping, Sequence

import numpy as np

from rbfmuscle.display.animation import AnimatedFibres, AnimatedMesh, Animation
from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.run.appearance import linear_rgb, rgb, stretch_colours
from rbfmuscle.validation import UsageError

_FLOAT, _INT = 5126, 5125  # types of numbers
_VERTICES, _INDICES = 34962, 34963  # what a view is bound as
_LINES = 1  # mode of a primitive


def animated_glb(run: Animation) -> bytes:
    """The content of an animated ``.glb``; UsageError if a muscle's surface has other vertices in
    other frames.
    """
    changing = [muscle.name for muscle in run.muscles if not muscle.keeps_vertices]
    if changing:
        raise UsageError(
            f"animated-glb needs surfaces that keep their vertices, those of {changing[0]!r} "
            "do not; "
            "run with surface = 'material', or export to usd, pvd or glb"
        )
    file = _File([_key_name(caption) for caption in run.captions])
    if len(run.times) > 1:
        file.times = file.add(run.times[:, None] - run.times[0], "SCALAR", bounds=True)
    children = [_add_part(file, part) for part in (*run.bones, *run.muscles)]
    children += [_add_fibres(file, fibres) for fibres in run.fibres]
    root: dict[str, object] = {"name": run.name, "children": children}
    left, posterior, superior = run.body  # glTF looks at what faces +z, with y up
    root["rotation"] = _quaternions(np.stack([left, superior, -posterior])[None])[0].tolist()
    return file.content({"name": run.name, "nodes": [file.append("nodes", root)]})


def _key_name(caption: str) -> str:
    """The caption of a frame as the name of a shape key, of which Blender keeps 63 bytes."""
    return caption.encode()[:63].decode(errors="ignore")


def _add_part(file: "_File", part: AnimatedMesh) -> int:
    """Number of a new node: a muscle has a morph target for each frame but the first, a bone a pose
    for each.
    """
    base, faces, normals = part.own(0)
    colour = [*linear_rgb(rgb(part.colour)).tolist(), 1.0]
    look = {"baseColorFactor": colour, "metallicFactor": 0.0, "roughnessFactor": 0.6}
    primitive: dict[str, object] = {
        "attributes": {
            "POSITION": file.add(base, "VEC3", target=_VERTICES, bounds=True),
            "NORMAL": file.add(normals, "VEC3", target=_VERTICES),
        },
        "indices": file.add(faces.reshape(-1, 1), "SCALAR", target=_INDICES),
        "material": file.append("materials", {"name": part.name, "pbrMetallicRoughness": look}),
    }
    targets = []
    for k in range(1, len(part.vertices)):
        vertices, _, turned = part.own(k)
        position = file.add(vertices - base, "VEC3", target=_VERTICES, bounds=True)
        normal = file.add(turned - normals, "VEC3", target=_VERTICES)
        targets.append({"POSITION": position, "NORMAL": normal})
    node = file.add_node(part.name, primitive, targets)
    if part.poses is not None:
        turns, shifts = _quaternions(part.poses[:, :3, :3]), part.poses[:, :3, 3]
        place = {"rotation": turns[0].tolist(), "translation": shifts[0].tolist()}
        file.lists["nodes"][node] |= place
        if part.moves:
            file.animate(node, "rotation", file.add(turns, "VEC4"))
            file.animate(node, "translation", file.add(shifts, "VEC3"))
    return node


def _add_fibres(file: "_File", fibres: AnimatedFibres) -> int:
    """Number of a new node of lines, coloured by the stretch of the first frame."""
    first = fibres.lines[0]
    base = first.points.reshape(-1, 3)
    colours = linear_rgb(stretch_colours(first.local_stretch)).reshape(-1, 3)
    primitive: dict[str, object] = {
        "mode": _LINES,
        "attributes": {
            "POSITION": file.add(base, "VEC3", target=_VERTICES, bounds=True),
            "COLOR_0": file.add(colours, "VEC3", target=_VERTICES),
        },
        "indices": file.add(fibres.segments.reshape(-1, 1), "SCALAR", target=_INDICES),
    }
    targets = []
    for lines in fibres.lines[1:]:
        moved = lines.points.reshape(-1, 3) - base
        targets.append({"POSITION": file.add(moved, "VEC3", target=_VERTICES, bounds=True)})
    return file.add_node(fibres.name, primitive, targets)


def _quaternions(rotations):
    """Quaternions (T, 4), scalar last, none more than half a turn from the one before."""
    from scipy.spatial.transform import Rotation

    found = Rotation.from_matrix(rotations).as_quat()
    for k in range(1, len(found)):
        if found[k] @ found[k - 1] < 0.0:
            found[k] = -found[k]
    return found


class _File:
    """The content of a glTF file: the binary part and the lists that describe it; ``names`` are
    those of the frames.
    """

    def __init__(self, names: Sequence[str]) -> None:
        self.names = names
        self.parts: list[bytes] = []
        self.size, self.times = 0, 0
        keys = "bufferViews", "accessors", "meshes", "materials", "nodes"
        self.lists: dict[str, list[dict[str, object]]] = {key: [] for key in keys}
        self.samplers: list[object] = []
        self.channels: list[object] = []

    def append(self, key: str, entry: dict[str, object]) -> int:
        """Number of a new entry of a list."""
        self.lists[key].append(entry)
        return len(self.lists[key]) - 1

    def add(
        self,
        values: Floats | Integers,
        shape: str,
        *,
        target: int | None = None,
        bounds: bool = False,
    ) -> int:
        """Number of a new accessor of these rows: whole numbers as indices, others in single
        precision.
        """
        whole = np.issubdtype(values.dtype, np.integer)
        rows = np.ascontiguousarray(values, dtype="<u4" if whole else "<f4")
        view: dict[str, object] = {"buffer": 0, "byteOffset": self.size, "byteLength": rows.nbytes}
        view |= {} if target is None else {"target": target}
        self.parts.append(rows.tobytes())
        self.size += rows.nbytes
        entry = {"bufferView": self.append("bufferViews", view), "count": len(rows), "type": shape}
        entry["componentType"] = _INT if whole else _FLOAT
        if bounds:
            entry |= {"min": rows.min(axis=0).tolist(), "max": rows.max(axis=0).tolist()}
        return self.append("accessors", entry)

    def add_node(
        self, name: str, primitive: dict[str, object], targets: Sequence[Mapping[str, int]]
    ) -> int:
        """Number of a new node with one primitive, which takes the forms of its morph targets, one
        for each frame but the first.
        """
        entry: dict[str, object] = {"name": name, "primitives": [primitive]}
        if targets:
            primitive["targets"] = list(targets)
            entry["weights"] = [0.0] * len(targets)
            entry["extras"] = {"targetNames": list(self.names[1:])}
        node = self.append("nodes", {"name": name, "mesh": self.append("meshes", entry)})
        if targets:
            weights = np.eye(len(targets) + 1)[:, 1:]
            self.animate(node, "weights", self.add(weights.reshape(-1, 1), "SCALAR"))
        return node

    def animate(self, node: int, path: str, values: int) -> None:
        """Let an accessor move a node's ``path`` over the times."""
        self.samplers.append({"input": self.times, "output": values, "interpolation": "LINEAR"})
        self.channels.append(
            {"sampler": len(self.samplers) - 1, "target": {"node": node, "path": path}}
        )

    def content(self, scene: dict[str, object]) -> bytes:
        """The whole file."""
        asset = {"version": "2.0", "generator": "rbfmuscle"}
        tree: dict[str, object] = {"asset": asset, "scene": 0, "scenes": [scene], **self.lists}
        tree["buffers"] = [{"byteLength": self.size}]
        if self.channels:
            tree["animations"] = [
                {"name": "motion", "samplers": self.samplers, "channels": self.channels}
            ]
        text = json.dumps(tree, separators=(",", ":")).encode()
        text += b" " * (-len(text) % 4)
        head = struct.pack("<4sIII4s", b"glTF", 2, 28 + len(text) + self.size, len(text), b"JSON")
        return b"".join([head, text, struct.pack("<I4s", self.size, b"BIN\0"), *self.parts])
