"""Checks at the public edges, and the errors that the command line turns into exit codes."""

import difflib
import os
import struct
import zlib
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

# What libraries raise, besides errors of their own, of a file that is not as it should be.
BROKEN_FILE = (
    ArithmeticError,
    AttributeError,
    EOFError,
    LookupError,
    MemoryError,
    OSError,
    RuntimeError,
    TypeError,
    UnboundLocalError,
    ValueError,
    struct.error,
    zlib.error,
)


class RBFMuscleError(Exception):
    """Base of the errors meant for users: one line that names file, object, value and remedy.

    ``muscle`` is the name of the muscle that cannot be used, where it is one of a scene.

    Examples
    --------
    >>> issubclass(SceneError, RBFMuscleError), SceneError.exit_code
    (True, 3)
    """

    exit_code = 1
    muscle: str = ""


class UsageError(RBFMuscleError, ValueError):
    """The call itself is wrong (exit code 2).

    Examples
    --------
    >>> import rbfmuscle as rm
    >>> rm.model_kind("rbff")
    Traceback (most recent call last):
    rbfmuscle.validation.UsageError: unknown model 'rbff', did you mean 'rbf'?
    """

    exit_code = 2


class SceneError(RBFMuscleError, ValueError):
    """The scene file, or a name or number in it, is wrong (exit code 3).

    Examples
    --------
    >>> import rbfmuscle as rm
    >>> rm.phantom_scene().muscle("extenser")
    Traceback (most recent call last):
    rbfmuscle.validation.SceneError: unknown muscle 'extenser', did you mean 'extensor'?
    """

    exit_code = 3


class MeshError(RBFMuscleError, ValueError):
    """A mesh cannot be used (exit code 4).

    Examples
    --------
    >>> import rbfmuscle as rm
    >>> rm.study_kernels("femur.off")
    Traceback (most recent call last):
    rbfmuscle.validation.MeshError: femur.off: .off is not a mesh format, use .stl, .obj, .ply, ...
    """

    exit_code = 4


class SolveError(RBFMuscleError, RuntimeError):
    """A frame could not be solved; frames so far are kept (exit code 5), in memory as ``run``, a
    `Run`.

    Examples
    --------
    >>> SolveError("muscle 'biceps': frame 3 did not converge").exit_code
    5
    """

    exit_code = 5
    run: object = None


class LimitExceededError(RBFMuscleError, RuntimeError):
    """A limit of ``fail_on`` was exceeded, or not measured (exit code 6); everything is
    written.

    Examples
    --------
    >>> LimitExceededError("biceps: volume_error = 0.2 > 0.001 at frame 3").exit_code
    6
    """

    exit_code = 6


class MissingDependencyError(RBFMuscleError, ImportError):
    """An optional part (graphics, an extra) is missing (exit code 7).

    ``written`` are files that did not need it.

    Examples
    --------
    >>> MissingDependencyError("USD needs usd-core").exit_code, MissingDependencyError.written
    (7, ())
    """

    exit_code = 7
    written: Sequence[Path] = ()


class NotFiniteError(ValueError):
    """Numbers hold NaN or infinity; a solver's loop turns it into a `SolveError` that names muscle
    and frame.
    """


class SceneWarning(UserWarning):
    """A scene asks for something impossible, for instance bones moved into each other.

    Examples
    --------
    >>> import warnings
    >>> warnings.simplefilter("error", SceneWarning)  # such a scene is not run
    """


class NumericalWarning(UserWarning):
    """A result is usable but less accurate than asked; the message names the cause and the
    remedy.

    Examples
    --------
    >>> import warnings
    >>> warnings.simplefilter("error", NumericalWarning)
    """


MOST_NAMED = 40  # names that a message lists
LONGEST_SHOWN = 80  # characters of a value that a message shows


def shown(value: object, *, longest: int = LONGEST_SHOWN) -> str:
    """Return a value as a message shows it, cut where it is long."""
    try:
        text = value if isinstance(value, str) else repr(value)
    except (ValueError, RecursionError):  # numbers of thousands of digits have no decimal form
        text = f"a {type(value).__name__} too long to show"
    return text if len(text) <= longest else f"{text[: longest - 15]} ... {text[-10:]}"


def listed(names: Sequence[str], most: int, *, separator: str = ", ") -> str:
    """Return the first of some names as a message lists them, and how many more there are."""
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return separator.join(names[:most]) + more


def shown_path(path: str | os.PathLike[str]) -> str:
    """Return a path as a message shows it: whole, unless it is longer than paths are."""
    return shown(str(path), longest=400)


def read_text(path: Path, *, context: str) -> str:
    """Return the text of a file that a scene names, or raise SceneError that begins with
    ``place``.
    """
    if not os.path.isfile(path):
        raise SceneError(f"{context}{shown_path(path)}: cannot read it: no such file")
    try:
        return path.read_text(encoding="utf-8", errors="replace")
    except OSError as error:
        raise SceneError(f"{context}{path}: cannot read it: {error.strerror}") from None


def check_points(points: ArrayLike, *, name: str = "points") -> NDArray[np.float64]:
    """Return points as a finite, C-contiguous (n, 3) float64 array, or raise ValueError that calls
    them ``name``.
    """
    points = _as_floats(points, name)
    if points.ndim != 2 or points.shape[1] != 3:
        raise ValueError(f"{name} must have shape (n, 3), got {points.shape}")
    check_finite(points, name=name)
    return points


def _as_floats(values: ArrayLike, name: str) -> NDArray[np.float64]:
    try:
        return np.ascontiguousarray(values, dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        reason = " ".join(str(error).split())[:100]
        raise ValueError(f"{name} must be an array of numbers ({reason})") from None


def check_vectors(vectors: ArrayLike, count: int) -> NDArray[np.float64]:
    """Return (count, 3) finite float64 normals, one for each point."""
    vectors = check_points(vectors, name="normals")
    if len(vectors) != count:
        raise ValueError(f"normals must have one row a point ({count}), got {len(vectors)}")
    return vectors


def check_values(values: ArrayLike, count: int) -> NDArray[np.float64]:
    """Return (count,) finite float64 values, one for each point."""
    values = _as_floats(values, "values")
    if values.shape != (count,):
        raise ValueError(f"values must have shape ({count},), got {values.shape}")
    check_finite(values, name="values")
    return values


def check_finite(array: NDArray[np.generic], *, name: str) -> None:
    """Raise NotFiniteError (a ValueError) naming the first row that holds NaN or infinity."""
    if not np.isfinite(array).all():
        row = int(np.argwhere(~np.isfinite(array))[0][0])
        raise NotFiniteError(f"{name} must be finite, row {row} is {array[row]}")


def check_positive(value: float, *, name: str) -> float:
    """Return value as a finite float above zero."""
    value = float(value)
    if not (np.isfinite(value) and value > 0):
        raise ValueError(f"{name} must be a positive number, got {value}")
    return value


def check_mesh(
    vertices: ArrayLike, faces: ArrayLike, *, name: str = "mesh"
) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Return ``(vertices, faces)`` as (n, 3) float64 and (m, 3) int64.

    MeshError if the mesh is empty, has non-finite vertices or indices out of range.
    """
    try:
        vertices = check_points(vertices, name=f"vertices of {name}")
    except ValueError as error:
        raise MeshError(str(error)) from None
    faces = np.ascontiguousarray(faces, dtype=np.int64)
    if faces.ndim != 2 or faces.shape[1] != 3:
        raise MeshError(f"faces of {name} must have shape (m, 3), got {faces.shape}")
    if len(vertices) == 0 or len(faces) == 0:
        raise MeshError(f"{name} is empty ({len(vertices)} vertices, {len(faces)} faces)")
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise MeshError(f"faces of {name} point outside its {len(vertices)} vertices")
    return vertices, faces


def did_you_mean(word: object, known: Iterable[object]) -> str:
    """Return "did you mean 'x'?", or the list of what is known when nothing is near.

    Examples
    --------
    >>> did_you_mean("Cubik", ["cubic", "quintic"])
    "did you mean 'cubic'?"
    """
    names = [str(name) for name in known]
    lower = {name.lower(): name for name in names}
    near = difflib.get_close_matches(str(word).lower()[:100], lower, n=1, cutoff=0.5)
    if near:
        return f"did you mean {lower[near[0]]!r}?"
    if not names:
        return "there are none"
    return f"known: {listed([shown(name) for name in names], MOST_NAMED)}"
