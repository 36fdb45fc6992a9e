"""What overlaps at rest, as bones and muscles come from different sources: kept, resolved or refused."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from rbfmuscle.validation import SceneError

if TYPE_CHECKING:
    from rbfmuscle.simulation.stepper import MuscleStepper


# Depth [mm] below which nothing overlaps, and the movement [mm] below which a muscle has settled.
DEPTH = 0.02
SETTLED = 0.01
# Bones grow into a muscle by this much [mm] in one solve, so that contact never has to guess the way out.
GROWTH = 1.0
MOST_SOLVES = 60


def resolve_initial_overlap(stepper: MuscleStepper) -> None:
    """Deal with overlap at rest as the scene's ``[contact] initial`` says; for a muscle in its rest pose.

    ``"resolve"`` lets the bones grow from the muscle's surface to their true size while the model holds its
    shape and volume; the muscle gives way by the least that its own elasticity knows. ``"keep"`` measures
    every gap from the depth at rest.

    Raises
    ------
    SceneError
        With ``"error"``, naming muscle, bone and depth.
    """
    contacts, scene = stepper.contacts, stepper.scene
    least = scene.length(DEPTH)
    overlap = contacts.depths(stepper.model.contact_points())
    overlap = {b: depth for b, depth in overlap.items() if depth.max(initial=0.0) > least}
    if not overlap:
        _settle_rest_of(stepper)
        return
    if scene.contact.initial == "error":
        b = max(overlap, key=lambda key: overlap[key].max())
        count, depth = int((overlap[b] > least).sum()), overlap[b].max()
        raise SceneError(
            f"muscle {stepper.name!r} overlaps bone {contacts.names[b]!r} at rest: {count} points, "
            f"{depth:.3g} {scene.units} deep; set [contact] initial to 'resolve' or 'keep'"
        )
    for b, depth in overlap.items():
        contacts.allow(b, depth)
        action = "overlap_kept" if scene.contact.initial == "keep" else "overlap_resolved"
        stepper.report(contacts.names[b], int((depth > least).sum()), action)
    if scene.contact.initial == "resolve":
        _resolve(stepper, overlap)
    _settle_rest_of(stepper)


def _settle_rest_of(stepper):
    """Let the model bring out of bones what no contact point stands for, where that is to be resolved."""
    if stepper.scene.contact.initial == "resolve":
        stepper.model.settle(stepper.contacts)


def _resolve(stepper, overlap):
    contacts, model = stepper.contacts, stepper.model
    model.predict(contacts.poses, contacts.poses)
    deepest = max(float(depth.max()) for depth in overlap.values())
    growths = max(1, math.ceil(deepest / stepper.scene.length(GROWTH)))
    settled = stepper.scene.length(SETTLED)
    for k in range(MOST_SOLVES + growths):
        for b, depth in overlap.items():
            contacts.allow(b, depth * max(0.0, 1.0 - (k + 1) / growths))
        before = model.contact_points().copy()
        stepper.solve({})
        moved = np.linalg.norm(model.contact_points() - before, axis=1).max()
        if k + 1 >= growths and moved < settled:
            return
