"""Muscles that contract: their slack length and tendon on the mesh, their activation along a
motion.
"""

import itertools
import math
from collections.abc import Mapping

import numpy as np

from rbfmuscle.geometry.arrays import Booleans, Floats, box_size
from rbfmuscle.geometry.exact_distance import ExactDistance
from rbfmuscle.geometry.surfaces import geodesic, surface_graph
from rbfmuscle.scene.frames import interpolate, read_storage
from rbfmuscle.scene.objects import Motion, Muscle
from rbfmuscle.scene.options import (
    TENDON_STRAIN,
    ActivationTable,
    Contraction,
    ContractionTable,
    TendonRegionTable,
)
from rbfmuscle.validation import SceneError, did_you_mean

# A fibre that lies farther outside than this share of the muscle's diagonal is one of another
# muscle or frame: lines that run on to the bone, beyond the mesh of the muscle, stay below.
OUTSIDE = 0.1
# No activation changes by more in one sub-step; smaller steps change the shapes that are reached by
# less than 0.1 mm (tests/contract/test_contraction.py).
STEP = 0.1
SETTLING = 4  # further solves after activation has changed while no bone moved


def contraction_keys(given: Mapping[str, object], *, muscle: str) -> ContractionTable | None:
    """The checked keys of one muscle, or None where it has none; a value None counts as not
    given.
    """
    found = {key: value for key, value in given.items() if value is not None}
    if not found:
        return None
    table = ContractionTable.build(found, context=f"muscle {muscle!r} ")
    if isinstance(table.activation, ActivationTable):
        table = table.model_copy(update={"activation": _read_activation(table.activation, muscle)})
    return table


def _read_activation(given: ActivationTable, muscle: str) -> ActivationTable:
    """The values of a table's file, of the column of a muscle where none is named."""
    if given.file is None:
        return given
    context = f"muscle {muscle!r} activation: "
    _, labels, rows = read_storage(given.file, context=context)
    name = given.column or muscle
    forms = (name, f"{name}/activation", f"/forceset/{name}/activation", f"{name}.activation")
    column = next((labels.index(form) for form in forms if form in labels), -1)
    if column < 0 or "time" not in labels:
        wanted = name if column < 0 else "time"
        raise SceneError(
            f"{context}{given.file} has no column {wanted!r}, {did_you_mean(wanted, labels)}"
        )
    values = {
        "times": rows[:, labels.index("time")].tolist(),
        "values": rows[:, column].tolist(),
    }
    return ActivationTable.build(values, context=f"{context}{given.file} column {name!r}: ")


def make_contraction(muscle: Muscle) -> Contraction:
    """What the keys of a muscle come to on its mesh.

    SceneError on fibres outside it, or a tendon that covers all or nothing.
    """
    keys = muscle.contraction or ContractionTable()
    vertices = np.asarray(muscle.mesh.vertices, dtype=float)
    distance = ExactDistance(vertices, np.asarray(muscle.mesh.faces))
    limit = OUTSIDE * box_size(vertices)
    for number, line in enumerate(muscle.fibres or ()):
        outside = float(distance.signed_distance(np.asarray(line, dtype=float)).max())
        if outside > limit:
            raise SceneError(
                f"muscle {muscle.name!r} fibres: polyline {number} leaves the muscle, by "
                f"{outside:.4g} at worst "
                f"({limit:.4g} is allowed); check its unit and frame"
            )
    stretch, tendon = keys.fibre_stretch_at_rest, keys.tendon_region
    strain = TENDON_STRAIN if tendon is None else tendon.strain
    return Contraction(stretch or 1.0, _tendon(muscle, tendon), strain, stretch is not None)


def _tendon(muscle: Muscle, given: TendonRegionTable | None) -> Booleans:
    """Vertices (n,) that are tendon: up to a length from the attachments."""
    free = np.ones(len(muscle.mesh.vertices), dtype=bool)
    if given is None:
        return ~free
    context = f"muscle {muscle.name!r} tendon_region"
    bones = [attachment.bone for attachment in muscle.attachments]
    if given.at is not None and given.at not in bones:
        raise SceneError(
            f"{context}: not attached to {given.at!r}, {did_you_mean(given.at, bones)}"
        )
    start = np.concatenate([a.vertices for a in muscle.attachments if given.at in (None, a.bone)])
    tendon = geodesic(surface_graph(muscle.mesh), start) <= given.length
    free[np.concatenate([a.vertices for a in muscle.attachments])] = False
    if not (free & ~tendon).any():
        raise SceneError(f"{context}: covers all of the muscle, leave a belly that can contract")
    if not (free & tendon).any():
        raise SceneError(f"{context}: holds no vertex beyond the attachments, make it longer")
    return tendon


def activation_curve(muscle: Muscle, motion: Motion) -> Floats:
    """Activation (n,) of one muscle in each frame, 0 to 1; of one that goes by time the first value
    where the motion has no times, as that of a single pose.
    """
    given = 0.0 if muscle.contraction is None else muscle.contraction.activation
    if not isinstance(given, ActivationTable):
        values = np.atleast_1d(given)
        progress = motion.numbers / max(motion.whole - 1, 1)
        return np.interp(progress, np.linspace(0.0, 1.0, len(values)), values)
    values = np.array(given.values)
    if given.frames is not None:
        return np.interp(motion.numbers, given.frames, values)
    if motion.times is None or given.times is None:
        return np.full(len(motion), values[0])
    return np.interp(motion.times, given.times, values)


class Activations:
    """Activations of the muscles that contract in the frame loop, and the sub-steps that they need.

    ``here`` is that of each muscle now, 0 before the first frame; ``target``, set by hand as a
    window does, overrides the scene's own curves.
    """

    def __init__(self, muscles: list[Muscle], motion: Motion) -> None:
        contracting = [muscle for muscle in muscles if muscle.contraction is not None]
        self.curves = {muscle.name: activation_curve(muscle, motion) for muscle in contracting}
        self.here = dict.fromkeys(self.curves, 0.0)
        self.target: dict[str, float] = {}

    def at(self, frame: int) -> dict[str, float]:
        """Activation of each muscle that contracts in a frame."""
        return {
            name: self.target.get(name, float(curve[min(frame, len(curve) - 1)]))
            for name, curve in self.curves.items()
        }

    def refine(
        self, frame: int, stops: list[dict[str, float]]
    ) -> tuple[list[dict[str, float]], list[dict[str, float]]]:
        """Sub-steps short enough in activation too.

        ``stops`` are coordinates: where the bones are, then the ends of the sub-steps that they
        need. Returned are these with further ones between them, and for each but the first the
        activation by muscle.
        """
        if not self.curves:
            return stops, []
        goal, start = self.at(frame), self.here
        most = max(abs(goal[name] - start[name]) for name in goal)
        wanted, steps = math.ceil(most / STEP - 1e-9), len(stops) - 1
        if steps == 0 and wanted == 0:
            return stops, []
        each = max(1, math.ceil(wanted / max(1, steps)))
        fine = [stops[0]]
        for before, after in list(itertools.pairwise(stops)) or [(stops[0], stops[0])]:
            fine += [interpolate(before, after, k / each) for k in range(1, each)] + [after]
        count = len(fine) - 1
        values = [interpolate(start, goal, k / count) for k in range(1, count + 1)]
        self.here = goal
        if steps == 0:
            # Bones that stand still leave the muscles nothing else to settle in.
            fine, values = fine + [stops[0]] * SETTLING, values + [goal] * SETTLING
        return fine, values
