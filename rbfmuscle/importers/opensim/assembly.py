"""Constraints and loops of a model: what fixes a pose is met at rest, what is left out is named."""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from rbfmuscle.importers.opensim.model import (
    GROUND,
    ModelJoint,
    OsimModel,
    Walk,
    joints_between,
)
from rbfmuscle.scene.joints.joint import Coupling, ordered
from rbfmuscle.validation import SceneError

MOST_ROUNDS = 200  # of meeting the weld constraints; a few are enough where they can be met
LEAST_MOVE = 1e-12  # of a round that goes on [metre and radian]
CLOSED = 1e-9  # what is left of a weld constraint that is met [metre and radian]
NEAR = 1e-6  # a loop is closed where its ends are no farther apart [metre and radian]
STEP = 1e-6  # of the central differences [radian or metre]


def assemble(model: OsimModel) -> OsimModel:
    """The model, its weld constraints met at rest; what is left out or doubtful is named."""
    _order_couplings(model)
    _meet_welds(model)
    walk = model.walk()
    for joint in walk.left:
        _name_loop(model, walk, joint)
    for weld in model.welds:
        if weld not in walk.left:
            ends = f"{weld.parent} to {weld.child}"
            model.notes.append(f"{weld.name} is taken as a fixed joint, {ends}")
    for constraint in model.constraints:
        first, second = constraint.bodies
        names = _moving(joints_between(walk, first, second))
        depends = f"; {', '.join(names)} may break it" if names else ""
        model.doubts.append(f"{constraint.title} ({first} to {second}) is not taken{depends}")
    for body in walk.roots:
        if body != GROUND:
            model.doubts.append(
                f"body {body!r} is joined to the ground by no joint: it stands where its frame "
                "is, with all that hangs on it"
            )
    return model


def _order_couplings(model):
    """Couplings in order; one of a coordinate that another moves, or of a ring, is left out."""
    kept: list[Coupling] = []
    for coupling in model.couplings:
        try:
            kept = ordered([*kept, coupling])
        except SceneError as error:
            of = ", ".join(coupling.of)
            model.doubts.append(
                f"the coupler of {coupling.coordinate} to {of} is not taken: {error}"
            )
    model.couplings = kept


def _meet_welds(model):
    """Change the rest values of coordinates as little as the weld constraints need, as OpenSim does
    when it opens a model.
    """
    walk = model.walk(welds=False)
    rings = [joints_between(walk, weld.parent, weld.child) for weld in model.welds]
    welds = [weld for weld, ring in zip(model.welds, rings) if ring]
    followers = {coupling.coordinate for coupling in model.couplings}
    known = model.coordinates()
    wanted = {name for ring in rings for name in _moving(ring)}
    for coupling in reversed(model.couplings):
        wanted |= set(coupling.of) if coupling.coordinate in wanted else set()
    names = [n for n in known if n in wanted and n not in followers and not known[n].locked]
    if not welds:
        return
    start = np.array([known[name].rest for name in names])

    def apart(values):
        places = model.transforms(dict(zip(names, values.tolist())), welds=False)
        return np.concatenate([_apart(weld, places, {}) for weld in welds])

    values = _nearest_closed(apart, start) if names else start
    if np.abs(apart(values)).max() > CLOSED:
        off = apart(start).reshape(len(welds), 6)
        for weld, row in zip(welds, off):
            if np.abs(row).max() > NEAR:
                model.welds.remove(weld)
                model.doubts.append(
                    f"{weld.name} ({weld.parent} to {weld.child}) cannot be met, it is not taken: "
                    f"{1000.0 * np.linalg.norm(row[:3]):.3g} mm are between its frames"
                )
        return
    for joint in model.joints:
        for name, fact in joint.coordinates.items():
            full = f"{joint.name}.{name}"
            if full in names:
                rest = float(values[names.index(full)])
                joint.coordinates[name] = replace(fact, rest=rest)


def _nearest_closed(apart, start):
    """The values nearest to ``start`` (n,) at which nothing is apart, by Gauss and Newton."""
    values = start
    for _ in range(MOST_ROUNDS):
        slopes = np.stack(
            [
                (apart(values + e) - apart(values - e)) / (2 * STEP)
                for e in STEP * np.eye(len(start))
            ],
            axis=1,
        )
        wanted = slopes @ (values - start) - apart(values)
        target = start + np.linalg.lstsq(slopes, wanted, rcond=1e-9)[0]
        move = target - values
        values = values + move * min(1.0, 1.0 / max(np.abs(move).max(), 1e-300))
        if np.abs(move).max() < LEAST_MOVE:
            break
    return values


def _apart(joint, places, values):
    """Distance (3,) [metre] and turn (3,) [radian] between the ends of a joint."""
    between = np.linalg.inv(places[joint.parent] @ joint.across(values)) @ places[joint.child]
    return np.concatenate([between[:3, 3], Rotation.from_matrix(between[:3, :3]).as_rotvec()])


def _moving(joints: list[ModelJoint]) -> list[str]:
    """Full names of the coordinates of some joints."""
    return [f"{joint.name}.{name}" for joint in joints for name in joint.coordinates]


def _name_loop(model: OsimModel, walk: Walk, joint: ModelJoint) -> None:
    """Name a joint or a weld constraint that closes a loop, the loop, and what is open in it."""
    ring = joints_between(walk, joint.parent, joint.child)
    what = f"{joint.name} ({joint.parent} to {joint.child})"
    if joint.kind == "free":
        model.notes.append(f"{what} holds nothing: other joints hold both bodies; not taken")
        return
    loop = f"closes a loop with {', '.join(one.name for one in ring) or 'itself'}: not taken"
    off = _apart(joint, model.transforms(), model.resolved())
    gap = f", its ends are {1000.0 * np.linalg.norm(off[:3]):.3g} mm apart at rest"
    if np.abs(off).max() <= NEAR:
        gap = ", it is closed at rest"
    names = _moving(ring)
    moved = f"; {', '.join(names)} may open it" if names else ""
    (model.doubts if names or np.abs(off).max() > NEAR else model.notes).append(
        f"{what} {loop}{gap}{moved}"
    )
