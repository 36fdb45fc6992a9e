"""Frames and functions of a model, as ``.osim`` files write them.

Frames are bodies, and frames offset from them, found by the paths that files name them by.
"""

from __future__ import annotations

import itertools
import math
import posixpath
import re
from collections import defaultdict
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import cast
from xml.etree import ElementTree

import defusedxml.ElementTree
import numpy as np
from numpy.typing import ArrayLike
from scipy.spatial.transform import Rotation

from rbfmuscle.scene.joints import (
    Coupling,
    Curve,
    Function,
    Joint,
    Linear,
    Multivariate,
    Polynomial,
    all_coordinates,
    coordinate_values,
    exponents,
    full_name,
    scaled,
)
from rbfmuscle.scene.objects import new_name
from rbfmuscle.validation import SceneError

GROUND = "ground"


@dataclass
class ModelJoint(Joint):
    """A joint between two bodies: ``X_child = X_parent P J(q) C^-1``, with P and C the joint's
    frames (4, 4) in them.

    Its own centre is the origin.
    """

    parent_frame: np.ndarray = field(default_factory=lambda: np.eye(4))
    child_frame: np.ndarray = field(default_factory=lambda: np.eye(4))

    def across(self, values: Mapping[str, float]) -> np.ndarray:
        """The child's frame (4, 4) in the parent's, at values of coordinates by full names."""
        own = {name: values[f"{self.name}.{name}"] for name in self.coordinates}
        return self.parent_frame @ self.displacement(own) @ np.linalg.inv(self.child_frame)


@dataclass
class ModelMesh:
    """A mesh that a body shows: scaled by three factors, then moved by ``transform`` (4, 4) into
    the body.
    """

    file: str
    body: str
    scale: tuple[float, ...]
    transform: np.ndarray


@dataclass
class WrapShape:
    """A cylinder (z), ellipsoid or sphere that a path goes around, in a frame (4, 4) of a body
    [metre].
    """

    body: str
    frame: np.ndarray
    radii: np.ndarray  # of the ellipsoid; of a cylinder two radii and half the length
    kind: str
    quadrant: str


@dataclass
class ModelMuscle:
    """A muscle of the model: points by body in their frames [metre], shapes it wraps around, volume
    [m3].

    ``title`` is its type and its name in the file.
    """

    name: str
    points: list[tuple[str, np.ndarray]]
    wraps: list[WrapShape] = field(default_factory=list)
    volume: float = 0.0
    title: str = ""


# Joints from the roots outwards, with whether each is walked from its child to its parent.
Steps = list[tuple[ModelJoint, bool]]


@dataclass
class OsimModel:
    """All that is taken from an ``.osim`` file; ``bodies`` begin with ``"ground"``.

    ``welds`` are its weld constraints, as joints; ``constraints`` the others, which are not taken:
    type and name in the file, and the two bodies. ``notes`` say what is in the file and is not
    taken, or taken otherwise than a user may expect; ``doubts`` what makes the scene another one
    than the model.
    """

    name: str
    version: int
    path: Path
    bodies: list[str] = field(default_factory=list)
    joints: list[ModelJoint] = field(default_factory=list)
    welds: list[ModelJoint] = field(default_factory=list)
    couplings: list[Coupling] = field(default_factory=list)
    constraints: list[tuple[str, str, str]] = field(default_factory=list)
    meshes: list[ModelMesh] = field(default_factory=list)
    muscles: list[ModelMuscle] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    doubts: list[str] = field(default_factory=list)

    def walk(self, *, welds: bool = True) -> tuple[Steps, list[str], list[ModelJoint]]:
        """How the bodies hang together, by joints and, unless told otherwise, by weld constraints:
        steps; roots, the bodies that no joint joins to those before them; and the joints between
        two bodies that are joined already, each of which closes a loop.

        A weld constraint comes after the joints, a joint that leaves its body free after both.
        """
        joints = [*self.joints, *(self.welds if welds else [])]
        waiting = sorted(joints, key=lambda joint: joint.kind == "free")
        steps: Steps = []
        roots: list[str] = []
        reached: set[str] = set()
        children = {joint.child for joint in joints}
        for body in [GROUND, *sorted(self.bodies, key=lambda body: body in children)]:
            if body in reached:
                continue
            reached.add(body)
            roots.append(body)
            while ready := next(
                (j for j in waiting if (j.parent in reached) != (j.child in reached)), None
            ):
                waiting.remove(ready)
                steps.append((ready, ready.child in reached))
                reached |= {ready.parent, ready.child}
        return steps, roots, waiting

    def resolved(self, values: Mapping[str, float] | None = None) -> dict[str, float]:
        """Every coordinate's value by its full name; bare names may be given where one joint has
        them.
        """
        known = all_coordinates(list(self.joints))
        asked = {full_name(n, list(known), context="pose"): v for n, v in (values or {}).items()}
        return coordinate_values(asked, known, self.couplings)

    def transforms(
        self, values: Mapping[str, float] | None = None, *, welds: bool = True
    ) -> dict[str, np.ndarray]:
        """The (4, 4) transform from every body to the ground [metre], at values of coordinates."""
        resolved = self.resolved(values)
        found = {body: np.eye(4) for body in self.bodies}
        steps, _, _ = self.walk(welds=welds)
        for joint, backward in steps:
            across = joint.across(resolved)
            if backward:
                found[joint.parent] = found[joint.child] @ np.linalg.inv(across)
            else:
                found[joint.child] = found[joint.parent] @ across
        return found


def joints_between(steps: Steps, first: str, second: str) -> list[Joint]:
    """The joints on the way from a body to another; none where they have different roots."""
    above = {
        (joint.parent if backward else joint.child): (
            joint,
            joint.child if backward else joint.parent,
        )
        for joint, backward in steps
    }
    chains = []
    for name in (first, second):
        chain = []
        while name in above:
            joint, name = above[name]
            chain.append(joint)
        chains.append((chain, name))
    (one, root), (two, other) = chains
    if root != other:
        return []
    return [*(j for j in one if j not in two), *(j for j in reversed(two) if j not in one)]


# The largest published models have 3 MB and a depth of 14.
MOST_BYTES = 30_000_000
MOST_DEPTH = 100
# Levels of the file that are no components of the model.
_LEVELS = ("OpenSimDocument", "Model", "objects", "components", "frames")


class Node(ElementTree.Element):
    """One element.

    ``owner`` is the element that it stands in, ``prototype`` that of the file's defaults for its
    tag, which has what it does not say itself.
    """

    owner: Node | None = None
    prototype: Node | None = None

    @property
    def name(self) -> str:
        """The attribute ``name``, as it is written."""
        return self.get("name", "").strip()

    @property
    def path(self) -> str:
        """Path of the component in the model, as sockets write it."""
        above = self.owner.path if self.owner is not None else ""
        if self.tag in _LEVELS:
            return above
        is_set = self.tag.endswith("Set") or self.tag == "Ground"
        return f"{above}/{self.tag.lower() if is_set else self.name}"

    @property
    def place(self) -> str:
        """Tags and names of the component and of those that it stands in, for messages."""
        above = self.owner.place if self.owner is not None else ""
        if not self.name or self.tag in _LEVELS or self.tag.endswith("Set"):
            return above
        return f"{above}{': ' if above else ''}{self.tag} {self.name!r}"

    def error(self, message: str) -> SceneError:
        """An error that names the component."""
        return SceneError(f"{self.place}: {message}")

    def nodes(self) -> list[Node]:
        """All children."""
        return [node for node in self if isinstance(node, Node)]

    def child(self, tag: str) -> Node | None:
        """The first child of that tag, the prototype's where there is none."""
        found = cast("Node | None", self.find(tag))
        if found is None and self.prototype is not None:
            return cast("Node | None", self.prototype.find(tag))
        return found

    def objects(self, tag: str) -> list[Node]:
        """What a set holds: children of ``<tag><objects>``, or of ``<tag>`` itself where there is
        no such level.
        """
        node = self.child(tag)
        inner = node.child("objects") if node is not None else None
        return inner.nodes() if inner is not None else node.nodes() if node is not None else []

    def word(self, tag: str, default: str = "") -> str:
        """Text of the child of that tag, without white space around it; the default where it is
        missing or empty.
        """
        node = self.child(tag)
        return ("" if node is None else node.text or "").strip() or default

    def truth(self, tag: str, default: bool = False) -> bool:
        """Whether the child of that tag says true."""
        return self.word(tag, str(default)).lower() in ("true", "1", "yes")

    def numbers(self, tag: str, default: str = "", *, count: int | None = None) -> list[float]:
        """The finite numbers in the child of that tag; ``count`` says how many there must be."""
        text = self.word(tag, default)
        try:
            # OpenSim also takes commas and brackets.
            values = [float(word) for word in re.sub(r"[,()\[\]~]", " ", text).split()]
        except ValueError:
            raise self.error(f"{tag}: {text[:60]!r} is no list of numbers; correct it") from None
        if not all(map(math.isfinite, values)):
            raise self.error(f"{tag}: {text[:60]!r} is not finite; correct it")
        if count is not None and len(values) != count:
            raise self.error(f"{tag}: {count} numbers are needed, got {text[:60]!r}")
        return values

    def number(self, tag: str, default: float = 0.0) -> float:
        """The number in the child of that tag."""
        return self.numbers(tag, str(default), count=1)[0]

    def vector(self, tag: str, default: str = "0 0 0") -> np.ndarray:
        """The three numbers (3,) in the child of that tag."""
        return np.array(self.numbers(tag, default, count=3))


def _link(root: Node) -> Node:
    """The root, every element with its owner; SceneError where they are nested too deep."""
    level = [root]
    for _ in range(MOST_DEPTH):
        for owner in level:
            for node in owner.nodes():
                node.owner = owner
        level = [node for owner in level for node in owner.nodes()]
    if level:
        raise SceneError(f"elements nested deeper than {MOST_DEPTH}, this is no OpenSim model")
    return root


def read_xml(path: Path) -> Node:
    """The root element of an XML file; two colons in a name, which XML forbids, become two
    underscores.

    SceneError if the file is missing, unreadable, no XML, or beyond the limits of this module.
    """
    try:
        with path.open("rb") as file:
            data = file.read(MOST_BYTES + 1)
        if len(data) > MOST_BYTES:
            raise SceneError(f"more than {MOST_BYTES / 1e6:.0f} MB, this is no OpenSim model")
        builder = ElementTree.TreeBuilder(element_factory=Node)
        parser = defusedxml.ElementTree.DefusedXMLParser(target=builder, forbid_dtd=True)
        try:
            data.decode("utf-8")
        except UnicodeDecodeError:
            # Of a file that says UTF-8, or nothing, and is in Latin-1: OpenSim reads these too.
            said = rb"\s*<\?xml[^>]*encoding=[\"'](?!utf-?8)"
            if not re.match(said, data, flags=re.IGNORECASE):
                data = data.decode("latin-1").encode("utf-8")
        parser.feed(data.replace(b"::", b"__"))  # nine published models have such names
        return _link(cast("Node", parser.close()))
    except OSError as error:
        reason = f"cannot read the model: {error.strerror}"
    except SceneError as error:
        reason = str(error)
    except defusedxml.DefusedXmlException:
        reason = "has a DOCTYPE or entities, which no model needs; delete the declaration"
    except (ElementTree.ParseError, ValueError, LookupError) as error:  # of an unknown encoding
        reason = f"not well-formed XML: {' '.join(str(error).split())[:100]}"
    raise SceneError(f"{path}: {reason}") from None


_DEEPEST = 50  # parts of a path to a component
SPLINES = ("SimmSpline", "NaturalCubicSpline", "natCubicSpline")  # older names of the same spline
# Of polynomials of several coordinates: OpenSim's own fits have at most 6 and 9.
MOST_COORDINATES = 6
HIGHEST_ORDER = 9
BESIDE = ("coordinates", "axis", "scale")  # what stands beside a function in an element


class Reading:
    """A model that is being read from its element ``<Model>``, and what the file calls its parts.

    ``bodies`` are plain names, unlike each other, by absolute path; ``bare`` those of bodies by the
    name that the file gives them; ``offsets`` and ``stations`` are other frames, and points, by
    absolute path; ``wraps`` are what paths go around by name, ``contacts`` contact geometry by
    path; ``called`` are full names of coordinates by the file's.
    """

    def __init__(self, model: OsimModel, element: Node) -> None:
        self.model = model
        self.bodies = {"/ground": GROUND}
        self.bare = {GROUND: GROUND}
        self.offsets: dict[str, Node] = {}
        self.stations: dict[str, Node] = {}
        self.wraps: dict[str, list[Node]] = defaultdict(list)
        self.contacts: dict[str, Node] = {}
        self.called: dict[str, str] = {}
        self._known: dict[str, tuple[str, np.ndarray]] = {}
        self._open: list[str] = []  # frames whose places are being sought
        for node in cast("Iterator[Node]", element.iter()):
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
            elif node.tag.startswith("Contact"):
                self.contacts[node.path] = node
            for shape in node.objects("WrapObjectSet"):
                self.wraps[shape.name].append(shape)
        model.bodies = list(self.bodies.values())

    def coordinate(self, name: str) -> str:
        """Full name of a coordinate that the file names bare or by its path; empty where none has
        it.
        """
        words = name.strip().split("/")
        return self.called.get("/".join(words[-2:]), self.called.get(words[-1], ""))

    def place(self, name: str, *, inside: str = "/") -> tuple[str, np.ndarray]:
        """Body and frame in it (4, 4) of a name, absolute or relative to the component
        ``inside``.
        """
        name = name.strip()
        guesses = [posixpath.normpath(posixpath.join(inside, name))]
        if "/" not in name:
            guesses += [f"/bodyset/{name}", f"/{name}", f"/componentset/{name}"]
        path = next((p for p in guesses if p in self.bodies or p in self.offsets), None)
        if path is None:
            raise SceneError(f"{inside}: there is no frame {name!r}; correct the socket")
        if path in self.bodies:
            return self.bodies[path], np.eye(4)
        if path in self._open or len(self._open) > _DEEPEST:
            raise SceneError(f"frame {path!r} is offset from itself; correct its parent")
        if path not in self._known:
            self._open.append(path)
            frame = self.offsets[path]
            if frame.tag == "StationDefinedFrame":
                self._known[path] = self._of_stations(frame)
            else:
                body, outer = self.place(socket(frame, "parent") or "..", inside=path)
                own = frame_at(frame.vector("translation"), frame.vector("orientation"))
                self._known[path] = body, outer @ own
            self._open.pop()
        return self._known[path]

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
        points = (found[key][1] for key in ("point_a", "point_b", "point_c"))
        transform = np.eye(4)
        transform[:3, :3] = _station_axes(frame, *points)
        body, transform[:3, 3] = found["origin_point"]
        return body, transform


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
            raise node.owner.error(
                f"{node.tag} needs as many y as x, and x that increase, got {len(x)} and {len(y)}"
            )
        return Curve(tuple(x), tuple(y), 3 if node.tag in SPLINES else 1)
    raise node.owner.error(
        f"a function {node.tag!r} is not in the table of functions; "
        "use a SimmSpline or a PolynomialFunction instead"
    )


def _read_multivariate(node):
    """A polynomial of several coordinates, its terms in the order of `exponents`."""
    dimension, order = int(node.number("dimension", 1)), int(node.number("order", 0))
    if not (1 <= dimension <= MOST_COORDINATES and 0 <= order <= HIGHEST_ORDER):
        words = f"of {dimension} coordinates and order {order}"
        raise node.owner.error(
            f"a polynomial {words}; at most {MOST_COORDINATES} and {HIGHEST_ORDER} are taken"
        )
    powers, coefficients = exponents(dimension, order), node.numbers("coefficients", "0")
    if len(coefficients) != len(powers):
        words = f"{len(powers)} coefficients are needed, got {len(coefficients)}"
        raise node.owner.error(
            f"a polynomial of {dimension} coordinates and order {order}: {words}"
        )
    terms = [(c, *row) for c, row in zip(coefficients, powers.tolist())]
    # Of zeros alone the constant says how many coordinates it is of.
    return Multivariate(tuple(term for term in terms if term[0]) or (terms[0],))
