"""Polynomials of muscles' lengths over coordinates, and the file of them that OpenSim reads."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

import numpy as np

from rbfmuscle.scene.joints.functions import exponents

ARM_WEIGHT = 1.0 / 3.0  # one mm of a length weighs as much as this many mm/rad of a moment arm
FOLDS = 5  # parts of the poses that are left out in turn to choose the order


@dataclass(frozen=True)
class FittedPath:
    """A polynomial for a muscle's length over coordinates (full names); minus its derivatives are
    the moment arms.

    ``order`` is the largest sum of exponents; ``coefficients`` are those of the terms in
    `exponents`, for coordinates in radians or scene units [scene unit].
    """

    muscle: str
    coordinates: tuple[str, ...]
    order: int
    coefficients: np.ndarray

    def length(self, values: np.ndarray) -> np.ndarray:
        """Length (n,) at coordinates (n, d)."""
        return _rows(values, self.order)[0] @ self.coefficients

    def arms(self, values: np.ndarray) -> np.ndarray:
        """Moment arms (n, d) at coordinates (n, d)."""
        return (_rows(values, self.order)[1:] @ self.coefficients).T


def _rows(values, order):
    """Terms (1 + d, n, m) of the length, then of the moment arm of each coordinate."""
    values = np.asarray(values, dtype=float)
    powers = exponents(values.shape[1], order)
    rows = [np.prod(values[:, None, :] ** powers, axis=2)]
    for axis in range(values.shape[1]):
        lower = powers.copy()
        lower[:, axis] = np.maximum(lower[:, axis] - 1, 0)
        rows.append(-powers[:, axis] * np.prod(values[:, None, :] ** lower, axis=2))
    return np.array(rows)


def fit_path(
    muscle: str,
    coordinates: tuple[str, ...],
    values: np.ndarray,
    lengths: np.ndarray,
    arms: np.ndarray,
    *,
    radian: np.ndarray | None = None,
    most: int = 7,
) -> FittedPath:
    """Fit a polynomial to lengths (n,) and, by its derivatives, to moment arms (n, d).

    ``values`` (n, d) are the coordinates [radian or scene unit], of which ``radian`` (d,), 1 by
    default, weighs as much as one radian, whatever the scene's unit. The order, at most ``most``,
    is the one whose fit without a fifth of the poses, each in turn, errs least there; there are
    always more equations than terms.
    """
    count, dimension = values.shape
    weights = np.r_[1.0, ARM_WEIGHT * (np.ones(dimension) if radian is None else radian)][:, None]
    wanted = weights * np.vstack([lengths, arms.T])
    group, best = np.arange(count) % FOLDS, (np.inf, 1, np.empty(0))
    for order in range(1, most + 1):
        if order > 1 and 1.5 * len(exponents(dimension, order)) > 0.8 * count * (1 + dimension):
            break
        rows = weights[:, :, None] * _rows(values, order)
        error = 0.0
        for fold in range(FOLDS):
            out = group == fold
            left_out = rows[:, out] @ _solve(rows[:, ~out], wanted[:, ~out])
            error += np.sum((left_out - wanted[:, out]) ** 2)
        if error < best[0]:
            best = (error, order, _solve(rows, wanted))
    return FittedPath(muscle, coordinates, *best[1:])


def _solve(rows, wanted):
    """Coefficients by least squares; columns are scaled, as powers of coordinates differ by orders
    of magnitude.
    """
    matrix = rows.reshape(-1, rows.shape[2])
    size = np.maximum(np.linalg.norm(matrix, axis=0), 1e-300)
    return np.linalg.lstsq(matrix / size, wanted.ravel(), rcond=None)[0] / size


def write_paths(
    file: Path,
    fitted: list[FittedPath],
    metre: float,
    turning: dict[str, bool],
    targets: Mapping[str, str],
) -> None:
    """Write paths as the set of ``FunctionBasedPath`` that OpenSim loads.

    ``metre`` is its length in scene units; ``turning`` says which coordinates are no shifts, which
    are in metres there. ``targets`` are the paths of coordinates in the OpenSim model; the others
    have the names of the scene.
    """
    add = ElementTree.SubElement
    root = ElementTree.Element("OpenSimDocument", Version="40600")
    paths = add(root, "Set_FunctionBasedPath_")
    objects = add(paths, "objects")
    add(paths, "groups")
    for path in fitted:
        units = np.array([1.0 if turning[name] else metre for name in path.coordinates])
        powers = exponents(len(path.coordinates), path.order)
        numbers = path.coefficients * np.prod(units**powers, axis=1) / metre
        item = add(objects, "FunctionBasedPath", name=f"/forceset/{path.muscle}")
        function = add(add(item, "length_function"), "MultivariatePolynomialFunction")
        own = {name: "/jointset/" + name.replace(".", "/", 1) for name in path.coordinates}
        names = [targets.get(name, own[name]) for name in path.coordinates]
        add(item, "coordinate_paths").text = " ".join(names)
        add(function, "coefficients").text = " ".join(repr(float(value)) for value in numbers)
        add(function, "dimension").text = str(len(path.coordinates))
        add(function, "order").text = str(path.order)
    ElementTree.indent(root)
    ElementTree.ElementTree(root).write(file, encoding="UTF-8", xml_declaration=True)
