"""Settings of an RBF muscle, and what is known of it at rest, found once: where its centres and
samples lie, the fit that its field is made by, and what holds its points.
"""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import replace
from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import AfterValidator, Field
from pydantic_core import PydanticCustomError
from scipy.spatial import cKDTree

from rbfmuscle.cache import content_key, load_arrays, store_arrays
from rbfmuscle.geometry.arrays import Floats, Integers
from rbfmuscle.geometry.exact_distance import ExactDistance
from rbfmuscle.geometry.frames import RestFrame, principal_axes
from rbfmuscle.geometry.surfaces import mesh_volume
from rbfmuscle.implicit.extraction import extract_surface
from rbfmuscle.implicit.field import FieldFit
from rbfmuscle.implicit.kernels import get_kernel
from rbfmuscle.implicit.placement import GREEDY_LARGEST, SurfaceSample, cached_sample
from rbfmuscle.implicit.selection import BOUND, choose_epsilon, spacing, surface_error
from rbfmuscle.scene.muscles import attachment_frames, ordered_muscle
from rbfmuscle.scene.objects import Muscle, from_mm
from rbfmuscle.scene.options import NotNegative, Table
from rbfmuscle.scene.scene import Scene
from rbfmuscle.surface.drawing import RestState
from rbfmuscle.validation import NumericalWarning, SceneError, UsageError

FEWEST_CENTRES = 4  # a linear polynomial in space has four coefficients


def _known_bound(condition: float) -> float:
    if 0.0 < condition < 1.0:
        raise ValueError("condition must be at least 1, or 0 for no bound")
    return condition


def _enough_centres(count: int) -> int:
    if 0 < count < FEWEST_CENTRES:
        raise ValueError(f"centres must be at least {FEWEST_CENTRES}, or 0 for as many as it needs")
    return count


def _known_kernel(name: str) -> str:
    try:
        get_kernel(name)
    except UsageError as error:
        raise PydanticCustomError("unknown_key", "{reason}", {"reason": str(error)}) from None
    return name


class RBFOptions(Table):
    """``[muscle.model]`` of an RBF muscle.

    ``centres``, where none are given, follow from the muscle's area, and are more where the surface
    at rest would err by more than ``rest_error`` (RMS; 0 for 0.5 mm, or a tenth of the muscle's
    thickness where that is less), and ``epsilon`` (a kernel's shape parameter) from the error at
    rest. A ridge keeps the ``condition`` of every fit below a bound, 0 for 1e10 where the kernel
    has a shape parameter and none where not. ``samples`` of the surface meet the bones: the
    vertices of a mesh that has as many. ``nodes`` of the elastic solid that carries the centres,
    and the greatest number of ``iterations`` of a
    solve. Fibres shorten without resistance from their length in the scan to 1 / ``slack_ratio`` of
    it (1: no slack); beyond, the solid is stiffer along them than across by ``fibre_ratio``, a
    ratio of Young's moduli. ``surface`` is shown by a mesh of the ``material`` that is
    brought onto the level set, by the same mesh ``embedded`` in the solid without a field, or by
    ``marching`` cubes; ``resolution`` is the number of edges or cells along the longest side, 0 for
    the input mesh.
    """

    hints: ClassVar[Mapping[str, str]] = {
        "placement": "remove it: centres lie where a fit misses the surface"
    }
    centres: Annotated[int, Field(ge=0, le=20_000), AfterValidator(_enough_centres)] = 0
    rest_error: NotNegative = 0.0
    samples: Annotated[int, Field(ge=50, le=50_000)] = 6000
    nodes: Annotated[int, Field(ge=30, le=3000)] = 300
    iterations: Annotated[int, Field(ge=1, le=1000)] = 150
    slack_ratio: Annotated[float, Field(ge=1.0, le=5.0)] = 1.8
    surface: Literal["material", "embedded", "marching"] = "material"
    resolution: Annotated[int, Field(ge=0, le=1000)] = 0
    kernel: Annotated[str, AfterValidator(_known_kernel)] = "cubic"
    epsilon: NotNegative = 0.0
    condition: Annotated[NotNegative, AfterValidator(_known_bound)] = 0.0
    fibre_ratio: Annotated[float, Field(ge=1.0, le=1e4)] = 1.5


# Area for each centre [mm²], from which their number follows where the scene names none, and the
# least number.
AREA_FOR_EACH = 212.0
LEAST_CENTRES = 150
# A field at rest that is looked at before it is used: cells along its longest side, and the share
# of the mesh's volume by which its level zero may be off.
CELLS, VOLUME_BOUND = 48, 0.2
# What the surface at rest may err by where the scene says nothing: a length [mm], or a share of the
# muscle's thickness.
REST_ERROR, REST_SHARE = 0.5, 0.1
# How fast the error falls with the centres, taken low; trials of their number, and the most, in the
# usual number.
FALL = 1.2
TRIALS = 5
MOST_CENTRES = 4.0
# What is aimed at, in what is wanted: the shown mesh adds its own.
AIM = 0.97
# Part of the names under which numbers of centres are kept: raise it when the way to find them
# changes.
SEARCH = 4
SEED = 0


def choose_centres(
    muscle: Muscle, scene: Scene, options: RBFOptions, *, known_only: bool = False
) -> tuple[int, str]:
    """How many centres a muscle has, and why: as many as the scene says, else as its area and the
    error at rest ask for.

    The number is kept on disk; with ``known_only`` nothing is fitted, and where it is not on disk
    it is the least that it can be.
    """
    if options.centres:
        return options.centres, "as given"
    area_for_each = AREA_FOR_EACH * from_mm(1.0, scene.units) ** 2
    usual = max(LEAST_CENTRES, int(round(muscle.mesh.area / area_for_each, -1)))
    # What the surface at rest may err by, RMS [scene unit]: as asked for, or by the muscle's size.
    thickness = 2.0 * float(muscle.mesh.volume) / float(muscle.mesh.area)
    by_size = min(from_mm(REST_ERROR, scene.units), REST_SHARE * thickness)
    wanted = options.rest_error or by_size
    frame = RestFrame(np.asarray(muscle.mesh.vertices, dtype=float))
    fit = (
        get_kernel(options.kernel).identity,
        round(options.epsilon * frame.size, 9),
        options.condition,
        options.samples,
        SEED,
    )
    key = content_key(
        frame.local,
        np.asarray(muscle.mesh.faces),
        ("centres", SEARCH, usual, round(wanted / frame.size, 9), *fit),
    )
    found = load_arrays(key)
    if found is None and known_only:
        return usual, "by its area; more where the rest error asks for them"
    if found is None:
        count, error = _search_centres(muscle, frame, options, usual, wanted)
        found = {"count": np.array(count), "error": np.array(error / frame.size)}
        store_arrays(key, found)
    count, error = int(found["count"]), float(found["error"]) * frame.size
    how = "by its area" if count == usual else f"more than the {usual} of its area"
    met = "met" if error <= wanted else "not met"
    return count, f"{how}, rest error {error:.2g}, {wanted:.2g} {scene.units} wanted: {met}"


def _search_centres(
    muscle: Muscle, frame: RestFrame, options: RBFOptions, usual: int, wanted: float
) -> tuple[int, float]:
    """The number of centres that errs little enough, or the best within reach, and its error."""
    most = min(int(MOST_CENTRES * usual), GREEDY_LARGEST)
    count = usual
    tried = []
    for _ in range(TRIALS):
        centres, _, fit = place_points(muscle, frame, options, count)
        error = _rest_miss(frame, centres, fit)
        tried.append((error > wanted, count if error <= wanted else error, count, error))
        if error <= AIM * wanted or count >= most:
            break
        # Infinite where no fit is to be had, or next to nothing is wanted.
        grown = min(count * (error / (AIM * wanted)) ** (1.0 / FALL), float(most))
        count = min(most, max(count + 20, 10 * int(np.ceil(grown / 10))))
    return min(tried)[2:]


def _rest_miss(frame: RestFrame, centres: SurfaceSample, fit: FieldFit) -> float:
    """How far the mesh's vertices lie from the field's surface, RMS [scene unit]."""
    points = frame.points(centres.points)
    try:
        field = fit.fit(points, frame.directions(centres.normals))
    except (ValueError, np.linalg.LinAlgError):
        return np.inf
    return surface_error(field, frame.points(frame.local), float(spacing(points).mean()))


def place_points(
    muscle: Muscle, frame: RestFrame, options: RBFOptions, count: int
) -> tuple[SurfaceSample, SurfaceSample, FieldFit]:
    """Centres and samples of a muscle in the coordinates of its frame, and their fit in the
    scene's.
    """
    faces = np.asarray(muscle.mesh.faces)
    centres = cached_sample(frame.local, faces, count, "greedy")
    samples = cached_sample(frame.local, faces, options.samples, "even")
    fit = _choose_fit(muscle.name, frame, faces, options, centres, samples)
    if options.condition or (fit.kernel.has_epsilon and not options.epsilon):
        _refuse_broken(muscle.name, frame, faces, fit, centres)
    return centres, samples, fit


def _choose_fit(
    name: str,
    frame: RestFrame,
    faces: Integers,
    options: RBFOptions,
    centres: SurfaceSample,
    samples: SurfaceSample,
) -> FieldFit:
    """The kernel, and its shape parameter where the scene leaves it open: by the error at the
    samples at rest.
    """
    kernel = get_kernel(options.kernel)
    fit = FieldFit(
        kernel,
        options.epsilon or 1.0,
        options.condition or (BOUND if kernel.has_epsilon else np.inf),
    )
    if not kernel.hermite:
        warnings.warn(
            f"muscle {name!r}: kernel {kernel.name!r} is C{kernel.smoothness} only; the field is "
            "fitted to values on and off the surface, with three centres a point, in place "
            "of normals",
            NumericalWarning,
            stacklevel=6,
        )
    if not kernel.has_epsilon or options.epsilon:
        return fit
    try:
        # In the muscle's own frame, so that a scene that is turned chooses the same.
        chosen = choose_epsilon(
            centres.points,
            centres.normals,
            fit,
            held_out=samples.points,
            distance=ExactDistance(frame.local, faces).signed_distance,
        )
    except np.linalg.LinAlgError as error:
        raise SceneError(f"muscle {name!r}: {error}") from None
    return replace(fit, epsilon=chosen.epsilon / frame.size)


def _refuse_broken(
    name: str, frame: RestFrame, faces: Integers, fit: FieldFit, centres: SurfaceSample
) -> None:
    """Raise where the level zero at rest is open, in more sheets than one, or of another volume."""
    local = replace(fit, epsilon=fit.epsilon * frame.size)
    shape = f" and epsilon {fit.epsilon:.3g}" if fit.kernel.has_epsilon else ""
    said = f"muscle {name!r}: kernel {fit.kernel.name!r} with {len(centres.points)} centres{shape}"
    bound = ", a greater condition" if np.isfinite(fit.condition) else ""
    remedy = (
        f"take kernel 'cubic', more centres{bound}, or another epsilon (rbfmuscle kernels "
        "ranks them)"
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NumericalWarning)
        try:
            field = local.fit(centres.points, centres.normals)
            found = extract_surface(field, points=centres.points, resolution=CELLS)
        except (ValueError, np.linalg.LinAlgError) as error:
            raise SceneError(f"{said} gives no surface at rest ({error}); {remedy}") from None
    off = found.volume / mesh_volume(frame.local, faces) - 1.0
    if found.components > 1 or abs(off) > VOLUME_BOUND:
        raise SceneError(
            f"{said} breaks at rest: {found.components} sheets, {100 * off:+.3g} % of volume; "
            f"{remedy}"
        )


# A patch smaller than the spacing of the centres still has to hold the muscle against turning.
LEAST_ATTACHED = 4


def measure_rest(muscle: Muscle, scene: Scene, options: RBFOptions) -> RestState:
    """Measure a muscle; SceneError if no centre is left free to move."""
    frame = RestFrame(np.asarray(muscle.mesh.vertices, dtype=float))
    count, _ = choose_centres(muscle, scene, options)
    centres, samples, fit = place_points(muscle, frame, options, count)
    bones, attached_bone = _find_holders(muscle, scene, frame, centres.points, samples.points)
    if (attached_bone[: len(centres.points)] >= 0).all():
        raise SceneError(
            f"muscle {muscle.name!r}: every centre lies on an attachment; nothing is free to move"
        )
    return RestState(
        frame.points(centres.points),
        frame.directions(centres.normals),
        frame.points(samples.points),
        samples.control_faces,
        fit,
        fit.parts(centres.points),
        bones,
        attached_bone,
        float(muscle.mesh.volume),
        # Cells along the muscle's own axes are smaller than along the scene's, and turn with the
        # scene.
        frame.directions(principal_axes(samples.points)),
    )


def _find_holders(
    muscle: Muscle, scene: Scene, frame: RestFrame, centres: Floats, samples: Floats
) -> tuple[list[str], Integers]:
    """The bones that hold a muscle, and which of them, by its position, holds each centre, then
    each sample; -1 where none does.
    """
    names = sorted(attachment_frames(scene.bones, muscle))
    patches = [np.asarray(attachment.vertices) for attachment in muscle.attachments]
    numbers = np.array(
        [names.index(attachment.attachment_frame) for attachment in muscle.attachments]
    )
    owner = np.full(len(frame.local), -1)
    for number, patch in zip(numbers, patches):
        owner[patch] = number
    used = np.unique(owner[owner >= 0])
    place = np.full(len(names) + 1, -1)
    place[used] = np.arange(len(used))
    owner, numbers = place[owner], place[numbers]
    tree = cKDTree(frame.local)
    nearest = tree.query(centres)[1]
    held_by = owner[nearest]
    for number, patch in zip(numbers, patches):
        if number >= 0 and np.isin(nearest, patch).sum() < LEAST_ATTACHED:
            _claim(held_by, number, cKDTree(frame.local[patch]).query(centres)[0])
    return [names[b] for b in used], np.concatenate([held_by, owner[tree.query(samples)[1]]])


def _claim(held_by: Integers, number: int, distance: Floats) -> None:
    """Give a bone the centres nearest to its patch, but none that a bone next to it needs."""
    held = np.bincount(held_by[held_by >= 0])
    left = LEAST_ATTACHED
    for centre in np.argsort(distance, kind="stable"):
        own = held_by[centre]
        if own >= 0 and own != number:
            if held[own] <= LEAST_ATTACHED:
                continue
            held[own] -= 1
        held_by[centre] = number
        left -= 1
        if left == 0:
            return


def solved_points(muscle: Muscle, scene: Scene, options: RBFOptions) -> str:
    """How many centres a muscle will have, and why."""
    count, why = choose_centres(ordered_muscle(muscle)[0], scene, options, known_only=True)
    return f"{count} centres ({why})"
