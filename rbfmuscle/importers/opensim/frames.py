"""The frames of a model: bodies, and frames offset from them, found by the paths that files name them by."""

import posixpath

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from rbfmuscle.importers.opensim.xml import Node, plain_name
from rbfmuscle.validation import SceneError

_DEEPEST = 50


class Frames:
    """Every frame of a model (the element ``<Model>``) by its absolute path."""

    def __init__(self, model: Node) -> None:
        self.bodies = {"/ground": "ground"}
        self.bodies |= {f"/bodyset/{body.name}": body.name for body in model.objects("BodySet")}
        found = [node for node in model.iter("PhysicalOffsetFrame") if isinstance(node, Node)]
        self.offsets = {node.path: node for node in found}

    def place(self, name: str, *, inside: str = "/") -> tuple[str, np.ndarray]:
        """Body and frame in it (4, 4) of a name, absolute or relative to the component ``inside``."""
        transform, path = np.eye(4), self._find(name, inside)
        for _ in range(_DEEPEST):
            if path in self.bodies:
                return self.bodies[path], transform
            frame = self.offsets[path]
            transform = frame_at(frame.vector("translation"), frame.vector("orientation")) @ transform
            path = self._find(socket(frame, "parent") or "..", path)
        raise SceneError(f"frame {path!r} is offset from itself; correct its parent")

    def _find(self, name, inside):
        name = plain_name(name)
        guesses = [posixpath.normpath(posixpath.join(inside, name))]
        if "/" not in name:
            guesses += [f"/bodyset/{name}", f"/{name}", f"/componentset/{name}"]
        for guess in guesses:
            if guess in self.bodies or guess in self.offsets:
                return guess
        raise SceneError(f"{inside}: there is no frame {name!r}; correct the socket")


def frame_at(origin: ArrayLike, orientation: ArrayLike = (0.0, 0.0, 0.0)) -> np.ndarray:
    """The frame (4, 4) at ``origin`` (3,), turned about its own x, then y, then z [radian]."""
    frame = np.eye(4)
    frame[:3, :3], frame[:3, 3] = Rotation.from_euler("XYZ", orientation).as_matrix(), origin
    return frame


def socket(node: Node, name: str) -> str:
    """What a socket is connected to, as versions from 4 on and their forerunners write it."""
    tags = f"socket_{name}", f"connector_{name}_connectee_name", f"{name}_name"
    return next(filter(None, map(node.word, tags)), "")
