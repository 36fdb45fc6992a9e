"""Polynomials fitted to the lengths and moment arms of a muscle over its coordinates, as paths that OpenSim takes."""

import itertools
from dataclasses import dataclass
from pathlib import Path
from xml.sax.saxutils import escape

import numpy as np

# One mm of a length weighs as much as this many mm/rad of a moment arm.
ARM_WEIGHT = 1.0 / 3.0
# OpenSim's function takes up to six coordinates.
MOST_COORDINATES = 6


@dataclass(frozen=True)
class FittedPath:
    """A polynomial for a muscle's length; minus its derivatives are the moment arms.

    Attributes
    ----------
    muscle : str
    coordinates : tuple of str
        Full names, the order of the polynomial's arguments.
    order : int
        Largest sum of exponents.
    coefficients : (m,) ndarray
        Of the terms in `exponents`, for coordinates in radians or scene units [scene unit].
    """

    muscle: str
    coordinates: tuple[str, ...]
    order: int
    coefficients: np.ndarray

    def length(self, values: np.ndarray) -> np.ndarray:
        """Length (n,) at coordinates (n, d)."""
        return (
            _terms(np.asarray(values, float), exponents(len(self.coordinates), self.order))
            @ self.coefficients
        )

    def arms(self, values: np.ndarray) -> np.ndarray:
        """Moment arms (n, d) at coordinates (n, d)."""
        values, powers = np.asarray(values, float), exponents(len(self.coordinates), self.order)
        return np.stack(
            [-_slopes(values, powers, axis) @ self.coefficients for axis in range(values.shape[1])], axis=1
        )


def exponents(dimension: int, order: int) -> np.ndarray:
    """Return the exponents (m, d) of every term up to an order, the last coordinate's going fastest, as OpenSim's."""
    powers = itertools.product(range(order + 1), repeat=dimension)
    return np.array([power for power in powers if sum(power) <= order])


def _terms(values, powers):
    return np.prod(values[:, None, :] ** powers[None], axis=2)


def _slopes(values, powers, axis):
    lower = powers.copy()
    lower[:, axis] = np.maximum(lower[:, axis] - 1, 0)
    return powers[:, axis] * _terms(values, lower)


def fit_path(
    muscle: str,
    coordinates: tuple[str, ...],
    values: np.ndarray,
    lengths: np.ndarray,
    arms: np.ndarray,
    *,
    most: int = 7,
) -> FittedPath:
    """Fit a polynomial to lengths and, by its derivatives, to moment arms.

    The order is the one whose fit without a fifth of the poses, each in turn, errs least there.

    Parameters
    ----------
    values : (n, d) ndarray
        Coordinates [radian or scene unit].
    lengths : (n,) ndarray
    arms : (n, d) ndarray
    most : int
        Highest order tried; there are always more equations than terms.
    """
    count, dimension = values.shape
    best = None
    for order in range(1, most + 1):
        if 1.5 * len(exponents(dimension, order)) > 0.8 * count * (1 + dimension):
            break
        error = _left_out(values, lengths, arms, order)
        if best is None or error < best[0]:
            best = (error, order)
    order = best[1] if best is not None else 1
    return FittedPath(muscle, coordinates, order, _solve(values, lengths, arms, order))


def _left_out(values, lengths, arms, order):
    group, total = np.arange(len(values)) % 5, 0.0
    for fold in range(5):
        out = group == fold
        made = FittedPath(
            "", ("",) * values.shape[1], order, _solve(values[~out], lengths[~out], arms[~out], order)
        )
        total += np.sum((made.length(values[out]) - lengths[out]) ** 2)
        total += ARM_WEIGHT**2 * np.sum((made.arms(values[out]) - arms[out]) ** 2)
    return total


def _solve(values, lengths, arms, order):
    """Coefficients by least squares in coordinates from -1 to 1, written out in the coordinates themselves."""
    powers = exponents(values.shape[1], order)
    low, high = values.min(axis=0), values.max(axis=0)
    middle, half = 0.5 * (low + high), np.maximum(0.5 * (high - low), 1e-9)
    scaled = (values - middle) / half
    rows, right = [_terms(scaled, powers)], [lengths]
    for axis in range(values.shape[1]):
        rows.append(-ARM_WEIGHT * _slopes(scaled, powers, axis) / half[axis])
        right.append(ARM_WEIGHT * arms[:, axis])
    solution = np.linalg.lstsq(np.concatenate(rows), np.concatenate(right), rcond=None)[0]
    return _written_out(solution, powers, middle, half)


def _written_out(coefficients, powers, middle, half):
    """Coefficients for ``x`` from those for ``(x - middle) / half``."""
    order = int(powers.sum(axis=1).max())
    cube = np.zeros((order + 1,) * powers.shape[1])
    cube[tuple(powers.T)] = coefficients
    for axis in range(powers.shape[1]):
        shift = np.zeros(
            (order + 1, order + 1)
        )  # from the power of the scaled coordinate to those of the plain one
        for k in range(order + 1):
            plain = np.polynomial.polynomial.polypow([-middle[axis] / half[axis], 1.0 / half[axis]], k)
            shift[: len(plain), k] = plain
        cube = np.moveaxis(np.tensordot(shift, cube, axes=(1, axis)), 0, axis)
    return cube[tuple(powers.T)]


def write_paths(file: Path, fitted: list[FittedPath], metre: float, turning: dict[str, bool]) -> None:
    """Write paths as the set of ``FunctionBasedPath`` that OpenSim loads.

    Parameters
    ----------
    file : path
    fitted : list of FittedPath
    metre : float
        Scene units in a metre.
    turning : dict of str to bool
        Whether a coordinate is no shift: shifts are in metres there.
    """
    parts = [
        '<?xml version="1.0" encoding="UTF-8" ?>',
        '<OpenSimDocument Version="40600">',
        "<Set_FunctionBasedPath_>",
    ]
    parts.append("<objects>")
    for path in fitted:
        powers = exponents(len(path.coordinates), path.order)
        units = np.array([1.0 if turning[name] else metre for name in path.coordinates])
        numbers = path.coefficients * np.prod(units**powers, axis=1) / metre
        names = " ".join("/jointset/" + name.replace(".", "/", 1) for name in path.coordinates)
        parts += [
            f'<FunctionBasedPath name="/forceset/{escape(path.muscle)}">',
            f"<coordinate_paths>{escape(names)}</coordinate_paths>",
            "<length_function><MultivariatePolynomialFunction>",
            f"<coefficients>{' '.join(repr(float(value)) for value in numbers)}</coefficients>",
            f"<dimension>{len(path.coordinates)}</dimension><order>{path.order}</order>",
            "</MultivariatePolynomialFunction></length_function>",
            "</FunctionBasedPath>",
        ]
    parts += ["</objects>", "<groups />", "</Set_FunctionBasedPath_>", "</OpenSimDocument>"]
    file.write_text("\n".join(parts) + "\n", encoding="utf-8")
