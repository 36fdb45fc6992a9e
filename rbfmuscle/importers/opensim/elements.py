"""Frames and functions of a model, as ``.osim`` files write them.

Frames are bodies, and frames offset from them, found by the paths that files name them by.
"""

import itertools
import posixpath

import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from rbfmuscle.importers.opensim.model import GROUND
from rbfmuscle.importers.opensim.xml import Node
from rbfmuscle.scene.joints.functions import (
    Function,
    Linear,
    Multivariate,
    PiecewiseLinear,
    Polynomial,
    Spline,
    exponents,
    scaled,
)
from rbfmuscle.scene.names import new_name
from rbfmuscle.validation import SceneError

_DEEPEST = 50  # parts of a path to a component
SPLINES = ("SimmSpline", "NaturalCubicSpline", "natCubicSpline")  # older names of the same spline
# Of polynomials of several coordinates: OpenSim's own fits have at most 6 and 9.
MOST_COORDINATES = 6
HIGHEST_ORDER = 9
BESIDE = ("coordinates", "axis", "scale")  # what stands beside a function in an element


class Frames:
    """Every frame of a model (the element ``<Model>``) by its absolute path.

    ``bodies`` are plain names, unlike each other, by path; ``bare`` those of bodies by the name
    that the file gives them.
    """

    def __init__(self, model: Node) -> None:
        self.bodies, self.bare = {"/ground": GROUND}, {GROUND: GROUND}
        self.offsets: dict[str, Node] = {}
        self.stations: dict[str, Node] = {}
        self._known: dict[str, tuple[str, np.ndarray]] = {}
        self._open: list[str] = []  # frames whose places are being sought
        for node in model.iter():
            if not isinstance(node, Node):
                continue
            if node.tag == "Body" and node.name != GROUND:
                if node.path in self.bodies:
                    raise SceneError(f"two bodies are named {node.name!r}; rename one")
                name = new_name(node.name, self.bodies.values())
                self.bodies[node.path] = name
                self.bare.setdefault(node.name, name)
            elif node.tag in ("PhysicalOffsetFrame", "StationDefinedFrame"):
                self.offsets[node.path] = node
            elif node.tag == "Station":
                self.stations[node.path] = node

    def place(self, name: str, *, inside: str = "/") -> tuple[str, np.ndarray]:
        """Body and frame in it (4, 4) of a name, absolute or relative to the component
        ``inside``.
        """
        return self._placed(self._find(name, inside))

    def _placed(self, path):
        if path in self.bodies:
            return self.bodies[path], np.eye(4)
        if path in self._open or len(self._open) > _DEEPEST:
            raise SceneError(f"frame {path!r} is offset from itself; correct its parent")
        if path not in self._known:
            self._open.append(path)
            frame = self.offsets[path]
            self._known[path] = (
                self._of_stations(frame)
                if frame.tag == "StationDefinedFrame"
                else self._of_parent(frame)
            )
            self._open.pop()
        return self._known[path]

    def _of_parent(self, frame):
        """Body and frame in it (4, 4) of a frame offset from another."""
        body, outer = self.place(socket(frame, "parent") or "..", inside=frame.path)
        return body, outer @ frame_at(frame.vector("translation"), frame.vector("orientation"))

    def _of_stations(self, frame):
        """Body and frame in it (4, 4) of a frame through three stations, its origin a fourth."""
        found = {}
        for key in ("point_a", "point_b", "point_c", "origin_point"):
            path = posixpath.normpath(posixpath.join(frame.path, socket(frame, key)))
            if path not in self.stations:
                raise frame.error(f"there is no station {path!r}; correct its {key}")
            station = self.stations[path]
            body, own = self.place(socket(station, "parent_frame") or "..", inside=path)
            found[key] = body, own[:3, :3] @ station.vector("location") + own[:3, 3]
        if len({body for body, _ in found.values()}) > 1:
            raise frame.error("its stations are in several bodies; put them into one")
        turn = _station_axes(frame, *(found[key][1] for key in ("point_a", "point_b", "point_c")))
        transform = np.eye(4)
        transform[:3, :3] = turn
        body, transform[:3, 3] = found["origin_point"]
        return body, transform

    def _find(self, name, inside):
        name = name.strip()
        guesses = [posixpath.normpath(posixpath.join(inside, name))]
        if "/" not in name:
            guesses += [f"/bodyset/{name}", f"/{name}", f"/componentset/{name}"]
        for guess in guesses:
            if guess in self.bodies or guess in self.offsets:
                return guess
        raise SceneError(f"{inside}: there is no frame {name!r}; correct the socket")


def _station_axes(frame, a, b, c):
    """Axes (3, 3), as columns, of a frame through three points (3,)."""
    axes = {frame.word("ab_axis", "+x"): b - a}
    axes[frame.word("ab_x_ac_axis", "+y")] = np.cross(b - a, c - a)
    turn = np.zeros((3, 3))
    for name, direction in axes.items():
        size = np.linalg.norm(direction)
        if name.lstrip("+-") not in ("x", "y", "z") or size == 0.0:
            raise frame.error(f"its axis {name!r} cannot be set; correct axes and stations")
        sign = -1.0 if name.startswith("-") else 1.0
        turn[:, "xyz".index(name[-1])] = sign * direction / size
    missing = [k for k in range(3) if not turn[:, k].any()]
    if len(missing) != 1:
        raise frame.error("both its axes are the same one; name two")
    k = missing[0]
    turn[:, k] = np.cross(turn[:, k - 2], turn[:, k - 1])
    return turn


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
    child = node.child("function") if node is not None else None
    inside = node if child is None else child
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
        return Polynomial(tuple(node.numbers("coefficients", "1")))
    if node.tag == "MultivariatePolynomialFunction":
        return _read_multivariate(node)
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


def _read_multivariate(node):
    """A polynomial of several coordinates, its terms in the order of `exponents`."""
    dimension, order = int(node.number("dimension", 1)), int(node.number("order", 0))
    if not (1 <= dimension <= MOST_COORDINATES and 0 <= order <= HIGHEST_ORDER):
        words = f"of {dimension} coordinates and order {order}"
        most = f"at most {MOST_COORDINATES} and {HIGHEST_ORDER} are taken"
        raise node.owner.error(f"a polynomial {words}; {most}")
    powers, coefficients = exponents(dimension, order), node.numbers("coefficients", "0")
    if len(coefficients) != len(powers):
        words = f"{len(powers)} coefficients are needed, got {len(coefficients)}"
        raise node.owner.error(
            f"a polynomial of {dimension} coordinates and order {order}: {words}"
        )
    rows = zip(coefficients, powers.tolist())
    return Multivariate(tuple((c, *map(int, row)) for c, row in rows if c))
