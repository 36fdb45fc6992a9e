"""The kernel table: values, derivatives and definiteness of every row."""

import mpmath as mp
import numpy as np
import pytest
import trimesh
from scipy.spatial.distance import cdist

from rbfmuscle.implicit.field import RBFField
from rbfmuscle.implicit.fitting import exponents
from rbfmuscle.implicit.kernels import KERNELS, get_kernel, register_kernel
from rbfmuscle.studies.kernels import study_kernels
from rbfmuscle.validation import UsageError

mp.mp.dps = 50


def binomial(beta, sign):
    return lambda s: sign * (1 + s * s) ** mp.mpf(beta)


def cut(function):
    return lambda s: function(s) if s < 1 else mp.mpf(0)


# written from the literature, independently of the table
LITERAL = {
    "linear": lambda s: -s,
    "cubic": lambda s: s**3,
    "quintic": lambda s: -(s**5),
    "septic": lambda s: s**7,
    "thin_plate_spline": lambda s: s**2 * mp.log(s),
    "polyharmonic_4": lambda s: -(s**4) * mp.log(s),
    "gaussian": lambda s: mp.exp(-s * s),
    "multiquadric": binomial(0.5, -1),
    "inverse_multiquadric": binomial(-0.5, 1),
    "inverse_quadratic": binomial(-1, 1),
    "generalised_multiquadric": binomial(1.5, 1),
    "matern_12": lambda s: mp.exp(-s),
    "matern_32": lambda s: (1 + s) * mp.exp(-s),
    "matern_52": lambda s: (1 + s + s**2 / 3) * mp.exp(-s),
    "matern_72": lambda s: (1 + s + 2 * s**2 / 5 + s**3 / 15) * mp.exp(-s),
    "wendland_c0": cut(lambda s: (1 - s) ** 2),
    "wendland_c2": cut(lambda s: (1 - s) ** 4 * (4 * s + 1)),
    "wendland_c4": cut(lambda s: (1 - s) ** 6 * (35 * s**2 + 18 * s + 3) / 3),
    "wendland_c6": cut(lambda s: (1 - s) ** 8 * (32 * s**3 + 25 * s**2 + 8 * s + 1)),
    "wendland_51": cut(lambda s: (1 - s) ** 5 * (5 * s + 1)),
    "buhmann": cut(lambda s: 12 * s**4 * mp.log(s) - 21 * s**4 + 32 * s**3 - 12 * s**2 + 1),
    "skala_cervenka": lambda s: s**2 * (s ** mp.mpf(1.8) - 1),
}


def literal_radial(name, s, k):
    """k-th radial function by 50-digit differences of the literal formula."""
    s = mp.mpf(float(s))
    d = [mp.diff(LITERAL[name], s, n) if n else LITERAL[name](s) for n in range(k + 1)]
    if k == 0:
        return d[0]
    if k == 1:
        return d[1] / s
    return (d[2] - d[1] / s) / s**2


def radial(kernel, k):
    """The k-th radial function, of s."""
    return lambda s: kernel.radial(s * s, k + 1)[k]


@pytest.mark.parametrize("k", range(3))
@pytest.mark.parametrize("name", KERNELS)
def test_radial_functions_against_fifty_digits(name, k):
    kernel = KERNELS[name]
    s = np.array([1e-3, 0.01, 0.1, 0.25, 0.3, 0.5, 0.7, 0.8, 0.9, 0.95, 1.1, 1.7, 3.0, 6.0, 20.0])
    values = radial(kernel, k)(s)
    exact = np.array([float(literal_radial(name, x, k)) for x in s])
    size = np.abs(exact)
    if (
        name == "buhmann"
    ):  # the four terms cancel towards s = 1, so relative to the value at the centre
        size = np.maximum(size, np.abs(kernel.table[k]).max())
    if name == "skala_cervenka":  # difference of two terms, zero near s = 1
        size = np.maximum(size, 2.0 * s ** (2.0 - 2 * k))
    if name in (
        "thin_plate_spline",
        "polyharmonic_4",
    ):  # sum of a logarithm and a constant, zero in between
        size = np.maximum(size, np.abs(kernel.table[k]).max() * s ** float(kernel.table[k, 0]))
    # exp(-s^2): the rounding of s^2 alone costs s^2 eps
    bound = 1e-14 * np.maximum(1, s * s / 20 if name == "gaussian" else 1)
    assert (np.abs(values - exact) <= bound * size + 1e-300).all()


@pytest.mark.parametrize("name", KERNELS)
def test_values_at_zero_are_limits_and_finite_where_there_are_none(name):
    kernel = KERNELS[name]
    for k, (value,) in enumerate(kernel.radial(np.zeros(1), 3)):
        near = float(literal_radial(name, 1e-9, k))
        if kernel.smoothness >= 2 * k:
            # the next term of the expansion is of order s (log s), its factor at most 1e4
            assert abs(near - value) <= 1e-3 * max(1, abs(value)) or name == "skala_cervenka"
        else:
            assert abs(near) > 19 and np.isfinite(value)
    assert kernel.phi(0.0) == kernel.radial(np.zeros(1), 1)[0]


@pytest.mark.parametrize("name", KERNELS)
def test_epsilon_multiplies_the_distance(name):
    kernel = KERNELS[name]
    r = np.array([0.1, 0.4, 2.2])
    assert np.allclose(kernel.phi(r, 0.5), kernel.phi(0.5 * r), rtol=1e-14)
    h = 1e-5
    slope = (kernel.phi(r + h, 0.5) - kernel.phi(r - h, 0.5)) / (2 * h)
    assert np.allclose(0.25 * radial(kernel, 1)(0.5 * r) * r, slope, rtol=1e-7, atol=1e-9)
    assert kernel.compact == (LITERAL[name](mp.mpf(2)) == 0)
    if kernel.compact:
        assert kernel.phi(0.999 / 0.3, 0.3) >= 0
        assert kernel.phi([1 / 0.3, 5.0, 1e60], 0.3).tolist() == [0, 0, 0]


def least_eigenvalue(kernel, points, degree):
    """Of the kernel matrix in the null space of the polynomials."""
    matrix = kernel.phi(cdist(points, points), 1.3)
    block = np.prod(points[:, None] ** exponents(degree), axis=2).T
    if len(block):
        basis = np.linalg.qr(block.T, mode="complete")[0][:, len(block) :]
        matrix = basis.T @ matrix @ basis
    return np.linalg.eigvalsh(matrix)[0]


@pytest.mark.parametrize("name", KERNELS)
def test_kernel_is_conditionally_definite_of_its_order(name):
    points = np.random.default_rng(0).uniform(-1, 1, (40, 3))
    assert least_eigenvalue(KERNELS[name], points, KERNELS[name].degree) > 0
    if name in ("cubic", "multiquadric", "skala_cervenka"):
        assert least_eigenvalue(KERNELS[name], points, KERNELS[name].degree - 1) < 0


def test_a_kernel_that_is_no_name_is_refused_as_such():
    with pytest.raises(UsageError, match="given by its name"):
        get_kernel(lambda s: s**3)
    with pytest.raises(UsageError, match="unknown kernel 'cubik', did you mean 'cubic'"):
        get_kernel("cubik")


def sech(s):
    return 1 / np.cosh(s)


def sech_first(s):
    return -np.tanh(s) / np.cosh(s) / s


def sech_second(s):
    return (1 - 2 / np.cosh(s) ** 2 + np.tanh(s) / s) / np.cosh(s) / s**2


@pytest.fixture
def outside():
    """Kernels that a test registers are unknown after it."""
    known = dict(KERNELS)
    yield lambda name, *functions, **facts: register_kernel(
        name, *functions, **{"order": 0, "smoothness": 99, **facts}
    )
    KERNELS.clear()
    KERNELS.update(known)


@pytest.mark.parametrize(
    "name", ["linear", "thin_plate_spline", "gaussian", "matern_52", "wendland_c4", "buhmann"]
)
def test_a_kernel_given_as_functions_is_the_built_in_one(outside, name):
    own = KERNELS[name]
    functions = [radial(own, k) for k in range(3 if own.hermite else 2)]
    copy = outside(
        "copy", *functions, order=own.order, smoothness=own.smoothness, compact=own.compact
    )
    s = np.concatenate([[0.0], np.geomspace(1e-8, 1e4, 997)])
    usual = np.linspace(0.5, 1.0, 20, endpoint=False)
    size = 0.0
    for k, function in enumerate(functions):
        exact, found = function(s), radial(copy, k)(s)
        bound = np.abs(function(usual)).max()
        finite = (s > 0.0) | (own.smoothness >= 2 * k)
        assert np.isfinite(found).all()
        size = np.maximum(np.maximum(np.abs(exact), bound), size)
        assert (np.abs(found[finite] - exact[finite]) <= 1e-11 * size[finite]).all()
        size = np.where(s > 0, size / np.maximum(s, 1e-99) ** 2, 0.0)


def test_a_field_is_the_same_with_a_kernel_given_as_functions(outside):
    gaussian = KERNELS["gaussian"]
    outside("copy", *(radial(gaussian, k) for k in range(3)))
    normals = np.random.default_rng(3).normal(size=(60, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    at = np.random.default_rng(4).uniform(-1.5, 1.5, (300, 3))
    own, copy = (
        RBFField.fit_hermite(normals, normals, kernel=name, epsilon=1.5)
        for name in ("gaussian", "copy")
    )
    # the condition, 1e4, times what is lost by sampling, 1e-12
    assert np.abs(own(at) - copy(at)).max() < 1e-7
    assert np.abs(own.gradient(at) - copy.gradient(at)).max() < 1e-7


def test_a_registered_kernel_is_studied_beside_the_others(outside):
    outside("sech", sech, sech_first, sech_second)
    ball = trimesh.creation.icosphere(3, 10.0)
    study = study_kernels(ball, kernels=["sech", "cubic"], centres=[60], resolution=24)
    errors = {row.kernel: row.rms for row in study.rows}
    # Both are near 0.012, with 60 centres; which is nearer hangs on where these lie.
    assert errors["sech"] == pytest.approx(errors["cubic"], rel=0.3)


def test_wrong_functions_of_a_kernel_are_refused(outside):
    with pytest.raises(UsageError, match="'cubic' is known already"):
        outside("cubic", sech, sech_first, sech_second)
    with pytest.raises(UsageError, match="letters, digits and _"):
        outside("a,b", sech, sech_first, sech_second)
    with pytest.raises(UsageError, match="C99, so it needs its function second"):
        outside("new", sech, sech_first)
    with pytest.raises(UsageError, match="first of a kernel is not the derivative of phi"):
        outside("new", sech, lambda s: -sech_first(s), sech_second)
    with pytest.raises(UsageError, match="second of a kernel is not the derivative of first"):
        outside("new", sech, sech_first, lambda s: sech_second(s) + 1e-4)
    with pytest.raises(
        UsageError, match="not the derivative of phi by s, divided by s, near s = 1"
    ):
        outside("new", lambda s: np.where(s < 1.01, sech(s), 0), sech_first, smoothness=0)
    with pytest.raises(UsageError, match="phi of a kernel is not finite near s = 1"):
        outside("new", lambda s: np.where(s < 1.01, 1.0, np.inf), sech_first, smoothness=0)
    with pytest.raises(UsageError, match="phi of a kernel must be finite at s = 0, got nan"):
        outside("new", lambda s: np.sin(s) / s * sech(s), sech_first, smoothness=0)
    with pytest.raises(UsageError, match="takes an array"):
        outside("new", lambda s: 1.0, sech_first, smoothness=0)
    assert "new" not in KERNELS


def test_what_is_kept_of_a_kernel_goes_by_its_formula(outside):
    first = outside("one", sech, sech_first, sech_second).identity
    KERNELS.pop("one")
    functions = [radial(KERNELS["matern_72"], k) for k in range(3)]
    assert outside("one", *functions, smoothness=6).identity != first
    assert KERNELS["cubic"].identity == "cubic"
