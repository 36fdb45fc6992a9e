"""Frames and functions of a model, as ``.osim`` files write them.

Frames are bodies, and frames offset from them, found by the paths that files name them by.
"""

import itertools
import posixpath

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from rbfmuscle.importers.opensim.xml import Node, plain_name
from rbfmuscle.scene.joints.functions import (
    Function,
    Linear,
    PiecewiseLinear,
    Polynomial,
    Spline,
    scaled,
)
from rbfmuscle.validation import SceneError

_DEEPEST = 50
SPLINES = ("SimmSpline", "NaturalCubicSpline", "natCubicSpline")  # older names of the same spline
BESIDE = ("coordinates", "axis", "scale")  # what stands beside a function in an element


class Frames:
    """Every frame of a model (the element ``<Model>``) by its absolute path."""

    def __init__(self, model: Node) -> None:
        self.bodies = {"/ground": "ground"}
        self.bodies |= {f"/bodyset/{body.name}": body.name for body in model.objects("BodySet")}
        found = [node for node in model.iter("PhysicalOffsetFrame") if isinstance(node, Node)]
        self.offsets = {node.path: node for node in found}

    def place(self, name: str, *, inside: str = "/") -> tuple[str, np.ndarray]:
        """Body and frame in it (4, 4) of a name, absolute or relative to the component
        ``inside``.
        """
        transform, path = np.eye(4), self._find(name, inside)
        for _ in range(_DEEPEST):
            if path in self.bodies:
                return self.bodies[path], transform
            frame = self.offsets[path]
            transform = (
                frame_at(frame.vector("translation"), frame.vector("orientation")) @ transform
            )
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


def read_function(node: Node | None) -> Function | None:
    """The function in an element, directly or in its child ``function``; None where there is
    none.
    """
    holder = node.child("function") if node is not None else None
    inside = node if holder is None else holder
    found = (
        [inner for inner in inside.nodes() if inner.tag not in BESIDE] if inside is not None else []
    )
    return _read(found[0]) if found else None


def _read(node):
    if node.tag == "Constant":
        return Linear((), node.number("value"))
    if node.tag == "LinearFunction":
        *slopes, constant = node.numbers("coefficients", "1 0")
        return Linear(tuple(slopes), constant)
    if node.tag == "PolynomialFunction":
        return Polynomial(tuple(node.numbers("coefficients")))
    if node.tag == "MultiplierFunction":
        inner, scale = read_function(node), node.number("scale", 1.0)
        if inner is None:
            raise node.owner.error("a MultiplierFunction without a function; give it one")
        if (
            isinstance(inner, Linear) and len(inner.slopes) == 1
        ):  # OpenSim takes only a plain one for linear
            return Polynomial((scale * inner.slopes[0], scale * inner.constant))
        return scaled(inner, scale)
    if node.tag == "PiecewiseLinearFunction" or node.tag in SPLINES:
        x, y = node.numbers("x"), node.numbers("y")
        if not x or len(x) != len(y) or any(b <= a for a, b in itertools.pairwise(x)):
            words = f"needs as many y as x, and x that increase, got {len(x)} and {len(y)}"
            raise node.owner.error(f"{node.tag} {words}")
        kind = Spline if node.tag in SPLINES else PiecewiseLinear
        return kind(tuple(x), tuple(y))
    known = "use a SimmSpline or a PolynomialFunction instead"
    raise node.owner.error(f"a function {node.tag!r} is not in the table of functions; {known}")
