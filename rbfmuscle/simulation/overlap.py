"""What overlaps at rest, as bones and muscles come from different sources: kept, resolved or
refused.
"""

import math

import numpy as np

from rbfmuscle.geometry.arrays import Floats
from rbfmuscle.scene.objects import from_mm
from rbfmuscle.simulation.contact import BoneContacts
from rbfmuscle.simulation.stepper import MuscleStepper
from rbfmuscle.validation import SceneError

# Depth [mm] below which nothing overlaps, and the movement [mm] below which a muscle has settled.
DEPTH = 0.02
SETTLED = 0.01
# Bones grow into a muscle by this much [mm] in one solve, so that contact never has to guess the
# way out.
GROWTH = 1.0
MOST_SOLVES = 60  # after the bones have grown


def resolve_initial_overlap(stepper: MuscleStepper) -> None:
    """Deal with overlap at rest as the scene's ``[contact] initial`` says; for a muscle in its rest
    pose.

    ``"resolve"`` lets the bones grow from the muscle's surface to their true size while the model
    holds its shape and volume, ``"keep"`` measures every gap from the depth at rest, ``"error"``
    raises SceneError.
    """
    contacts, scene = stepper.contacts, stepper.scene
    least, initial = from_mm(DEPTH, scene.units), scene.contact.initial
    overlap = _depths_at_rest(contacts, stepper.model.contact_points(), least)
    for b, depth in sorted(overlap.items(), key=lambda found: -found[1].max()):
        count, bone = int((depth > least).sum()), contacts.bones.names[b]
        if initial == "error":
            raise SceneError(
                f"muscle {stepper.name!r} overlaps bone {bone!r} at rest: {count} points, "
                f"{depth.max():.3g} "
                f"{scene.units} deep; set [contact] initial to 'resolve' or 'keep'"
            )
        contacts.allow(b, depth)
        stepper.report(bone, count, "overlap_kept" if initial == "keep" else "overlap_resolved")
    if initial == "resolve" and overlap:
        _resolve(stepper, overlap)


def _depths_at_rest(contacts: BoneContacts, points: Floats, least: float) -> dict[int, Floats]:
    """Depth (n,) of each free contact point (n, 3) in each bone that one is deeper in than
    ``least``.
    """
    found = {}
    for row, field in enumerate(contacts.bones.fields):
        depth = np.zeros(len(points))
        distance = field.distance(points[contacts.free], contacts.placed[row], reach=0.0)
        depth[contacts.free] = np.maximum(-distance, 0.0)
        if depth.max(initial=0.0) > least:
            found[row] = depth
    return found


def _resolve(stepper: MuscleStepper, overlap: dict[int, Floats]) -> None:
    """Solve while the depth (n,) that is allowed in each bone shrinks to zero, until no contact
    point moves; an event where that does not happen.
    """
    contacts, model = stepper.contacts, stepper.model
    model.predict(contacts.poses, contacts.poses)
    deepest = max(float(depth.max()) for depth in overlap.values())
    growths = max(1, math.ceil(deepest / from_mm(GROWTH, stepper.scene.units)))
    settled = from_mm(SETTLED, stepper.scene.units)
    for k in range(MOST_SOLVES + growths):
        for b, depth in overlap.items():
            contacts.allow(b, depth * max(0.0, 1.0 - (k + 1) / growths))
        before = model.contact_points().copy()
        stepper.solve({})
        moved = np.linalg.norm(model.contact_points() - before, axis=1).max()
        if k + 1 >= growths and moved < settled:
            return
    stepper.report("", MOST_SOLVES + growths, "iteration_cap")
