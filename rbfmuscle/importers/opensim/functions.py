"""Functions as ``.osim`` files write them."""

import itertools

from rbfmuscle.importers.opensim.xml import Node
from rbfmuscle.scene.joints.functions import (
    Function,
    Linear,
    PiecewiseLinear,
    Polynomial,
    Spline,
    scaled,
)

# Older names of the same spline.
SPLINES = ("SimmSpline", "NaturalCubicSpline", "natCubicSpline")
# What stands beside a function in an element.
BESIDE = ("coordinates", "axis", "scale")


def read_function(node: Node | None) -> Function | None:
    """The function in an element, directly or in its child ``function``; None where there is none."""
    holder = node.child("function") if node is not None else None
    inside = node if holder is None else holder
    found = [inner for inner in inside.nodes() if inner.tag not in BESIDE] if inside is not None else []
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
        if isinstance(inner, Linear) and len(inner.slopes) == 1:  # OpenSim takes only a plain one for linear
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
