"""Numbers and functions as ``.osim`` files write them."""

import itertools
import math

from rbfmuscle.importers.opensim.xml import Node
from rbfmuscle.scene.joints.functions import (
    Constant,
    Function,
    Linear,
    PiecewiseLinear,
    Polynomial,
    Spline,
    scaled,
)
from rbfmuscle.validation import SceneError

# Older names of the same spline.
SPLINES = ("SimmSpline", "NaturalCubicSpline", "natCubicSpline")
FUNCTIONS = (
    "Constant",
    "LinearFunction",
    "PolynomialFunction",
    "PiecewiseLinearFunction",
    "MultiplierFunction",
    *SPLINES,
)


def numbers(text: str, *, place: str, count: int | None = None) -> list[float]:
    """Return the finite numbers in a text, or raise, naming the place.

    Parameters
    ----------
    count : int, optional
        How many there must be.
    """
    words = text.replace(",", " ").split()
    try:
        values = [float(word) for word in words]
    except ValueError:
        raise SceneError(f"{place}: {text.strip()[:60]!r} is no list of numbers; correct it") from None
    if not all(math.isfinite(value) for value in values):
        raise SceneError(f"{place}: {text.strip()[:60]!r} is not finite; correct it")
    if count is not None and len(values) != count:
        raise SceneError(f"{place}: {count} numbers are needed, got {text.strip()[:60]!r}")
    return values


def vector(node: Node, tag: str, default: str, *, place: str) -> list[float]:
    """Return the three numbers of a child element."""
    return numbers(node.word(tag, default), place=f"{place}: {tag}", count=3)


def truth(node: Node, tag: str, default: bool = False) -> bool:
    """Return the value of a child element that says true or false."""
    return node.word(tag, str(default)).lower() in ("true", "1", "yes")


def find_function(node: Node | None) -> Node | None:
    """Return the element of the function that stands in a node, directly or one level deeper; None where none is."""
    if node is None:
        return None
    known = [
        inner
        for inner in node.nodes()
        if inner.tag in FUNCTIONS or inner.tag.endswith(("Function", "Spline"))
    ]
    if known:
        return known[0]
    for inner in node.nodes():
        if inner.tag in ("function", "coupled_coordinates_function") and len(inner):
            return inner.nodes()[0]
    return None


def read_function(node: Node, *, place: str, depth: int = 0) -> Function:
    """Return the function that an element describes.

    Raises
    ------
    SceneError
        If it is of a kind that the table of functions lacks, or its numbers are wrong.
    """

    def values(tag):
        return numbers(node.word(tag), place=f"{place}: {tag}")

    if node.tag == "Constant":
        return Constant((values("value") or [0.0])[0])
    if node.tag == "LinearFunction":
        found = values("coefficients") or [1.0, 0.0]
        return Linear(tuple(found[:-1]), found[-1])
    if node.tag == "PolynomialFunction":
        return Polynomial(tuple(values("coefficients")))
    if node.tag == "MultiplierFunction":
        inner = find_function(node)
        if inner is None or depth > 20:
            raise SceneError(f"{place}: a MultiplierFunction without a function; give it one")
        scale = (values("scale") or [1.0])[0]
        return scaled(read_function(inner, place=place, depth=depth + 1), scale)
    if node.tag == "PiecewiseLinearFunction" or node.tag in SPLINES:
        x, y = values("x"), values("y")
        if not x or len(x) != len(y) or any(b <= a for a, b in itertools.pairwise(x)):
            raise SceneError(
                f"{place}: {node.tag} needs as many y as x, and x that increase, got {len(x)} and {len(y)}"
            )
        return Spline(tuple(x), tuple(y)) if node.tag in SPLINES else PiecewiseLinear(tuple(x), tuple(y))
    raise SceneError(
        f"{place}: a function {node.tag!r} is not in our table; put a SimmSpline or a PolynomialFunction in its place"
    )
