"""The flat range of the Gaussian: what each way of solving gives as epsilon goes to 0.

    python benchmarks/flat_range.py [--exact] [--seeds]

First table: 80 centres in the unit ball, values of a field like a distance, largest error at 400 other points.
``truncated`` drops singular values below 1e-14, ``oversampled`` fits 400 samples by a truncated SVD, ``default`` does
so with the library's default kernel; ``flat`` are the two fits of FlatField; ``exact`` solves with 250 digits (mpmath).
Second table: a smoother function, where the flat range is the best one. Then noise, with the smoothing
chosen, and what flat fits do with other centres.
"""

import argparse
import itertools
import time
import warnings

import numpy as np
from scipy import linalg

from rbfmuscle.implicit.field import RBFField
from rbfmuscle.implicit.fit.fitting import solve_least_squares
from rbfmuscle.implicit.fit.flat_limit import FlatField
from rbfmuscle.implicit.fit.systems import collocation, frame
from rbfmuscle.implicit.kernels.table import get_kernel
from rbfmuscle.validation import NumericalWarning, UsageError

EPSILONS = (1.0, 0.5, 0.2, 0.05, 0.01)
SMOOTH_EPSILONS = (1.0, 0.5, 0.3, 0.2, 0.1, 0.05, 0.01, 0.0)
CENTRES, SAMPLES, UNSEEN = 80, 400, 400


def ball(rng, count):
    """Points spread evenly at random in the unit ball: (count, 3)."""
    points = rng.normal(size=(count, 3))
    points /= np.linalg.norm(points, axis=1)[:, None]
    return points * rng.random((count, 1)) ** (1 / 3)


def data(seed=0):
    """Centres, samples and unseen points."""
    rng = np.random.default_rng(seed)
    centres, unseen = ball(rng, CENTRES), ball(rng, UNSEEN)
    return centres, ball(rng, SAMPLES), unseen


def distance_like(points):
    """Nearly the distance from a sphere, with a wave on it."""
    wave = 0.1 * np.sin(3 * points[:, 0]) * np.cos(2 * points[:, 1])
    return np.sqrt((points**2).sum(axis=1) + 0.05) - 0.6 + wave


def smooth(points):
    """An entire function."""
    return np.exp(0.5 * points[:, 0]) * np.cos(points[:, 1] + 0.5 * points[:, 2])


def errors(target, epsilon, seed=0):
    """Largest error of each way at the unseen points, by its name."""
    centres, samples, unseen = data(seed)
    values, sampled, expected = target(centres), target(samples), target(unseen)
    gaussian = get_kernel("gaussian")

    def worst(found):
        return float(np.abs(found - expected).max())

    out = {"epsilon": epsilon}
    if epsilon:
        # both sides in the coordinates that the field itself would use
        place = frame(centres)
        matrix, _ = collocation(centres, centres, gaussian, epsilon, -1, *place)
        rows, _ = collocation(unseen, centres, gaussian, epsilon, -1, *place)
        out["condition"] = float(np.linalg.cond(matrix))
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", linalg.LinAlgWarning)
            out["direct"] = worst(rows @ linalg.solve(matrix, values))
        out["truncated"] = worst(rows @ solve_least_squares(matrix, values)[0])
        field = RBFField.fit_least_squares(samples, sampled, centres, kernel=gaussian, epsilon=epsilon)
        out["oversampled"] = worst(field(unseen))
    out["default"] = worst(RBFField.fit_least_squares(samples, sampled, centres)(unseen))
    try:
        field = FlatField.fit(centres, values, epsilon=epsilon)
        out["flat"], out["uncertain"] = worst(field(unseen)), field.error
        fitted = FlatField.fit_least_squares(samples, sampled, centres, epsilon=epsilon)
        out["flat oversampled"] = worst(fitted(unseen))
    except UsageError:  # not flat: the direct solve is sound there
        out["flat"], out["flat oversampled"] = out["direct"], out["oversampled"]
    return out


def exact_error(target, epsilon):
    """Largest error at the unseen points of the interpolant computed with 250 digits."""
    import mpmath

    centres, _, unseen = data()
    with mpmath.workdps(250):
        square = mpmath.mpf(epsilon) ** 2
        centres_, unseen_ = ([[mpmath.mpf(float(c)) for c in p] for p in rows] for rows in (centres, unseen))

        def row(x):
            return [mpmath.exp(-square * sum((a - b) ** 2 for a, b in zip(x, c))) for c in centres_]

        matrix = mpmath.matrix([row(x) for x in centres_])
        weights = mpmath.lu_solve(matrix, mpmath.matrix([*map(float, target(centres))]))
        found = np.array([float(mpmath.fdot(row(x), weights)) for x in unseen_])
    return float(np.abs(found - target(unseen)).max())


def show(rows):
    """Print rows as a Markdown table."""
    names = list(dict.fromkeys(name for row in rows for name in row))
    print("| " + " | ".join(names) + " |\n|" + "---|" * len(names))
    for row in rows:
        cells = (row.get(name, "") for name in names)
        print("| " + " | ".join(cell if isinstance(cell, str) else f"{cell:.3g}" for cell in cells) + " |")


def ellipsoid(count):
    """Points spread evenly over an ellipsoid, as a sphere's, and normals of that sphere."""
    i = np.arange(count) + 0.5
    z, angle = 1 - 2 * i / count, np.pi * (1 + 5**0.5) * i
    ring = np.sqrt(1 - z * z)
    normals = np.c_[ring * np.cos(angle), ring * np.sin(angle), z]
    return normals * [1.0, 1.3, 0.7], normals


def noisy_fits():
    """Name and fit (smoothing -> RMS error, smoothing) of some noisy data."""
    rng = np.random.default_rng(0)
    centres, _, unseen = data()
    noisy = smooth(centres) + 0.05 * rng.normal(size=CENTRES)
    for kernel, epsilon in (("cubic", 1.0), ("matern_52", 1.5), ("gaussian", 0.5)):

        def fit_values(smoothing, kernel=kernel, epsilon=epsilon):
            field = RBFField.fit(centres, noisy, kernel=kernel, epsilon=epsilon, smoothing=smoothing)
            return float(np.sqrt(np.mean((field(unseen) - smooth(unseen)) ** 2))), field.smoothing

        yield f"{CENTRES} values, {kernel}", fit_values
    exact, normals = ellipsoid(150)
    moves = rng.normal(size=exact.shape)
    for size, derivatives in itertools.product((0.0, 0.03, 0.1), ("all", "normal")):

        def fit_surface(smoothing, derivatives=derivatives, points=exact + size * moves):
            field = RBFField.fit_hermite(points, normals, smoothing=smoothing, derivatives=derivatives)
            value, gradient = field.value_and_gradient(ellipsoid(1000)[0])
            return float(np.sqrt(np.mean((value / np.linalg.norm(gradient, axis=1)) ** 2))), field.smoothing

        yield f"surface of {len(exact)}, noise {size}, {derivatives}", fit_surface


def noise():
    """Values with noise of 0.05, points of a surface with noise: RMS error by smoothing."""
    rows = []
    for name, fit in noisy_fits():
        best, at = min(fit(smoothing) for smoothing in np.geomspace(1e-8, 10, 37))
        (gcv, chosen), (loo, _) = fit("gcv"), fit("loo")
        rows.append({"data": name, "none": fit(0.0)[0], "gcv": gcv, "loo": loo, "best of 37": best})
        rows[-1] |= {"smoothing by gcv": chosen, "best smoothing": at}
    return rows


def other_points(seeds=8):
    """Other points and functions like a distance: the worst ratio to the oversampled Gaussian."""
    functions = {
        "with a wave": distance_like,
        "smoother": lambda p: np.sqrt((p * p).sum(axis=1) + 0.1) - 0.5,
        "cone": lambda p: np.linalg.norm(p, axis=1) - 0.6,
        "ellipsoid": lambda p: np.sqrt((p * p / np.array([0.81, 0.36, 0.16])).sum(axis=1) + 0.02) - 1.0,
    }
    rows = []
    for name, target in functions.items():
        flat, default = [], []
        for seed in range(seeds):
            found = [errors(target, epsilon, seed) for epsilon in EPSILONS]
            flat += [row["flat oversampled"] / row["oversampled"] for row in found]
            default.append(found[0]["default"] / min(row["oversampled"] for row in found))
        rows.append({"function": name, "flat, same epsilon": max(flat), "median": float(np.median(flat))})
        rows[-1]["default, best epsilon"] = max(default)
    return rows


def growth():
    """Estimated error of the limit by the number of centres, for the entire function."""
    kernels = ("gaussian", "inverse_multiquadric", "multiquadric")
    rows = []
    for count in (20, 80, 150, 200, 300):
        centres = ball(np.random.default_rng(1), count)
        fits = {kernel: FlatField.fit(centres, smooth(centres), kernel=kernel) for kernel in kernels}
        rows.append({"centres": count} | {kernel: field.error for kernel, field in fits.items()})
    return rows


def fit_times():
    """Seconds of a direct and of a flat fit, and of evaluating each at the unseen points, least of five."""
    centres, _, unseen = data()
    values = smooth(centres)
    makers = {
        "direct": lambda: RBFField.fit(centres, values, kernel="gaussian", epsilon=1.0),
        "flat": lambda: FlatField.fit(centres, values),
        "smoothed": lambda: RBFField.fit(centres, values, smoothing=0.1),
        "smoothing chosen": lambda: RBFField.fit(centres, values, smoothing="gcv"),
    }
    rows = []
    for name, make in makers.items():
        fits, calls = [], []
        for _ in range(5):
            start = time.perf_counter()
            field = make()
            middle = time.perf_counter()
            field(unseen)
            fits.append(middle - start)
            calls.append(time.perf_counter() - middle)
        rows.append(f"{name}: fit {1e3 * min(fits):.3g} ms, {UNSEEN} points {1e3 * min(calls):.3g} ms")
    return rows


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--exact", action="store_true", help="solve with 250 digits too (half a minute)")
    parser.add_argument("--seeds", action="store_true", help="other points and functions too (two minutes)")
    options = parser.parse_args()
    warnings.simplefilter("ignore", NumericalWarning)
    for target, epsilons in ((distance_like, EPSILONS), (smooth, SMOOTH_EPSILONS)):
        rows = [errors(target, epsilon) for epsilon in epsilons]
        for row in rows:
            if options.exact and row["epsilon"]:
                row["exact"] = exact_error(target, row["epsilon"])
        print(f"\n{target.__doc__}\n")
        show(rows)
    for part in (noise, growth, *([other_points] if options.seeds else [])):
        print(f"\n{part.__doc__}\n")
        show(part())
    print("\n" + "\n".join(fit_times()))


if __name__ == "__main__":
    main()
