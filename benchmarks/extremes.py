"""Every kernel at the extremes: right within a bound, or a warning or an error that names cause and
remedy.

``python benchmarks/extremes.py [--kernels a,b]`` fits an ellipsoid (half axes 3, 2 and 1) under
every extreme and says how many kernels are right, warned of, refused, or wrong without a word
("silent": the one outcome that must not occur).
"""

import argparse
import warnings

import numpy as np

from rbfmuscle.implicit.extraction import extract_surface
from rbfmuscle.implicit.field import FieldFit
from rbfmuscle.implicit.kernels import KERNELS, get_kernel
from rbfmuscle.implicit.selection import spacing
from rbfmuscle.validation import NumericalWarning

HALF = np.array([3.0, 2.0, 1.0])
# Shape parameters, in units of 1 / (mean distance to the nearest centre); numbers of centres and
# their bounds.
SHAPES = (1e-3, 1e-2, 0.1, 1.0, 10.0, 1e3)
COUNTS = {4: 1.0, 10: 1.0, 50: 0.5, 1000: 0.05}
OUTCOMES = ("right", "warned", "refused", "silent")


def spiral(count):
    """Points and normals on a spiral over the ellipsoid."""
    i = np.arange(count) + 0.5
    z = 1 - 2 * i / count
    angle, ring = np.pi * (1 + 5**0.5) * i, np.sqrt(1 - z * z)
    unit = np.column_stack([ring * np.cos(angle), ring * np.sin(angle), z])
    normals = unit / HALF
    return unit * HALF, normals / np.linalg.norm(normals, axis=1, keepdims=True)


def judge_at(size=1.0, shift=0.0):
    """What measures a field's surface at unseen points of a scaled and shifted ellipsoid, in
    shortest half axes.
    """
    unseen, true = spiral(997)

    def judge(field):
        value, gradient = field.value_and_gradient(unseen * size + shift)
        slope = np.einsum("ij,ij->i", gradient, true)
        # Where the field does not rise outwards there is no surface, or it is inside out.
        off = np.where(slope > 0.2, np.abs(value) / np.maximum(slope, 0.2), size)
        return float(np.sqrt((np.minimum(off, size) ** 2).mean()) / size)

    return judge


def sides_of(below, above, inside):
    """What judges by the share of points on the wrong side of the surface."""
    return lambda field: float(
        ((field(below) >= 0 if inside else field(below) > 0) | (field(above) <= 0)).mean()
    )


def cases():
    """Name, points, normals, epsilon times spacing, judge, bound of the error."""
    points, normals = spiral(200)
    for shape in SHAPES:
        yield f"epsilon h = {shape:g}", points, normals, shape, judge_at(), 0.1
    for size in (1e-6, 1e-3, 1e3, 1e6):
        yield f"coordinates of {size:g}", points * size, normals, 0.1, judge_at(size), 0.1
    yield "1e6 from the origin", points + 1e6, normals, 0.1, judge_at(1.0, 1e6), 0.1
    for count, bound in COUNTS.items():
        yield f"{count} centres", *spiral(count), 0.1, judge_at(), bound
    rng = np.random.default_rng(0)
    for noise in (0.01, 0.1):
        noisy = normals + noise * rng.normal(size=normals.shape)
        yield f"{100 * noise:g} % noise on normals", points, noisy, 0.1, judge_at(), 0.1
    yield (
        "single precision",
        points.astype(np.float32),
        normals.astype(np.float32),
        0.1,
        judge_at(),
        0.1,
    )
    near = points.copy()
    near[10] = near[20] + [1e-12, 0.0, 0.0]
    yield "two centres 1e-12 apart", near, normals, 0.1, judge_at(), 0.1
    twice = np.vstack([points, points[:1]]), np.vstack([normals, normals[:1]])
    yield "two centres in one place", *twice, 0.1, judge_at(), 0.1
    axis = np.linspace(0.0, 50.0, 12)
    side = np.stack(np.meshgrid(axis, axis, [0.0]), axis=-1).reshape(-1, 3)
    middle = 0.5 * (side[:-1] + side[1:]) + [0.0, 0.0, 0.05]
    two_sides = np.repeat([[0.0, 0.0, -1.0], [0.0, 0.0, 1.0]], len(side), axis=0)
    plate = np.vstack([side, side + [0.0, 0.0, 0.1]])
    yield (
        "thin plate, 0.1 of 50",
        plate,
        two_sides,
        0.1,
        sides_of(middle, middle + [0, 0, 0.2], True),
        0.2,
    )
    up = np.tile([0.0, 0.0, 1.0], (25, 1))
    grid = np.stack(np.meshgrid(np.arange(5.0), np.arange(5.0), [0.0]), axis=-1).reshape(-1, 3)
    for name, flat in (
        ("coplanar", grid),
        ("collinear", np.arange(25.0)[:, None] * [1.0, 0.0, 0.0]),
    ):
        between = 0.5 * (flat[:-1] + flat[1:])
        judge = sides_of(between - [0.0, 0.0, 0.2], between + [0.0, 0.0, 0.2], False)
        yield f"{name} centres", flat, up, 0.1, judge, 0.1


def outcome(kernel, points, normals, shape, judge, bound):
    """Outcome, error and what was said."""
    with warnings.catch_warnings(record=True) as heard:
        warnings.simplefilter("always", NumericalWarning)
        try:
            apart = spacing(np.unique(np.asarray(points, dtype=float), axis=0)).mean()
            field = FieldFit(get_kernel(kernel), shape / apart).fit(points, normals)
            error = judge(field)
        except (ValueError, np.linalg.LinAlgError) as failed:
            return "refused", None, str(failed)
    if heard:
        return "warned", error, str(heard[0].message)
    if error <= bound:
        return "right", error, ""
    try:  # what showing the surface says of it
        where = np.asarray(points, dtype=float)
        sheets = extract_surface(field, points=where, resolution=32).components
    except ValueError as failed:
        return "refused", error, str(failed)
    if sheets > 1:
        return "warned", error, f"{sheets} sheets"
    return "silent", error, ""


def study(kernels):
    """Rows of case, kernel, outcome, error, what was said."""
    for name, points, normals, shape, judge, bound in cases():
        for kernel in kernels:
            if name.startswith("epsilon") and not kernel.has_epsilon:
                continue
            yield name, kernel.name, *outcome(kernel, points, normals, shape, judge, bound)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kernels", default=",".join(KERNELS))
    rows = list(study([KERNELS[name] for name in parser.parse_args().kernels.split(",")]))
    for case in dict.fromkeys(row[0] for row in rows):
        found = [row for row in rows if row[0] == case]
        counts = ", ".join(f"{name} {sum(row[2] == name for row in found)}" for name in OUTCOMES)
        silent = ", ".join(row[1] for row in found if row[2] == "silent")
        print(f"{case}: {counts}{f': {silent}' if silent else ''}")


if __name__ == "__main__":
    main()
