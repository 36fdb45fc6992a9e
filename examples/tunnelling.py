"""# Tunnelling

A point that is on one side of a bone in one frame and on the other in the next has tunnelled: a
distance field, asked at the end alone, pushes it out on the wrong side. `[detect]` looks at the way
in between. A run never takes steps so large; here one muscle is taken through 40 degrees of
adduction in a single step, as a slow machine might.
"""

import math

import numpy as np
from pictures import folder, plot

import rbfmuscle as rm
from rbfmuscle.models import build_model
from rbfmuscle.scene.options import DetectOptions, TunnellingOptions
from rbfmuscle.simulation.contact import BoneContacts, BonesInReach
from rbfmuscle.simulation.group import Group
from rbfmuscle.simulation.stepper import MuscleStepper, Path

out = folder("tunnelling")
scene = rm.phantom_scene()
muscle = scene.muscle("adductor_posterior")
fields = {bone.name: rm.BoneSDF.from_mesh(bone.mesh) for bone in scene.bones}
rest, turned = {"hip.adduction": 0.0}, {"hip.adduction": math.radians(40.0)}


def step(action):
    """One step of 40 degrees: the points, and what was noticed."""
    scene.detect = DetectOptions(tunnelling=TunnellingOptions(action=action))
    model = build_model(muscle, scene, "pbd")
    reached = BonesInReach(list(fields), list(fields.values()))
    stepper = MuscleStepper(model, BoneContacts(reached, model.attached_bone), scene)
    Group([stepper]).step(Path.between(rest, turned, stepper.poses))
    _, events, _ = stepper.collect()
    for event in events:
        print(f"{action:8} {event.count:4} points at the {event.bone}: {event.action}")
    return model.contact_points().copy(), {event.action: event.count for event in events}


points, events = {}, {}
for action in ("report", "substep"):
    points[action], events[action] = step(action)

moved = np.linalg.norm(points["report"] - points["substep"], axis=1)
print(f"points on the wrong side were up to {moved.max():.1f} mm from where they belong")


def scatter(axes):
    for action, colour in (("report", "#d99a2b"), ("substep", "#2f6f8f")):
        axes.plot(points[action][:, 0], points[action][:, 1], ".", ms=2, color=colour, label=action)
    axes.set(xlabel="x [mm]", ylabel="y [mm]", aspect="equal", title="the muscle from above")
    axes.legend()


plot(out / "points.png", scatter, size=(6.0, 4.5))

# The check of this page: points go through where nothing is done; none stays beyond where they are
# brought back.
assert events["report"]["reported"] > 20
assert "unresolved" not in events["substep"]
assert "halved" in events["substep"]
