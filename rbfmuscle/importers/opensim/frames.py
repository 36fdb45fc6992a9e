"""The frames of a model: bodies, and what is offset from them, found by the paths that files name them by."""

import posixpath

import numpy as np

from rbfmuscle.importers.opensim.functions import vector
from rbfmuscle.importers.opensim.xml import Node
from rbfmuscle.scene.joints.joint import frame_at
from rbfmuscle.validation import SceneError

OFFSET = "PhysicalOffsetFrame"
_DEEPEST = 50


class Frames:
    """Every frame of a model by its absolute path.

    Parameters
    ----------
    model : Node
        The element ``<Model>``.
    bodies : list of Node
    """

    def __init__(self, model: Node, bodies: list[Node]) -> None:
        self.bodies = {"/ground": "ground"} | {f"/bodyset/{body.name}": body.name for body in bodies}
        self.offsets = {}
        for child in model.nodes():
            if child.tag == "Ground":
                self._take("/ground", child)
        for body in bodies:
            self._take(f"/bodyset/{body.name}", body)
        for joint in model.objects("JointSet"):
            self._take(f"/jointset/{joint.name}", joint)
        for part in model.objects("ComponentSet"):
            if part.tag == OFFSET:
                self.offsets[f"/componentset/{part.name}"] = part
                self._take(f"/componentset/{part.name}", part)
        self._take("", model)

    def of(self, owner: Node) -> list[Node]:
        """The offset frames that stand inside a body, a joint or another frame."""
        found = []
        for tag in ("components", "frames"):
            attached_bone = owner.child(tag)
            found += (
                []
                if attached_bone is None
                else [child for child in attached_bone.nodes() if child.tag == OFFSET]
            )
        return found

    def _take(self, path, owner):
        for frame in self.of(owner):
            self.offsets[f"{path}/{frame.name}"] = frame
            self._take(f"{path}/{frame.name}", frame)

    def of_joint(self, joint: Node, role: str) -> tuple[str, np.ndarray]:
        """Body and frame in it (4, 4) of a joint's end, ``role`` being parent or child."""
        name = _socket(joint, f"{role}_frame")
        if not name:
            raise SceneError(f"joint {joint.name!r}: names no {role} frame; give it one")
        return self.place(name, inside=f"/jointset/{joint.name}")

    def place(self, name: str, *, inside: str = "/") -> tuple[str, np.ndarray]:
        """Body and frame in it (4, 4) of a name, absolute or relative to the component ``inside``.

        Raises
        ------
        SceneError
            If nothing has that name, or frames hang on each other in a ring.
        """
        transform, path = np.eye(4), self._find(name, inside)
        for _ in range(_DEEPEST):
            if path in self.bodies:
                return self.bodies[path], transform
            frame = self.offsets[path]
            at = f"frame {path!r}"
            origin = vector(frame, "translation", "0 0 0", place=at)
            angles = vector(frame, "orientation", "0 0 0", place=at)
            transform = frame_at(np.array(origin), angles) @ transform
            path = self._find(_socket(frame, "parent") or "..", path)
        raise SceneError(f"frame {path!r} hangs on itself; correct its parent")

    def _find(self, name, inside):
        name = name.strip()
        guesses = [posixpath.normpath(posixpath.join(inside, name))]
        if "/" not in name:
            guesses += [f"/bodyset/{name}", f"/{name}", f"/componentset/{name}"]
        for guess in guesses:
            if guess in self.bodies or guess in self.offsets:
                return guess
        raise SceneError(f"{inside}: there is no frame {name!r}; correct the socket")


def _socket(node, name):
    """What a socket is connected to, as versions from 4 on and their forerunners write it."""
    return (
        node.word(f"socket_{name}")
        or node.word(f"connector_{name}_connectee_name")
        or node.word(f"{name}_name")
    )
